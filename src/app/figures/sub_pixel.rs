//! Sub-pixel noise: the effect of structure of the sky within pixels on visibilities and on the map (the paper, appendix and
//! Fig. 20).
//!
//! A pixel map predicts `B T`, with T the means over pixels, while the sky gives `V`. The difference `b = V - B T` has the
//! covariance `N_b = <b bt>`, and the map has `Sigma_b = A N_b At` with `A = (BtN^-1B + R)^-1 BtN^-1`. Both are averaged over
//! skies with different seeds. The figure shows the square roots of their diagonals.

use std::fmt::Write;
use std::path::Path;

use faer::{Mat, Side, prelude::Solve};
use rayon::prelude::*;
use serde::Serialize;

use super::error::FigureError;
use super::output::FigureParts;
use crate::mother::{NoiseModel, Schedule};
use crate::pipeline::Plan;
use crate::products::pictures::{
    Axis, ColourScale, Curve, MapPanel, Palette, Plot, Scaling, Sheet, draw_plots, draw_sheet,
};
use crate::response::pixel::{
    CHILDREN, Directions, PairGeometry, PixelMethod, RowMaker, SingleGeometry, sky_powers, sky_sums,
};
use crate::sky::generated::generate;
use crate::sky::healpix::{pixel_area_sr, pixel_directions};
use crate::sky::{Frame, SkyMap};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::norm;
use crate::units::{ChannelId, all_pairs};

/// nside of the maps.
const NSIDES: [usize; 2] = [8, 16];
/// Number of skies over which covariances are averaged.
const SKIES: u64 = 6;
/// Maximum number of visibilities, from windows evenly spaced over the mission.
const VISIBILITIES_MAX: usize = 3000;
/// Edges of the classes of baseline length, in units of b_p.
const CLASSES_BP: [f64; 9] = [0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0];
/// Number of steps of the power iteration for W_max.
const POWER_STEPS: usize = 100;

#[derive(Serialize)]
struct SubPixelNumbers {
    frequency_hz: f64,
    epsilon: f64,
    skies: u64,
    cases: Vec<SubPixelCase>,
}

#[derive(Serialize)]
struct SubPixelCase {
    nside: usize,
    nside_fine: usize,
    rows: &'static str,
    windows: usize,
    visibilities: usize,
    /// Square root of the mean diagonal of N_b by baseline length.
    classes: Vec<SubPixelClass>,
    /// Square root of the mean diagonal of Sigma_b, K.
    sigma_b_k: f64,
    tr_sigma_b_k2: f64,
    /// Mean of the sky, K.
    mean_k: f64,
    #[serde(skip)]
    map_k: Vec<f64>,
}

#[derive(Serialize)]
struct SubPixelClass {
    from_bp: f64,
    to_bp: f64,
    count: usize,
    rms_k_sr: f64,
    /// Relative to the rms visibility.
    of_visibility: f64,
    /// Relative to the thermal noise.
    of_noise: f64,
}

/// Sampled visibilities for one nside.
struct VisibilitySample {
    windows: usize,
    pairs: Vec<PairGeometry>,
    dt_s: Vec<f64>,
    length_bp: Vec<f64>,
}

