//! Delays between daughters: what they cost over a channel's width, and what brings it back.

use std::f64::consts::PI;

use lunarray::array::{Array, ArrayConfig, ObservingWindows};
use lunarray::units::all_pairs;
use lunarray::units::constants::SPEED_OF_LIGHT_M_S;
use lunarray::units::vector::{dot, sub, unit};
use num_complex::Complex64;

use crate::craft::{Spacecraft, WIDTH_HZ, point, stream};

#[test]
fn delays_decorrelate_as_a_sinc_and_offsets_restore() {
    // An array that hardly moves, and a source along its track: delays up to 333 us.
    let slow = ArrayConfig { orbital_period_s: 8e6, ..ArrayConfig::default() };
    let start = {
        let array = Array::new(&slow).unwrap();
        let t_s = ObservingWindows::new(&array, 0.0, 1e9).next().unwrap().start.seconds();
        unit(sub(array.position_m(0, t_s), array.position_m(7, t_s)))
    };
    let sky = point(start);
    // At 1 MHz breathing turns the longest baseline's fringe by 0.015 in this time: 4e-4 of the amplitude.
    let craft = Spacecraft::new(slow, vec![1e6], sky, 40.0);
    let t_s = craft.window.start.seconds() + 20.0;
    let (frames, _) = craft.sample(5);
    let streams: Vec<Vec<Complex64>> = (0..8).map(|n| stream(&frames, n)).collect();
    let mut greatest = 0.0_f64;
    for pair in all_pairs(8) {
        let (i, j) = (usize::from(pair.i), usize::from(pair.j));
        let tau_s = dot(start, sub(craft.array.position_m(i, t_s), craft.array.position_m(j, t_s)))
            / SPEED_OF_LIGHT_M_S;
        let delay = tau_s * WIDTH_HZ;
        greatest = greatest.max(delay);
        for lag in [0, delay.round() as usize] {
            // The daughter nearer to the source is ahead: x_i(t) = x_j(t + tau).
            let pairs = streams[i].iter().zip(&streams[j][lag..]);
            let count = streams[i].len() - lag;
            let amplitude = (pairs.map(|(a, b)| a * b.conj()).sum::<Complex64>() / count as f64).norm();
            let x = PI * (delay - lag as f64);
            let expected = if x.abs() < 1e-9 { 1.0 } else { (x.sin() / x).abs() };
            // Noise of 1/sqrt(n) a complex mean; 1 - cos(pi lag / 128) and rounding of the lag at the window's rim.
            let error = (1.0 / count as f64).sqrt();
            assert!(
                (amplitude - expected).abs() < 4.0 * error + 3e-3,
                "{pair} {lag}: {amplitude} {expected}"
            );
        }
    }
    assert!(greatest > 2.0, "{greatest}");
}
