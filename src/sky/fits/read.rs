//! Reading of maps in RING or NESTED order, full or partial, with any numeric type.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use super::card::CardValue;
use super::error::{FitsError, FitsProblem};
use super::header::{BLOCK_BYTES, Header};
use super::metadata::{MapUnit, column_hz, frequency_hz, is_same_hz};
use super::table::{CellType, ColumnLayout, TableLayout};
use crate::sky::healpix::{is_valid_nside, nested_to_ring, nside_of, pixel_count};
use crate::sky::{Frame, SkyMap, is_unseen};
use crate::units::constants::HEALPIX_UNSEEN;

const PIECE_BYTES: usize = 1 << 20;
/// Maximum number of header-data units before the table.
const UNITS_MAX: usize = 1000;
/// Maximum nside of a partial map with any number of pixels: 100 MB when expanded.
const NSIDE_MAX_SPARSE: usize = 1024;

/// Options for reading a map.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ReadOptions {
    /// Map column of the table, counted from 0 without the column of pixel numbers.
    pub column: usize,
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
    file.map.check_whole().map_err(|problem| refuse(problem.into()))?;
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

/// Lists the assumptions made about a map's unit, frequency and column. Reads only headers.
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
        if frequency_hz(header, number)?.is_none() {
            notes.push("the map states no frequency (FREQ); it is taken as one at the channel's".to_owned());
        }
        let (_, column) = choose_columns(table, explicit, chosen)?;
        let columns = table.maps_like(column, explicit);
        if columns > 1 && column_hz(header, number)?.is_none() {
            notes.push(format!(
                "the table has {columns} columns of maps and does not say their frequencies; `{}`, the first, is used",
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

/// Reads the frequency of the first map in a file, Hz, if it is stated, from headers only.
pub(super) fn read_frequency(path: &Path) -> Result<Option<f64>, FitsError> {
    read_headers(path, |header, _| frequency_hz(header, 1 + usize::from(is_explicit(header)?)))
}

/// Opens a file; gives its length, bytes. A pipe would be waited for, and a device has no length.
fn open(path: &Path) -> Result<(File, u64), FitsProblem> {
    let found = std::fs::metadata(path).map_err(FitsProblem::io("open"))?;
    match found.is_file() {
        true => Ok((File::open(path).map_err(FitsProblem::io("open"))?, found.len())),
        false => Err(FitsProblem::NotAFile),
    }
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
    let nested = is_nested(&header)?;
    let (frame, frame_assumed) = frame(&header, options)?;

    let mut values = match index {
        None => read_implicit(reader, &table, column, nside)?,
        Some(index) => read_explicit(reader, &table, index, column, nside)?,
    };
    let is_bad = bad_values(&header);
    values.iter_mut().filter(|value| is_bad(**value)).for_each(|value| *value = HEALPIX_UNSEEN);
    let values = if nested { to_ring(nside, &values) } else { values };
    let number = chosen + 1 + usize::from(explicit);
    let (unit, frequency_hz) = (unit(&header, number)?, frequency_hz(&header, number)?);
    let map = SkyMap::new(frame, values)?;
    let columns = table.maps_like(column, explicit);
    Ok(MapFile { map, name: column.name.clone(), unit, frame_assumed, frequency_hz, columns, header })
}

fn check_start(reader: &mut (impl Read + Seek), length: u64) -> Result<(), FitsProblem> {
    if length == 0 {
        return Err(FitsProblem::Empty);
    }
    let mut start = Vec::new();
    reader.seek(SeekFrom::Start(0)).map_err(FitsProblem::io("seek"))?;
    reader.by_ref().take(9).read_to_end(&mut start).map_err(FitsProblem::io("read"))?;
    if start == b"SIMPLE  =" {
        return Ok(());
    }
    let found = match start.as_slice() {
        [0x1f, 0x8b, ..] => "a gzip signature (decompress it first)".to_owned(),
        other => format!("`{}`", other.escape_ascii()),
    };
    Err(FitsProblem::NotFits { found })
}

/// Returns a test for values that mean no value: UNSEEN, or the header's BAD_DATA.
fn bad_values(header: &Header) -> impl Fn(f64) -> bool + use<> {
    let stated = header.real("BAD_DATA");
    // Single precision keeps seven digits.
    move |value| is_unseen(value) || stated.is_some_and(|bad| (value - bad).abs() <= 1e-6 * bad.abs())
}

/// Index of the map column to read, from 0: of those that state their frequencies, the nearest to the requested one.
fn chosen_column(
    header: &Header,
    table: &TableLayout,
    explicit: bool,
    options: &ReadOptions,
) -> Result<usize, FitsProblem> {
    let Some(wanted_hz) = options.frequency_hz else { return Ok(options.column) };
    let mut nearest: Option<(f64, usize)> = None;
    for column in 0..table.columns.len() - usize::from(explicit) {
        let Some(hz) = column_hz(header, column + 1 + usize::from(explicit))? else { continue };
        let distance = if is_same_hz(hz, wanted_hz) { 0.0 } else { (hz / wanted_hz).ln().abs() };
        if nearest.is_none_or(|(smallest, _)| distance < smallest) {
            nearest = Some((distance, column));
        }
    }
    Ok(nearest.map_or(options.column, |(_, column)| column))
}

/// Finds the first binary table: its header followed by the primary header, and the offset of its rows.
fn find_table(reader: &mut (impl Read + Seek), length: u64) -> Result<(Header, u64), FitsProblem> {
    let mut at = 0;
    let mut units = 0;
    let mut primary = Header::default();
    while at < length && units < UNITS_MAX {
        let (header, data) = Header::read(reader, at, length)?;
        units += 1;
        if header.text("XTENSION") == Some("BINTABLE") {
            return Ok((header.with_primary(primary), data));
        }
        let needed = data.saturating_add(header.data_bytes()?);
        if needed > length {
            return Err(FitsProblem::Truncated { expected: "data before the table", needed, length });
        }
        at = needed.next_multiple_of(BLOCK_BYTES as u64);
        if units == 1 {
            primary = header;
        }
    }
    Err(FitsProblem::NoTable { units })
}

fn unit(header: &Header, column: usize) -> Result<String, FitsProblem> {
    let key = format!("TUNIT{column}");
    match header.get(&key) {
        None => Ok(String::new()),
        Some(CardValue::Text(text)) => Ok(text.trim().to_owned()),
        Some(other) => Err(FitsProblem::keyword(&key, other, "a unit such as 'K'")),
    }
}

/// Requires HEALPix pixels, if the header states the pixelisation.
fn check_pixels(header: &Header) -> Result<(), FitsProblem> {
    match header.get("PIXTYPE") {
        None => Ok(()),
        Some(CardValue::Text(text)) if text.trim().eq_ignore_ascii_case("HEALPIX") => Ok(()),
        Some(other) => Err(FitsProblem::keyword("PIXTYPE", other, "'HEALPIX'")),
    }
}

/// Whether the table gives pixel numbers, from INDXSCHM or else OBJECT.
fn is_explicit(header: &Header) -> Result<bool, FitsProblem> {
    match (header.text("INDXSCHM"), header.text("OBJECT")) {
        (Some("EXPLICIT"), _) => Ok(true),
        (Some("IMPLICIT"), Some("PARTIAL")) => {
            Err(FitsProblem::keyword("INDXSCHM", "'IMPLICIT' with OBJECT 'PARTIAL'", "EXPLICIT for that"))
        }
        (Some("IMPLICIT"), _) => Ok(false),
        (None, object) => Ok(object == Some("PARTIAL")),
        (Some(other), _) => Err(FitsProblem::keyword("INDXSCHM", other, "IMPLICIT or EXPLICIT")),
    }
}

/// Returns the column of pixel numbers, if there is one, and the column of the map.
fn choose_columns(
    table: &TableLayout,
    explicit: bool,
    column: usize,
) -> Result<(Option<&ColumnLayout>, &ColumnLayout), FitsProblem> {
    let (index, maps) = match table.columns.split_first() {
        Some((first, rest)) if explicit => (Some(first), rest),
        _ => (None, table.columns.as_slice()),
    };
    let no_column = || FitsProblem::NoColumn { column, columns: maps.len() };
    let map = maps.get(column).ok_or_else(no_column)?;
    let key = |number: usize| format!("TFORM{number}");
    if map.cell == CellType::Other || map.repeat == 0 {
        let found = format!("no numbers ({} cells)", map.repeat);
        let number = column + 1 + usize::from(explicit);
        return Err(FitsProblem::keyword(&key(number), found, "B, I, J, K, E or D cells"));
    }
    if let Some(index) = index
        && !(index.is_integer() && index.repeat == map.repeat)
    {
        let expected = "one integer pixel number for every value";
        return Err(FitsProblem::keyword(&key(1), format!("{} cells", index.repeat), expected));
    }
    Ok((index, map))
}

fn nside(header: &Header, cells: u64, explicit: bool) -> Result<usize, FitsProblem> {
    let expected = "a power of two from 1 to 8192";
    let Some(nside) = header.count("NSIDE")? else {
        let known = if explicit { None } else { usize::try_from(cells).ok().and_then(nside_of) };
        return known.ok_or_else(|| FitsProblem::missing("NSIDE", expected));
    };
    match usize::try_from(nside) {
        Ok(nside) if is_valid_nside(nside) => Ok(nside),
        _ => Err(FitsProblem::keyword("NSIDE", nside, expected)),
    }
}

fn is_one_of<const N: usize>(text: &str, names: [&str; N]) -> bool {
    names.iter().any(|name| text.trim().eq_ignore_ascii_case(name))
}

fn is_nested(header: &Header) -> Result<bool, FitsProblem> {
    match header.get("ORDERING") {
        None => Ok(false),
        Some(CardValue::Text(text)) if is_one_of(text, ["RING"]) => Ok(false),
        Some(CardValue::Text(text)) if is_one_of(text, ["NEST", "NESTED"]) => Ok(true),
        Some(other) => Err(FitsProblem::keyword("ORDERING", other, "RING or NESTED")),
    }
}

fn frame(header: &Header, options: &ReadOptions) -> Result<(Frame, bool), FitsProblem> {
    let named = header.text("SKYCOORD").and_then(Frame::from_coordsys);
    match (header.get("COORDSYS"), named.or(options.frame_if_missing)) {
        (None, None) => Err(FitsProblem::NoFrame),
        (None, Some(frame)) => Ok((frame, named.is_none())),
        (Some(found), _) => header
            .text("COORDSYS")
            .and_then(Frame::from_coordsys)
            .map(|frame| (frame, false))
            .ok_or_else(|| FitsProblem::keyword("COORDSYS", found, "'E', 'G' or 'C'")),
    }
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
