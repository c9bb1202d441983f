//! Visibilities of a band-limited sky for pairs at any orbital position and baseline length on one circular orbit.

use rustfft::{Fft, FftPlanner};
use std::f64::consts::TAU;
use std::sync::Arc;

use super::blocked::{BLOCK_NODES, BlockedPatterns};
use super::filter::FilteredPatterns;
use super::forward::ALPHAS_MAX;
use super::gridding_kernel::{Kernel, LANES};
use super::rotation::{RotatedSky, RotationTable};
use super::runs::RunLimits;
use super::{HarmonicError, NodeGrid, PairState, PatternGeometry, PatternTable};
use crate::numerics::chebyshev;
use crate::numerics::fft_length;
use crate::sky::harmonics::Alm;

/// Nodes per wavelength of u: 2.25 times the Nyquist density of the band |n_y| <= 1 (n_y is the direction cosine along the baseline), so that a kernel of six nodes
/// suffices.
const NODES_PER_WAVELENGTH: f64 = 4.5;
/// Number of grid values of alpha, the longitude of the node, for which the sky is rotated together.
pub(super) const ALPHA_BLOCK: usize = 64;
/// Maximum number of blocks of alphas that are kept and that a batch uses.
pub(super) const BLOCKS_KEPT: usize = 4;
/// Number of Chebyshev terms of a series between nodes.
pub(super) const TERMS: usize = 8;

/// Factor by which the interpolation error along alpha may exceed the tolerance at the highest order m, which few coefficients have.
pub(super) const ALPHA_TOLERANCE: f64 = 3.0;

/// Parameters of a model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ModelSettings {
    /// Orbit, Moon, wavelength and antennas.
    pub geometry: PatternGeometry,
    /// Inclination of the orbit, rad, 0 to pi.
    pub inclination_rad: f64,
    /// Longest baseline, wavelengths.
    pub u_max: f64,
    /// Ratio of bandwidth to frequency; each visibility is a mean over the channel. 0 for one frequency.
    pub fractional_bandwidth: f64,
    /// Maximum error at the band edge |n_y| = 1, relative to the rms visibility.
    pub tolerance: f64,
}

impl ModelSettings {
    /// Settings for a single frequency, with a tolerance of 1e-5.
    #[must_use]
    pub fn new(geometry: PatternGeometry, inclination_rad: f64, u_max: f64) -> Self {
        Self { geometry, inclination_rad, u_max, fractional_bandwidth: 0.0, tolerance: 1e-5 }
    }

    fn check(&self) -> Result<(), HarmonicError> {
        let geometry = &self.geometry;
        let orbit = geometry.orbit_radius_m;
        for (name, value, good, expected) in [
            ("orbit_radius_m", orbit, orbit > 0.0, "a positive number"),
            (
                "moon_radius_m",
                geometry.moon_radius_m,
                geometry.moon_radius_m > 0.0 && geometry.moon_radius_m < orbit,
                "between 0 and the orbit's radius",
            ),
            ("wavelength_m", geometry.wavelength_m, geometry.wavelength_m > 0.0, "a positive number"),
            (
                "inclination_rad",
                self.inclination_rad,
                (0.0..=std::f64::consts::PI).contains(&self.inclination_rad),
                "0 to pi",
            ),
            (
                "u_max",
                self.u_max,
                self.u_max >= 0.0 && self.u_max * geometry.wavelength_m < 2.0 * orbit,
                "0 to the orbit's diameter in wavelengths",
            ),
            (
                "fractional_bandwidth",
                self.fractional_bandwidth,
                (0.0..=0.5).contains(&self.fractional_bandwidth),
                "0 to 0.5",
            ),
            ("tolerance", self.tolerance, (1e-5..=1e-2).contains(&self.tolerance), "1e-5 to 1e-2"),
        ] {
            if !(good && value.is_finite()) {
                return Err(HarmonicError::Parameter { name, value, expected });
            }
        }
        Ok(())
    }
}

/// Visibilities of one sky at one frequency, for pairs on one orbit.
pub struct HarmonicModel {
    settings: ModelSettings,
    pub(super) sky: Alm,
    pub(super) rotation: Arc<RotationTable<f32>>,
    pub(super) patterns: BlockedPatterns,
    pub(super) u_kernel: Kernel,
    pub(super) alpha: PeriodicGrid,
    pub(super) gamma: PeriodicGrid,
    pub(super) fft: Arc<dyn Fft<f32>>,
    /// Blocks of alphas in `skies`.
    pub(super) blocks: Vec<usize>,
    pub(super) skies: Vec<RotatedSky<f32>>,
}

/// Uniform grid on the circle with its gridding kernel.
pub(super) struct PeriodicGrid {
    pub(super) count: usize,
    pub(super) kernel: Kernel,
    /// Reciprocals of the kernel's transform at orders 0, 1, ..
    pub(super) correction: Vec<f64>,
}

