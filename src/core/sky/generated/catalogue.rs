//! Published catalogues of point sources: text tables with a line of column names.

use std::borrow::Cow;
use std::fmt;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::column_units::{
    FLUX_WORDS, POSITION_WORDS, angle_deg, flux_jy, in_comments, is_unit, require_unit,
};
use super::columns::{SourceColumns, normalise};
use crate::files::{Columns, Row, Separator, TableFault, is_comment, read_file, text_of, without_cells};
use crate::sky::Frame;
use crate::sky::frame::rotate;
use crate::units::vector::Vec3;
use crate::units::{Dimension, echo};

/// Maximum size of a catalogue, bytes; a line has some 50.
const BYTES_MAX: u64 = 256 << 20;

/// Highest flux density, Jy: some 1e15 K in a pixel of 4 degrees at 3 MHz.
const FLUX_JY_MAX: f64 = 1e12;

/// Title of the columns of machine-readable tables of CDS and AAS.
const BY_BYTES: &str = "Byte-by-byte Description of file";

/// Lowest and highest frequency of a flux density, Hz.
const FREQUENCY_HZ_MIN: f64 = 1e4;
const FREQUENCY_HZ_MAX: f64 = 1e12;

/// Why a catalogue cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CatalogueError {
    /// The file cannot be read.
    #[error("the catalogue {}: {source}", path.display())]
    Read {
        /// Path.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file is not a catalogue.
    #[error("the catalogue {}, line {line}: found {found}, expected {expected}", path.display())]
    Content {
        /// Path.
        path: PathBuf,
        /// Line, counted from 1.
        line: usize,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
    },
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Source {
    /// Direction on ecliptic axes, a unit vector.
    pub direction: Vec3,
    pub flux_jy: f64,
    /// Frequency of the flux, Hz.
    pub at_hz: f64,
    /// Spectral index in the catalogue; `None` for the index of the configuration.
    pub index: Option<f64>,
}

/// Sources of a catalogue, and the interpretation of its columns.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Catalogue {
    pub sources: Vec<Source>,
    /// Names of the sources; empty without a column of names.
    pub source_names: Vec<String>,
    path: PathBuf,
    frame: Frame,
    /// Names of the columns of flux and, if there is one, spectral index.
    names: (String, Option<String>),
    flux_unit: &'static str,
}

impl fmt::Display for Catalogue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut hz: Vec<f64> = self.sources.iter().map(|source| source.at_hz).collect();
        hz.sort_by(f64::total_cmp);
        let at = match (hz.first(), hz.last()) {
            (Some(&lowest), Some(&highest)) if lowest == highest => Dimension::Frequency.show(lowest),
            (Some(&lowest), Some(&highest)) => {
                format!("{} to {}", Dimension::Frequency.show(lowest), Dimension::Frequency.show(highest))
            }
            _ => "no frequency".to_owned(),
        };
        let (flux, index) = &self.names;
        let own = self.sources.iter().filter(|source| source.index.is_some()).count();
        let index = index.as_ref().map_or_else(
            || "sky.generated.source_spectral_index for all".to_owned(),
            |name| format!("spectral index `{name}` of {own}"),
        );
        let total: f64 = self.sources.iter().map(|source| source.flux_jy).sum();
        write!(
            f,
            "{}: {} sources, {} positions, flux `{flux}` ({}) at {at}, {total:.4e} Jy together, {index}",
            self.path.display(),
            self.sources.len(),
            self.frame,
            self.flux_unit
        )
    }
}

impl Catalogue {
    pub(super) fn read(path: &Path) -> Result<Self, CatalogueError> {
        Reader { path }.read()
    }

    /// A note if most spectral indices are above 0: some catalogues define them with the other sign.
    pub(super) fn note(&self) -> Option<String> {
        let own: Vec<f64> = self.sources.iter().filter_map(|source| source.index).collect();
        let above = own.iter().filter(|index| **index > 0.0).count();
        let name = self.names.1.as_deref().unwrap_or_default();
        (2 * above > own.len()).then(|| {
            format!(
                "{}: {above} of {} spectral indices `{name}` are above 0, with S ~ nu^{name}; change their sign if the catalogue means \
                 S ~ nu^-{name}",
                self.path.display(),
                own.len()
            )
        })
    }
}

