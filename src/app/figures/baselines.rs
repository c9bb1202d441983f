//! Baselines of all pairs over the mission: lengths, cross-track and radial components, and altitudes of the satellites.

use std::fmt::Write;

use rayon::prelude::*;
use serde::Serialize;

use super::error::FigureError;
use super::output::FigureParts;
use crate::frames::ObservingWindow;
use crate::mother::WindowThinning;
use crate::pipeline::Plan;
use crate::products::pictures::{Axis, Curve, Plot, draw_plots};
use crate::units::constants::DAY_S;
use crate::units::vector::{dot, norm, sub};
use crate::units::{Pair, all_pairs};

/// Maximum number of windows, evenly spaced over the mission.
const WINDOWS_MAX: usize = 500;
/// Number of time samples per window, including both ends.
const SAMPLES: usize = 9;
/// Maximum number of curves. Only pairs with the first satellite are drawn.
const CURVES_MAX: usize = 10;
/// Half of the width of a mark where windows are skipped, as a fraction of the mission.
const MARK: f64 = 0.002;

#[derive(Serialize)]
struct BaselineNumbers {
    satellites: usize,
    windows: usize,
    /// Shortest and longest baseline, m.
    length_m: [f64; 2],
    /// Maximum component of a baseline along the orbit normal of the first satellite, m, and relative to its length.
    across_m_max: f64,
    across_share_max: f64,
    /// Maximum difference of the orbital radii of two satellites, m.
    radial_m_max: f64,
    /// Lowest and highest altitude, m.
    altitude_m: [f64; 2],
}

#[derive(Clone, Copy)]
struct Extremes {
    length_m: [f64; 2],
    across_m: f64,
    across_share: f64,
    radial_m: f64,
}

struct WindowExtremes {
    day: f64,
    pairs: Vec<Extremes>,
    altitude_m: [f64; 2],
}

fn extremes_of(plan: &Plan, pairs: &[Pair], window: ObservingWindow) -> WindowExtremes {
    let array = &plan.array;
    let (start_s, end_s) = (window.start.seconds(), window.end.seconds());
    let initial =
        Extremes { length_m: [f64::INFINITY, 0.0], across_m: 0.0, across_share: 0.0, radial_m: 0.0 };
    let mut out = WindowExtremes {
        day: 0.5 * (start_s + end_s) / DAY_S,
        pairs: vec![initial; pairs.len()],
        altitude_m: [f64::INFINITY, f64::NEG_INFINITY],
    };
    for sample in 0..SAMPLES {
        let t_s = start_s + (end_s - start_s) * sample as f64 / (SAMPLES - 1) as f64;
        let positions_m: Vec<_> = (0..array.satellites()).map(|n| array.position_m(n, t_s)).collect();
        let normal_hat = array.normal_hat(0, t_s);
        for position_m in &positions_m {
            let altitude_m = norm(*position_m) - array.moon_radius_m();
            out.altitude_m = [out.altitude_m[0].min(altitude_m), out.altitude_m[1].max(altitude_m)];
        }
        for (found, pair) in out.pairs.iter_mut().zip(pairs) {
            let [r_i_m, r_j_m] = [pair.i, pair.j].map(|n| positions_m[usize::from(n)]);
            let baseline_m = sub(r_i_m, r_j_m);
            let length_m = norm(baseline_m);
            let across_m = dot(baseline_m, normal_hat).abs();
            found.length_m = [found.length_m[0].min(length_m), found.length_m[1].max(length_m)];
            found.across_m = found.across_m.max(across_m);
            if length_m > 0.0 {
                found.across_share = found.across_share.max(across_m / length_m);
            }
            found.radial_m = found.radial_m.max((norm(r_i_m) - norm(r_j_m)).abs());
        }
    }
    out
}

fn table(pairs: &[Pair], windows: &[WindowExtremes]) -> String {
    let mut csv = "day,i,j,length_m_min,length_m_max,across_m_max,radial_m_max\n".to_owned();
    for window in windows {
        for (pair, found) in pairs.iter().zip(&window.pairs) {
            let [shortest_m, longest_m] = found.length_m;
            let _ = writeln!(
                csv,
                "{:.4},{},{},{shortest_m:.3},{longest_m:.3},{:.3},{:.3}",
                window.day,
                pair.i + 1,
                pair.j + 1,
                found.across_m,
                found.radial_m
            );
        }
    }
    csv
}

/// A mark at each point, and nothing between them: baselines may turn there several times.
fn marks(values: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let [Some(first), Some(last)] = [values.first(), values.last()] else { return Vec::new() };
    let half = MARK * (last.0 - first.0).max(f64::MIN_POSITIVE);
    values.iter().flat_map(|&(x, y)| [(x - half, y), (x + half, y), (f64::NAN, y)]).collect()
}

