//! Total powers of the daughters as rows beside the visibilities of a channel.
//!
//! ```text
//! P(t) = (1 + g) (Int T (1 - M) dOmega + constant) + (o + s t) <P> + noise,   t from -1/2 to 1/2 over the pass, M = 1 behind the Moon.
//! ```
//!
//! Gain g, offset o and slope s are free in every pass of every daughter, with Gaussian priors, and are marginalised: with the columns C of
//! the three, in units of their priors, N^-1 becomes `N^-1 - N^-1 C (C'N^-1 C + I)^-1 C'N^-1`. The column of the gain is the power itself.
//! It is taken from the measured power at first and then from the map, in rounds. The gain stays part of the noise in all of them: fitted as a
//! number it would make the sky too bright by the square of its prior.

use std::collections::BTreeMap;
use std::f64::consts::SQRT_2;
use std::ops::Range;

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, Par, Side};
use rayon::prelude::*;
use serde::Serialize;

use super::disc::{Disc, Discs, visible_sr};
use crate::imaging::SkyPower;
use crate::imaging::power::Coupling;
use crate::imaging::unknowns::{degrees_orders_parts, index_of};
use crate::numerics::legendre::Legendre;
use crate::units::vector::{Vec3, add, dot, norm, scale, sub, unit};

/// Powers farther apart than this are of two passes, s.
const GAP_S: f64 = 600.0;
/// The longest pass, about an orbit, s.
const PASS_S: f64 = 8000.0;
/// Change of the Moon's direction, seen from a daughter, over which powers are averaged, in units of 1 / l_max.
const AVERAGED_RAD_L: f64 = 0.7;
/// The largest such change.
const AVERAGED_DEG_MAX: f64 = 2.0;
/// Highest degree of the blocks that precondition; powers have little of higher ones.
const BLOCK_DEGREES: usize = 48;
/// Highest degree up to which the normal matrix is found whole to precondition. With 12 its eigenvalues are within 0.68 to 1.5 of the
/// preconditioner's, with the blocks alone down to 0.07 (nside 32, 13,216 passes).
const COUPLED_DEGREES: usize = 12;
/// The matrix up to this degree is summed in so many parts, of so many rows at a time.
const COUPLING_PARTS: usize = 16;
const COUPLING_ROWS: usize = 4096;
/// Free parameters of a pass: gain, offset, slope.
const NUISANCES: usize = 3;

/// A total power of a daughter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PowerSample {
    /// Number of the daughter, from 0.
    pub daughter: u8,
    /// Middle of the integration, s.
    pub time_s: f64,
    /// Its length, s.
    pub duration_s: f64,
    /// Position relative to the Moon, ecliptic, m.
    pub r_m: Vec3,
    /// Power, K sr.
    pub power_k_sr: f64,
    /// Standard deviation of its noise, K sr.
    pub sigma_k_sr: f64,
}

/// Standard deviations of what is free in every pass of every daughter, and what the powers have beside the sky.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PowerPriors {
    /// Gain of the power, as a fraction.
    pub gain: f64,
    /// Offset, as a fraction of the mean power of the pass.
    pub offset: f64,
    /// Change of the offset from the start to the end of the pass, as a fraction of the same.
    pub slope: f64,
    /// Receiver noise and the Moon's own emission, K sr: one value, or one for each channel in order of frequency.
    pub constant_k_sr: Vec<f64>,
}

impl PowerPriors {
    /// Priors of gain, offset and slope in percent.
    #[must_use]
    pub fn of_percent(percent: [f64; 3], constant_k_sr: Vec<f64>) -> Self {
        let [gain, offset, slope] = percent.map(|percent| percent / 100.0);
        Self { gain, offset, slope, constant_k_sr }
    }
}

/// How the powers of a channel take part in its map.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PowerAgreement {
    /// Rows, each an average of consecutive integrations.
    pub rows: usize,
    /// Passes of the daughters, each with a gain, an offset and a slope of its own.
    pub passes: usize,
    /// Reduced chi-square of the powers with the map; above 1 it multiplies the variances.
    pub chi_square: f64,
}