/// Units of the columns that are used.
#[derive(Clone, Copy)]
struct Units {
    /// Of longitudes and latitudes that are one number, degrees.
    angle_deg: [f64; 2],
    flux_jy: f64,
}

/// Columns, units and numbered lines of a table.
struct Table<'a> {
    columns: Columns,
    units: Vec<String>,
    /// Names in the comments before the table, and the units that they give.
    comment_units: Vec<(String, String)>,
    rows: Vec<(usize, &'a str)>,
}

impl Table<'_> {
    /// The name of a column, and its units in their row and in comments, there under its name or else one of `others`.
    fn units_of(&self, place: usize, others: &[&str]) -> (&str, Vec<String>) {
        let name = normalise(&self.columns.names[place]);
        let in_comments = |names: &[&str]| {
            let of_column = self.comment_units.iter().filter(|(found, _)| names.contains(&found.as_str()));
            of_column.map(|(_, unit)| unit.clone()).collect::<Vec<String>>()
        };
        let mut found = in_comments(&[&name]);
        if found.is_empty() {
            found = in_comments(others);
        }
        found.push(self.units[place].clone());
        (&self.columns.names[place], found)
    }
}

struct Reader<'a> {
    path: &'a Path,
}

impl Reader<'_> {
    fn content_error(
        &self,
        line: usize,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> CatalogueError {
        let (found, expected) = (found.into(), expected.into());
        CatalogueError::Content { path: self.path.to_owned(), line, found, expected }
    }

    fn table_error(&self, TableFault { line, found, expected }: TableFault) -> CatalogueError {
        self.content_error(line, found, expected)
    }

    fn read(&self) -> Result<Catalogue, CatalogueError> {
        let text = self.text()?;
        let table = self.table(&text)?;
        let comments = text.lines().take_while(|line| without_cells(line));
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let is_vlssr =
            comments.clone().chain([&*name]).any(|text| text.to_ascii_lowercase().contains("vlss"));
        let columns = SourceColumns::recognise(&table.columns.names, is_vlssr).map_err(|expected| {
            let names: Vec<String> =
                table.columns.names.iter().take(40).map(|name| displayed(name)).collect();
            self.content_error(table.columns.line, format!("the columns {}", names.join(", ")), expected)
        })?;
        if columns.frame == Frame::Equatorial
            && !columns.places.iter().flatten().any(|place| table.columns.names[*place].contains("2000"))
            && let Some(line) = old_equinox(comments, &table, &columns)
        {
            let found = "positions of B1950 (FK4)";
            return Err(self.content_error(
                line,
                found,
                "of J2000: precess them, and call them RAJ2000 and DEJ2000",
            ));
        }
        let units = self.units(&table, &columns)?;
        let sources: Vec<Source> = table
            .rows
            .iter()
            .map(|&(line, text)| source(&table.columns.row(line, text)?, &columns, units))
            .collect::<Result<_, TableFault>>()
            .map_err(|fault| self.table_error(fault))?;
        if sources.is_empty() {
            return Err(self.content_error(1, "no sources", "one line per source below the names"));
        }
        let name = |place: usize| table.columns.names[place].clone();
        let is_name = |name: &String| ["name", "source", "id"].contains(&&*normalise(name));
        let source_names = table.columns.names.iter().position(is_name).map_or_else(Vec::new, |place| {
            let name = |(_, text): &(usize, &str)| table.columns.cell(text, place);
            table.rows.iter().map(name).collect()
        });
        Ok(Catalogue {
            sources,
            source_names,
            path: self.path.to_owned(),
            frame: columns.frame,
            names: (name(columns.flux), columns.index.map(name)),
            flux_unit: if units.flux_jy < 1.0 { "mJy" } else { "Jy" },
        })
    }

    /// The units of the columns that are used, each of which is there once.
    fn units(&self, table: &Table<'_>, columns: &SourceColumns) -> Result<Units, CatalogueError> {
        let SourceColumns { places: [lon, lat], flux, unfitted_flux, frequency_place, index, .. } = columns;
        let own = frequency_place.map(|(place, _)| place);
        for &place in lon.iter().chain(lat).chain([flux]).chain(unfitted_flux).chain(&own).chain(index) {
            let name = &table.columns.names[place];
            if table.columns.names.iter().filter(|other| *other == name).count() > 1 {
                let found = format!("several columns `{}`", displayed(name));
                return Err(self.content_error(table.columns.line, found, "one of each name"));
            }
        }
        let refuse = |(name, _): &(&str, Vec<String>), expected| {
            let name = displayed(name);
            move |unit: String| {
                self.content_error(
                    table.columns.line,
                    format!("the unit `{}` of `{name}`", displayed(&unit)),
                    expected,
                )
            }
        };
        let angle = |places: &[usize], hours: Option<f64>, expected| match *places {
            [place] => {
                let column = table.units_of(place, &POSITION_WORDS);
                angle_deg(&column, hours).map_err(refuse(&column, expected))
            }
            _ => Ok(hours.unwrap_or(1.0)),
        };
        let of_flux = table.units_of(*flux, &FLUX_WORDS);
        let of_row = &table.units[*flux];
        if of_row.starts_with('[') {
            let expected =
                "a flux density: brackets mean its logarithm; write Jy or mJy without them if it is none";
            return Err(refuse(&of_flux, expected)(of_row.clone()));
        }
        if let Some((place, unit_hz)) = *frequency_place {
            let column = table.units_of(place, &[]);
            let expected = "the unit in the column's name, or none";
            require_unit(&column, unit_hz).map_err(refuse(&column, expected))?;
        }
        let jy_of = |column: &(&str, Vec<String>)| {
            let expected = "a flux density in Jy or mJy, as the column's name says";
            flux_jy(column).map_err(refuse(column, expected))
        };
        let flux_unit_jy = jy_of(&of_flux)?;
        if let Some(place) = *unfitted_flux {
            let column = table.units_of(place, &FLUX_WORDS);
            if jy_of(&column)? != flux_unit_jy {
                let expected =
                    format!("the unit of `{}`, in place of which it is used", displayed(of_flux.0));
                return Err(self.content_error(
                    table.columns.line,
                    format!("another unit of `{}`", displayed(column.0)),
                    expected,
                ));
            }
        }
        Ok(Units {
            angle_deg: [
                angle(lon, Some(15.0), "deg, rad, arcmin, arcsec or hours, as the column's name says")?,
                angle(lat, None, "deg, rad, arcmin or arcsec, as the column's name says")?,
            ],
            flux_jy: flux_unit_jy,
        })
    }

    /// Reads the file as text; invalid UTF-8, as in names in other encodings, is replaced.
    fn text(&self) -> Result<String, CatalogueError> {
        let bytes = read_file(self.path, BYTES_MAX)
            .map_err(|source| CatalogueError::Read { path: self.path.to_owned(), source })?;
        let found = match bytes.trim_ascii_start().starts_with(b"<") {
            true => "an XML document (VOTable)",
            false => match text_of(&bytes) {
                Ok(text) if !text.contains(BY_BYTES) => return Ok(text),
                Ok(_) => {
                    "a table of CDS or AAS whose columns are ranges of bytes (astropy.io.ascii reads it, and writes CSV)"
                }
                Err(form) => form,
            },
        };
        Err(self.content_error(1, found, "a table as plain text (CSV, TSV)"))
    }

    /// Divides the text into names, units and rows. The names are the first line, or the last comment before numbers.
    fn table<'a>(&self, text: &'a str) -> Result<Table<'a>, CatalogueError> {
        let (mut comment, mut comments, mut is_before) = (None, Vec::new(), true);
        let mut lines = (1..).zip(text.lines()).filter(|(line, text)| {
            if is_comment(text) {
                let words = text.trim_start().trim_start_matches('#').trim();
                comment = if is_before { Some((*line, words)) } else { comment };
                comments.push(words);
            }
            let has_cells = !without_cells(text);
            is_before &= !has_cells;
            has_cells
        });
        let first = lines.next();
        let mut rest: Vec<(usize, &str)> = lines.collect();
        let Some((line, first)) = first else {
            return Err(self.content_error(1, "no columns", "a line of names, then one line per source"));
        };
        let separator = Separator::of(first);
        let cells = |text: &str| separator.cells(text).map(Cow::into_owned).collect::<Vec<String>>();
        let is_data = |text: &str| separator.cells(text).any(|cell| cell.parse::<f64>().is_ok());
        let (line, names) = match (is_data(first), comment) {
            (true, Some(names)) => {
                rest.insert(0, (line, first));
                names
            }
            _ => (line, first),
        };
        let columns = Columns::new(line, names, separator).map_err(|fault| self.table_error(fault))?;
        let is_rule = |text: &str| !text.is_empty() && text.chars().all(|c| "-=+| \t;,".contains(c));
        let mut units = vec![String::new(); columns.names.len()];
        let has_units = rest.first().is_some_and(|(_, text)| is_unit_row(&cells(text)));
        if has_units {
            let (line, text) = rest.remove(0);
            separator.require_closed(line, text).map_err(|fault| self.table_error(fault))?;
            let found = cells(text);
            units.iter_mut().zip(found).for_each(|(unit, found)| *unit = found);
        }
        rest.retain(|(_, text)| !is_rule(text));
        Ok(Table { columns, units, comment_units: in_comments(&comments), rows: rest })
    }
}

