//! Reading of maps in RING or NESTED order, full or partial, with any numeric type.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use super::card::CardValue;
use super::error::{FitsError, FitsProblem};
use super::header::{BLOCK_BYTES, Header};
use super::keywords::{check_pixels, choose_columns, frame, is_explicit, nside, stated_nested, unit};
use super::metadata::{
    MapUnit, QuotedFrequency, StatedFrequency, column_frequency, is_other_quantity, is_same_hz,
    quoted_frequencies, stated_frequency,
};
use super::table::{CellType, ColumnLayout, TableLayout};
use crate::files::{form_of, open_file};
use crate::sky::healpix::{nested_to_ring, pixel_count};
use crate::sky::{Frame, MapError, SkyMap, is_unseen};
use crate::units::Dimension;
use crate::units::constants::HEALPIX_UNSEEN;

const PIECE_BYTES: usize = 1 << 20;
/// Maximum number of header-data units before the table.
const UNITS_MAX: usize = 1000;
/// Maximum nside of a partial map with any number of pixels: 100 MB when expanded.
const NSIDE_MAX_SPARSE: usize = 1024;

/// Options for reading a map.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ReadOptions {
    /// Map column of the table, counted from 0 without the column of pixel numbers; `None` for the one of `frequency_hz`, or the first
    /// whose name is not that of an error, a number of observations or pixels, or polarisation.
    pub column: Option<usize>,
    /// Frame of files without COORDSYS; `None` makes such files an error.
    pub frame_if_missing: Option<Frame>,
    /// Frequency, Hz: where columns state their frequencies, the column with the nearest one is read in place of `column`.
    pub frequency_hz: Option<f64>,
}

/// A map with the metadata of its file.
#[derive(Clone, Debug, PartialEq)]
pub struct MapFile {
    /// The map, in RING order; pixels missing from a partial map are UNSEEN.
    pub map: SkyMap,
    /// Name of the column (TTYPE), may be empty.
    pub name: String,
    /// Unit of the column (TUNIT), may be empty.
    pub unit: String,
    /// Whether the frame is assumed, because the file has no COORDSYS.
    pub frame_assumed: bool,
    /// Frequency of the map, Hz, from its column or either header.
    pub frequency_hz: Option<f64>,
    /// Keyword that states the frequency.
    pub(super) frequency_keyword: String,
    /// Frequencies in other texts of the headers.
    pub(super) quoted: Vec<QuotedFrequency>,
    /// Order of the pixels, and whether it is assumed.
    pub(super) ordering: &'static str,
    /// RING number and value of the first pixel that the header calls bad.
    first_bad: Option<(usize, f64)>,
    /// Number of columns with maps of this size in the table.
    pub columns: usize,
    /// Cards of the table's header, then of the primary header.
    pub header: Header,
}

/// Reads a map in RING or NESTED order, full or partial, of integers or floats of any precision.
///
/// # Errors
/// [`FitsError`] with the file and its problem.
pub fn read_map(path: &Path, options: &ReadOptions) -> Result<SkyMap, FitsError> {
    read_map_file(path, options).map(|file| file.map)
}

/// Reads a map of temperatures with a usable value in every pixel, and converts it to K.
///
/// # Errors
/// [`FitsError`], including [`FitsProblem::Unit`] for a unit that is not one of temperature, and
/// [`crate::sky::MapError::BadPixels`] for pixels that are NaN, infinite or UNSEEN.
pub fn read_whole_map(path: &Path, options: &ReadOptions) -> Result<SkyMap, FitsError> {
    read_whole_map_file(path, options).map(|file| file.map)
}

