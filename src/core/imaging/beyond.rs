//! What the sky has beyond the degrees of a map, as noise of each visibility: the diagonal of the paper's N_b, by the baseline's length.
//!
//! A fringe of a baseline of u wavelengths has the local degree `l = 2 pi u sin(theta)` at an angle theta from the baseline, and `4 pi (2 l + 1)
//! j_l(2 pi u)^2` of its power at degree l. Of the ring at theta the Moon, whose middle lies across the baseline, hides the share h. So of a sky of
//! power C_l the real part of a visibility has, beyond l_max, the variance
//!
//! ```text
//! N_b = 1/2 sum_{l > l_max} (2 l + 1) 4 pi j_l(2 pi u)^2 C_l (1 - h),   cos(pi h) = cos(rho) / sin(theta),   sin(theta) = min(1, l / 2 pi u)
//! ```
//!
//! with rho the Moon's radius as seen. It holds where 2 pi u lies beyond l_max; near it the edge of the Moon adds about a third. A weight w becomes
//! `w / (1 + w N_b)`: a sum of a visibility's own numbers alone, in whatever order it comes.

use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};
use std::path::Path;

use crate::files::read_text;
use crate::frames::PlacedVisibilities;
use crate::imaging::SolveError;
use crate::imaging::regulariser::{POWER_FILE_BYTES_MAX, parse_power};
use crate::numerics::bessel::{BesselOrders, LANES};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{norm, sub};

/// Steps of a table, wavelengths: N_b follows rings of sin(theta), not single fringes, but has the wiggles of j_l near 2 pi u = l_max.
const STEP: f64 = 0.02;
/// Radii of orbits share a table within this, m: it changes what the Moon hides by 0.1 %.
const RADIUS_STEP_M: f64 = 10e3;
/// Greatest radius, in those of the Moon, beyond which what it hides does not count.
const RADII_MAX: f64 = 10.0;

/// The power of the sky beyond the degrees of one channel's map, and what it adds to visibilities.
#[derive(Clone, Debug)]
pub(in crate::imaging) struct BeyondNoise {
    /// C_l, K^2, from `l_max + 1` to where no baseline reaches.
    power_k2: Vec<f64>,
    l_max: usize,
    wavelength_m: f64,
    moon_radius_m: f64,
    u_max: f64,
    /// N_b, (K sr)^2, by length, for each radius in steps.
    tables: BTreeMap<u64, Vec<f64>>,
}

/// Reads a table of the sky's power, such as `sky-power.csv` of a map: its first degree, and C_l from there, K^2.
///
/// # Errors
/// A file that cannot be read or is no such table, or has less than two degrees.
pub fn read_power(path: &Path) -> Result<(usize, Vec<f64>), SolveError> {
    let failed = |found: String| SolveError::BeyondPower { path: path.to_owned(), found };
    let text = read_text(path, POWER_FILE_BYTES_MAX).map_err(|error| failed(error.to_string()))?;
    let (first, power_k2) = parse_power(&text).map_err(failed)?;
    if power_k2.len() < 2 {
        return Err(failed("one degree, which does not tell how it goes on".to_owned()));
    }
    Ok((first, power_k2))
}

/// Of a table from degree `first` the power at degree l: beyond its end it falls as over the last octave of it.
fn power_at(first: usize, power_k2: &[f64], l: usize) -> f64 {
    let last = first + power_k2.len() - 1;
    if l <= last {
        return power_k2.get(l.saturating_sub(first)).copied().unwrap_or(0.0);
    }
    let before = (last / 2).clamp(first, last - 1);
    let slope = (power_k2[last - first] / power_k2[before - first]).ln()
        / ((last + 1) as f64 / (before + 1) as f64).ln();
    power_k2[last - first] * ((l + 1) as f64 / (last + 1) as f64).powf(slope)
}

/// Degree from which on `j_l(2 pi u)` is nothing.
fn degree_reached(u: f64) -> usize {
    let x = TAU * u;
    (x + 5.0 * x.cbrt()) as usize + 5
}

impl BeyondNoise {
    /// For a channel whose map ends at `l_max` and has baselines up to `baseline_m_max`.
    pub(in crate::imaging) fn new(
        (first, power_k2): (usize, &[f64]),
        l_max: usize,
        frequency_hz: f64,
        baseline_m_max: f64,
        moon_radius_m: f64,
    ) -> Self {
        let wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz;
        let u_max = baseline_m_max / wavelength_m;
        let power_k2 = (l_max + 1..=degree_reached(u_max)).map(|l| power_at(first, power_k2, l)).collect();
        Self { power_k2, l_max, wavelength_m, moon_radius_m, u_max, tables: BTreeMap::new() }
    }