/// The source of a row.
fn source(row: &Row<'_>, columns: &SourceColumns, units: Units) -> Result<Source, TableFault> {
    let fault = |found: String, expected: &str| row.fault_of(found, expected);
    let joined = |places: &[usize]| places.iter().map(|&place| row.cell(place)).collect::<Vec<_>>().join(" ");
    let angle = |k: usize, expected: &str, limit: f64| {
        let text = joined(&columns.places[k]);
        let unit_deg = match is_sexagesimal(&text) {
            true if k == 0 && (columns.frame == Frame::Equatorial || units.angle_deg[0] == 15.0) => 15.0,
            true => 1.0,
            false => units.angle_deg[k],
        };
        let degrees = angle_of(&text).map(|value| unit_deg * value);
        let found = degrees.filter(|degrees| degrees.is_finite() && degrees.abs() <= limit);
        found.ok_or_else(|| fault(format!("{:?}", echo(&text)), expected))
    };
    let lon = angle(0, "a longitude: degrees, or hours, minutes and seconds", 360.0)?.to_radians();
    let lat = angle(1, "a latitude of -90 to 90 degrees", 90.0)?.to_radians();
    let flux_place =
        columns.unfitted_flux.filter(|_| is_blank(row.cell(columns.flux))).unwrap_or(columns.flux);
    let flux = row.number(flux_place, |flux| flux > 0.0, "a flux density above 0")?;
    if units.flux_jy * flux > FLUX_JY_MAX {
        let found = format!("{flux:e} {}", if units.flux_jy < 1.0 { "mJy" } else { "Jy" });
        return Err(fault(found, &format!("at most {FLUX_JY_MAX:e} Jy")));
    }
    let at_hz = match columns.frequency_place {
        None => columns.flux_hz,
        Some((place, unit)) => unit * row.number(place, |value| value > 0.0, "a frequency above 0")?,
    };
    if !(FREQUENCY_HZ_MIN..=FREQUENCY_HZ_MAX).contains(&at_hz) {
        return Err(fault(format!("a flux at {at_hz:e} Hz"), "a radio frequency, 10 kHz to 1000 GHz"));
    }
    let index = match columns.index {
        // Sources without a fit have no index.
        Some(place) if !is_blank(row.cell(place)) => {
            Some(row.number(place, |index| index.abs() <= 10.0, "a spectral index of -10 to 10")?)
        }
        _ => None,
    };
    let own = [lat.cos() * lon.cos(), lat.cos() * lon.sin(), lat.sin()];
    let direction = match columns.frame {
        Frame::Ecliptic => own,
        frame => rotate(&frame.to_ecliptic(), own),
    };
    Ok(Source { direction, flux_jy: units.flux_jy * flux, at_hz, index })
}