/// Reads a map as [`read_whole_map`], with the metadata of its file.
///
/// # Errors
/// As [`read_whole_map`].
pub fn read_whole_map_file(path: &Path, options: &ReadOptions) -> Result<MapFile, FitsError> {
    let mut file = read_map_file(path, options)?;
    let refuse = |problem| FitsError::new(path, problem);
    file.map.check_whole().map_err(|problem| match (problem, file.first_bad) {
        // The file has what it calls bad, in place of UNSEEN.
        (MapError::BadPixels { count, total, first, .. }, Some((bad, value))) if bad == first => {
            refuse(MapError::BadPixels { count, total, first, value }.into())
        }
        (problem, _) => refuse(problem.into()),
    })?;
    let unit =
        MapUnit::parse(&file.unit).ok_or_else(|| refuse(FitsProblem::Unit { found: file.unit.clone() }))?;
    let factor = unit.kelvin(file.frequency_hz).ok_or_else(|| {
        refuse(FitsProblem::missing("FREQ", format!("the map's frequency, to convert {} to K", file.unit)))
    })?;
    if factor != 1.0 {
        file.map.values_mut().iter_mut().for_each(|value| *value *= factor);
    }
    Ok(file)
}

/// Lists the assumptions made about a map's unit, order, frequency and column. Reads only headers.
///
/// # Errors
/// [`FitsError`] with the file and its problem.
pub fn read_notes(path: &Path, options: &ReadOptions) -> Result<Vec<String>, FitsError> {
    read_headers(path, |header, table| {
        let explicit = is_explicit(header)?;
        let chosen = chosen_column(header, table, explicit, options)?;
        let number = chosen + 1 + usize::from(explicit);
        let mut notes = Vec::new();
        if unit(header, number)?.is_empty() {
            notes.push("the map states no unit (TUNIT); it is taken as K".to_owned());
        }
        if stated_nested(header)?.is_none() {
            notes.push("the map states no order of its pixels (ORDERING); RING is assumed".to_owned());
        }
        if stated_frequency(header, number)?.is_none() {
            let quoted = quoted_frequencies(header, number);
            let said =
                quoted.first().map_or_else(String::new, |QuotedFrequency { keyword, text, .. }| {
                    format!(", but its header says '{text}' in {keyword}")
                });
            notes.push(format!(
                "the map states no frequency (FREQ){said}; it is taken as one at the channel's"
            ));
        }
        let (_, column) = choose_columns(table, explicit, chosen)?;
        let columns = table.maps_like(column, explicit);
        if columns > 1 && options.column.is_none() && column_frequency(header, number)?.is_none() {
            notes.push(format!(
                "the table has {columns} columns and does not say their frequencies; `{}`, the first that may be a temperature, is used \
                 (sky.column chooses another)",
                column.name
            ));
        }
        Ok(notes)
    })
}

/// Reads the nside of a map, from headers only.
///
/// # Errors
/// [`FitsError`] with the file and its problem.
pub fn read_nside(path: &Path, options: &ReadOptions) -> Result<usize, FitsError> {
    read_headers(path, |header, table| {
        let explicit = is_explicit(header)?;
        let chosen = chosen_column(header, table, explicit, options)?;
        let (_, column) = choose_columns(table, explicit, chosen)?;
        nside(header, table.rows.saturating_mul(column.repeat as u64), explicit)
    })
}

/// Reads the frequency of a map in a file, if it is stated, and those in other texts, from headers only.
pub(super) fn read_frequency(
    path: &Path,
    options: &ReadOptions,
) -> Result<(Option<StatedFrequency>, Vec<QuotedFrequency>), FitsError> {
    read_headers(path, |header, table| {
        let explicit = is_explicit(header)?;
        let number = chosen_column(header, table, explicit, options)? + 1 + usize::from(explicit);
        Ok((stated_frequency(header, number)?, quoted_frequencies(header, number)))
    })
}

/// Opens a file; gives its length, bytes. A pipe would be waited for, and a device has no length.
fn open(path: &Path) -> Result<(File, u64), FitsProblem> {
    let file = open_file(path).map_err(FitsProblem::io("open"))?;
    let length = file.metadata().map_err(FitsProblem::io("examine"))?.len();
    Ok((file, length))
}