/// The powers of a channel.
pub(super) struct PowerRows {
    l_max: usize,
    discs: Vec<Disc>,
    operator: Discs,
    power_k_sr: Vec<f64>,
    /// Number of independent samples in each row.
    independent: Vec<f64>,
    /// Time from -1/2 to 1/2 over the pass.
    time: Vec<f64>,
    passes: Vec<Range<usize>>,
    priors: [f64; NUISANCES],
    constant_k_sr: f64,
    /// Variance of what the sky has beyond l_max, (K sr)^2, times the number of rows that see the same structure: their errors are equal, and
    /// do not average.
    beyond: Vec<f64>,
}

/// The rows with their marginalised weights.
pub(super) struct WeightedRows<'a> {
    rows: &'a PowerRows,
    /// Multiplies the variance of every row.
    variance_factor: f64,
    weights: Vec<f64>,
    /// G of `N^-1 - G G'` in each pass.
    g: Vec<[f64; NUISANCES]>,
}

/// Sums over consecutive powers, weighted by their numbers of independent samples.
#[derive(Clone, Copy, Default)]
struct WeightedSums {
    independent: f64,
    power_k_sr: f64,
    time_s: f64,
    radius_m: f64,
    position_m: Vec3,
    /// Direction of the first, and start and end of all of them, not weighted.
    start_hat: Vec3,
    span_s: [f64; 2],
}

impl WeightedSums {
    fn add(&mut self, sample: &PowerSample) {
        // The radiometer equation.
        let count = (sample.power_k_sr / sample.sigma_k_sr).powi(2);
        self.independent += count;
        self.power_k_sr += count * sample.power_k_sr;
        self.time_s += count * sample.time_s;
        self.radius_m += count * norm(sample.r_m);
        self.position_m = add(self.position_m, scale(count, sample.r_m));
        self.span_s[1] = sample.time_s + 0.5 * sample.duration_s;
    }
}

impl PowerRows {
    /// Averages the powers of a channel, which are by daughter and time; `None` if there are none.
    pub(super) fn new(
        samples: &[PowerSample],
        moon_radius_m: f64,
        sky: &SkyPower,
        priors: &PowerPriors,
        constant_k_sr: f64,
    ) -> Option<Self> {
        let l_max = sky.power_k2.len() - 1;
        let change_rad = (AVERAGED_RAD_L / l_max.max(1) as f64).min(AVERAGED_DEG_MAX.to_radians());
        let (averages, passes) = averaged(samples, change_rad.cos());
        let disc = |average: &WeightedSums| Disc {
            direction: unit(scale(-1.0, average.position_m)),
            cos_radius: (1.0 - (moon_radius_m * average.independent / average.radius_m).powi(2))
                .max(0.0)
                .sqrt(),
        };
        let discs: Vec<Disc> = averages.iter().map(disc).collect();
        // Orbits are nearly circles: for this variance one radius of the Moon serves.
        let middle = discs.get(discs.len() / 2)?;
        let variance = variance_beyond(sky, middle.cos_radius);
        let times: Vec<f64> = averages.iter().map(|average| average.time_s / average.independent).collect();
        let time = passes.iter().flat_map(|pass| {
            let [first, last] = [times[pass.start], times[pass.end - 1]];
            let length = if last > first { last - first } else { 1.0 };
            times[pass.clone()].iter().map(move |t| (t - 0.5 * (first + last)) / length)
        });
        Some(Self {
            l_max,
            operator: Discs::new(l_max, &arcs(&discs, &averages, &passes)),
            time: time.collect(),
            beyond: sharing(&discs, l_max).into_iter().map(|rows| rows * variance).collect(),
            discs,
            power_k_sr: averages.iter().map(|average| average.power_k_sr / average.independent).collect(),
            independent: averages.iter().map(|average| average.independent).collect(),
            passes,
            priors: [priors.gain, priors.offset, priors.slope],
            constant_k_sr,
        })
    }

    pub(super) fn measured(&self) -> Vec<f64> {
        self.power_k_sr.clone()
    }

    /// The powers that a map of these unknowns has.
    pub(super) fn model(&self, x: &[f64]) -> Vec<f64> {
        self.operator.powers(x).into_iter().map(|power| power + self.constant_k_sr).collect()
    }