impl VisibilitySample {
    /// Scheduled integrations of evenly spaced windows, up to the baseline limit of the map.
    fn new(plan: &Plan, nside: usize) -> Result<Self, FigureError> {
        let frequency_hz = plan.schedules[0].frequency_hz;
        let bp_m = SPEED_OF_LIGHT_M_S / frequency_hz / pixel_area_sr(nside).sqrt();
        let limit_bp = plan.config.map.baseline_bp_max;
        let schedule = Schedule {
            baseline_wavelengths_max: limit_bp * bp_m * frequency_hz / SPEED_OF_LIGHT_M_S,
            every_nth: 1,
            ..plan.schedules[0]
        };
        let pairs = all_pairs(plan.array.satellites());
        let count = |window| -> f64 {
            pairs.iter().map(|&pair| schedule.estimate(&plan.array, window, pair).0).sum()
        };
        let all: f64 = plan.windows.iter().map(|&window| count(window)).sum();
        let every = (all / VISIBILITIES_MAX as f64).ceil().max(1.0) as usize;
        let mut sample = Self { windows: 0, pairs: Vec::new(), dt_s: Vec::new(), length_bp: Vec::new() };
        for &window in plan.windows.iter().step_by(every) {
            sample.windows += 1;
            for &pair in &pairs {
                for integration in schedule.integrations(&plan.array, window, pair) {
                    let midpoint_ticks =
                        i64::from(integration.offset_ticks) + i64::from(integration.duration_ticks / 2);
                    let t_s = window.start.plus_ticks(midpoint_ticks).seconds();
                    let [r_i_m, r_j_m] = [pair.i, pair.j].map(|n| plan.array.position_m(n.into(), t_s));
                    let geometry = PairGeometry {
                        r_i_m,
                        r_j_m,
                        frequency_hz,
                        moon_radius_m: plan.array.moon_radius_m(),
                        response: plan.config.spacecraft.antenna.into(),
                    };
                    sample
                        .length_bp
                        .push(norm(geometry.baseline_wavelengths()) * pixel_area_sr(nside).sqrt());
                    sample.pairs.push(geometry);
                    sample.dt_s.push(f64::from(integration.duration_ticks) * 1e-6);
                }
            }
        }
        if sample.pairs.is_empty() {
            return Err(FigureError::NoBaseline { limit_m: limit_bp * bp_m });
        }
        Ok(sample)
    }
}

pub(super) fn make(plan: &Plan, folder: &Path) -> Result<FigureParts, FigureError> {
    let mut cases = Vec::new();
    for nside in NSIDES {
        cases.extend(cases_for_nside(plan, nside)?);
    }
    let numbers = SubPixelNumbers {
        frequency_hz: plan.schedules[0].frequency_hz,
        epsilon: epsilon(plan),
        skies: SKIES,
        cases,
    };
    let mut csv = "nside,rows,from_bp,to_bp,count,rms_k_sr,of_visibility,of_noise\n".to_owned();
    for case in &numbers.cases {
        for class in &case.classes {
            let _ = writeln!(
                csv,
                "{},{},{},{},{},{:.5e},{:.5e},{:.5e}",
                case.nside,
                case.rows,
                class.from_bp,
                class.to_bp,
                class.count,
                class.rms_k_sr,
                class.of_visibility,
                class.of_noise
            );
        }
    }
    let maps = folder.join("sub-pixel-maps.png");
    draw_maps(&numbers)?.write(&maps)?;
    let picture = draw_plots("", &[plot(&numbers)], 1)?;
    Ok(FigureParts { extra_files: vec![maps], ..FigureParts::new(&numbers, csv, picture) })
}

fn epsilon(plan: &Plan) -> f64 {
    plan.config.map.epsilon().get(0).unwrap_or(1e-4)
}

fn cases_for_nside(plan: &Plan, nside: usize) -> Result<Vec<SubPixelCase>, FigureError> {
    let sample = VisibilitySample::new(plan, nside)?;
    let nside_fine = CHILDREN * nside;
    let directions = Directions::from(pixel_directions(nside_fine).as_slice());
    let frequency_hz = plan.schedules[0].frequency_hz;
    // Visibilities and pixel means of each sky.
    let mut skies = Vec::new();
    for number in 0..SKIES {
        let seed = plan.config.seed.wrapping_add(number);
        let fine_k = generate(&plan.config.sky.generated, frequency_hz, nside_fine, seed)?;
        let fine = SkyMap::new(Frame::Ecliptic, fine_k)?;
        let values: Vec<f32> = fine.values().iter().map(|&value| value as f32).collect();
        let sums = sky_sums(&sample.pairs, &directions, &values, pixel_area_sr(nside_fine))?;
        let visibilities: Vec<[f64; 2]> =
            sums.iter().map(|sum| [sum.visibility_k_sr.re, sum.visibility_k_sr.im]).collect();
        skies.push((visibilities, fine.degrade(nside)?));
    }
    let sigma_k_sr = noise_k_sr(plan, &sample, &skies[0].1)?;
    [("centre", PixelMethod::Centre), ("average", PixelMethod::Average)]
        .into_iter()
        .map(|(name, method)| {
            let rows = rows(&sample, nside, method)?;
            let (epsilon, sample) = (epsilon(plan), &sample);
            let inputs = CaseInputs { epsilon, sample, sigma_k_sr: &sigma_k_sr, skies: &skies, rows: &rows };
            Ok(SubPixelCase { rows: name, nside, nside_fine, ..inputs.case() })
        })
        .collect()
}