    /// Counts what is beyond as noise: lowers the weights.
    pub(in crate::imaging) fn lower_weights(&mut self, placed: &mut PlacedVisibilities) {
        for k in 0..placed.len() {
            let u = norm(sub(placed.r_i_m[k], placed.r_j_m[k])) / self.wavelength_m;
            let variance = self.variance(u, norm(placed.r_i_m[k]));
            // Others are refused as they are.
            if let Some(weight) = placed.weight.get_mut(k).filter(|weight| **weight > 0.0) {
                *weight /= 1.0 + *weight * variance;
            }
        }
    }

    /// N_b, (K sr)^2, of a baseline of `u` wavelengths at a distance from the Moon's centre.
    fn variance(&mut self, u: f64, radius_m: f64) -> f64 {
        let radii = (radius_m / self.moon_radius_m).clamp(1.0, RADII_MAX);
        if self.power_k2.is_empty() || !radii.is_finite() || !(0.0..=self.u_max).contains(&u) {
            return 0.0;
        }
        let step = (radii * self.moon_radius_m / RADIUS_STEP_M).round() as u64;
        if !self.tables.contains_key(&step) {
            let radii = (step as f64 * RADIUS_STEP_M / self.moon_radius_m).max(1.0);
            self.tables.insert(step, self.table((1.0 - radii.powi(-2)).sqrt()));
        }
        let Some(table) = self.tables.get(&step) else { return 0.0 };
        let (below, share) = ((u / STEP) as usize, (u / STEP).fract());
        let at = |k: usize| table.get(k).or(table.last()).copied().unwrap_or(0.0);
        at(below) * (1.0 - share) + at(below + 1) * share
    }

    /// N_b by length, where the cosine of the Moon's radius as seen is `cos_rho`.
    fn table(&self, cos_rho: f64) -> Vec<f64> {
        let count = (self.u_max / STEP) as usize + 2;
        let mut orders = BesselOrders::default();
        let mut table = Vec::with_capacity(count);
        for first in (0..count).step_by(LANES) {
            let x: [f64; LANES] = std::array::from_fn(|lane| TAU * STEP * (first + lane).max(1) as f64);
            let longest = degree_reached(x[LANES - 1] / TAU);
            let bessel = orders.spherical(&x, longest.max(self.l_max + 1));
            for (lane, x) in x.iter().enumerate().take(count - first) {
                let term = |(k, power): (usize, &f64)| {
                    let l = self.l_max + 1 + k;
                    let j = bessel.get(l).map_or(0.0, |lanes| lanes[lane]);
                    let seen = 1.0 - hidden(cos_rho, (l as f64 / x).min(1.0));
                    (2 * l + 1) as f64 * 4.0 * PI * j * j * power * seen
                };
                table.push(0.5 * self.power_k2.iter().enumerate().map(term).sum::<f64>());
            }
        }
        table
    }
}

