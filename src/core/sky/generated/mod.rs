//! Model of the sky at any frequency of 0.1-120 MHz: diffuse Galactic emission, absorbing gas, fluctuations and point sources.
//!
//! Radiative transfer of synchrotron emission through warm ionised gas is solved along lines of sight through a smooth
//! Galaxy. The plane therefore becomes dark below about 10 MHz, while nearby emission, from the radio loops and the local cavity,
//! stays bright. The extragalactic background is isotropic (Cane 1979), and opaque nebulae absorb the emission behind
//! them. Gas and spectral index vary over the sky, small scales follow Remazeilles et al. (2015), and point
//! sources the GLEAM counts of Franzen et al. (2019). The model uses Galactic coordinates; maps are on ecliptic axes.
//!
//! The parameters were fitted to published statistics of ULSA (Cong et al. 2021, direction-dependent index; their map at
//! nside 64, measured in Galactic coordinates, K):
//!
//! | MHz | mean | 5 % | 50 % | 95 % | b > 60 deg | b < -60 deg | abs(b) < 5 deg |
//! |---|---|---|---|---|---|---|---|
//! | 1 | 3.47e7 | 0.96e7 | 2.69e7 | 7.36e7 | 6.76e7 | 2.67e7 | 2.13e7 |
//! | 3 | 6.08e6 | 3.67e6 | 5.81e6 | 9.40e6 | 6.84e6 | 4.67e6 | 3.95e6 |
//! | 10 | 3.77e5 | 2.26e5 | 3.20e5 | 7.51e5 | 3.07e5 | 2.40e5 | 5.09e5 |

mod added;
mod catalogue;
mod column_units;
mod columns;
mod config;
mod features;
mod fluctuations;
mod galaxy;
mod points;
mod sources;

#[doc(hidden)]
pub use added::{AddedSky, AddedSkyError};
#[doc(hidden)]
pub use catalogue::CatalogueError;
pub use config::{GeneratedSky, GeneratedSkyError};
#[doc(hidden)]
pub use points::{CataloguePoint, describe_catalogue, read_catalogue};
#[doc(hidden)]
pub use sources::{CatalogueSource, catalogue};

use rayon::prelude::*;

use super::frame::{Frame, Rotation, rotate};
use super::harmonics::HarmonicsError;
use super::healpix::{pixel_area_sr, pixel_count, pixel_of, ring, ring_to_nested};
use crate::units::vector::Vec3;
use features::Features;
use fluctuations::{RandomField, gaussian_field, large_scale_power, small_scale_fraction, small_scale_power};
use galaxy::{ELECTRON_K, Galaxy, REFERENCE_HZ, SYNCHROTRON_INDEX};

/// Minimum nside of the computation, which resolves the dark plane; coarser maps are averages.
const NSIDE_MIN: usize = 64;

/// Frequency of the small-scale formula, Hz (Remazeilles et al. 2015).
const HASLAM_HZ: f64 = 408e6;

/// Extragalactic background at [`REFERENCE_HZ`], K: Cane (1979), 1.06e-20 nu^-0.80 W m^-2 Hz^-1 sr^-1 with nu in MHz,
/// by T = I c^2 / (2 k nu^2).
const EXTRAGALACTIC_K: f64 = 5.468e4;

const EXTRAGALACTIC_INDEX: f64 = 2.80;

/// Minimum factor of the fluctuations on the diffuse emission.
const FLUCTUATION_FLOOR: f64 = 0.05;

/// Generates the sky at `frequency_hz`: K in RING order on ecliptic axes, `12 nside^2` values, all positive.
///
/// Equal seeds give the same sky at every frequency and nside, up to pixel averaging and the degrees above
/// `3 nside - 1` that a map cannot represent. A point source fills the pixel that contains it.
///
/// # Errors
/// [`GeneratedSkyError`] for the first problem of the configuration, a frequency outside 0.1-120 MHz, or an `nside` that is not a
/// power of two between 1 and 1024.
pub fn generate(
    config: &GeneratedSky,
    frequency_hz: f64,
    nside: usize,
    seed: u64,
) -> Result<Vec<f64>, GeneratedSkyError> {
    config::check_request(frequency_hz, nside)?;
    if let Some(problem) = config.problems().into_iter().next() {
        return Err(problem.into());
    }
    let fine = nside.max(NSIDE_MIN);
    let diffuse_sky = DiffuseSky::new(config, frequency_hz);
    let fields = RandomFields::new(config, fine, seed)?;
    let mut kelvin = vec![0.0; pixel_count(fine)];
    let mut depth = vec![0.0; pixel_count(fine)];
    let mut rings: Vec<(usize, &mut [f64], &mut [f64])> = Vec::with_capacity(4 * fine);
    let (mut kelvin_rest, mut depth_rest) = (kelvin.as_mut_slice(), depth.as_mut_slice());
    for k in 1..4 * fine {
        let (kelvin_ring, after) = kelvin_rest.split_at_mut(ring(fine, k).len);
        let (depth_ring, depth_after) = depth_rest.split_at_mut(kelvin_ring.len());
        rings.push((k, kelvin_ring, depth_ring));
        (kelvin_rest, depth_rest) = (after, depth_after);
    }
    rings.into_par_iter().for_each(|(k, kelvin, depth)| {
        let ring = ring(fine, k);
        for p in 0..ring.len {
            let longitude = ring.phi0_rad + std::f64::consts::TAU * p as f64 / ring.len as f64;
            let (sin, cos) = longitude.sin_cos();
            let direction = [ring.sin_theta * cos, ring.sin_theta * sin, ring.z];
            (kelvin[p], depth[p]) = diffuse_sky.line_of_sight(direction, fields.values_at(ring.first + p));
        }
    });
    if config.point_sources {
        let kelvin_per_jansky = sources::kelvin_sr_per_jansky(config, frequency_hz) / pixel_area_sr(fine);
        for source in sources::draw(config, seed) {
            let pixel = pixel_of(fine, source.direction);
            let transmission = if config.sources_absorbed { (-depth[pixel]).exp() } else { 1.0 };
            kelvin[pixel] += source.flux_jy * kelvin_per_jansky * transmission;
        }
    }
    Ok(if fine == nside { kelvin } else { averaged(&kelvin, fine, nside) })
}