/// The line that says that positions are of B1950: a comment, the names, or a row with a column of equinoxes.
fn old_equinox<'a>(
    comments: impl Iterator<Item = &'a str>,
    table: &Table<'_>,
    columns: &SourceColumns,
) -> Option<usize> {
    let is_old_comment = |line: &str| {
        let line = line.to_ascii_lowercase();
        let of_positions = ["equinox", "epoch", "coord", "position"].iter().any(|word| line.contains(word));
        line.contains("b1950") || line.contains("fk4") || (line.contains("1950") && of_positions)
    };
    let is_old_cell = |cell: &str| {
        let cell = cell.to_ascii_uppercase();
        cell.contains("FK4") || cell.trim_start_matches('B').parse() == Ok(1950.0)
    };
    let in_rows = || {
        let place =
            table.columns.names.iter().position(|name| ["equinox", "epoch"].contains(&&*normalise(name)))?;
        let old = |(_, text): &&(usize, &str)| is_old_cell(&table.columns.cell(text, place));
        table.rows.iter().find(old).map(|(line, _)| *line)
    };
    let in_names = columns.places.iter().flatten().any(|place| table.columns.names[*place].contains("1950"));
    let in_comments = comments.zip(1..).find(|(line, _)| is_old_comment(line)).map(|(_, line)| line);
    in_comments.or(in_names.then_some(table.columns.line)).or_else(in_rows)
}