impl PeriodicGrid {
    fn new(l_max: usize, tolerance: f64) -> Self {
        let count = fft_length((2 * l_max + 1) * 5 / 4 + 2 * LANES);
        let kernel = Kernel::new(tolerance, count as f64 / (2 * l_max + 1) as f64);
        let frequencies: Vec<f64> = (0..=l_max).map(|m| m as f64 / count as f64).collect();
        let correction = kernel.transforms(&frequencies).iter().map(|t| 1.0 / t).collect();
        Self { count, kernel, correction }
    }
}

impl HarmonicModel {
    /// Builds the model of `sky` (K); takes seconds at l = 1024.
    ///
    /// # Errors
    /// [`HarmonicError::Parameter`].
    pub fn new(sky: Alm, settings: ModelSettings) -> Result<Self, HarmonicError> {
        settings.check()?;
        let rotation = Arc::new(RotationTable::new(sky.l_max(), settings.inclination_rad));
        Self::with_rotation(sky, settings, rotation)
    }

    /// Builds the model with a rotation table that channels share, for the sky's `l_max` and the inclination of the settings.
    ///
    /// # Errors
    /// [`HarmonicError::Parameter`].
    pub fn with_rotation(
        sky: Alm,
        settings: ModelSettings,
        rotation: Arc<RotationTable<f32>>,
    ) -> Result<Self, HarmonicError> {
        settings.check()?;
        let l_max = sky.l_max();
        if rotation.l_max() != l_max {
            let value = rotation.l_max() as f64;
            return Err(HarmonicError::Parameter {
                name: "rotation.l_max",
                value,
                expected: "the sky's l_max",
            });
        }
        let u_kernel = Kernel::new(settings.tolerance, 0.5 * NODES_PER_WAVELENGTH);
        let step = 1.0 / NODES_PER_WAVELENGTH;
        let margin = FilteredPatterns::MARGIN + u_kernel.width() / 2 + 1;
        let grid = NodeGrid {
            first: -(margin as f64) * step,
            step,
            count: (settings.u_max / step).ceil() as usize + 2 * margin + BLOCK_NODES,
        };
        let table = PatternTable::new(settings.geometry, l_max, grid);
        // The fringe exp(-2 pi i u n_y) has a spatial frequency of |n_y| / density cycles per node. The kernel's transform is divided out, and the
        // mean over the channel multiplies by a sinc.
        let patterns = FilteredPatterns::new(
            table,
            1.002 * step,
            |f| u_kernel.transforms(f).iter().map(|t| 1.0 / t).collect(),
            |u| u * settings.fractional_bandwidth / step,
        );
        let gamma = PeriodicGrid::new(l_max, settings.tolerance);
        Ok(Self {
            settings,
            rotation,
            patterns: BlockedPatterns::new(patterns, l_max),
            u_kernel,
            alpha: PeriodicGrid::new(l_max, settings.tolerance),
            fft: FftPlanner::new().plan_fft_forward(gamma.count),
            gamma,
            sky,
            blocks: Vec::new(),
            skies: Vec::new(),
        })
    }

    /// Settings of the model.
    #[must_use]
    pub fn settings(&self) -> &ModelSettings {
        &self.settings
    }

    pub(super) fn check_states(&self, states: &[PairState]) -> Result<(), HarmonicError> {
        let u_max = self.settings.u_max;
        for (index, state) in states.iter().enumerate() {
            let all = [state.node_rad, state.phase_rad, state.baseline_wavelengths, state.span_rad];
            if all.iter().any(|x| !x.is_finite()) {
                return Err(HarmonicError::NotFinite { index });
            }
            let u = state.baseline_wavelengths;
            if !(0.0..=u_max).contains(&u) {
                return Err(HarmonicError::Baseline { index, u, u_max });
            }
        }
        Ok(())
    }

    /// Rotates the sky to the alphas of the `needed` blocks that are not kept from earlier calls.
    pub(super) fn rotate_sky(&mut self, needed: &[usize]) {
        let missing: Vec<usize> = needed.iter().copied().filter(|b| !self.blocks.contains(b)).collect();
        for block in missing {
            if self.blocks.len() >= BLOCKS_KEPT
                && let Some(oldest) = self.blocks.iter().position(|b| !needed.contains(b))
            {
                self.blocks.remove(oldest);
                self.skies.remove(oldest);
            }
            let alphas: Vec<f64> = (0..ALPHA_BLOCK)
                .map(|k| TAU * (block * ALPHA_BLOCK + k) as f64 / self.alpha.count as f64)
                .collect();
            let sky = RotatedSky::new(&self.rotation, &self.sky, &self.alpha.correction, &alphas);
            self.blocks.push(block);
            self.skies.push(sky);
        }
    }

    pub(super) fn run_limits(&self) -> RunLimits {
        let tolerance = self.settings.tolerance;
        RunLimits {
            m_max: self.sky.l_max() as f64,
            // A wider range would read more than a block of nodes for a few visibilities.
            u_half: 0.5 * BLOCK_NODES as f64 / NODES_PER_WAVELENGTH,
            fringe_phase_half: chebyshev::h_max(TERMS, tolerance),
            node_half: chebyshev::h_max(ALPHAS_MAX, ALPHA_TOLERANCE * tolerance)
                / self.sky.l_max().max(1) as f64,
            residual: 10.0 * tolerance,
        }
    }
}
