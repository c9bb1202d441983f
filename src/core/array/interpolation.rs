//! Interpolation error of tabulated positions, from the positions alone.
//!
//! The polynomial through eight nodes errs by `d8r/dt8 h^8 / 8! s (s-1) .. (s-7)` (Abramowitz and Stegun 25.2.27),
//! and the eighth difference of nine nodes is `h^8 d8r/dt8` at a time among them. So a ninth node of the orbit
//! determines the error.

use crate::frames::EphemerisSegment;
use crate::units::vector::{Vec3, norm};

/// Number of nodes of an interpolation.
const NODES: usize = 8;

/// Estimated maximum error of the positions of a segment between its nodes, m, for motion that is as smooth between
/// nodes as over nine of them. For a segment of eight nodes it is the error of seven nodes, some ten times that of
/// eight for orbits in steps of minutes. `None` for a segment that is too short.
#[must_use]
pub fn interpolation_error_m(segment: &EphemerisSegment) -> Option<f64> {
    let (nodes, satellites) = (segment.nodes(), usize::from(segment.satellites));
    if nodes < NODES || satellites == 0 || segment.positions_m.len() < nodes * satellites {
        return None;
    }
    let points = if nodes > NODES { NODES } else { NODES - 1 };
    let (weights, peaks) = (binomials(points), peaks(points));
    let difference_m = |first: usize, satellite: usize| {
        let mut sum: Vec3 = [0.0; 3];
        for (k, weight) in weights.iter().enumerate() {
            let position_m = segment.positions_m[(first + k) * satellites + satellite];
            sum.iter_mut().zip(position_m).for_each(|(sum, r)| *sum += weight * r);
        }
        norm(sum)
    };
    let mut worst_m: f64 = 0.0;
    for satellite in 0..satellites {
        let differences_m: Vec<f64> =
            (0..nodes - points).map(|first| difference_m(first, satellite)).collect();
        for interval in 0..nodes - 1 {
            // The nodes that the interpolation goes through.
            let first = interval.saturating_sub(points / 2 - 1).min(nodes - points);
            let peak = peaks[(interval - first).min(points - 2)];
            // They are the first or the last nodes of either difference.
            let of_both = first.saturating_sub(1)..(first + 1).min(differences_m.len());
            let most_m = differences_m[of_both].iter().fold(0.0, |most, m| f64::max(most, *m));
            worst_m = worst_m.max(peak * most_m);
        }
    }
    Some(worst_m)
}

/// Factors of the values in a difference of this order.
fn binomials(order: usize) -> Vec<f64> {
    let mut row = vec![1.0];
    for k in 0..order {
        let last = row[k];
        row.push(-last * (order - k) as f64 / (k + 1) as f64);
    }
    row
}

/// Maximum of `|s (s-1) .. (s-n+1)| / n!` between nodes o and o + 1 of n, by o.
fn peaks(points: usize) -> Vec<f64> {
    // The extremum of a step is flat: 64 samples miss at most a fraction of 4e-4.
    const PLACES: usize = 64;
    let product = |s: f64| (0..points).map(|k| (s - k as f64) / (k + 1) as f64).product::<f64>().abs();
    let peak = |o: usize| {
        let places = (0..=PLACES).map(|k| o as f64 + k as f64 / PLACES as f64);
        places.map(product).fold(0.0, f64::max)
    };
    (0..points - 1).map(peak).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig, Ephemeris, KeplerElements, segments_for};
    use crate::units::MissionTime;
    use crate::units::vector::sub;

    /// Maximum error of the interpolation of a segment against the array itself.
    fn measured_m(array: &Array, segment: &EphemerisSegment) -> f64 {
        let mut table = Ephemeris::default();
        table.insert(segment.clone());
        let (from_s, to_s) = (segment.start.seconds(), segment.end().seconds());
        let times = (1..4000).map(|k| from_s + (to_s - from_s) * f64::from(k) / 4000.0);
        let error = |t_s: f64| {
            let off = |n| norm(sub(table.position_at(t_s, n).unwrap(), array.position_m(n, t_s)));
            (0..array.satellites()).map(off).fold(0.0, f64::max)
        };
        times.map(error).fold(0.0, f64::max)
    }

    fn ellipses() -> Array {
        let elements = |mean_anomaly_deg| KeplerElements {
            semi_major_axis_m: 2.5e6,
            eccentricity: 0.25,
            inclination_deg: 50.0,
            node_longitude_deg: 40.0,
            periapsis_deg: 70.0,
            mean_anomaly_deg,
            node_rate_deg_per_day: -0.75,
            periapsis_rate_deg_per_day: 0.0,
        };
        let kepler = vec![elements(-10.0), elements(-20.0), elements(-30.0)];
        Array::new(&ArrayConfig { satellites: 3, kepler, ..ArrayConfig::default() }).unwrap()
    }

    #[test]
    fn the_estimated_error_is_the_measured_one() {
        let circle = Array::new(&ArrayConfig::default()).unwrap();
        // Steps range from a quarter of those in packets to ten times that, where rounding does not hide the error.
        for (array, step_s, span_s) in [
            (&circle, 240.0, 7200.0),
            (&circle, 600.0, 7200.0),
            (&ellipses(), 120.0, 2_751.3),
            (&ellipses(), 300.0, 7200.0),
        ] {
            let end = MissionTime::from_seconds(span_s);
            let segment = segments_for(array, MissionTime(0), end, step_s).remove(0);
            let (told_m, measured_m) =
                (interpolation_error_m(&segment).unwrap(), measured_m(array, &segment));
            // The eighth derivative changes over nine nodes, by up to a few tens of percent on an ellipse in steps of 5 min.
            let ratio = told_m / measured_m;
            assert!((0.6..1.7).contains(&ratio), "{step_s} s: {told_m} m told, {measured_m} m measured");
        }
    }

    #[test]
    fn errors_in_a_window_are_micrometres_and_a_jump_is_found() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let mut segment = segments_for(&array, MissionTime(0), MissionTime(2_751_300_000), 60.0).remove(0);
        // 1.1 um by the formula at the ends, and what roundings of 2e-10 m and times make of it.
        let told_m = interpolation_error_m(&segment).unwrap();
        assert!((0.5e-6..2e-6).contains(&told_m), "{told_m}");
        // A position that is off by a metre is seen through the outermost node's factor, 0.03 of 8 or 70 of it.
        segment.positions_m[8 * 20 + 3][1] += 1.0;
        let told_m = interpolation_error_m(&segment).unwrap();
        assert!((0.05..3.0).contains(&told_m), "{told_m}");
    }

    #[test]
    fn eight_nodes_give_an_upper_limit_and_fewer_none() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let mut segment = segments_for(&array, MissionTime(0), MissionTime(1_000_000), 60.0).remove(0);
        assert_eq!(segment.nodes(), 8);
        segment.step_ticks = 300_000_000;
        for (place, position_m) in segment.positions_m.iter_mut().enumerate() {
            *position_m = array.position_m(place % 8, 300.0 * (place / 8) as f64);
        }
        let (told_m, measured_m) = (interpolation_error_m(&segment).unwrap(), measured_m(&array, &segment));
        assert!(told_m > measured_m && told_m < 50.0 * measured_m, "{told_m} {measured_m}");
        segment.positions_m.truncate(8 * 7);
        assert_eq!(interpolation_error_m(&segment), None);
    }
}