    /// Marginalises gains, offsets and slopes for powers near `model`. `variance_factor` multiplies the variance of every row.
    pub(super) fn weighted(&self, model: &[f64], variance_factor: f64) -> WeightedRows<'_> {
        let variance =
            |((power, independent), beyond): ((&f64, &f64), &f64)| power * power / independent + beyond;
        let weights: Vec<f64> = model
            .iter()
            .zip(&self.independent)
            .zip(&self.beyond)
            .map(|row| (variance_factor * variance(row)).recip())
            .collect();
        let g = self.passes.par_iter().flat_map_iter(|pass| {
            let mean = self.power_k_sr[pass.clone()].iter().sum::<f64>() / pass.len() as f64;
            let c: Vec<[f64; NUISANCES]> = pass
                .clone()
                .map(|row| {
                    let [gain, offset, slope] = self.priors;
                    [gain * model[row], offset * mean, slope * mean * self.time[row]]
                })
                .collect();
            marginalised(&c, &weights[pass.clone()])
        });
        WeightedRows { rows: self, variance_factor, g: g.collect(), weights }
    }

    /// Real harmonics up to a degree, in the order of unknowns, at the discs of some rows.
    fn harmonics(&self, degree_max: usize, rows: Range<usize>) -> Mat<f64> {
        let directions = || self.discs[rows.clone()].iter().map(|disc| disc.direction);
        let legendre = Legendre::new(degree_max, directions().map(cos_sin));
        let azimuths_rad: Vec<f64> = directions().map(|[x, y, _]| y.atan2(x)).collect();
        let ones = vec![1.0; rows.len()];
        let mut harmonics = Mat::<f64>::zeros(rows.len(), (degree_max + 1).pow(2));
        for m in 0..=degree_max {
            let waves: Vec<(f64, f64)> =
                azimuths_rad.iter().map(|azimuth| (m as f64 * azimuth).sin_cos()).collect();
            let lambda = legendre.rows::<f64>(m, &ones);
            for (l, lambda) in (m..).zip(lambda.chunks_exact(rows.len())) {
                let at = index_of(degree_max, l, m, 0);
                for (row, (y, (sin, cos))) in lambda.iter().zip(&waves).enumerate() {
                    if m == 0 {
                        harmonics[(row, at)] = *y;
                    } else {
                        harmonics[(row, at)] = SQRT_2 * y * cos;
                        harmonics[(row, at + 1)] = -SQRT_2 * y * sin;
                    }
                }
            }
        }
        harmonics
    }
}

