//! Antennas as files say they are: attitudes, and tables of patterns.

use std::path::PathBuf;
use std::sync::Arc;

use thiserror::Error;

use super::antenna_tables::{AntennaTables, TableError};
use crate::array::{ArrayError, Attitudes, tilted_axes};
use crate::frames::AntennaResponse;
use crate::response::pixel::SatelliteAntenna;
use crate::units::vector::{Vec3, cross, scale};
use crate::units::{Checks, echo, keys};

keys! {
    /// Files of antennas.
    pub struct AntennaFiles {
        /// Attitudes: CCSDS AEM files (KVN or XML, also gzip) of quaternions; their objects are the daughters, in order of
        /// appearance. The (first) dipole is along the body's z axis, the second along x, the third along y.
        expert attitudes: Vec<PathBuf> = Vec::new();
        /// Patterns: tables (CSV) of gain or fields by frequency and direction on the body's axes, one for all daughters or one
        /// each.
        expert tables: Vec<PathBuf> = Vec::new();
        /// Maximum part of a table, up to 0.5, that the fit of an effective axis and a form of degree 2 may leave, rms over directions.
        #[only_with(".tables")]
        expert table_error_max: f64 = 0.02;
    }
}

impl AntennaFiles {
    /// Whether there are any.
    #[must_use]
    pub fn is_some(&self) -> bool {
        !(self.attitudes.is_empty() && self.tables.is_empty())
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_none(&self) -> bool {
        !self.is_some()
    }

    /// Whether nothing is set.
    #[must_use]
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Degree that the factors of two patterns add to a pair's response.
    #[must_use]
    pub fn degree(&self) -> usize {
        if self.tables.is_empty() { 0 } else { 4 }
    }

    /// All files.
    pub fn paths(&self) -> impl Iterator<Item = &PathBuf> {
        self.attitudes.iter().chain(&self.tables)
    }

    /// The same with other names of its files.
    #[must_use]
    pub fn map_paths(&self, of: impl Fn(&PathBuf) -> PathBuf) -> Self {
        let all = |paths: &[PathBuf]| paths.iter().map(&of).collect();
        Self { attitudes: all(&self.attitudes), tables: all(&self.tables), ..self.clone() }
    }

    /// Requires an error that a fit of a dipole can have, and no other pattern beside tables.
    pub fn check(&self, key: &str, has_patterns: bool, checks: &mut Checks) {
        let (error, name) = (self.table_error_max, format!("{key}.table_error_max"));
        checks.number(name, error, error > 0.0 && error <= 0.5, "above 0, at most 0.5");
        let expected = "none beside pattern or pattern_by_frequency: a table has the whole pattern";
        let (name, found) = (format!("{key}.tables"), format!("({} files)", self.tables.len()));
        checks.require(name, found, self.tables.is_empty() || !has_patterns, expected);
    }
}

/// Why antennas cannot be as files say.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum MeasuredAntennasError {
    /// Attitudes that cannot be read.
    #[error(transparent)]
    Attitudes(#[from] ArrayError),
    /// A table that cannot be used.
    #[error(transparent)]
    Table(#[from] TableError),
    /// Files that are not of this array.
    #[error("{0}")]
    Other(String),
}

/// Antennas as files say they are.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MeasuredAntennas {
    attitudes: Option<Attitudes>,
    tables: Option<Arc<AntennaTables>>,
}

/// What an antenna is asked for.
#[derive(Clone, Copy, Debug)]
pub struct AntennaQuery {
    /// Its satellite, from 0.
    pub satellite: usize,
    /// TAI seconds since 1958.
    pub tai_s: f64,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// What it consists of.
    pub elements: AntennaResponse,
}

impl MeasuredAntennas {
    /// Reads the files.
    ///
    /// # Errors
    /// The first that cannot be used.
    pub fn read(files: &AntennaFiles) -> Result<Self, MeasuredAntennasError> {
        let attitudes = (!files.attitudes.is_empty()).then(|| Attitudes::read(&files.attitudes));
        let tables =
            (!files.tables.is_empty()).then(|| AntennaTables::read(&files.tables, files.table_error_max));
        Ok(Self { attitudes: attitudes.transpose()?, tables: tables.transpose()?.map(Arc::new) })
    }

