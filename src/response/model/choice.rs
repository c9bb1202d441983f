//! The choice of the model of a channel, by the cost of each.

use std::f64::consts::TAU;
use std::fmt;

use serde::{Deserialize, Serialize};

use super::{general, harmonic};
use crate::response::general::row_tables_bytes;
use crate::sky::SkyConfig;

/// The model asked for in the configuration.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ModelChoice {
    /// Direct sums if they take about a minute or less, otherwise the cheaper model.
    #[default]
    Auto,
    /// Sums over the sky's pixels.
    Direct,
    /// Spherical harmonics; satellites follow each other on one circle.
    Harmonic,
    /// Spherical harmonics for satellites anywhere.
    General,
}

/// Kind of a visibility model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ModelKind {
    /// Sums over the sky's pixels.
    Direct,
    /// Spherical harmonics on a circle.
    Harmonic,
    /// Spherical harmonics anywhere.
    General,
}

impl ModelKind {
    /// Preferred number of visibilities a call ([`VisibilityModel::batch`](super::VisibilityModel::batch)).
    #[must_use]
    pub fn batch(self) -> usize {
        match self {
            Self::Direct => 1,
            Self::Harmonic => harmonic::BATCH,
            Self::General => general::BATCH,
        }
    }
}

impl fmt::Display for ModelKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Direct => "direct",
            Self::Harmonic => "harmonic",
            Self::General => "general",
        })
    }
}

/// The work of a channel's model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Load {
    /// Visibilities.
    pub visibilities: f64,
    /// nside of the sky.
    pub sky_nside: usize,
    /// Longest baseline, wavelengths.
    pub baseline_wavelengths_max: f64,
    /// Greatest band limit; 0 for the limit that the baselines need, or what the map determines if that is less.
    pub l_max: usize,
    /// Whether visibilities are averages over their integrations.
    pub smeared: bool,
    /// Whether satellites follow each other on one circle, as the harmonic model has them.
    pub circle: bool,
}

/// The chosen model, the reason, and the cost of each.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ModelPlan {
    /// The model.
    pub kind: ModelKind,
    /// Reason for the choice.
    pub why: &'static str,
    /// Band limit of the harmonic and of the general model.
    pub l_max: usize,
    /// Longest baseline of the harmonic model, wavelengths.
    pub baseline_wavelengths_max: f64,
    /// Cost of direct sums, fringes: one a pixel and visibility.
    pub direct_fringes: f64,
    /// Cost of setting up the harmonic model, in fringes that take as long.
    pub set_up_fringes: f64,
    /// Cost of one visibility of the harmonic model, in such fringes.
    pub visibility_fringes: f64,
    /// Cost of one visibility of the general model, in such fringes.
    pub general_fringes: f64,
    /// Memory of the chosen model, bytes.
    pub bytes: f64,
}

/// Greatest band limit that is chosen without being asked for.
const L_MAX: usize = 1024;
/// Direct sums up to this cost are preferred: about a minute on two cores, and they have no band limit.
const DIRECT_FRINGES_ALLOWED: f64 = 1.2e11;
/// Memory of a batch of the general model, bytes a position: the position, its view, its row's place.
const POSITION_BYTES: f64 = 600.0;
/// Most memory of a harmonic model that was not asked for, bytes.
const BYTES_ALLOWED: f64 = 8e9;