/// Applies `read` to the headers of a file's first map.
fn read_headers<T>(
    path: &Path,
    read: impl FnOnce(&Header, &TableLayout) -> Result<T, FitsProblem>,
) -> Result<T, FitsError> {
    let from_file = || {
        let (file, length) = open(path)?;
        let mut reader = BufReader::new(file);
        check_start(&mut reader, length)?;
        let (header, start) = find_table(&mut reader, length)?;
        read(&header, &TableLayout::new(&header, start, length)?)
    };
    from_file().map_err(|problem| FitsError::new(path, problem))
}

/// Reads a map with its header.
///
/// # Errors
/// [`FitsError`] with the file and its problem.
pub fn read_map_file(path: &Path, options: &ReadOptions) -> Result<MapFile, FitsError> {
    let read = || {
        let (file, length) = open(path)?;
        read_map_from(&mut BufReader::new(file), length, options)
    };
    read().map_err(|problem| FitsError::new(path, problem))
}

/// Reads a map from a source of `length` bytes.
///
/// # Errors
/// [`FitsProblem`].
pub fn read_map_from(
    reader: &mut (impl Read + Seek),
    length: u64,
    options: &ReadOptions,
) -> Result<MapFile, FitsProblem> {
    check_start(reader, length)?;
    let (header, start) = find_table(reader, length)?;
    check_pixels(&header)?;
    let table = TableLayout::new(&header, start, length)?;
    reader.seek(SeekFrom::Start(start)).map_err(FitsProblem::io("seek"))?;

    let explicit = is_explicit(&header)?;
    let chosen = chosen_column(&header, &table, explicit, options)?;
    let (index, column) = choose_columns(&table, explicit, chosen)?;
    let cells = table.rows.saturating_mul(column.repeat as u64);
    let nside = nside(&header, cells, explicit)?;
    let nested = stated_nested(&header)?;
    let (frame, frame_assumed) = frame(&header, options.frame_if_missing)?;

    let mut values = match index {
        None => read_implicit(reader, &table, column, nside)?,
        Some(index) => read_explicit(reader, &table, index, column, nside)?,
    };
    if nested == Some(true) {
        values = to_ring(nside, &values);
    }
    let first_bad = leave_bad_out(&mut values, &bad_values(&header, column)?);
    let number = chosen + 1 + usize::from(explicit);
    let (unit, frequency) = (unit(&header, number)?, stated_frequency(&header, number)?);
    Ok(MapFile {
        map: SkyMap::new(frame, values)?,
        name: column.name.clone(),
        unit,
        frame_assumed,
        frequency_hz: frequency.as_ref().map(|frequency| frequency.hz),
        quoted: quoted_frequencies(&header, number),
        ordering: match nested {
            None => "RING order (assumed)",
            Some(false) => "RING order",
            Some(true) => "NESTED order",
        },
        frequency_keyword: frequency.map_or("FREQ".to_owned(), |frequency| frequency.keyword),
        first_bad,
        columns: table.maps_like(column, explicit),
        header,
    })
}

fn check_start(reader: &mut (impl Read + Seek), length: u64) -> Result<(), FitsProblem> {
    if length == 0 {
        return Err(FitsProblem::Empty);
    }
    let mut start = Vec::new();
    reader.seek(SeekFrom::Start(0)).map_err(FitsProblem::io("seek"))?;
    reader.by_ref().take(512).read_to_end(&mut start).map_err(FitsProblem::io("read"))?;
    if start.starts_with(b"SIMPLE  =") {
        return Ok(());
    }
    let found = match form_of(&start) {
        Some(form) => format!("the signature of {form} (decompress it first, if it is compressed)"),
        None => format!("`{}`", start[..start.len().min(9)].escape_ascii()),
    };
    Err(FitsProblem::NotFits { found })
}

/// The values that the header says are none. BLANK of integers is read with the table, as TNULL.
fn bad_values(header: &Header, column: &ColumnLayout) -> Result<Vec<f64>, FitsProblem> {
    let blank = if column.is_integer() { None } else { Some("BLANK") };
    let mut found = Vec::new();
    for key in ["BAD_DATA", "BADVAL", "BAD_VAL", "MISSVAL", "UNSEEN"].into_iter().chain(blank) {
        found.extend(header.number(key)?);
    }
    Ok(found)
}

