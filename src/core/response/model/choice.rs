//! Choice of a channel's visibility model by cost.

use std::f64::consts::TAU;
use std::fmt;

use serde::{Deserialize, Serialize};

use super::{general, harmonic};
use crate::response::general::row_tables_bytes;
use crate::sky::SkyConfig;

/// Model as set in the configuration.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ModelChoice {
    /// Direct sums if they take seconds (without a common circle: a minute) or less, otherwise the cheaper model.
    #[default]
    Auto,
    /// Sums over the sky's pixels.
    Direct,
    /// Spherical harmonics, for satellites on one circle.
    Harmonic,
    /// Spherical harmonics, for satellites at any positions.
    General,
}

/// Kind of a visibility model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ModelKind {
    /// Sums over the sky's pixels.
    Direct,
    /// Spherical harmonics, for satellites on one circle.
    Harmonic,
    /// Spherical harmonics, for satellites at any positions.
    General,
}

impl ModelKind {
    /// Preferred number of visibilities per call ([`VisibilityModel::batch`](super::VisibilityModel::batch)).
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

/// Size of a channel's problem, from which the cost of each model follows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Workload {
    /// Number of visibilities.
    pub visibilities: f64,
    /// nside of the sky.
    pub sky_nside: usize,
    /// Longest baseline, wavelengths.
    pub baseline_wavelengths_max: f64,
    /// Band limit; 0 for the limit that the baselines need, or that the map determines if that is less.
    pub l_max: usize,
    /// Whether visibilities are averages over their integrations.
    pub is_time_averaged: bool,
    /// Whether all satellites are on one circle, as the harmonic model requires.
    pub is_on_circle: bool,
    /// Whether the sky has points at exact directions, beside which its map need not hold all that the baselines see.
    pub has_points: bool,
}

impl Workload {
    /// Whether baselines see degrees of the sky that harmonics do not have, and no band limit was asked for. Harmonics leave them
    /// out, so that their choice would change what is simulated.
    fn is_beyond_map(&self) -> bool {
        let seen = l_max_of_fringes(self.baseline_wavelengths_max);
        self.l_max == 0
            && !self.has_points
            && seen > l_max_of_sky(self.baseline_wavelengths_max, self.sky_nside)
    }
}

/// The chosen model, the reason, and the cost of each.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ModelPlan {
    /// The model.
    pub kind: ModelKind,
    /// Reason of the choice.
    pub why: &'static str,
    /// Band limit of the harmonic and of the general model.
    pub l_max: usize,
    /// Longest baseline of the harmonic model, wavelengths.
    pub baseline_wavelengths_max: f64,
    /// Cost of direct sums, fringes: one per pixel and visibility.
    pub direct_fringes: f64,
    /// Cost of setting up the harmonic model, as the number of fringes that take the same time.
    pub set_up_fringes: f64,
    /// Cost of one visibility of the harmonic model, in the same unit.
    pub visibility_fringes: f64,
    /// Cost of one visibility of the general model, in the same unit.
    pub general_fringes: f64,
    /// Memory of the chosen model, bytes.
    pub bytes: f64,
}

/// Maximum band limit unless the configuration sets one.
const DEFAULT_L_MAX_MAX: usize = 1024;
/// Without a circle direct sums up to this cost are preferred: they take about a minute on two cores, and have no band limit.
const DIRECT_FRINGES_MAX: f64 = 1.2e11;
/// The same on a circle, where harmonics are as accurate: some seconds.
const CIRCLE_DIRECT_FRINGES_MAX: f64 = 5e9;
/// Memory of a batch of the general model, bytes per position: its coordinates, its view, and the index of its row.
const POSITION_BYTES: f64 = 600.0;
/// Maximum memory of a harmonic model unless the configuration sets that model, bytes.
const HARMONIC_BYTES_MAX: f64 = 8e9;

