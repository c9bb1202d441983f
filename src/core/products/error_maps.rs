//! How well a map is known: pixel by pixel, and by degree.

use std::path::Path;

use crate::imaging::anywhere::Refinement;
use crate::imaging::{Diagnostics, Sample, SkyPower, Uncertainty};
use crate::sky::Frame;
use crate::sky::fits::{Column, FitsError, WriteOptions, write_columns};

/// Probabilities between which an interval holds 68.27 %: within one standard deviation of a Gaussian.
const INTERVAL: [f64; 2] = [0.15866, 0.84134];

/// A map that says how well another is known.
pub struct ErrorMap {
    /// Name of its file.
    pub file: &'static str,
    column: &'static str,
    unit: &'static str,
    values: Vec<f64>,
}

impl ErrorMap {
    /// Standard deviation, mask and resolution of a map.
    pub(super) fn all(errors: &Uncertainty) -> [Self; 3] {
        let [mask, resolution] = Self::coverage(errors);
        let values = errors.sigma_k.clone();
        [Self { file: "sigma.fits", column: "TEMPERATURE", unit: "K", values }, mask, resolution]
    }

    /// Mask and resolution.
    pub fn coverage(errors: &Uncertainty) -> [Self; 2] {
        let values = errors.resolution_deg.clone();
        [
            Self { file: "mask.fits", column: "MEASURED", unit: "", values: errors.mask() },
            Self { file: "resolution.fits", column: "RESOLUTION", unit: "deg", values },
        ]
    }

    /// Writes it into `folder`.
    ///
    /// # Errors
    /// As [`write_columns`].
    pub fn write(&self, folder: &Path, options: &WriteOptions) -> Result<(), FitsError> {
        let column = Column { name: self.column, unit: self.unit, values: &self.values };
        write_columns(&folder.join(self.file), Frame::Ecliptic, &[column], options)
    }
}

/// What the standard deviation of a map's pixels has and what it has not; the mask follows it. At most 68 characters, which a header's line holds.
pub(super) fn limits(diagnostics: &Diagnostics, refinement: Option<&Refinement>) -> &'static str {
    // Sums over pixels are solved without iterations.
    match (refinement, diagnostics.convergence) {
        (Some(_), _) => "degrees up to l_max; too small far off a circle: lunarray sample",
        (None, Some(_)) if diagnostics.is_of_pixels => {
            "all degrees; may be too small for few data: lunarray sample"
        }
        (None, Some(_)) if diagnostics.errors_may_mislead => {
            "degrees up to l_max; may be far too small: the node turned little"
        }
        (None, Some(_)) => "degrees up to l_max",
        (None, None) => "all degrees, also those beyond the map's",
    }
}

/// Factor of errors from which it is said that they are too small.
const LOW: f64 = 1.4;

/// By how much errors of a harmonic map are too small, if that is to be said. Those of pixel maps have the sky's other degrees.
pub(super) fn errors_low_by(power: &SkyPower, diagnostics: &Diagnostics, visibilities: u64) -> Option<f64> {
    let is_of_harmonics = diagnostics.convergence.is_some() && !diagnostics.is_of_pixels;
    Some(power.errors_low_by(visibilities)).filter(|factor| is_of_harmonics && *factor >= LOW)
}

/// A vector with the standard deviation of each component, in words.
pub fn told_vector(value: [f64; 3], sigma: [f64; 3]) -> String {
    let one = |k: usize| format!("{:.2e} +- {:.1e}", value[k], sigma[k]);
    format!("({}, {}, {})", one(0), one(1), one(2))
}

/// The angular power of samples, a line a degree from l = 1: the median, and the interval that holds it with 68 % probability.
pub fn own_power_csv(samples: &[Sample]) -> String {
    let mut table = String::from(
        "# Angular power of the sky itself by the samples, with the interval that holds it with 68 % probability.\n\
         l,power_k2,low_k2,high_k2\n",
    );
    let degrees = samples.first().map_or(0, |sample| sample.power_k2.len());
    for l in 1..degrees {
        let mut powers: Vec<f64> = samples.iter().map(|sample| sample.power_k2[l]).collect();
        powers.sort_by(f64::total_cmp);
        let [low, middle, high] = [INTERVAL[0], 0.5, INTERVAL[1]].map(|share| quantile(&powers, share));
        table.push_str(&format!("{l},{middle:e},{low:e},{high:e}\n"));
    }
    table
}

/// Of sorted values: those of a few samples are spread evenly over probabilities.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let place = (share * (sorted.len() + 1) as f64 - 1.0).clamp(0.0, (sorted.len() - 1) as f64);
    let (below, rest) = (place.floor() as usize, place.fract());
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + rest * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::Convergence;

    #[test]
    fn limits_fit_into_a_line_of_a_header() {
        let convergence = Some(Convergence { iterations: 1, residual: 0.0, converged: true });
        for (convergence, is_of_pixels) in [(convergence, true), (convergence, false), (None, true)] {
            for errors_may_mislead in [false, true] {
                let diagnostics =
                    Diagnostics { convergence, is_of_pixels, errors_may_mislead, ..Diagnostics::default() };
                let found = limits(&diagnostics, None);
                assert!(found.len() <= 68, "{found}");
            }
        }
    }

    #[test]
    fn quantiles_are_those_of_evenly_spread_values() {
        let values: Vec<f64> = (1..=9).map(f64::from).collect();
        // The k-th of nine lies at k / 10.
        for (share, expected) in [(0.5, 5.0), (0.1, 1.0), (0.25, 2.5), (0.01, 1.0), (0.99, 9.0)] {
            assert!((quantile(&values, share) - expected).abs() < 1e-12, "{share}");
        }
        assert_eq!(quantile(&[3.0], 0.2), 3.0);
    }
}
