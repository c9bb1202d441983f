//! Events are told of what happened, and of nothing else.

use super::*;

fn is_drift_of(event: &InstrumentEvent, number: usize) -> bool {
    matches!(event, InstrumentEvent::Drift { daughter, .. } if *daughter as usize == number)
}

/// Daughter, from 1, and phase in deg over the part of a pass that has passed.
type Drift = (usize, fn(f64) -> f64);

#[test]
fn gradual_changes_are_drifts() {
    // Steady drifts of a daughter and of the reference, one that slows down, and a wave.
    let drifts: [Drift; 4] = [
        (6, |part| 9.4 * part),
        (1, |part| 18.7 * part),
        (3, |part| 12.0 * part * part),
        (8, |part| 6.0 * (TAU * part).sin()),
    ];
    let of = |seed: u64| drifts[seed as usize % drifts.len()];
    let found = outcome("gradual", |seed| {
        let (gains, (number, phase_deg)) = (gains(seed), of(seed));
        let gain = |c: usize, n: usize, time_s: f64| {
            let drift_deg = if n + 1 == number { phase_deg(time_s / SPAN_S[1]) } else { 0.0 };
            gains[c][n] * Complex64::cis(drift_deg.to_radians())
        };
        // Phases are known to some tenths of a degree.
        solved(&Pass { strength: 4.0, ..plain(seed, &gain) }, seed)
    });
    assert_eq!(found.tally.wrong, 0);
    for (seed, parts) in (first_seed()..).zip(&found.passes) {
        let events = instrument_events(parts);
        let is_right = parts.len() == 1 && events.len() == 1 && is_drift_of(&events[0], of(seed).0);
        assert!(is_right, "{seed}: {} parts, {events:?}", parts.len());
    }
}

#[test]
fn a_drift_of_a_clock_is_not_an_error_of_the_model() {
    // 18.75 ns in a pass, as 600 ns a day.
    let found = outcome("clock drift", |seed| {
        let gains = gains(seed);
        let gain = |c: usize, n: usize, time_s: f64| {
            let late_s = if n == 3 { 18.75e-9 * time_s / SPAN_S[1] } else { 0.0 };
            gains[c][n] * Complex64::cis(-TAU * FREQUENCIES_HZ[c] * late_s)
        };
        solved(&Pass { strength: 4.0, ..plain(seed, &gain) }, seed)
    });
    assert_eq!(found.tally.wrong, 0);
    for parts in &found.passes {
        let events = instrument_events(parts);
        assert!(parts.len() == 1 && events.iter().all(|event| is_drift_of(event, 4)), "{events:?}");
        assert!(!events.is_empty());
    }
}

#[test]
fn a_step_of_one_channel_is_no_jump_of_the_clock() {
    // Steps of 6 to 170 deg, each of one channel of one daughter, and jumps of clocks by 2.5 to 20 ns, after three of
    // six passes. 100 ns are 108 deg at 3 MHz, and whole turns at 10 and 20 MHz.
    let steps_deg = [-108.7, 31.0, 59.0, -20.0, 6.0, 170.0, -85.0, 12.0];
    let changes: Vec<(usize, [f64; 3])> = (0..3)
        .flat_map(|c| steps_deg.map(|deg| std::array::from_fn(|k| if k == c { deg } else { 0.0 })))
        .chain([2.5, -4.0, 8.0, -12.0, 20.0].map(|ns| FREQUENCIES_HZ.map(|hz| -360e-9 * hz * ns)))
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
        let is_right = match &events[..] {
            [InstrumentEvent::PhaseStep { pass: 3, daughter: told, channels, .. }] => {
                *told as usize == daughter + 1
                    && changed.len() == 1
                    && channels[0].0 == changed[0]
                    && channels.len() == 1
            }
            [InstrumentEvent::ClockJump { pass: 3, daughter: told, change_ns, .. }] => {
                let ns = -turn_deg[0] / (360e-9 * FREQUENCIES_HZ[0]);
                *told as usize == daughter + 1 && changed.len() == 3 && (change_ns - ns).abs() < 0.5
            }
            _ => false,
        };
        assert!(is_right, "daughter {}, {turn_deg:?} deg: {events:?}", daughter + 1);
    });
}

#[test]
fn a_wrong_model_blames_no_daughter() {
    // The sky is reversed, turned by 5 deg, or off by 20 %, or positions are off by 10 m.
    let found = solved_with_model("wrong model", |seed, pass| match seed % 4 {
        0 => turn(&mut pass.model, 180.0),
        1 => turn(&mut pass.model, 5.0),
        2 => {
            let mut random = random_stream(seed, StreamKind::Probe, [26, 0]);
            pass.model.iter_mut().for_each(|source| source.1 *= 1.0 + 0.2 * normal(&mut random));
            pass.strength = 4.0;
        }
        _ => pass.position_error_m = 10.0,
    });
    assert_eq!(found.tally.wrong, 0);
    assert!(reports_a_wrong_model(&found));
    for (seed, parts) in (first_seed()..).zip(&found.passes) {
        let events = instrument_events(parts);
        let are_of_model = events.iter().all(|event| matches!(event, InstrumentEvent::WrongModel { .. }));
        assert!(parts.len() == 1 && are_of_model, "{seed}: {} parts, {events:?}", parts.len());
    }
    // Data 2 s late: every pair sees the sky turned by 0.09 deg.
    let late = solved_with_model("late", |_, pass| {
        turn(&mut pass.model, 360.0 * 2.0 / 8258.0);
        pass.strength = 4.0;
    });
    assert_eq!(late.tally.wrong, 0);
}

fn turn(sky: &mut Sky, deg: f64) {
    let (sin, cos) = deg.to_radians().sin_cos();
    sky.iter_mut().for_each(|([x, y], _)| (*x, *y) = (cos * *x - sin * *y, sin * *x + cos * *y));
}

#[test]
fn a_state_is_told_once_in_a_pass() {
    let gains = gains(7);
    let gain = |c: usize, n: usize, _: f64| gains[c][n];
    let right = plain(7, &gain).solve(0, &SolverConfig::default()).remove(0);
    let mut wrong = Pass { model: sky(99), ..plain(7, &gain) }.solve(0, &SolverConfig::default()).remove(0);
    wrong.daughters[2].gains.iter_mut().for_each(|gain| gain.state = GainState::Uncertain);
    let at =
        |solution: &PassSolution, pass: u64, from_s: f64| PassSolution { pass, from_s, ..solution.clone() };
    let solutions = [
        at(&wrong, 0, 100.0),
        at(&right, 0, 200.0),
        at(&wrong, 0, 300.0),
        at(&right, 1, 900.0),
        at(&wrong, 2, 1800.0),
    ];
    let told: Vec<(u64, f64)> = instrument_events(&solutions)
        .into_iter()
        .filter_map(|event| match event {
            InstrumentEvent::WrongModel { pass, from_s, channel: 0, .. } => Some((pass, from_s)),
            _ => None,
        })
        .collect();
    assert_eq!(told, [(0, 100.0), (2, 1800.0)]);
}