    /// Whether nothing is known.
    #[must_use]
    pub fn is_none(&self) -> bool {
        self.attitudes.is_none() && self.tables.is_none()
    }

    /// Whether patterns are known.
    #[must_use]
    pub fn has_patterns(&self) -> bool {
        self.tables.is_some()
    }

    /// Requires files of so many satellites, of these elements, at a frequency.
    ///
    /// # Errors
    /// What does not fit.
    pub fn require(
        &self,
        satellites: usize,
        elements: AntennaResponse,
        frequency_hz: f64,
    ) -> Result<(), MeasuredAntennasError> {
        let other = |what: String| Err(MeasuredAntennasError::Other(what));
        if let Some(attitudes) = &self.attitudes
            && attitudes.objects().len() != satellites
        {
            let names: Vec<String> = attitudes.objects().take(20).map(echo).collect();
            return other(format!(
                "attitudes: {} objects ({}); expected {satellites}, one per daughter in the order in which they appear",
                attitudes.objects().len(),
                names.join(", ")
            ));
        }
        let Some(tables) = &self.tables else { return Ok(()) };
        if ![1, satellites].contains(&tables.count()) {
            return other(format!(
                "tables: {} files; expected 1, or {satellites}: one per daughter",
                tables.count()
            ));
        }
        let receivers = usize::from(elements.receivers());
        if elements == AntennaResponse::Isotropic || tables.dipoles() != Some(receivers) {
            let found = tables
                .dipoles()
                .map_or("dipoles that differ in number".to_owned(), |n| format!("{n} dipoles"));
            return other(format!(
                "tables: {found}; expected 1 with spacecraft.antenna = \"dipole-normal\", 3 with \"three-dipoles\", and none with \
                 \"isotropic\""
            ));
        }
        let [low_hz, high_hz] = tables.span_hz();
        if (low_hz..=high_hz).contains(&frequency_hz) {
            return Ok(());
        }
        other(format!(
            "tables: from {low_hz} Hz to {high_hz} Hz; expected {frequency_hz} Hz, a channel, in between"
        ))
    }

    /// Requires that an attitude is known from one time to another.
    ///
    /// # Errors
    /// That it is not.
    pub fn require_attitude(&self, satellite: usize, tai_s: [f64; 2]) -> Result<(), MeasuredAntennasError> {
        let Some(attitudes) = &self.attitudes else { return Ok(()) };
        let Some(unknown_s) = attitudes.first_unknown_s(satellite, tai_s) else { return Ok(()) };
        let spans = attitudes.known_utc(satellite);
        Err(MeasuredAntennasError::Other(format!(
            "attitudes: nothing of daughter {} at {} UTC; expected attitudes whenever it measures, and they go from {spans}",
            satellite + 1,
            crate::units::time_scales::utc_text(unknown_s)
        )))
    }

    /// The antenna of a satellite, whose axes along the track, along the orbit's normal and away from the Moon are given; tilted from
    /// its attitude, and with a factor `1 + q P_2` of its voltage where there are no tables.
    #[must_use]
    pub fn antenna(
        &self,
        of: AntennaQuery,
        track: [Vec3; 3],
        tilt_deg: [f64; 2],
        q: f64,
    ) -> SatelliteAntenna {
        let AntennaQuery { satellite, tai_s, frequency_hz, elements } = of;
        let body = self.attitudes.as_ref().and_then(|attitudes| attitudes.body_axes(satellite, tai_s));
        let upright = body.map_or(track, |[x, y, z]| [x, z, scale(-1.0, y)]);
        let [axis, across] = tilted_axes(upright, tilt_deg);
        match &self.tables {
            None => SatelliteAntenna::new(elements, [axis, across], q),
            Some(tables) => {
                tables.antenna(satellite, frequency_hz, elements, [across, cross(axis, across), axis])
            }
        }
    }
}
