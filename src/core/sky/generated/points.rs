//! Point sources of a table, each at its own direction.

use std::path::Path;

use super::catalogue::{Catalogue, CatalogueError};
use crate::units::vector::Vec3;

/// A source of a catalogue.
#[derive(Clone, Debug, PartialEq)]
pub struct CataloguePoint {
    /// Name; empty if the catalogue has none.
    pub name: String,
    /// Direction on ecliptic axes, a unit vector.
    pub direction: Vec3,
    /// Flux density, Jy.
    flux_jy: f64,
    /// Frequency of the flux density, Hz.
    at_hz: f64,
    /// Spectral index.
    index: f64,
}

impl CataloguePoint {
    /// Flux density at a frequency, Jy.
    #[must_use]
    pub fn flux_jy(&self, frequency_hz: f64) -> f64 {
        self.flux_jy * (frequency_hz / self.at_hz).powf(self.index)
    }
}

/// Reads the sources of a table (CSV or another text table); `index` is the spectral index of those without their own.
///
/// # Errors
/// [`CatalogueError`] for a file that is not such a table.
pub fn read_catalogue(path: &Path, index: f64) -> Result<Vec<CataloguePoint>, CatalogueError> {
    let Catalogue { sources, source_names, .. } = Catalogue::read(path)?;
    let mut names = source_names.into_iter();
    let point = |source: super::catalogue::Source| CataloguePoint {
        name: names.next().unwrap_or_default(),
        direction: source.direction,
        flux_jy: source.flux_jy,
        at_hz: source.at_hz,
        index: source.index.unwrap_or(index),
    };
    Ok(sources.into_iter().map(point).collect())
}

/// Describes a table as it is understood, and notes what it may mean otherwise.
///
/// # Errors
/// As [`read_catalogue`].
pub fn describe_catalogue(path: &Path) -> Result<(String, Option<String>), CatalogueError> {
    let catalogue = Catalogue::read(path)?;
    Ok((catalogue.to_string(), catalogue.note()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sources_have_names_and_their_flux_at_any_frequency() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "Name,l,b,flux_74mhz_jy,alpha\nA 1,0,90,10,-1\nB,90,0,20,\n").unwrap();
        let found = read_catalogue(file.path(), -0.5).unwrap();
        assert_eq!(found.iter().map(|one| one.name.as_str()).collect::<Vec<_>>(), ["A 1", "B"]);
        assert!((found[0].flux_jy(37e6) - 20.0).abs() < 1e-9);
        assert!((found[1].flux_jy(18.5e6) - 40.0).abs() < 1e-9);
        assert!(matches!(read_catalogue(Path::new("/nowhere"), -0.5), Err(CatalogueError::Read { .. })));
    }
}