impl WeightedRows<'_> {
    /// Multiplies a vector of rows by the marginalised weights.
    fn weigh(&self, rows: &[f64]) -> Vec<f64> {
        let of_pass = |pass: &Range<usize>| {
            let mut sums = [0.0; NUISANCES];
            for row in pass.clone() {
                sums.iter_mut().zip(self.g[row]).for_each(|(sum, g)| *sum += g * rows[row]);
            }
            let correction =
                move |row: usize| self.g[row].iter().zip(sums).map(|(g, sum)| g * sum).sum::<f64>();
            pass.clone().map(move |row| self.weights[row] * rows[row] - correction(row))
        };
        self.rows.passes.iter().flat_map(of_pass).collect()
    }

    /// Multiplies a map's unknowns by the normal matrix of the powers.
    pub(super) fn product(&self, x: &[f64]) -> Vec<f64> {
        self.rows.operator.transposed(&self.weigh(&self.rows.operator.powers(x)))
    }

    fn sky_k_sr(&self) -> Vec<f64> {
        self.rows.power_k_sr.iter().map(|power| power - self.rows.constant_k_sr).collect()
    }

    pub(super) fn right_hand_side(&self) -> Vec<f64> {
        self.rows.operator.transposed(&self.weigh(&self.sky_k_sr()))
    }

    /// Agreement of the powers with a map.
    pub(super) fn agreement(&self, x: &[f64]) -> PowerAgreement {
        let sky = self.rows.operator.powers(x);
        let residuals: Vec<f64> = self.sky_k_sr().iter().zip(sky).map(|(a, b)| a - b).collect();
        let square: f64 = residuals.iter().zip(self.weigh(&residuals)).map(|(a, b)| a * b).sum();
        let rows = residuals.len();
        PowerAgreement {
            rows,
            passes: self.rows.passes.len(),
            chi_square: self.variance_factor * square / rows as f64,
        }
    }

    /// The blocks of the normal matrix, averaged over rotations about the pole, by order and parity as those of the visibilities.
    pub(super) fn blocks(&self) -> Vec<Mat<f64>> {
        let l_max = self.rows.l_max;
        let highest = l_max.min(BLOCK_DEGREES);
        let points: Vec<(f64, f64)> = self.rows.discs.iter().map(|disc| cos_sin(disc.direction)).collect();
        let azimuths_rad: Vec<f64> =
            self.rows.discs.iter().map(|disc| disc.direction[1].atan2(disc.direction[0])).collect();
        let middle = self.rows.discs.len() / 2;
        let visible = visible_sr(highest, self.rows.discs[middle].cos_radius);
        let legendre = Legendre::new(highest, points.into_iter());
        let ones = vec![1.0; azimuths_rad.len()];
        let of_order = |m: usize| -> [Mat<f64>; 2] {
            let lambda = if m <= highest { legendre.rows::<f64>(m, &ones) } else { Vec::new() };
            let of_parity = |parity: usize| {
                let size = (l_max + 2).saturating_sub(m + parity) / 2;
                let mut block = Mat::<f64>::zeros(size, size);
                if m <= highest {
                    let degrees: Vec<usize> = (m + parity..=highest).step_by(2).collect();
                    let rows = |l: &usize| &lambda[(l - m) * azimuths_rad.len()..][..azimuths_rad.len()];
                    let found = self.block(&degrees.iter().map(rows).collect::<Vec<_>>(), m, &azimuths_rad);
                    for (j, l) in degrees.iter().enumerate() {
                        for (i, k) in degrees.iter().enumerate() {
                            block[(i, j)] = visible[*k] * found[(i, j)] * visible[*l];
                        }
                    }
                }
                block
            };
            [0, 1].map(of_parity)
        };
        let orders: Vec<[Mat<f64>; 2]> = (0..=l_max).into_par_iter().map(of_order).collect();
        orders.into_iter().flatten().filter(|block| block.nrows() > 0).collect()
    }

    /// What `blocks` lack of the normal matrix of the powers, up to [`COUPLED_DEGREES`].
    pub(super) fn coupling(&self, blocks: &[Mat<f64>]) -> Coupling {
        let degree_max = self.rows.l_max.min(COUPLED_DEGREES);
        let passes = &self.rows.passes;
        let per_part = passes.len().div_ceil(COUPLING_PARTS).max(1);
        let parts: Vec<Mat<f64>> =
            passes.par_chunks(per_part).map(|passes| self.normal_matrix(degree_max, passes)).collect();
        let unknowns: Vec<(usize, usize, usize)> = degrees_orders_parts(degree_max).collect();
        let middle = self.rows.discs.len() / 2;
        let visible = visible_sr(degree_max, self.rows.discs[middle].cos_radius);
        let matrix = Mat::from_fn(unknowns.len(), unknowns.len(), |i, j| {
            let [(l, m, part), (other, m_other, part_other)] = [unknowns[i], unknowns[j]];
            let whole: f64 = parts.iter().map(|matrix| matrix[(i, j)]).sum();
            let is_of_block = (m, part) == (m_other, part_other) && (l + other).is_multiple_of(2);
            let of_block = match is_of_block {
                true => blocks[2 * m + (l - m) % 2][((l - m) / 2, (other - m) / 2)],
                false => 0.0,
            };
            visible[l] * whole * visible[other] - of_block
        });
        let places = unknowns.iter().map(|(l, m, part)| index_of(self.rows.l_max, *l, *m, *part)).collect();
        Coupling { degree_max, places, matrix }
    }

    /// `Y' (N^-1 - G G') Y` of the rows of some passes.
    fn normal_matrix(&self, degree_max: usize, passes: &[Range<usize>]) -> Mat<f64> {
        let count = (degree_max + 1).pow(2);
        let mut matrix = Mat::<f64>::zeros(count, count);
        let mut rest = passes;
        while let [first, ..] = rest {
            let count_max = rest.partition_point(|pass| pass.end - first.start <= COUPLING_ROWS).max(1);
            let (passes, others) = rest.split_at(count_max);
            rest = others;
            let rows = first.start..passes[passes.len() - 1].end;
            let mut harmonics = self.rows.harmonics(degree_max, rows.clone());
            let mut g_times_y = Mat::<f64>::zeros(NUISANCES * passes.len(), count);
            for (number, pass) in passes.iter().enumerate() {
                for row in pass.clone() {
                    for (which, g) in self.g[row].iter().enumerate() {
                        for k in 0..count {
                            g_times_y[(NUISANCES * number + which, k)] +=
                                g * harmonics[(row - rows.start, k)];
                        }
                    }
                }
            }
            for k in 0..count {
                for row in rows.clone() {
                    harmonics[(row - rows.start, k)] *= self.weights[row].sqrt();
                }
            }
            for (factor, columns) in [(1.0, &harmonics), (-1.0, &g_times_y)] {
                matmul(&mut matrix, Accum::Add, columns.transpose(), columns, factor, Par::Seq);
            }
        }
        matrix
    }

    /// `Y' (N^-1 - G G') Y` of harmonics of one order at the discs, averaged over rotations about the pole.
    fn block(&self, lambda: &[&[f64]], m: usize, azimuths_rad: &[f64]) -> Mat<f64> {
        let count = lambda.len();
        let weighted =
            Mat::from_fn(azimuths_rad.len(), count, |row, k| self.weights[row].sqrt() * lambda[k][row]);
        let mut block = weighted.transpose() * &weighted;
        let mut g_times_y = Mat::<f64>::zeros(2 * NUISANCES * self.rows.passes.len(), count);
        for (number, pass) in self.rows.passes.iter().enumerate() {
            for row in pass.clone() {
                let (sin, cos) = (m as f64 * azimuths_rad[row]).sin_cos();
                for (which, g) in self.g[row].iter().enumerate() {
                    let at = 2 * (NUISANCES * number + which);
                    for (k, lambda) in lambda.iter().enumerate() {
                        g_times_y[(at, k)] += g * cos * lambda[row];
                        g_times_y[(at + 1, k)] += g * sin * lambda[row];
                    }
                }
            }
        }
        block -= g_times_y.transpose() * &g_times_y;
        block
    }
}

