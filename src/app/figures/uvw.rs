//! Observing time by baseline in the uvw space, on ecliptic axes (the paper, Fig. 5).

use std::fmt::Write;

use serde::Serialize;

use super::error::FigureError;
use super::exposure::{TimeSample, gather, limit_m};
use super::output::FigureParts;
use crate::pipeline::Plan;
use crate::products::pictures::{Axis, ColourScale, Palette, Raster, Scaling, draw_rasters};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, dot, scale, sub};

const CELLS: usize = 161;
/// Time step, s, in which a baseline rotates by half a degree.
const STEP_S: f64 = 12.0;
/// Horizontal and vertical axis of each plane.
const PLANES: [(usize, usize); 3] = [(0, 1), (0, 2), (1, 2)];
const NAMES: [&str; 3] = ["u", "v", "w"];

#[derive(Serialize)]
struct UvwNumbers {
    frequency_hz: f64,
    /// Limit on the baselines, wavelengths, which is half the side of the planes.
    limit_wavelengths: f64,
    pair_s: f64,
    /// Maximum of |w| / b, and mean of its square over time.
    w_share_max: f64,
    w_share_square_mean: f64,
    /// Fraction of the cells of each plane within the limit that are crossed by a baseline.
    filled: [f64; 3],
}

struct Counts {
    planes_s: [Vec<f64>; 3],
    pair_s: f64,
    w_max: f64,
    w_square_s: f64,
}

impl Counts {
    fn new() -> Self {
        let planes_s = [(); 3].map(|()| vec![0.0; CELLS * CELLS]);
        Self { planes_s, pair_s: 0.0, w_max: 0.0, w_square_s: 0.0 }
    }

    fn add(&mut self, sample: &TimeSample<'_>, limit_m: f64) {
        for pair in sample.pairs {
            let [i, j] = [pair.i, pair.j].map(|n| sample.states[usize::from(n)].position_m);
            let baseline_m = sub(i, j);
            let square = dot(baseline_m, baseline_m);
            if square >= limit_m * limit_m {
                continue;
            }
            let w_share = baseline_m[2].abs() / square.sqrt();
            self.pair_s += sample.length_s;
            self.w_max = self.w_max.max(w_share);
            self.w_square_s += sample.length_s * w_share * w_share;
            // The conjugate visibility is at the opposite baseline.
            for sign in [1.0, -1.0] {
                let u = scale(sign / limit_m, baseline_m);
                for (plane_s, (x, y)) in self.planes_s.iter_mut().zip(PLANES) {
                    plane_s[cell(u, y) * CELLS + cell(u, x)] += 0.5 * sample.length_s;
                }
            }
        }
    }

    fn merge(&mut self, other: Self) {
        for (to, from) in self.planes_s.iter_mut().zip(other.planes_s) {
            to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
        }
        self.pair_s += other.pair_s;
        self.w_max = self.w_max.max(other.w_max);
        self.w_square_s += other.w_square_s;
    }
}

/// Cell index of a component between -1 and 1.
fn cell(u: Vec3, axis: usize) -> usize {
    ((0.5 * (u[axis] + 1.0) * CELLS as f64) as usize).min(CELLS - 1)
}

/// Whether the centre of a cell is within the limit.
fn is_inside(k: usize) -> bool {
    let coordinate = |cell: usize| 2.0 * (cell as f64 + 0.5) / CELLS as f64 - 1.0;
    coordinate(k % CELLS).hypot(coordinate(k / CELLS)) < 1.0
}

pub(super) fn make(plan: &Plan) -> Result<FigureParts, FigureError> {
    let limit_m = limit_m(plan, 0);
    let counts =
        gather(plan, STEP_S, Counts::new, |counts, sample| counts.add(sample, limit_m), Counts::merge);
    if counts.pair_s == 0.0 {
        return Err(FigureError::NoBaseline { limit_m });
    }
    let frequency_hz = plan.schedules[0].frequency_hz;
    let limit_wavelengths = limit_m * frequency_hz / SPEED_OF_LIGHT_M_S;
    let inside: Vec<usize> = (0..CELLS * CELLS).filter(|&k| is_inside(k)).collect();
    let filled = |plane_s: &Vec<f64>| {
        inside.iter().filter(|&&k| plane_s[k] > 0.0).count() as f64 / inside.len() as f64
    };
    let numbers = UvwNumbers {
        frequency_hz,
        limit_wavelengths,
        pair_s: counts.pair_s,
        w_share_max: counts.w_max,
        w_share_square_mean: counts.w_square_s / counts.pair_s,
        filled: counts.planes_s.each_ref().map(filled),
    };
    let mut csv = "plane,x_wavelengths,y_wavelengths,pair_s\n".to_owned();
    for (plane_s, (x, y)) in counts.planes_s.iter().zip(PLANES) {
        let at = |cell: usize| limit_wavelengths * (2.0 * (cell as f64 + 0.5) / CELLS as f64 - 1.0);
        for (k, pair_s) in plane_s.iter().enumerate().filter(|(_, pair_s)| **pair_s > 0.0) {
            let _ = writeln!(
                csv,
                "{}{},{:.3},{:.3},{pair_s:.1}",
                NAMES[x],
                NAMES[y],
                at(k % CELLS),
                at(k / CELLS)
            );
        }
    }
    // Empty cells are NaN, which is drawn in grey.
    let hours: Vec<Vec<f64>> = counts
        .planes_s
        .iter()
        .map(|plane| plane.iter().map(|&s| if s > 0.0 { s / 3600.0 } else { f64::NAN }).collect())
        .collect();
    let scale = ColourScale::robust(&hours[0], Scaling::Log, Palette::default());
    let axis = |name: &str| Axis {
        label: format!("{name} (wavelengths)"),
        log: false,
        limits: Some((-limit_wavelengths, limit_wavelengths)),
    };
    let raster = |(values, (x, y)): (&'_ Vec<f64>, (usize, usize))| (values.clone(), NAMES[x], NAMES[y]);
    let planes: Vec<_> = hours.iter().zip(PLANES).map(raster).collect();
    let rasters: Vec<Raster<'_>> = planes
        .iter()
        .map(|(values, x, y)| Raster {
            title: format!("{x}, {y}"),
            x: axis(x),
            y: axis(y),
            values,
            columns: CELLS,
            scale,
            unit: "pair hours per cell".to_owned(),
        })
        .collect();
    let title = format!("Baselines at {} MHz on ecliptic axes; grey: none", frequency_hz / 1e6);
    let picture = draw_rasters(&title, &rasters, 3)?;
    Ok(FigureParts::new(&numbers, csv, picture))
}