/// Makes UNSEEN of the values that mean no value: UNSEEN of single precision, or what the header calls bad. Returns the first of the latter.
fn leave_bad_out(values: &mut [f64], bad: &[f64]) -> Option<(usize, f64)> {
    // Single precision keeps seven digits.
    let is_bad = |value: f64| bad.iter().any(|bad| (value - bad).abs() <= 1e-6 * bad.abs());
    let first = values.iter().position(|value| is_bad(*value) && !is_unseen(*value));
    let first = first.map(|pixel| (pixel, values[pixel]));
    let left_out = values.iter_mut().filter(|value| is_unseen(**value) || is_bad(**value));
    left_out.for_each(|value| *value = HEALPIX_UNSEEN);
    first
}

/// Index of the map column to read, from 0: of those that state their frequencies, the nearest to the requested one, else the first.
fn chosen_column(
    header: &Header,
    table: &TableLayout,
    explicit: bool,
    options: &ReadOptions,
) -> Result<usize, FitsProblem> {
    if let Some(column) = options.column {
        return Ok(column);
    }
    let before = usize::from(explicit);
    let is_map = |(_, column): &(usize, &ColumnLayout)| {
        column.cell != CellType::Other && column.repeat > 0 && !is_other_quantity(&column.name)
    };
    let maps: Vec<usize> =
        table.columns.iter().skip(before).enumerate().filter(is_map).map(|(k, _)| k).collect();
    let mut stated = Vec::new();
    for &column in &maps {
        stated.extend(column_frequency(header, column + 1 + before)?.map(|frequency| (column, frequency)));
    }
    let first = maps.first().copied().unwrap_or_default();
    let Some(wanted_hz) = options.frequency_hz else { return Ok(first) };
    let distance = |hz: f64| if is_same_hz(hz, wanted_hz) { 0.0 } else { (hz / wanted_hz).ln().abs() };
    let nearest = stated.iter().min_by(|(_, a), (_, b)| distance(a.hz).total_cmp(&distance(b.hz)));
    let Some((column, StatedFrequency { hz, keyword })) = nearest else { return Ok(first) };
    match stated.iter().find(|(other, frequency)| other != column && is_same_hz(frequency.hz, *hz)) {
        None => Ok(*column),
        Some((_, other)) => {
            let expected = format!("one column of that frequency; {} says it, too", other.keyword);
            Err(FitsProblem::keyword(keyword, Dimension::Frequency.show(*hz), expected))
        }
    }
}

/// Keywords of the header of a table with a map.
const MAP_KEYWORDS: [&str; 4] = ["PIXTYPE", "NSIDE", "ORDERING", "INDXSCHM"];

/// Finds the first binary table that says that it has a map, or else the first: its header followed by the primary header, and the
/// offset of its rows.
fn find_table(reader: &mut (impl Read + Seek), length: u64) -> Result<(Header, u64), FitsProblem> {
    let mut at = 0;
    let mut units = 0;
    let mut primary = None;
    let mut first = None;
    while at < length && units < UNITS_MAX {
        // What follows a table need not be whole.
        let (header, data) = match Header::read(reader, at, length) {
            Err(_) if first.is_some() => break,
            read => read?,
        };
        units += 1;
        // Compressed images are tables of tiles.
        let is_image = header.get("ZIMAGE") == Some(&CardValue::Logical(true));
        let is_table = header.text("XTENSION") == Some("BINTABLE") && !is_image;
        if is_table && MAP_KEYWORDS.iter().any(|key| header.get(key).is_some()) {
            return Ok((header.with_primary(primary.unwrap_or_default()), data));
        }
        let needed = header.data_bytes().map(|bytes| data.saturating_add(bytes));
        if is_table && first.is_none() {
            first = Some((header, data));
        } else {
            primary.get_or_insert(header);
        }
        at = match needed {
            Ok(needed) if needed <= length => needed.next_multiple_of(BLOCK_BYTES as u64),
            _ if first.is_some() => break,
            Ok(needed) => {
                return Err(FitsProblem::Truncated { expected: "data before the table", needed, length });
            }
            Err(problem) => return Err(problem),
        };
    }
    let (header, data) = first.ok_or(FitsProblem::NoTable { units })?;
    Ok((header.with_primary(primary.unwrap_or_default()), data))
}