struct DiffuseSky<'a> {
    config: &'a GeneratedSky,
    to_galactic: Rotation,
    galaxy: Galaxy,
    features: Features,
    /// Background without the sources that are drawn individually, K.
    background_k: f64,
    /// Logarithm ln(nu / reference), by which variations of the index are multiplied.
    log_ratio: f64,
}

impl<'a> DiffuseSky<'a> {
    fn new(config: &'a GeneratedSky, frequency_hz: f64) -> Self {
        let galaxy = Galaxy::new(frequency_hz, config.cloud_log_rms);
        let features = Features::new(frequency_hz, &galaxy, config.loops, config.nebulae);
        let background = EXTRAGALACTIC_K * (frequency_hz / REFERENCE_HZ).powf(-EXTRAGALACTIC_INDEX);
        // The background includes the sources that are drawn individually.
        let drawn = if config.point_sources { sources::mean_k(config, frequency_hz) } else { 0.0 };
        Self {
            config,
            to_galactic: Frame::Ecliptic.to_frame(Frame::Galactic),
            galaxy,
            features,
            background_k: (background - drawn).max(0.0),
            log_ratio: (frequency_hz / REFERENCE_HZ).ln(),
        }
    }

    /// Computes the temperature, K, and the optical depth of the whole line of sight in an ecliptic direction.
    fn line_of_sight(&self, ecliptic: Vec3, fields: FieldValues) -> (f64, f64) {
        let direction = rotate(&self.to_galactic, ecliptic);
        let sight = self.galaxy.sight(direction, fields.cloud);
        let index_factor = (-self.config.index_rms * fields.index * self.log_ratio).exp();
        let mut fluctuation = 1.0;
        if self.config.small_scales {
            let kelvin_408 =
                sight.unabsorbed_reference_k * (HASLAM_HZ / REFERENCE_HZ).powf(-SYNCHROTRON_INDEX);
            let fraction = self.config.small_scale_amplitude * small_scale_fraction(fields.small, kelvin_408);
            fluctuation = (1.0 + fraction).max(FLUCTUATION_FLOOR);
        }
        let transmission = (-sight.depth).exp();
        let diffuse = sight.synchrotron_k * index_factor * fluctuation
            + self.background_k * transmission
            + ELECTRON_K * (1.0 - transmission);
        let seen = self.features.add_to(direction, diffuse, self.galaxy.opacity_factor(fields.cloud));
        (seen.temperature_k, sight.depth + seen.depth)
    }
}

#[derive(Clone, Copy, Debug)]
struct FieldValues {
    small: f64,
    cloud: f64,
    index: f64,
}

/// Random fields of a sky; empty where disabled.
struct RandomFields {
    small: Vec<f64>,
    cloud: Vec<f64>,
    index: Vec<f64>,
}

impl RandomFields {
    fn new(config: &GeneratedSky, nside: usize, seed: u64) -> Result<Self, HarmonicsError> {
        let l_max = 3 * nside - 1;
        let field = |wanted: bool, power: &dyn Fn() -> Vec<f64>, field: RandomField| {
            if wanted { gaussian_field(&power(), nside, seed, field) } else { Ok(Vec::new()) }
        };
        let small = || {
            let l_max = l_max.min(config.small_scale_l_max);
            small_scale_power(l_max, config.small_scale_fwhm_deg.to_radians())
        };
        Ok(Self {
            small: field(config.small_scales, &small, RandomField::SmallScales)?,
            cloud: field(config.cloud_log_rms > 0.0, &|| large_scale_power(l_max), RandomField::Clouds)?,
            index: field(config.index_rms > 0.0, &|| large_scale_power(l_max), RandomField::Index)?,
        })
    }

    fn values_at(&self, pixel: usize) -> FieldValues {
        let value = |field: &[f64]| field.get(pixel).copied().unwrap_or(0.0);
        FieldValues { small: value(&self.small), cloud: value(&self.cloud), index: value(&self.index) }
    }
}

/// Averages a RING map over the children of each pixel of a coarser RING map.
fn averaged(kelvin: &[f64], from: usize, to: usize) -> Vec<f64> {
    let children = (from / to) * (from / to);
    let mut nested = vec![0.0; kelvin.len()];
    for (pixel, &value) in kelvin.iter().enumerate() {
        nested[ring_to_nested(from, pixel)] = value;
    }
    (0..pixel_count(to))
        .map(|pixel| {
            let first = ring_to_nested(to, pixel) * children;
            nested[first..first + children].iter().sum::<f64>() / children as f64
        })
        .collect()
}

#[cfg(test)]
mod tests;
