//! Changes between passes: each is told as what it is.

use super::*;

#[test]
fn a_step_of_one_channel_is_no_jump_of_the_clock() {
    // Steps of 6 to 170 deg, each of one channel of one daughter or the same of all, and jumps of clocks by 2.5 to 20 ns,
    // after three of six passes. 100 ns are 108 deg at 3 MHz, and whole turns at 10 and 20 MHz.
    let steps_deg = [-108.7, 31.0, 59.0, -20.0, 6.0, 170.0, -85.0, 12.0];
    let changes: Vec<(usize, [f64; 3])> = (0..3)
        .flat_map(|c| steps_deg.map(|deg| std::array::from_fn(|k| if k == c { deg } else { 0.0 })))
        .chain([2.5, -4.0, 8.0, -12.0, 20.0].map(|ns| FREQUENCIES_HZ.map(|hz| -360e-9 * hz * ns)))
        .chain([-8.0, 12.0, 40.0, 170.0].map(|deg| [deg; 3]))
        .enumerate()
        .collect();
    changes.into_par_iter().for_each(|(number, turn_deg)| {
        let daughter = number % DAUGHTERS;
        let gains = gains(500 + number as u64);
        let passes = (0..6_u64).flat_map(|pass| {
            let gain = |c: usize, n: usize, _: f64| {
                let has_turned = pass >= 3 && n == daughter;
                gains[c][n] * Complex64::cis(if has_turned { turn_deg[c].to_radians() } else { 0.0 })
            };
            let seed = first_seed() + 100 * number as u64 + pass;
            Pass { strength: 4.0, ..plain(seed, &gain) }.solve(pass, &SolverConfig::default())
        });
        let events = instrument_events(&passes.collect::<Vec<_>>());
        let changed: Vec<usize> = (0..3).filter(|c| turn_deg[*c] != 0.0).collect();
        let is_of_clock = changed.len() == 3 && turn_deg[0] != turn_deg[1];
        let is_right = match &events[..] {
            [InstrumentEvent::PhaseStep { pass: 3, daughter: told, channels, .. }] => {
                *told as usize == daughter + 1
                    && !is_of_clock
                    && channels.iter().map(|(c, ..)| *c).eq(changed)
            }
            [InstrumentEvent::ClockJump { pass: 3, daughter: told, change_ns, .. }] => {
                let ns = -turn_deg[0] / (360e-9 * FREQUENCIES_HZ[0]);
                *told as usize == daughter + 1 && is_of_clock && (change_ns - ns).abs() < 0.5
            }
            _ => false,
        };
        assert!(is_right, "daughter {}, {turn_deg:?} deg: {events:?}", daughter + 1);
    });
}