/// Thermal noise of the real and imaginary part of each visibility.
fn noise_k_sr(plan: &Plan, sample: &VisibilitySample, sky: &SkyMap) -> Result<Vec<f64>, FigureError> {
    let singles: Vec<SingleGeometry> = sample
        .pairs
        .iter()
        .map(|pair| SingleGeometry {
            r_m: pair.r_i_m,
            normal_hat: pair.orbit_normal().unwrap_or([0.0, 0.0, 1.0]),
            moon_radius_m: pair.moon_radius_m,
            response: pair.response,
        })
        .collect();
    let directions = Directions::from(sky.directions_ecliptic().as_slice());
    let values: Vec<f32> = sky.values().iter().map(|&value| value as f32).collect();
    let powers = sky_powers(&singles, &directions, &values, pixel_area_sr(sky.nside()))?;
    let spacecraft = &plan.config.spacecraft;
    let noise = NoiseModel {
        seed: None,
        receiver_noise_k_sr: spacecraft.receiver_k_sr(),
        response: plan.instrument.response,
    };
    // Of the first channel, like the baselines.
    let sigma = |(power, dt_s): (f64, &f64)| {
        noise.sigma_k_sr(ChannelId(0), [power; 2], spacecraft.channel_width_hz, *dt_s)
    };
    Ok(powers.into_iter().zip(&sample.dt_s).map(sigma).collect())
}

/// Transposed rows of B including the pixel area, with one column per real or imaginary part, alternating.
fn rows(sample: &VisibilitySample, nside: usize, method: PixelMethod) -> Result<Mat<f64>, FigureError> {
    let maker = RowMaker::new(nside, method)?;
    sample.pairs.iter().for_each(|pair| maker.prepare(pair));
    let area_sr = pixel_area_sr(nside);
    let row = |pair: &PairGeometry| {
        let (mut re, mut im) = (vec![0.0_f64; maker.pixels()], vec![0.0_f64; maker.pixels()]);
        maker.fill(pair, area_sr, &mut re, &mut im);
        [re, im]
    };
    let rows: Vec<[Vec<f64>; 2]> = sample.pairs.par_iter().map(row).collect();
    Ok(Mat::from_fn(maker.pixels(), 2 * rows.len(), |pixel, k| rows[k / 2][k % 2][pixel]))
}

struct CaseInputs<'a> {
    epsilon: f64,
    sample: &'a VisibilitySample,
    sigma_k_sr: &'a [f64],
    skies: &'a [(Vec<[f64; 2]>, SkyMap)],
    /// Transposed rows of B, with one column per part of a visibility.
    rows: &'a Mat<f64>,
}

