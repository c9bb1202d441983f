//! Summary of a channel's maps.

use std::fmt;

use serde::Serialize;

use super::beam::EffectiveBeam;
use super::config::PostProcessing;
use super::error_maps::told_vector;
use super::latitudes::LatitudeError;
use super::point_beams::{BeamWidths, PointBeamSummary};
use crate::imaging::anywhere::Refinement;
use crate::imaging::{Convergence, Diagnostics, SkyPower};

/// One snapshot.
#[derive(Clone, Debug, Serialize, bincode::Encode, bincode::Decode)]
pub struct SnapshotSummary {
    /// Number, from 1.
    pub number: u32,
    /// Mission time of the last data in it, s.
    pub until_s: f64,
    /// Visibilities in it.
    pub visibilities: u64,
    /// RMS of (map - truth) / RMS of truth; absent without a truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rms_error_over_rms_truth: Option<f64>,
    /// Mean of rho_l over 1 <= l <= 2 nside; absent without a truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rho_mean: Option<f64>,
}

/// Angular power spectra of what is compared, from l = 0.
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

/// One channel: its maps and their quality.
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
    /// Visibilities in the final map.
    pub visibilities: u64,
    /// Mean of the final map, K.
    pub mean_k: f64,
    /// Standard deviation of the mean, K, by the posterior; absent unless R is from the data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mean_sigma_k: Option<f64>,
    /// Dipole along the ecliptic's x, y and z, K; absent unless R is from the data, as its standard deviation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dipole_k: Option<[f64; 3]>,
    /// Standard deviation of the dipole, K.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dipole_sigma_k: Option<[f64; 3]>,
    /// Angular power of the sky that R is the inverse of, with its uncertainty; absent unless R is from the data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sky_power: Option<SkyPower>,
    /// RMS of the noise-only companion map, K.
    pub noise_rms_k: f64,
    /// Regularisation and solver diagnostics of the final solution.
    pub diagnostics: Diagnostics,
    /// How it was refined with the positions as they are; absent without `map.refine`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refinement: Option<Refinement>,
    /// The snapshots, including the final map.
    pub snapshots: Vec<SnapshotSummary>,
    /// Whether the visibilities, and so the map, hold thermal noise; with real data they do.
    pub thermal_noise: bool,
    /// What was done with map, noise and input before they were compared; absent if nothing was.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub post_processing: Option<PostProcessing>,
    /// rho_l of the final map as it is, with its thermal noise if it holds any, and the input at its own resolution,
    /// l = 0, 1, ..; absent without a truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rho: Option<Vec<f64>>,
    /// The same with the power of the noise-only companion subtracted from that of the map, which leaves noise out of it up to
    /// chance; absent without noise or truth. Null where noise is all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rho_noise_subtracted: Option<Vec<f64>>,
    /// SNR_l of the final map; absent without a truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub snr: Option<Vec<f64>>,
    /// Angular power of the final map, its input and its noise; absent without a truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub power: Option<PowerSpectra>,
    /// The effective beam, and noise in it; absent without a truth.
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
    /// Whether the noise of a pixel exceeds the mean of the map, so that single pixels show little but noise. Without thermal
    /// noise in the visibilities there is none in the map.
    #[must_use]
    pub fn is_noise(&self) -> bool {
        self.thermal_noise && self.noise_rms_k > self.mean_k.abs()
    }
}

/// A temperature with its standard deviation, if that is known.
fn with_error(value_k: f64, sigma_k: Option<f64>) -> String {
    match sigma_k {
        Some(sigma_k) => format!("({value_k:.4e} +- {sigma_k:.1e}) K"),
        None => format!("{value_k:.3e} K"),
    }
}

impl ChannelSummary {
    /// What R the map was made with, in words.
    fn told_regulariser(&self) -> String {
        let Some(power) = &self.sky_power else {
            return match self.diagnostics.epsilon {
                Some(epsilon) => {
                    format!("regularised with epsilon {epsilon:e}: errors of pixels are not known")
                }
                None => String::new(),
            };
        };
        let decided: f64 = power.decided.iter().sum();
        let all = power.decided.len().pow(2);
        format!(
            "as smooth as the data say (map.regulariser = \"data\"): they decide {decided:.0} of {all} harmonics, and \
             scatter {:.2} times their noise; errors of pixels are in sigma.fits",
            power.noise_factor
        )
    }
}

impl fmt::Display for ChannelSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
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
        write!(f, "\n             {}", self.told_regulariser())?;
        if self.is_noise() {
            write!(
                f,
                "\n             mostly noise, {:.1} times the mean: more data or a smaller map.nside lowers it",
                self.noise_rms_k / self.mean_k.abs()
            )?;
        }
        if let Some(refinement) = &self.refinement {
            write!(f, "\n             {refinement}")?;
        } else if let Diagnostics { convergence: Some(convergence), l_max: None, .. } = self.diagnostics {
            // Pixels without their matrix; one that is held leaves no residual.
            let Convergence { iterations, residual, converged } = convergence;
            let ended = if converged {
                ""
            } else {
                ": not converged, more products (map.iterations_max) change the map"
            };
            write!(
                f,
                "\n             {iterations} products with rows made again, residual {residual:.1e}{ended}"
            )?;
        }
        if let Some((fwhm_deg, noise_jy)) =
            self.beam.as_ref().and_then(|beam| Some((beam.fwhm_deg?, beam.noise_rms_jy?)))
        {
            write!(
                f,
                "\n             effective beam: FWHM {fwhm_deg:.2} deg, noise {noise_jy:.3e} Jy rms in it"
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
                write!(f, "  {l}: {:.3}", rho[l])?;
            }
        }
        Ok(())
    }
}