fn cos_sin([x, y, z]: Vec3) -> (f64, f64) {
    // Not at a pole, where Legendre functions have no logarithm.
    (z, x.hypot(y).max(1e-12))
}

/// Each disc with the two directions of Gauss's quadrature over the arc on which it moves during its powers: over 60 s, 2.6 degrees, the degree
/// l = 20 loses 3.4 %. The quadrature is off by `(l arc)^4 / 4320`, 3e-3 for l = 20 over 120 s. The motion is that between the neighbours in
/// its pass; a power alone in its pass counts as that of its middle.
fn arcs(discs: &[Disc], averages: &[WeightedSums], passes: &[Range<usize>]) -> Vec<(Disc, [Vec3; 2])> {
    let time_s = |row: usize| averages[row].time_s / averages[row].independent;
    let of_row = |(pass, row): (&Range<usize>, usize)| {
        let [before, after] = [row.saturating_sub(1).max(pass.start), (row + 1).min(pass.end - 1)];
        let moved = sub(discs[after].direction, discs[before].direction);
        let elapsed_s = time_s(after) - time_s(before);
        let [start_s, end_s] = averages[row].span_s;
        let share = if elapsed_s > 0.0 { (end_s - start_s) / elapsed_s } else { 0.0 };
        let offset = scale(0.5 * share / 3.0_f64.sqrt(), moved);
        let disc = discs[row];
        (disc, [unit(sub(disc.direction, offset)), unit(add(disc.direction, offset))])
    };
    passes.iter().flat_map(|pass| pass.clone().map(move |row| (pass, row))).map(of_row).collect()
}