/// Calls `use_row` for every row; memory is bounded by one read or one row.
fn for_each_row(
    reader: &mut impl Read,
    table: &TableLayout,
    mut use_row: impl FnMut(u64, &[u8]) -> Result<(), FitsProblem>,
) -> Result<(), FitsProblem> {
    let rows_at_once = (PIECE_BYTES / table.row_bytes).max(1) as u64;
    let mut piece = vec![0; table.row_bytes * rows_at_once.min(table.rows) as usize];
    let mut done = 0;
    while done < table.rows {
        let rows = rows_at_once.min(table.rows - done);
        let piece = &mut piece[..table.row_bytes * rows as usize];
        reader.read_exact(piece).map_err(FitsProblem::io("read"))?;
        for (k, row) in piece.chunks_exact(table.row_bytes).enumerate() {
            use_row(done + k as u64, row)?;
        }
        done += rows;
    }
    Ok(())
}

fn read_implicit(
    reader: &mut impl Read,
    table: &TableLayout,
    column: &ColumnLayout,
    nside: usize,
) -> Result<Vec<f64>, FitsProblem> {
    let pixels = pixel_count(nside);
    let found = table.rows.saturating_mul(column.repeat as u64);
    if found != pixels as u64 {
        let name = column.name.clone();
        return Err(FitsProblem::ValueCount { name, found, expected: pixels as u64, nside });
    }
    // The layout of the table was checked against the file's length, so that the allocation is bounded by it.
    let mut values = Vec::with_capacity(pixels);
    for_each_row(reader, table, |_, row| {
        column.decode(column.cells(row), HEALPIX_UNSEEN, &mut values);
        Ok(())
    })?;
    Ok(values)
}

fn read_explicit(
    reader: &mut impl Read,
    table: &TableLayout,
    index: &ColumnLayout,
    column: &ColumnLayout,
    nside: usize,
) -> Result<Vec<f64>, FitsProblem> {
    let pixels = pixel_count(nside);
    let found = table.rows.saturating_mul(column.repeat as u64);
    if nside > NSIDE_MAX_SPARSE && found < pixels as u64 / 16 {
        return Err(FitsProblem::Sparse { found, nside, limit: NSIDE_MAX_SPARSE });
    }
    if found > pixels as u64 {
        let name = column.name.clone();
        return Err(FitsProblem::ValueCount { name, found, expected: pixels as u64, nside });
    }
    let mut values = vec![HEALPIX_UNSEEN; pixels];
    let mut filled = vec![false; pixels];
    let (mut numbers, mut cells) = (Vec::new(), Vec::new());
    for_each_row(reader, table, |row_number, row| {
        numbers.clear();
        cells.clear();
        index.decode_integers(index.cells(row), &mut numbers);
        column.decode(column.cells(row), HEALPIX_UNSEEN, &mut cells);
        for (&pixel, &value) in numbers.iter().zip(&cells) {
            match usize::try_from(pixel).ok().filter(|&p| p < pixels && !filled[p]) {
                Some(p) => {
                    filled[p] = true;
                    values[p] = value;
                }
                None => {
                    return Err(FitsProblem::Pixel { row: row_number, pixel, last: pixels as u64 - 1 });
                }
            }
        }
        Ok(())
    })?;
    Ok(values)
}

fn to_ring(nside: usize, nested: &[f64]) -> Vec<f64> {
    let mut ring = vec![0.0; nested.len()];
    for (pixel, &value) in nested.iter().enumerate() {
        ring[nested_to_ring(nside, pixel)] = value;
    }
    ring
}