pub(super) fn make(plan: &Plan) -> Result<FigureParts, FigureError> {
    let pairs = all_pairs(plan.array.satellites());
    let step = plan.windows.len().div_ceil(WINDOWS_MAX).max(1);
    let chosen: Vec<ObservingWindow> = plan.windows.iter().step_by(step).copied().collect();
    let windows: Vec<WindowExtremes> =
        chosen.par_iter().map(|window| extremes_of(plan, &pairs, *window)).collect();
    let all = || windows.iter().flat_map(|window| &window.pairs);
    let minimum = |values: &mut dyn Iterator<Item = f64>| values.fold(f64::INFINITY, f64::min);
    let maximum = |values: &mut dyn Iterator<Item = f64>| values.fold(f64::NEG_INFINITY, f64::max);
    let numbers = BaselineNumbers {
        satellites: plan.array.satellites(),
        windows: windows.len(),
        length_m: [
            minimum(&mut all().map(|pair| pair.length_m[0])),
            maximum(&mut all().map(|pair| pair.length_m[1])),
        ],
        across_m_max: maximum(&mut all().map(|pair| pair.across_m)),
        across_share_max: maximum(&mut all().map(|pair| pair.across_share)),
        radial_m_max: maximum(&mut all().map(|pair| pair.radial_m)),
        altitude_m: [
            minimum(&mut windows.iter().map(|window| window.altitude_m[0])),
            maximum(&mut windows.iter().map(|window| window.altitude_m[1])),
        ],
    };
    let are_skipped = step > 1 || plan.config.spacecraft.window_thinning() != WindowThinning::EveryNth(1);
    let line = |values: Vec<(f64, f64)>| if are_skipped { marks(&values) } else { values };
    // Positions are exact to less than a millimetre; what is smaller is rounding.
    let whole_mm = |value_m: f64| (value_m * 1e3).round() / 1e3;
    let shown = || pairs.iter().enumerate().filter(|(_, pair)| pair.i == 0).take(CURVES_MAX);
    let curves = |value: &dyn Fn(&Extremes) -> f64| -> Vec<Curve> {
        let points =
            |k: usize| line(windows.iter().map(|window| (window.day, value(&window.pairs[k]))).collect());
        let curve = |(k, pair): (usize, &Pair)| Curve {
            label: format!("{}-{}", pair.i + 1, pair.j + 1),
            points: points(k),
            dashed: false,
        };
        shown().map(curve).collect()
    };
    let altitude = |index: usize, label: &str| Curve {
        label: label.to_owned(),
        points: line(windows.iter().map(|window| (window.day, window.altitude_m[index] / 1e3)).collect()),
        dashed: index == 0,
    };
    let day = || Axis { label: "day".to_owned(), ..Axis::default() };
    let axis = |label: &str, log: bool| Axis { label: label.to_owned(), log, ..Axis::default() };
    let plot = |title: &str, y: Axis, curves: Vec<Curve>| Plot {
        title: title.to_owned(),
        x: day(),
        y,
        curves,
        levels: Vec::new(),
    };
    let plots = [
        plot("longest in each window", axis("baseline (m)", true), curves(&|pair| pair.length_m[1])),
        plot("largest cross-track component", axis("m", false), curves(&|pair| whole_mm(pair.across_m))),
        plot(
            "largest difference of orbital radii",
            axis("m", false),
            curves(&|pair| whole_mm(pair.radial_m)),
        ),
        plot(
            "altitudes of all satellites",
            axis("altitude (km)", false),
            vec![altitude(0, "lowest"), altitude(1, "highest")],
        ),
    ];
    let title = format!("Baselines of {} satellites, {} windows", plan.array.satellites(), windows.len());
    let picture = draw_plots(&title, &plots, 2)?;
    Ok(FigureParts::new(&numbers, table(&pairs, &windows), picture))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_joins_windows_between_which_others_were_skipped() {
        let drawn = marks(&[(0.0, 1.0), (100.0, 7.0)]);
        let pieces: Vec<&[(f64, f64)]> =
            drawn.split(|(x, _)| x.is_nan()).filter(|line| !line.is_empty()).collect();
        assert_eq!(pieces.len(), 2);
        for (piece, (x, y)) in pieces.iter().zip([(0.0, 1.0), (100.0, 7.0)]) {
            assert!(piece.iter().all(|point| (point.0 - x).abs() < 1.0 && point.1 == y), "{piece:?}");
        }
        assert_eq!(marks(&[]), []);
    }
}