/// Averages powers while the Moon's direction changes by less than an angle. Returns the averages, and those of each pass of each daughter.
fn averaged(samples: &[PowerSample], cos_change: f64) -> (Vec<WeightedSums>, Vec<Range<usize>>) {
    let is_good = |sample: &&PowerSample| {
        let positive = sample.power_k_sr > 0.0 && sample.sigma_k_sr > 0.0;
        let is_short = (0.0..=PASS_S).contains(&sample.duration_s);
        positive
            && is_short
            && sample.power_k_sr.is_finite()
            && sample.sigma_k_sr.is_finite()
            && norm(sample.r_m) > 0.0
    };
    let (mut averages, mut passes) = (Vec::<WeightedSums>::new(), Vec::<Range<usize>>::new());
    let mut before: Option<&PowerSample> = None;
    let mut start_s = 0.0;
    for sample in samples.iter().filter(is_good) {
        let direction = unit(sample.r_m);
        let is_of_pass = |before: &PowerSample| {
            // From the end of one to the start of the next.
            let gap_s = sample.time_s - before.time_s - 0.5 * (sample.duration_s + before.duration_s);
            let is_soon = gap_s < GAP_S && sample.time_s - start_s < PASS_S;
            before.daughter == sample.daughter && is_soon
        };
        let goes_on = before.is_some_and(is_of_pass);
        if !goes_on {
            start_s = sample.time_s;
        }
        let is_near = averages.last().is_some_and(|average| dot(average.start_hat, direction) > cos_change);
        if !(goes_on && is_near) {
            let begun_s = sample.time_s - 0.5 * sample.duration_s;
            averages.push(WeightedSums {
                start_hat: direction,
                span_s: [begun_s; 2],
                ..WeightedSums::default()
            });
            match passes.last_mut() {
                Some(pass) if goes_on => pass.end = averages.len(),
                _ => passes.push(averages.len() - 1..averages.len()),
            }
        }
        if let Some(average) = averages.last_mut() {
            average.add(sample);
        }
        before = Some(sample);
    }
    (averages, passes)
}

/// G of `N^-1 - G G' = N^-1 - N^-1 C (C'N^-1 C + I)^-1 C'N^-1`, row by row.
fn marginalised(columns: &[[f64; NUISANCES]], weights: &[f64]) -> Vec<[f64; NUISANCES]> {
    let mut matrix = Mat::<f64>::identity(NUISANCES, NUISANCES);
    for (c, w) in columns.iter().zip(weights) {
        for i in 0..NUISANCES {
            for j in 0..NUISANCES {
                matrix[(i, j)] += c[i] * w * c[j];
            }
        }
    }
    // Its eigenvalues are at least 1: only input that is not finite has no factor.
    let Ok(factor) = matrix.llt(Side::Lower) else { return vec![[0.0; NUISANCES]; columns.len()] };
    let lower = factor.L();
    let of_row = |(c, w): (&[f64; NUISANCES], &f64)| {
        let mut g = [0.0; NUISANCES];
        for i in 0..NUISANCES {
            let known: f64 = (0..i).map(|j| lower[(i, j)] * g[j]).sum();
            g[i] = (w * c[i] - known) / lower[(i, i)];
        }
        g
    };
    columns.iter().zip(weights).map(of_row).collect()
}

/// Variance of a power from what the sky has beyond l_max, with C_l continued as it ends.
fn variance_beyond(sky: &SkyPower, cos_radius: f64) -> f64 {
    let first = sky.power_k2.len();
    let visible = visible_sr(4 * first, cos_radius);
    let term = |l: usize| {
        (2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * sky.continued_k2(l) * visible[l].powi(2)
    };
    (first..=4 * first).map(term).sum()
}

/// For each disc the number of those that see the same structure beyond l_max: those in its cell of half a wavelength of that degree.
fn sharing(discs: &[Disc], l_max: usize) -> Vec<f64> {
    let step = std::f64::consts::PI / (l_max + 1) as f64;
    let cell = |disc: &Disc| {
        let [x, y, z] = disc.direction;
        let ring = (z.clamp(-1.0, 1.0).acos() / step) as i64;
        let circumference = ((ring as f64 + 0.5) * step).sin();
        (ring, (y.atan2(x) * circumference / step).floor() as i64)
    };
    let mut counts: BTreeMap<(i64, i64), f64> = BTreeMap::new();
    discs.iter().for_each(|disc| *counts.entry(cell(disc)).or_default() += 1.0);
    discs.iter().map(|disc| counts[&cell(disc)]).collect()
}
