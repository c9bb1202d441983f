//! Fringes that turn during integrations.

use super::*;
use crate::units::Pair;

/// Integrations of the longest baseline, in which the fringe of a direction turns by an eighth, and of another pair that does not turn and knows
/// the power, 1e7 K sr, by a weight a million times larger; each the mean of 1000 instants.
fn turning(array: &Array, from_s: f64, hat: Vec3, duration_s: f64) -> [PlacedVisibilities; 2] {
    let last = array.satellites() - 1;
    [(Pair { i: 0, j: last as u8 }, 1.0), (Pair { i: 1, j: 2 }, 1e6)].map(|(pair, weight)| {
        let is_turning = pair.i == 0;
        let at = |t_s: f64| [0, last].map(|n| array.position_m(n, t_s));
        let mut block =
            PlacedVisibilities { pair, frequency_hz: FREQUENCY_HZ, ..PlacedVisibilities::default() };
        for k in 0..40 {
            let t_s = from_s + duration_s * (f64::from(k) + 0.5);
            let wave = |n: i32| {
                let after_s = duration_s * ((f64::from(n) + 0.5) / 1000.0 - 0.5);
                let [r_i_m, r_j_m] = at(t_s + if is_turning { after_s } else { 0.0 });
                plane_wave(1e4, hat, sub(r_i_m, r_j_m), FREQUENCY_HZ)
            };
            let [r_i_m, r_j_m] = if is_turning { at(t_s) } else { at(from_s) };
            let value = if is_turning {
                (0..1000).map(wave).sum()
            } else {
                plane_wave(1e7, hat, sub(r_i_m, r_j_m), FREQUENCY_HZ)
            };
            block.time_s.push(t_s);
            block.r_i_m.push(r_i_m);
            block.r_j_m.push(r_j_m);
            block.value_k_sr.push(value);
            block.weight.push(weight);
            block.duration_s.push(duration_s as f32);
        }
        block
    })
}

#[test]
fn what_is_subtracted_turns_with_the_fringe() {
    let array = array();
    let at = |t_s: f64| sub(array.position_m(0, t_s), array.position_m(array.satellites() - 1, t_s));
    let from_s = 1e5;
    // The direction along which the baseline moves, away from the Moon.
    let motion_m_s = sub(at(from_s + 0.5), at(from_s - 0.5));
    let outwards = dot(motion_m_s, array.position_m(0, from_s)).signum();
    let hat = unit(scale(outwards, motion_m_s));
    // An eighth of a turn.
    let duration_s = (299_792_458.0 / FREQUENCY_HZ / (8.0 * norm(motion_m_s)) * 256.0).round() / 256.0;
    let blocks = turning(&array, from_s, hat, duration_s);
    let row = |block, k| BurstRow { block, k, steady_k2_sr2: 0.0 };
    let rows: Vec<BurstRow> =
        blocks.iter().flat_map(|block| (0..block.len()).map(move |k| row(block, k))).collect();
    let worst = |smears: bool| {
        let place = Place { hat, moon_radius_m: 1_737_100.0, smears };
        let span_s = [from_s, from_s + 40.0 * duration_s];
        let curve = LightCurve::fit(&rows, place, span_s).unwrap();
        let curve = LightCurve { variance_k2_sr2: vec![0.0; curve.cells()], ..curve };
        let left = |k: usize| curve.without_burst(&blocks[0], k).unwrap().0.norm() / 1e7;
        (0..blocks[0].len()).map(left).fold(0.0, f64::max)
    };
    // A steady source has sin(x) / x of its power, x = pi / 8, in each: 0.02554 is left. The turn is an eighth to the rounding of the length,
    // a 500th, and to the cosine of the baseline's turn in 40 integrations.
    let [middle, turned] = [false, true].map(worst);
    assert!((middle - 0.02554).abs() < 1e-3, "{middle}");
    assert!(turned < 1e-3, "{turned}");
}