impl CaseInputs<'_> {
    fn case(&self) -> SubPixelCase {
        let (pixels, parts) = (self.rows.nrows(), self.rows.ncols());
        // The errors b, with one column per sky.
        let columns: Vec<Vec<f64>> = self
            .skies
            .iter()
            .map(|(visibilities, coarse)| {
                let sky = Mat::from_fn(pixels, 1, |pixel, _| coarse.values()[pixel]);
                let predicted = self.rows.transpose() * &sky;
                (0..parts).map(|k| visibilities[k / 2][k % 2] - predicted[(k, 0)]).collect()
            })
            .collect();
        let weight = |k: usize| self.sigma_k_sr[k / 2].powi(-2);
        let weighted = Mat::from_fn(pixels, parts, |pixel, k| self.rows[(pixel, k)] * weight(k));
        let mut normal = &weighted * self.rows.transpose();
        let regularisation = self.epsilon * largest_eigenvalue(&normal);
        for pixel in 0..pixels {
            normal[(pixel, pixel)] += regularisation;
        }
        let errors = Mat::from_fn(parts, columns.len(), |k, sky| columns[sky][k]);
        let right = &weighted * &errors;
        // R makes the matrix positive definite.
        let solved = match normal.llt(Side::Lower) {
            Ok(factor) => factor.solve(&right),
            Err(_) => Mat::from_fn(pixels, columns.len(), |_, _| f64::NAN),
        };
        let count = columns.len() as f64;
        let square = |pixel: usize| (0..columns.len()).map(|sky| solved[(pixel, sky)].powi(2)).sum::<f64>();
        let variance: Vec<f64> = (0..pixels).map(|pixel| square(pixel) / count).collect();
        let trace: f64 = variance.iter().sum();
        let mean_k = self.skies[0].1.values().iter().sum::<f64>() / pixels as f64;
        SubPixelCase {
            nside: 0,
            nside_fine: 0,
            rows: "",
            windows: self.sample.windows,
            visibilities: self.sample.pairs.len(),
            classes: self.classes(&columns),
            sigma_b_k: (trace / pixels as f64).sqrt(),
            tr_sigma_b_k2: trace,
            mean_k,
            map_k: variance.into_iter().map(f64::sqrt).collect(),
        }
    }

    fn classes(&self, errors: &[Vec<f64>]) -> Vec<SubPixelClass> {
        let class = |edges: &[f64]| {
            let within = |k: &usize| (edges[0]..edges[1]).contains(&self.sample.length_bp[*k]);
            let members: Vec<usize> = (0..self.sample.pairs.len()).filter(within).collect();
            let mean = |value: &dyn Fn(usize, usize) -> f64| {
                let all = errors.len() * members.len();
                let sums = (0..errors.len()).map(|sky| members.iter().map(|&k| value(sky, k)).sum::<f64>());
                (sums.sum::<f64>() / all as f64).sqrt()
            };
            let error = |sky: usize, k: usize| errors[sky][2 * k].powi(2) + errors[sky][2 * k + 1].powi(2);
            let power = |sky: usize, k: usize| {
                let [re, im] = self.skies[sky].0[k];
                re * re + im * im
            };
            // Relative to the noise of both parts.
            let noisy = |sky: usize, k: usize| error(sky, k) / 2.0 / self.sigma_k_sr[k].powi(2);
            let rms_k_sr = mean(&error);
            (!members.is_empty()).then(|| SubPixelClass {
                from_bp: edges[0],
                to_bp: edges[1],
                count: members.len(),
                rms_k_sr,
                of_visibility: rms_k_sr / mean(&power),
                of_noise: mean(&noisy),
            })
        };
        CLASSES_BP.windows(2).filter_map(class).collect()
    }
}

/// The largest eigenvalue of a symmetric matrix, by power iteration.
fn largest_eigenvalue(matrix: &Mat<f64>) -> f64 {
    let order = matrix.nrows();
    let mut vector = Mat::from_fn(order, 1, |k, _| 1.0 + 0.5 * (k as f64).sin());
    let mut value = 0.0;
    for _ in 0..POWER_STEPS {
        let next = matrix * &vector;
        value = next.norm_l2() / vector.norm_l2();
        let scale = 1.0 / next.norm_l2();
        vector = Mat::from_fn(order, 1, |k, _| scale * next[(k, 0)]);
    }
    value
}

fn plot(numbers: &SubPixelNumbers) -> Plot {
    let curve = |case: &SubPixelCase| Curve {
        label: format!("nside {}, {}", case.nside, case.rows),
        points: case
            .classes
            .iter()
            .map(|class| (0.5 * (class.from_bp + class.to_bp), class.of_visibility))
            .collect(),
        dashed: case.rows == "average",
    };
    Plot {
        title: format!("Sub-pixel noise, {} skies at {} MHz", numbers.skies, numbers.frequency_hz / 1e6),
        x: Axis { label: "baseline (b_{p})".to_owned(), ..Axis::default() },
        y: Axis { label: "rms of b / rms of V".to_owned(), log: true, limits: None },
        curves: numbers.cases.iter().map(curve).collect(),
        levels: vec![1.0],
    }
}

