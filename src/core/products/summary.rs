//! Summary of the maps of a channel.

use std::fmt;

use serde::Serialize;

use super::beam::EffectiveBeam;
use super::config::PostProcessing;
use super::error_maps::{limits, told_vector};
use super::latitudes::LatitudeError;
use super::point_beams::{BeamWidths, PointBeamSummary};
use crate::imaging::anywhere::Refinement;
use crate::imaging::circle::MoverFluxes;
use crate::imaging::{Convergence, Diagnostics, GainUncertainty, SkyPower};

/// Summary of one snapshot.
#[derive(Clone, Debug, Serialize, bincode::Encode, bincode::Decode)]
pub struct SnapshotSummary {
    /// Number, from 1.
    pub number: u32,
    /// Mission time of the last data in the map, s.
    pub until_s: f64,
    /// Number of visibilities in the map.
    pub visibilities: u64,
    /// RMS of (map - truth) / RMS of truth; absent without a truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rms_error_over_rms_truth: Option<f64>,
    /// Mean of rho_l over 1 <= l <= 2 nside; absent without a truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rho_mean: Option<f64>,
}

/// Angular power spectra of map, input and noise, from l = 0.
#[derive(Clone, Debug, Serialize, bincode::Encode, bincode::Decode)]
pub struct PowerSpectra {
    /// C_l of the map, K^2.
    pub map_k2: Vec<f64>,
    /// C_l of the input at its own resolution, K^2.
    pub input_k2: Vec<f64>,
    /// C_l of map times input, K^2.
    pub cross_k2: Vec<f64>,
    /// C_l of the noise-only map, K^2.
    pub noise_k2: Option<Vec<f64>>,
}

/// Summary of the maps of one channel and their quality.
#[derive(Clone, Debug, Serialize, bincode::Encode, bincode::Decode)]
pub struct ChannelSummary {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Seed of the space segment.
    pub seed: u64,
    /// Hash of the space segment's configuration.
    pub space_hash: String,
    /// nside of the maps.
    pub nside: usize,
    /// Mission times of the first and the last data, s.
    pub span_s: [f64; 2],
    /// Number of visibilities in the final map.
    pub visibilities: u64,
    /// Mean of the final map, K.
    pub mean_k: f64,
    /// Posterior standard deviation of the mean, K; absent unless R is from the data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mean_sigma_k: Option<f64>,
    /// Dipole along the ecliptic's x, y and z, K; absent unless R is from the data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dipole_k: Option<[f64; 3]>,
    /// Posterior standard deviation of the dipole, K.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dipole_sigma_k: Option<[f64; 3]>,
    /// Angular power of the sky, whose inverse is R, with its uncertainty; absent unless R is from the data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sky_power: Option<SkyPower>,
    /// How many times too small errors are if the sky beyond the degrees solved for makes the residuals exceed the noise; absent below 1.4.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub errors_low_by: Option<f64>,
    /// The part of the errors of map and power that is by errors of the applied gains; absent where it is not among them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain_errors: Option<GainUncertainty>,
    /// That, and after how many iterations, an interruption ended the solution: errors are not known, and an earlier map was kept. Absent
    /// without.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub interrupted: Option<String>,
    /// RMS of the noise-only map, K; NaN if the solution was interrupted.
    pub noise_rms_k: f64,
    /// Regularisation and solver diagnostics of the final solution.
    pub diagnostics: Diagnostics,
    /// Report on the iterative refinement with exact positions; absent without `map.refine`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refinement: Option<Refinement>,
    /// Fluxes of bodies that move, which the map is without; absent without `map.movers`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub movers: Option<MoverFluxes>,
    /// The snapshots, including the final map.
    pub snapshots: Vec<SnapshotSummary>,
    /// Whether the visibilities, and so the map, contain thermal noise; always true for real data.
    pub thermal_noise: bool,
    /// Processing of map, noise and input before they were compared; absent if there was none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub post_processing: Option<PostProcessing>,
    /// rho_l of the final map, including any thermal noise, and the input at its own resolution, from l = 0; absent without a
    /// truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rho: Option<Vec<f64>>,
    /// rho_l with the power of the noise-only map subtracted from that of the map; absent without noise or truth. Null where
    /// the noise exceeds the map.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rho_noise_subtracted: Option<Vec<f64>>,
    /// SNR_l of the final map; absent without a truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub snr: Option<Vec<f64>>,
    /// Angular power of the final map, its input and its noise; absent without a truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub power: Option<PowerSpectra>,
    /// The effective beam, and the noise per beam; absent without a truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub beam: Option<EffectiveBeam>,
    /// Effective beams in the directions of `map.beams_deg`; absent without any.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub point_beams: Vec<PointBeamSummary>,
    /// Relative error by distance from the ecliptic; absent without a truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub latitudes: Option<Vec<LatitudeError>>,
    /// Files written, relative to the output folder.
    pub files: Vec<String>,
}

