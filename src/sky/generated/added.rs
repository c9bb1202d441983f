//! Small scales and point sources on a map of one's own: the paper's input is a smooth map (ULSA) with both.

use std::path::Path;

use thiserror::Error;

use super::fluctuations::{RandomField, gaussian_field, small_scale_fraction, small_scale_power};
use super::sources::{COUNTS_HZ, draw, kelvin_sr_per_jansky};
use super::{FLUCTUATION_FLOOR, GeneratedSky, HASLAM_HZ};
use crate::sky::healpix::{pixel_area_sr, pixel_of};
use crate::sky::{AddedSky, MapError, SkyMap};
use crate::units::vector::Vec3;

/// Temperature index by which a map's emission is taken to 408 MHz, where the amplitude of small scales is known.
const INDEX_TO_HASLAM: f64 = 2.5;

/// Longest catalogue, bytes; lines of some 50.
const CATALOGUE_BYTES_MAX: u64 = 256 << 20;

/// Columns of a catalogue that have to be there, as `lunarray sky --sources` writes them.
const COLUMNS: [&str; 3] = ["ecliptic_longitude_deg", "ecliptic_latitude_deg", "flux_154mhz_jy"];
/// A column of each source's own spectral index.
const INDEX_COLUMN: &str = "spectral_index";

/// Why nothing could be added to a map.
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
    #[error("the catalogue {}: {source}", path.display())]
    Read {
        /// Path.
        path: std::path::PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A catalogue that is none.
    #[error("the catalogue {}, line {line}: found {found}, expected {expected}", path.display())]
    Catalogue {
        /// Path.
        path: std::path::PathBuf,
        /// Line, from 1.
        line: usize,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
    },
}

/// A point source of a catalogue.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Source {
    direction: Vec3,
    flux_jy: f64,
    /// Its own spectral index; that of the section if the catalogue has none.
    index: Option<f64>,
}

impl AddedSky {
    /// Reads the catalogue, if there is one.
    ///
    /// # Errors
    /// One that cannot be read.
    pub fn check(&self) -> Result<(), AddedSkyError> {
        self.catalogue.as_deref().map_or(Ok(()), |path| read_catalogue(path).map(drop))
    }

    /// The map with what is to be added, on ecliptic axes, at `nside` or the map's own if that is finer.
    ///
    /// A finer map is smoothed with the FWHM of a pixel of the coarse one, so that its edges do not show. Small scales are those of a
    /// generated sky (Remazeilles et al. 2015), relative to the emission there; sources stand above the map, whose mean grows by
    /// theirs.
    ///
    /// # Errors
    /// A map that cannot be resampled; a catalogue that cannot be read.
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
                // A pixel without emission has nothing that could fluctuate.
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
            sources.extend(drawn.map(|one| Source {
                direction: one.direction,
                flux_jy: one.flux_jy,
                index: None,
            }));
        }
        if let Some(path) = &self.catalogue {
            sources.extend(read_catalogue(path)?);
        }
        for source in sources {
            let index = source.index.unwrap_or(generated.source_spectral_index);
            let scale = (frequency_hz / COUNTS_HZ).powf(index - generated.source_spectral_index);
            let kelvin =
                scale * source.flux_jy * kelvin_sr_per_jansky(generated, frequency_hz) / pixel_area_sr(nside);
            map.values_mut()[pixel_of(nside, source.direction)] += kelvin;
        }
        Ok(map)
    }
}

/// The sources of a table (CSV) with a line of names.
fn read_catalogue(path: &Path) -> Result<Vec<Source>, AddedSkyError> {
    let failed = |source| AddedSkyError::Read { path: path.to_owned(), source };
    let bytes = std::fs::metadata(path).map_err(failed)?.len();
    let wrong = |line: usize, found: String, expected: &str| AddedSkyError::Catalogue {
        path: path.to_owned(),
        line,
        found,
        expected: expected.to_owned(),
    };
    if bytes > CATALOGUE_BYTES_MAX {
        return Err(wrong(1, format!("{bytes} bytes"), "at most 268 MB"));
    }
    let text = std::fs::read_to_string(path).map_err(failed)?;
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let names: Vec<&str> =
        lines.next().map_or_else(Vec::new, |(_, line)| line.split(',').map(str::trim).collect());
    let place = |name: &str| names.iter().position(|found| *found == name);
    let mut places = [0; 3];
    for (place_of, name) in places.iter_mut().zip(COLUMNS) {
        let expected =
            format!("the columns {}, and {INDEX_COLUMN} if sources have their own", COLUMNS.join(", "));
        *place_of = place(name).ok_or_else(|| wrong(1, format!("no column {name}"), &expected))?;
    }
    let index_place = place(INDEX_COLUMN);
    let source = |(number, line): (usize, &str)| {
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let number_at = |place: usize, expected: &str, good: fn(f64) -> bool| {
            let cell = cells.get(place).copied().unwrap_or_default();
            let value = cell.parse::<f64>().ok().filter(|value| value.is_finite() && good(*value));
            let shown: String = cell.chars().take(40).collect();
            value.ok_or_else(|| wrong(number + 1, format!("`{}`", shown.escape_debug()), expected))
        };
        let lon = number_at(places[0], "a longitude, degrees", |_| true)?.to_radians();
        let lat =
            number_at(places[1], "a latitude of -90 to 90 degrees", |lat| lat.abs() <= 90.0)?.to_radians();
        let flux_jy = number_at(places[2], "a flux density above 0, Jy", |flux| flux > 0.0)?;
        let index = index_place
            .map(|place| number_at(place, "a spectral index of -10 to 10", |index| index.abs() <= 10.0))
            .transpose()?;
        let direction = [lat.cos() * lon.cos(), lat.cos() * lon.sin(), lat.sin()];
        Ok(Source { direction, flux_jy, index })
    };
    lines.map(source).collect()
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
        // 20 and 39 Jy are differences of some 3e5 K.
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
        // The same field whatever the map: another seed differs.
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
        let file = file(&format!("{}\n{}\n", COLUMNS.join(","), lines.join("\n")));
        let listed = AddedSky { catalogue: Some(file.path().to_owned()), ..AddedSky::default() };
        let again = listed.add_to(flat(64), &config, 1e7, 64, 99).unwrap();
        let differ = map.values().iter().zip(again.values()).filter(|(a, b)| (*a - *b).abs() > 1e-6 * *a);
        // A source within 1e-9 degrees of a pixel's edge may change sides.
        assert!(differ.count() <= 2);
    }

    #[test]
    fn catalogues_that_are_none_say_where() {
        let said = |text: &str| read_catalogue(file(text).path()).unwrap_err().to_string();
        let head = COLUMNS.join(",");
        assert!(said("a,b\n1,2").contains("line 1: found no column ecliptic_longitude_deg"));
        assert!(said("").contains("no column"));
        for (row, words) in [
            ("1,2,x", "found `x`, expected a flux density"),
            ("1,2,-3", "above 0"),
            ("1,91,3", "-90 to 90"),
            ("NaN,1,3", "a longitude"),
            ("1,2", "found ``"),
        ] {
            let found = said(&format!("{head}\n0,0,1\n{row}\n"));
            assert!(found.contains("line 3") && found.contains(words), "{found}");
        }
        assert!(matches!(read_catalogue(Path::new("/nowhere/x.csv")), Err(AddedSkyError::Read { .. })));
    }
}