impl ModelPlan {
    /// Chooses the model for `load`. The choice does not depend on the machine, because results depend on the model.
    #[must_use]
    pub fn new(choice: ModelChoice, load: Workload) -> Self {
        let u_max = load.baseline_wavelengths_max;
        let l_max = match load.l_max {
            0 => l_max_of_sky(u_max, load.sky_nside),
            // Coefficients that the map does not determine are refused later, where they are computed.
            configured => configured,
        };
        let pixels = 12.0 * (load.sky_nside as f64).powi(2);
        let direct_fringes = pixels * load.visibilities;
        let (l, nodes) = (l_max as f64, 4.5 * u_max + 40.0);
        // Measured in fringes of 0.45 ns (two cores). Set-up: patterns and rotation; visibility: rotated sky, products, interpolation.
        let set_up_fringes = 2e8 + 40.0 * l * l * nodes + 6.0 * l * l * l;
        let visibility_fringes = 500.0 + 8.0 * l;
        let harmonic_fringes = set_up_fringes + visibility_fringes * load.visibilities;
        // Patterns of both signs of mu, d+ and d-, and rotated skies.
        let harmonic_bytes = 2.2 * l * l * nodes + 4.0 / 3.0 * l * l * l + 600.0 * l * l;
        // One row per 45 visibilities, and interpolation (bench `general`).
        let general_fringes = 7e3 + 0.7 * l * (l + TAU * u_max);
        let (kind, why) = match choice {
            ModelChoice::Direct => (ModelKind::Direct, "as configured"),
            ModelChoice::Harmonic => (ModelKind::Harmonic, "as configured"),
            ModelChoice::General => (ModelKind::General, "as configured"),
            ModelChoice::Auto if load.is_beyond_map() && !load.is_time_averaged => {
                (ModelKind::Direct, "harmonics would leave out what baselines see")
            }
            ModelChoice::Auto if !load.is_on_circle => {
                if direct_fringes <= DIRECT_FRINGES_MAX {
                    (ModelKind::Direct, "at most a minute")
                } else if general_fringes < pixels {
                    (ModelKind::General, "no common circle; faster than direct sums")
                } else {
                    (ModelKind::Direct, "no common circle; faster than general")
                }
            }
            ModelChoice::Auto if load.is_time_averaged => (ModelKind::Harmonic, "averages over integrations"),
            ModelChoice::Auto if direct_fringes <= CIRCLE_DIRECT_FRINGES_MAX => {
                (ModelKind::Direct, "seconds")
            }
            ModelChoice::Auto if harmonic_bytes > HARMONIC_BYTES_MAX => {
                (ModelKind::Direct, "harmonic needs more than 8 GB")
            }
            ModelChoice::Auto if harmonic_fringes < direct_fringes => (ModelKind::Harmonic, "faster"),
            ModelChoice::Auto => (ModelKind::Direct, "faster"),
        };
        let bytes = match kind {
            ModelKind::Direct => 28.0 * pixels,
            ModelKind::Harmonic => harmonic_bytes,
            ModelKind::General => {
                let threads = rayon::current_num_threads();
                row_tables_bytes(l_max, u_max, f64::INFINITY, threads, 0) as f64
                    + POSITION_BYTES * general::BATCH as f64
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

/// Band limit of harmonics: that which baselines need, at most 1024, or that the map determines.
fn l_max_of_sky(u_max: f64, nside: usize) -> usize {
    default_l_max(u_max).min(SkyConfig::l_max_determined(nside))
}

/// Band limit that baselines need, at most 1024.
fn default_l_max(u_max: f64) -> usize {
    l_max_of_fringes(u_max).min(DEFAULT_L_MAX_MAX)
}

/// Maximum degree to which fringes of `u_max` wavelengths respond: 2 pi u plus the width of the Airy function's decay.
#[must_use]
pub fn l_max_of_fringes(u_max: f64) -> usize {
    let turning = TAU * u_max;
    (turning + 6.0 * turning.cbrt()).ceil() as usize + 8
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(visibilities: f64, sky_nside: usize, u: f64) -> Workload {
        Workload {
            visibilities,
            sky_nside,
            baseline_wavelengths_max: u,
            l_max: 0,
            is_time_averaged: false,
            is_on_circle: true,
            has_points: false,
        }
    }

    #[test]
    fn small_jobs_are_summed_and_large_ones_are_not() {
        let plan = |load| ModelPlan::new(ModelChoice::Auto, load);
        assert_eq!(plan(load(5e4, 64, 31.3)).kind, ModelKind::Direct);
        assert_eq!(plan(load(5e4, 128, 31.3)).kind, ModelKind::Harmonic);
        let paper = plan(load(2.6e7, 512, 125.2));
        assert_eq!(paper.kind, ModelKind::Harmonic);
        // 2 pi 125.2 = 787, plus the width of the decay.
        assert!((840..860).contains(&paper.l_max), "{}", paper.l_max);
        assert_eq!(plan(load(2.6e7, 64, 125.2)).l_max, 144);
        // A configured l_max is used as it is.
        assert_eq!(plan(Workload { l_max: 191, ..load(2.6e7, 64, 125.2) }).l_max, 191);
        assert_eq!(plan(Workload { l_max: 1024, ..load(2.6e7, 512, 125.2) }).l_max, 1024);
        // All pairs at 10 MHz would need gigabytes of patterns.
        assert_eq!(plan(load(1.9e9, 512, 3336.0)).kind, ModelKind::Direct);
        assert_eq!(
            plan(Workload { is_time_averaged: true, ..load(5e4, 64, 31.3) }).kind,
            ModelKind::Harmonic
        );
    }

    #[test]
    fn a_choice_by_cost_never_leaves_out_what_baselines_see() {
        let plan = |load| ModelPlan::new(ModelChoice::Auto, load).kind;
        // Baselines of 31.3 wavelengths see degrees up to 241; 9/4 nside are 144 and 288.
        for (nside, is_on_circle, kind) in [
            (64, true, ModelKind::Direct),
            (64, false, ModelKind::Direct),
            (128, true, ModelKind::Harmonic),
            (128, false, ModelKind::General),
        ] {
            assert_eq!(
                plan(Workload { is_on_circle, ..load(2.6e7, nside, 31.3) }),
                kind,
                "{nside} {is_on_circle}"
            );
        }
        // Harmonics end at 1024: 170 wavelengths see 1138, which nside 512 holds.
        assert_eq!(plan(load(2.6e7, 512, 170.0)), ModelKind::Direct);
        // What is asked for, and points beside a map that need not hold them.
        assert_eq!(plan(Workload { l_max: 144, ..load(2.6e7, 64, 31.3) }), ModelKind::Harmonic);
        assert_eq!(plan(Workload { has_points: true, ..load(2.6e7, 64, 31.3) }), ModelKind::Harmonic);
    }

    #[test]
    fn without_a_circle_large_jobs_take_rows_at_true_positions() {
        let plan = |load| ModelPlan::new(ModelChoice::Auto, Workload { is_on_circle: false, ..load }).kind;
        assert_eq!(plan(load(5e4, 64, 31.3)), ModelKind::Direct);
        assert_eq!(plan(Workload { l_max: 288, ..load(2.6e7, 256, 125.2) }), ModelKind::General);
        // A low band limit makes the general model cheap, a small map the direct sum.
        assert_eq!(plan(Workload { l_max: 20, ..load(2.6e7, 64, 3.0) }), ModelKind::General);
        assert_eq!(plan(load(2.6e7, 16, 125.2)), ModelKind::Direct);
    }

    #[test]
    fn what_is_asked_for_is_taken() {
        for (choice, kind) in [
            (ModelChoice::Direct, ModelKind::Direct),
            (ModelChoice::Harmonic, ModelKind::Harmonic),
            (ModelChoice::General, ModelKind::General),
        ] {
            let plan = ModelPlan::new(choice, Workload { l_max: 200, ..load(10.0, 512, 10.0) });
            assert_eq!((plan.kind, plan.l_max), (kind, 200));
        }
    }
}