impl ChannelSummary {
    /// Whether the noise of a pixel exceeds the mean of the map, so that single pixels are mostly noise. Never without thermal
    /// noise in the visibilities.
    #[must_use]
    pub fn is_noise(&self) -> bool {
        self.thermal_noise && self.noise_rms_k > self.mean_k.abs()
    }
}

/// Formats a temperature with its standard deviation, if known.
fn with_error(value_k: f64, sigma_k: Option<f64>) -> String {
    match sigma_k {
        Some(sigma_k) => format!("({value_k:.4e} +- {sigma_k:.1e}) K"),
        None => format!("{value_k:.3e} K"),
    }
}

impl ChannelSummary {
    fn regulariser_text(&self) -> String {
        let Some(power) = &self.sky_power else {
            return match self.diagnostics.epsilon {
                Some(epsilon) => {
                    format!("regulariser with epsilon {epsilon:e}: no errors of pixels")
                }
                None => String::new(),
            };
        };
        let constrained: f64 = power.constrained.iter().sum();
        let all = power.constrained.len().pow(2);
        let low = self.errors_low_by.map(|factor| {
            format!(
                "\n             errors are too small, by some {factor:.1} times, unless it is noise of instruments by which residuals exceed the \
                noise: baselines see the sky beyond l = {}; a larger map.nside or a smaller map.baseline_bp_max helps",
                power.power_k2.len().saturating_sub(1)
            )
        });
        format!(
            "regulariser from the data: {constrained:.0} of {all} harmonics measured, residuals {:.2} times the noise; errors of pixels in \
            sigma.fits ({}){}",
            power.noise_factor,
            limits(&self.diagnostics, self.refinement.as_ref()),
            low.unwrap_or_default()
        )
    }
}

impl fmt::Display for ChannelSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(interruption) = &self.interrupted {
            let kept = if self.files.is_empty() { ": the earlier map was kept" } else { "" };
            return write!(
                f,
                "{:>8.3} MHz  nside {}  {interruption}{kept}",
                self.frequency_hz / 1e6,
                self.nside
            );
        }
        write!(
            f,
            "{:>8.3} MHz  nside {}  {} visibilities  mean {}  noise {:.2e} K rms",
            self.frequency_hz / 1e6,
            self.nside,
            self.visibilities,
            with_error(self.mean_k, self.mean_sigma_k),
            self.noise_rms_k
        )?;
        if let (Some(dipole_k), Some(sigma_k)) = (self.dipole_k, self.dipole_sigma_k) {
            write!(f, "\n             dipole along x, y, z {} K", told_vector(dipole_k, sigma_k))?;
        }
        write!(f, "\n             {}", self.regulariser_text())?;
        if self.is_noise() {
            write!(
                f,
                "\n             mostly noise, {:.1} times the mean: more data or a smaller map.nside lowers it",
                self.noise_rms_k / self.mean_k.abs()
            )?;
        }
        if let Some(refinement) = &self.refinement {
            write!(f, "\n             {refinement}")?;
        } else if let Some(convergence) = self.diagnostics.convergence_of_pixels() {
            let Convergence { iterations, residual, converged } = convergence;
            let warning = if converged { "" } else { ": not converged, increase map.iterations_max" };
            write!(f, "\n             {iterations} iterations, residual {residual:.1e}{warning}")?;
        }
        if let Some(movers) = &self.movers {
            write!(f, "\n             {movers}")?;
        }
        if let Some((fwhm_deg, noise_jy)) =
            self.beam.as_ref().and_then(|beam| Some((beam.fwhm_deg?, beam.noise_rms_jy?)))
        {
            write!(
                f,
                "\n             effective beam: FWHM {fwhm_deg:.2} deg, noise {noise_jy:.3e} Jy rms per beam"
            )?;
        }
        for beam in &self.point_beams {
            let width = |widths: Option<BeamWidths>| {
                widths.map_or_else(|| "-".to_owned(), |widths| format!("{:.2} deg", widths.fwhm_deg()))
            };
            write!(
                f,
                "\n             beam at {:.1}, {:.1} deg: FWHM {}, after post-processing {}",
                beam.longitude_deg,
                beam.latitude_deg,
                width(beam.solved),
                width(beam.processed)
            )?;
        }
        let noise = if self.thermal_noise { "with the map's thermal noise" } else { "without thermal noise" };
        let curves = [(noise, &self.rho), ("noise power subtracted", &self.rho_noise_subtracted)];
        for (what, rho) in curves {
            let Some(rho) = rho else { continue };
            write!(f, "\n             rho_l ({what}):")?;
            let l_max = rho.len().saturating_sub(1).min(2 * self.nside);
            let step = (l_max / 8).max(1);
            for l in (step..=l_max).step_by(step) {
                // Where the noise is larger than the map there is no such number.
                match rho[l] {
                    found if found.is_finite() => write!(f, "  {l}: {found:.3}")?,
                    _ => write!(f, "  {l}: -")?,
                }
            }
        }
        Ok(())
    }
}