/// Share of the ring at an angle of this sine from the baseline that the Moon hides.
fn hidden(cos_rho: f64, sin_theta: f64) -> f64 {
    if sin_theta <= cos_rho { 0.0 } else { (cos_rho / sin_theta).acos() / PI }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::sky::harmonics::{Alm, synthesis};
    use crate::sky::healpix::{pixel_area_sr, pixel_directions};
    use crate::units::constants::MOON_RADIUS_M;
    use crate::units::vector::dot;
    use crate::units::{StreamKind, random_stream};

    /// Skies of degrees beyond a map's, and their visibilities as sums over the directions that neither satellite's Moon hides.
    #[test]
    fn variances_are_those_of_visibilities_of_skies_beyond() {
        const L_MAX: usize = 12;
        const SKIES: usize = 24;
        const NSIDE: usize = 32;
        let power: Vec<f64> = (0..=60).map(|l| 1e6 * ((l + 1) as f64).powf(-2.5)).collect();
        let mut stream = random_stream(77, StreamKind::Probe, [0, 0]);
        let skies: Vec<Vec<f64>> = (0..SKIES)
            .map(|_| {
                let mut alm = Alm::zeros(60);
                for (l, power) in power.iter().enumerate().skip(L_MAX + 1) {
                    for m in 0..=l {
                        let scale = power.sqrt() * if m == 0 { 1.0 } else { 0.5_f64.sqrt() };
                        let [re, im]: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut stream));
                        *alm.get_mut(l, m) =
                            Complex64::new(scale * re, if m == 0 { 0.0 } else { scale * im });
                    }
                }
                synthesis(&alm, NSIDE).unwrap()
            })
            .collect();
        let directions = pixel_directions(NSIDE);
        let radius_m = MOON_RADIUS_M + 300e3;
        let wavelength_m = 30.0;
        let mut beyond =
            BeyondNoise::new((0, &power), L_MAX, SPEED_OF_LIGHT_M_S / wavelength_m, 300.0, MOON_RADIUS_M);
        let lengths = [1.0, 2.0, 3.0, 5.0, 8.0];
        let mut seen = Vec::new();
        for u in lengths {
            let (mut sum, mut count) = (0.0, 0.0);
            for place in 0..24 {
                // Pairs that follow one another, at places all over the sky.
                let (node, phase) = (2.4 * f64::from(place), 0.7 * f64::from(place));
                let tilt: f64 = 0.5 + 0.1 * f64::from(place % 5);
                let at = |phase: f64| {
                    let (x, y) = (phase.cos(), phase.sin());
                    let (y, z) = (y * tilt.cos(), y * tilt.sin());
                    [x * node.cos() - y * node.sin(), x * node.sin() + y * node.cos(), z]
                        .map(|x| radius_m * x)
                };
                let [i, j] = [at(phase), at(phase - u * wavelength_m / radius_m)];
                let b = sub(i, j);
                let limit = -(1.0 - (MOON_RADIUS_M / radius_m).powi(2)).sqrt() * radius_m;
                let fringe: Vec<Complex64> = directions
                    .iter()
                    .map(|n| {
                        let is_seen = dot(i, *n) > limit && dot(j, *n) > limit;
                        let phase = -TAU * dot(b, *n) / wavelength_m;
                        if is_seen {
                            Complex64::from_polar(pixel_area_sr(NSIDE), phase)
                        } else {
                            Complex64::ZERO
                        }
                    })
                    .collect();
                for sky in &skies {
                    let value: Complex64 = fringe.iter().zip(sky).map(|(fringe, sky)| fringe * sky).sum();
                    sum += 0.5 * value.norm_sqr();
                    count += 1.0;
                }
            }
            seen.push(sum / count);
        }
        let ratios: Vec<f64> =
            lengths.iter().zip(&seen).map(|(u, v)| beyond.variance(*u, radius_m) / v).collect();
        // 576 values, of which those of one sky are not independent: 6 %; twice that.
        assert!(ratios[2..].iter().all(|ratio| (ratio - 1.0).abs() < 0.15), "{ratios:?}");
        // The formula's limit, as documented: where 2 pi u = 12.6 the Moon's edge adds a third.
        assert!((ratios[1] - 0.75).abs() < 0.15, "{ratios:?}");
        // Below, it has nothing where there is hardly anything.
        assert!(ratios[0] < 0.01 && seen[0] < 0.03 * seen[2], "{ratios:?} {seen:?}");
    }

    #[test]
    fn weights_fall_with_what_is_beyond_and_tables_go_on_as_they_end() {
        let power: Vec<f64> = (2..=40).map(|l| ((l + 1) as f64).powi(-3)).collect();
        // A power law stays one.
        for l in [2, 40, 41, 400] {
            assert!((power_at(2, &power, l) / ((l + 1) as f64).powi(-3) - 1.0).abs() < 1e-9, "{l}");
        }
        assert_eq!(power_at(2, &power, 1), power[0]);
        let mut beyond = BeyondNoise::new((2, &power), 10, SPEED_OF_LIGHT_M_S, 20.0, MOON_RADIUS_M);
        let mut placed = PlacedVisibilities {
            r_i_m: vec![[MOON_RADIUS_M + 3e5, 0.0, 0.0]; 3],
            r_j_m: [0.5, 10.0, 10.0].map(|u| [MOON_RADIUS_M + 3e5, u, 0.0]).to_vec(),
            weight: vec![1e4, 1e4, -1e4],
            time_s: vec![0.0; 3],
            ..PlacedVisibilities::default()
        };
        beyond.lower_weights(&mut placed);
        // Half a wavelength sees nothing beyond l = 10: j_11(pi)^2 is below 1e-10.
        assert!((placed.weight[0] / 1e4 - 1.0).abs() < 1e-6, "{:?}", placed.weight);
        let variance = beyond.variance(10.0, MOON_RADIUS_M + 3e5);
        assert!((placed.weight[1] - 1.0 / (1e-4 + variance)).abs() < 1e-6 * placed.weight[1]);
        assert!(placed.weight[1] < 0.9e4);
        // One that is not positive is refused later, and so stays as it is.
        assert_eq!(placed.weight[2], -1e4);
    }
}