/// Formats a cell for messages: short, and without control characters.
fn displayed(cell: &str) -> String {
    cell.chars().take(40).collect::<String>().escape_debug().to_string()
}

/// Whether a row contains units: no numbers, and at least one unit that is usual in catalogues.
fn is_unit_row(cells: &[String]) -> bool {
    cells.iter().all(|cell| cell.parse::<f64>().is_err()) && cells.iter().any(|cell| is_unit(cell))
}

fn is_blank(cell: &str) -> bool {
    let cell = cell.to_ascii_lowercase();
    ["", "nan", "--", "-", "null", "none", "n/a"].contains(&cell.as_str())
}

fn is_sexagesimal(text: &str) -> bool {
    angle_parts(text).len() > 1
}

/// Splits an angle into numbers at colons, blanks, and the letters and signs of units.
fn angle_parts(text: &str) -> Vec<&str> {
    let signs = |c: char| c.is_whitespace() || ":hdms\u{b0}'\"\u{2032}\u{2033}".contains(c);
    text.split(signs).filter(|part| !part.is_empty()).collect()
}

/// Parses an angle of one number, or of up to three with minutes and seconds, in units of the first number.
fn angle_of(text: &str) -> Option<f64> {
    let text = text.trim().replace('\u{2212}', "-").replace(',', ".");
    let (sign, rest) = match text.strip_prefix(['-', '+']) {
        Some(rest) if text.starts_with('-') => (-1.0, rest),
        Some(rest) => (1.0, rest),
        None => (1.0, text.as_str()),
    };
    let numbers: Vec<f64> = angle_parts(rest).iter().map(|part| part.parse().ok()).collect::<Option<_>>()?;
    match numbers[..] {
        [whole] => Some(sign * whole),
        [whole, ref parts @ ..] if parts.len() <= 2 && whole >= 0.0 => {
            let good = parts.iter().all(|part| (0.0..60.0).contains(part));
            let minutes = parts.iter().rev().fold(0.0, |sum, part| (sum + part) / 60.0);
            good.then_some(sign * (whole + minutes))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests;