fn draw_maps(numbers: &SubPixelNumbers) -> Result<crate::products::pictures::Picture, FigureError> {
    let panel = |case: &'_ SubPixelCase| {
        (format!("nside {}, {}: rms {:.2e} K", case.nside, case.rows, case.sigma_b_k), case.map_k.clone())
    };
    let drawn: Vec<(String, Vec<f64>)> = numbers.cases.iter().map(panel).collect();
    let panels: Vec<MapPanel<'_>> = drawn
        .iter()
        .map(|(caption, values)| MapPanel {
            values,
            caption: caption.clone(),
            scale: ColourScale::robust(values, Scaling::Log, Palette::default()),
            unit: "K".to_owned(),
        })
        .collect();
    let sheet = Sheet {
        title: "Square root of the diagonal of Sigma_{b}".to_owned(),
        subtitle: format!("epsilon {:e}, {} skies", numbers.epsilon, numbers.skies),
        columns: 2,
        width_px: 1800,
        ..Sheet::default()
    };
    Ok(draw_sheet(&panels, &sheet)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::AntennaResponse;

    #[test]
    fn covariances_of_orthogonal_rows_are_known() {
        // Twelve pixels and six visibilities, each part of which measures one pixel times r_k; two skies.
        let r = |k: usize| 1.0 + 0.25 * k as f64;
        let rows = Mat::from_fn(12, 12, |pixel, k| if pixel == k { r(k) } else { 0.0 });
        let geometry = PairGeometry {
            r_i_m: [2e6, 0.0, 0.0],
            r_j_m: [2e6, 100.0, 0.0],
            frequency_hz: 1e7,
            moon_radius_m: 1.7e6,
            response: AntennaResponse::Isotropic,
        };
        let sample = VisibilitySample {
            windows: 1,
            pairs: vec![geometry; 6],
            dt_s: vec![1.0; 6],
            length_bp: vec![0.1, 0.1, 0.1, 1.9, 1.9, 1.9],
        };
        // The errors b of the two skies: 1 and 2 in every part of the first three visibilities, 3 and 4 in the others.
        let error = |sky: usize, k: usize| (1 + sky + if k < 6 { 0 } else { 2 }) as f64;
        let coarse = |sky: usize| {
            SkyMap::new(Frame::Ecliptic, (0..12).map(|p| 5.0 + (p * (sky + 1)) as f64).collect()).unwrap()
        };
        let skies: Vec<(Vec<[f64; 2]>, SkyMap)> = (0..2)
            .map(|sky| {
                let map = coarse(sky);
                let part = |k: usize| r(k) * map.values()[k] + error(sky, k);
                ((0..6).map(|v| [part(2 * v), part(2 * v + 1)]).collect(), map)
            })
            .collect();
        let inputs =
            CaseInputs { epsilon: 0.1, sample: &sample, sigma_k_sr: &[0.5; 6], skies: &skies, rows: &rows };
        let found = inputs.case();
        // A = r / sigma^2 / (r^2 / sigma^2 + epsilon W_max), W_max = r_11^2 / sigma^2.
        for (k, found) in found.map_k.iter().enumerate() {
            let gain = r(k) / (r(k).powi(2) + 0.1 * r(11).powi(2));
            let mean_square = 0.5 * (error(0, k).powi(2) + error(1, k).powi(2));
            // The power iteration for W_max stops at 1e-6 or better, as its second eigenvalue is 0.87 of it.
            assert!((found / (gain * mean_square.sqrt()) - 1.0).abs() < 1e-6, "{k}: {found}");
        }
        // With two parts per visibility, twice the means of 1, 4 and of 9, 16.
        let [near, far] = &found.classes[..] else { panic!("{} classes", found.classes.len()) };
        assert!((near.rms_k_sr - 5_f64.sqrt()).abs() < 1e-12 && (far.rms_k_sr - 5.0).abs() < 1e-12);
        // In units of a sigma of 0.5 per part.
        assert!((near.of_noise - 2.5_f64.sqrt() / 0.5).abs() < 1e-12);
        assert_eq!((near.count, far.count), (3, 3));
    }
}
