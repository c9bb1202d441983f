//! Small scales and point sources added to a map file: the paper's input is a smooth map (ULSA) with both.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::catalogue::{Catalogue, CatalogueError, Source};
use super::fluctuations::{RandomField, gaussian_field, small_scale_fraction, small_scale_power};
use super::sources::{COUNTS_HZ, draw, kelvin_sr_per_jansky};
use super::{FLUCTUATION_FLOOR, GeneratedSky, HASLAM_HZ};
use crate::sky::healpix::{pixel_area_sr, pixel_of};
use crate::sky::{MapError, SkyMap};

/// Components added to a map file (`sky.added`), with the parameters of `[sky.generated]`, at `sky.nside` or at the nside of the map
/// if that is finer.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AddedSky {
    /// Fluctuations on small scales.
    pub small_scales: bool,
    /// Point sources drawn from the published counts.
    pub sources: bool,
    /// Point sources from a table (CSV).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub catalogue: Option<PathBuf>,
}

/// Temperature index for scaling a map's emission to 408 MHz, where the amplitude of small scales is known.
const INDEX_TO_HASLAM: f64 = 2.5;

/// Why components could not be added to a map.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum AddedSkyError {
    /// The map cannot be resampled.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The fluctuations could not be synthesised.
    #[error("sky.added.small_scales: {0}")]
    Fluctuations(#[from] crate::sky::harmonics::HarmonicsError),
    /// A catalogue that cannot be read.
    #[error(transparent)]
    Catalogue(#[from] CatalogueError),
}

impl AddedSky {
    /// Checks that the catalogue, if there is one, can be read.
    ///
    /// # Errors
    /// [`AddedSkyError::Catalogue`] if it cannot.
    pub fn check(&self) -> Result<(), AddedSkyError> {
        Ok(self.catalogue.as_deref().map_or(Ok(()), |path| Catalogue::read(path).map(drop))?)
    }

    /// Adds the components to a map, on ecliptic axes, at `nside` or at the nside of the map if that is finer.
    ///
    /// If the map is refined, it is smoothed with the FWHM of one of its pixels, to hide their edges. Small scales are those of a
    /// generated sky (Remazeilles et al. 2015), relative to the local emission. Sources add to the map, and so increase its mean.
    ///
    /// # Errors
    /// [`AddedSkyError`] for a map that cannot be resampled, or a catalogue that cannot be read.
    pub fn add_to(
        &self,
        map: SkyMap,
        generated: &GeneratedSky,
        frequency_hz: f64,
        nside: usize,
        seed: u64,
    ) -> Result<SkyMap, AddedSkyError> {
        let mut map = map.to_ecliptic();
        if nside > map.nside() {
            map = map.refined(nside / map.nside(), pixel_area_sr(map.nside()).sqrt())?;
        }
        let nside = map.nside();
        if self.small_scales {
            let l_max = (3 * nside - 1).min(generated.small_scale_l_max);
            let power = small_scale_power(l_max, generated.small_scale_fwhm_deg.to_radians());
            let field = gaussian_field(&power, nside, seed, RandomField::SmallScales)?;
            let to_haslam = (HASLAM_HZ / frequency_hz).powf(-INDEX_TO_HASLAM);
            for (value, g) in map.values_mut().iter_mut().zip(field) {
                // A pixel without emission does not fluctuate.
                let fraction = match *value > 0.0 {
                    true => generated.small_scale_amplitude * small_scale_fraction(g, *value * to_haslam),
                    false => 0.0,
                };
                *value *= (1.0 + fraction).max(FLUCTUATION_FLOOR);
            }
        }
        let mut sources = Vec::new();
        if self.sources {
            let drawn = draw(generated, seed).into_iter();
            sources.extend(drawn.map(|source| Source {
                direction: source.direction,
                flux_jy: source.flux_jy,
                at_hz: COUNTS_HZ,
                index: None,
            }));
        }
        if let Some(path) = &self.catalogue {
            sources.extend(Catalogue::read(path)?.sources);
        }
        for source in sources {
            let index = source.index.unwrap_or(generated.source_spectral_index);
            let at_counts = (COUNTS_HZ / source.at_hz).powf(index);
            let scale = at_counts * (frequency_hz / COUNTS_HZ).powf(index - generated.source_spectral_index);
            let kelvin =
                scale * source.flux_jy * kelvin_sr_per_jansky(generated, frequency_hz) / pixel_area_sr(nside);
            map.values_mut()[pixel_of(nside, source.direction)] += kelvin;
        }
        map.check_temperatures()?;
        Ok(map)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::Frame;
    use crate::units::constants::{BOLTZMANN_J_K, SPEED_OF_LIGHT_M_S};

    fn flat(nside: usize) -> SkyMap {
        SkyMap::constant(nside, Frame::Ecliptic, 3e5).unwrap()
    }

    fn file(text: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        file
    }

    #[test]
    fn a_source_has_its_flux() {
        let table = "name,ecliptic_longitude_deg,ecliptic_latitude_deg,flux_154mhz_jy,spectral_index\n\
                     A,30,40,10,-0.5\n\nB,200,-80,20,0\n";
        let file = file(table);
        let added = AddedSky { catalogue: Some(file.path().to_owned()), ..AddedSky::default() };
        let (nside, frequency_hz) = (64, 1e7);
        let map = added.add_to(flat(nside), &GeneratedSky::default(), frequency_hz, nside, 1).unwrap();
        // S = 2 k T nu^2 / c^2 dOmega.
        let to_jy =
            2.0 * BOLTZMANN_J_K * (frequency_hz / SPEED_OF_LIGHT_M_S).powi(2) * pixel_area_sr(nside) / 1e-26;
        let mut fluxes: Vec<f64> =
            map.values().iter().map(|t| (t - 3e5) * to_jy).filter(|flux| flux.abs() > 1e-6).collect();
        fluxes.sort_by(f64::total_cmp);
        let expected = [20.0, 10.0 * (154e6f64 / 1e7).sqrt()];
        assert_eq!(fluxes.len(), 2);
        // 20 and 39 Jy are small differences of some 3e5 K.
        assert!(
            fluxes.iter().zip(expected).all(|(found, flux)| (found / flux - 1.0).abs() < 1e-6),
            "{fluxes:?}"
        );
        let at = pixel_of(
            nside,
            [
                40f64.to_radians().cos() * 30f64.to_radians().cos(),
                40f64.to_radians().cos() * 0.5,
                40f64.to_radians().sin(),
            ],
        );
        assert!(map.values()[at] > 3e5);
    }

    #[test]
    fn small_scales_are_those_of_a_generated_sky() {
        let added = AddedSky { small_scales: true, ..AddedSky::default() };
        let config = GeneratedSky::default();
        let map = added.add_to(flat(16), &config, 1e7, 64, 3).unwrap();
        assert_eq!(map.nside(), 64);
        let relative: Vec<f64> = map.values().iter().map(|t| t / 3e5 - 1.0).collect();
        let rms = (relative.iter().map(|x| x * x).sum::<f64>() / relative.len() as f64).sqrt();
        // alpha T_408^(beta - 1) times the rms of G, by its power (Remazeilles et al. 2015).
        let g = small_scale_power(191, 5f64.to_radians());
        let variance: f64 = g.iter().enumerate().map(|(l, c)| (2 * l + 1) as f64 * c).sum::<f64>()
            / (4.0 * std::f64::consts::PI);
        let expected = 0.0599 * (3e5 * (408e6f64 / 1e7).powf(-2.5)).powf(0.782 - 1.0) * variance.sqrt();
        // The sample variance of a field with some 1,000 modes at its peak.
        assert!((rms / expected - 1.0).abs() < 0.1, "{rms} {expected}");
        // The field depends only on the seed, not on the map.
        assert_eq!(map, added.add_to(flat(16), &config, 1e7, 64, 3).unwrap());
        assert_ne!(map, added.add_to(flat(16), &config, 1e7, 64, 4).unwrap());
    }

    #[test]
    fn drawn_sources_are_those_of_the_catalogue_that_is_written() {
        let added = AddedSky { sources: true, ..AddedSky::default() };
        let config = GeneratedSky::default();
        let map = added.add_to(flat(64), &config, 1e7, 64, 5).unwrap();
        let lines: Vec<String> = crate::sky::generated::catalogue(&config, 1e7, 5)
            .iter()
            .map(|one| format!("{:.9},{:.9},{:e}", one.place_deg[0], one.place_deg[1], one.flux_154mhz_jy))
            .collect();
        let head = "ecliptic_longitude_deg,ecliptic_latitude_deg,flux_154mhz_jy";
        let file = file(&format!("{head}\n{}\n", lines.join("\n")));
        let listed = AddedSky { catalogue: Some(file.path().to_owned()), ..AddedSky::default() };
        let again = listed.add_to(flat(64), &config, 1e7, 64, 99).unwrap();
        let differ = map.values().iter().zip(again.values()).filter(|(a, b)| (*a - *b).abs() > 1e-6 * *a);
        // A source within 1e-9 degrees of a pixel's edge may fall into the neighbouring pixel.
        assert!(differ.count() <= 2);
    }
}