impl ModelPlan {
    /// Chooses the model for `load`. Does not depend on the machine, because results depend on the model.
    #[must_use]
    pub fn new(choice: ModelChoice, load: Load) -> Self {
        let u_max = load.baseline_wavelengths_max;
        let l_max = match load.l_max {
            0 => band_limit(u_max).min(SkyConfig::l_max_held(load.sky_nside)),
            // The configuration may ask for a little more than the default; what the map does not determine is refused by those who
            // make its coefficients.
            asked => asked,
        };
        let pixels = 12.0 * (load.sky_nside as f64).powi(2);
        let direct_fringes = pixels * load.visibilities;
        let (l, nodes) = (l_max as f64, 4.5 * u_max + 40.0);
        // Measured, in fringes of 0.45 ns (two cores): patterns and rotation; rotated sky, products, sampling.
        let set_up_fringes = 2e8 + 40.0 * l * l * nodes + 6.0 * l * l * l;
        let visibility_fringes = 500.0 + 8.0 * l;
        let harmonic_fringes = set_up_fringes + visibility_fringes * load.visibilities;
        // Patterns of both signs of mu; d+ and d-; rotated skies.
        let harmonic_bytes = 2.2 * l * l * nodes + 4.0 / 3.0 * l * l * l + 600.0 * l * l;
        // A row for every 45 visibilities, and their interpolation (bench `general`).
        let general_fringes = 7e3 + 0.7 * l * (l + TAU * u_max);
        let (kind, why) = match choice {
            ModelChoice::Direct => (ModelKind::Direct, "as configured"),
            ModelChoice::Harmonic => (ModelKind::Harmonic, "as configured"),
            ModelChoice::General => (ModelKind::General, "as configured"),
            ModelChoice::Auto if !load.circle => {
                if direct_fringes <= DIRECT_FRINGES_ALLOWED {
                    (ModelKind::Direct, "takes a minute at most")
                } else if general_fringes < pixels {
                    (ModelKind::General, "no common circle; cheaper than direct sums")
                } else {
                    (
                        ModelKind::Direct,
                        "harmonics on a circle need a common one; cheaper than at true positions",
                    )
                }
            }
            ModelChoice::Auto if load.smeared => (ModelKind::Harmonic, "averages over integrations"),
            ModelChoice::Auto if direct_fringes <= DIRECT_FRINGES_ALLOWED => {
                (ModelKind::Direct, "takes a minute at most")
            }
            ModelChoice::Auto if harmonic_bytes > BYTES_ALLOWED => {
                (ModelKind::Direct, "harmonic needs more than 8 GB")
            }
            ModelChoice::Auto if harmonic_fringes < direct_fringes => (ModelKind::Harmonic, "cheaper"),
            ModelChoice::Auto => (ModelKind::Direct, "cheaper"),
        };
        let bytes = match kind {
            ModelKind::Direct => 28.0 * pixels,
            ModelKind::Harmonic => harmonic_bytes,
            ModelKind::General => {
                let threads = rayon::current_num_threads();
                row_tables_bytes(l_max, u_max, threads, 0) as f64 + POSITION_BYTES * general::BATCH as f64
            }
        };
        Self {
            kind,
            why,
            l_max,
            baseline_wavelengths_max: u_max,
            direct_fringes,
            set_up_fringes,
            visibility_fringes,
            general_fringes,
            bytes,
        }
    }
}

/// As [`degrees_seen`], at most 1024.
fn band_limit(u_max: f64) -> usize {
    degrees_seen(u_max).min(L_MAX)
}

/// Greatest degree that fringes of `u_max` wavelengths reach: 2 pi u plus the width of the Airy function's decay.
#[must_use]
pub fn degrees_seen(u_max: f64) -> usize {
    let turning = TAU * u_max;
    (turning + 6.0 * turning.cbrt()).ceil() as usize + 8
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(visibilities: f64, sky_nside: usize, u: f64) -> Load {
        Load { visibilities, sky_nside, baseline_wavelengths_max: u, l_max: 0, smeared: false, circle: true }
    }

    #[test]
    fn small_jobs_are_summed_and_large_ones_are_not() {
        let plan = |load| ModelPlan::new(ModelChoice::Auto, load);
        assert_eq!(plan(load(5e4, 64, 31.3)).kind, ModelKind::Direct);
        let paper = plan(load(2.6e7, 512, 125.2));
        assert_eq!(paper.kind, ModelKind::Harmonic);
        // 2 pi 125.2 = 787, and the fall beyond.
        assert!((840..860).contains(&paper.l_max), "{}", paper.l_max);
        assert_eq!(plan(load(2.6e7, 64, 125.2)).l_max, 144);
        // What is asked for is taken, or refused where the map does not hold it.
        assert_eq!(plan(Load { l_max: 191, ..load(2.6e7, 64, 125.2) }).l_max, 191);
        assert_eq!(plan(Load { l_max: 1024, ..load(2.6e7, 512, 125.2) }).l_max, 1024);
        // All pairs at 10 MHz ask for gigabytes of patterns.
        assert_eq!(plan(load(1.9e9, 512, 3336.0)).kind, ModelKind::Direct);
        assert_eq!(plan(Load { smeared: true, ..load(5e4, 64, 31.3) }).kind, ModelKind::Harmonic);
    }

    #[test]
    fn without_a_circle_large_jobs_take_rows_at_true_positions() {
        let plan = |load| ModelPlan::new(ModelChoice::Auto, Load { circle: false, ..load }).kind;
        assert_eq!(plan(load(5e4, 64, 31.3)), ModelKind::Direct);
        assert_eq!(plan(Load { l_max: 288, ..load(2.6e7, 256, 125.2) }), ModelKind::General);
        // Few degrees cost little, and so do few pixels.
        assert_eq!(plan(Load { l_max: 20, ..load(2.6e7, 64, 3.0) }), ModelKind::General);
        assert_eq!(plan(load(2.6e7, 16, 125.2)), ModelKind::Direct);
    }

    #[test]
    fn what_is_asked_for_is_taken() {
        for (choice, kind) in [
            (ModelChoice::Direct, ModelKind::Direct),
            (ModelChoice::Harmonic, ModelKind::Harmonic),
            (ModelChoice::General, ModelKind::General),
        ] {
            let plan = ModelPlan::new(choice, Load { l_max: 200, ..load(10.0, 512, 10.0) });
            assert_eq!((plan.kind, plan.l_max), (kind, 200));
        }
    }
}
