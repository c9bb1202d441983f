//! Atomic writing of maps, with healpy's cards in healpy's order.

use std::io::Write;
use std::path::Path;

use super::card::Card;
use super::error::{FitsError, FitsProblem};
use super::header::BLOCK_BYTES;
use crate::files::{AtomicFile, IfUnfinished};
use crate::sky::healpix::{nested_to_ring, nside_of};
use crate::sky::{Frame, MapError, SkyMap, is_unseen};
use crate::units::constants::HEALPIX_UNSEEN;

/// Number of values of a column in one row of the table, unless the map has fewer.
const ROW_VALUES: usize = 1024;

/// Precision of the written values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// Single precision, 32 bits.
    #[default]
    Single,
    /// Double precision, 64 bits.
    Double,
}

/// Order of the written pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Ordering {
    /// RING order.
    #[default]
    Ring,
    /// NESTED order.
    Nested,
}

/// Options for writing maps.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WriteOptions {
    /// Precision.
    pub precision: Precision,
    /// Order of pixels in the file.
    pub ordering: Ordering,
    /// Whether only pixels that are not UNSEEN in the first column are written, with their numbers.
    pub partial: bool,
    /// Additional header cards, for the provenance of the map.
    pub cards: Vec<Card>,
}

/// A column of the table.
#[derive(Clone, Copy, Debug)]
pub struct Column<'a> {
    /// Name (TTYPE).
    pub name: &'a str,
    /// Unit (TUNIT); omitted if empty.
    pub unit: &'a str,
    /// Values in RING order.
    pub values: &'a [f64],
}

/// Writes one map in K, as column TEMPERATURE; replaces any file at `path`.
///
/// # Errors
/// As [`write_columns`].
pub fn write_map(path: &Path, map: &SkyMap, options: &WriteOptions) -> Result<(), FitsError> {
    let column = Column { name: "TEMPERATURE", unit: "K", values: map.values() };
    write_columns(path, map.frame(), &[column], options)
}

/// Writes maps of the same nside and frame as columns of one table; replaces any file at `path`.
///
/// The file appears whole or not at all: it is written under a temporary name in the same folder, flushed to
/// disk and renamed.
///
/// # Errors
/// [`FitsError`] for columns of unequal or invalid length, cards that FITS cannot represent, values beyond the
/// range of the precision, or an error of the operating system.
pub fn write_columns(
    path: &Path,
    frame: Frame,
    columns: &[Column<'_>],
    options: &WriteOptions,
) -> Result<(), FitsError> {
    let write = || {
        let table = Table::new(columns, options)?;
        let header = table.header(frame)?;
        write_whole(path, |out| {
            out.write_all(&header).map_err(FitsProblem::io("write"))?;
            table.write_rows(out)
        })
    };
    write().map_err(|problem| FitsError::new(path, problem))
}

/// Creates in memory the file that [`write_map`] writes.
///
/// # Errors
/// As [`write_columns`], except errors of the operating system.
pub fn map_bytes(map: &SkyMap, options: &WriteOptions) -> Result<Vec<u8>, FitsError> {
    let column = Column { name: "TEMPERATURE", unit: "K", values: map.values() };
    let write = || {
        let columns = [column];
        let table = Table::new(&columns, options)?;
        let mut bytes = table.header(map.frame())?;
        table.write_rows(&mut bytes)?;
        Ok(bytes)
    };
    write().map_err(|problem| FitsError::new(Path::new("memory"), problem))
}

/// Creates the cards that describe a binary table with these fields: name, format and unit.
pub(super) fn binary_table_cards(row_bytes: usize, rows: usize, fields: &[(&str, &str, &str)]) -> Vec<Card> {
    let mut cards = vec![
        Card::text("XTENSION", "BINTABLE", "binary table extension"),
        Card::integer("BITPIX", 8, "array data type"),
        Card::integer("NAXIS", 2, "number of array dimensions"),
        Card::integer("NAXIS1", row_bytes as i64, "length of dimension 1"),
        Card::integer("NAXIS2", rows as i64, "length of dimension 2"),
        Card::integer("PCOUNT", 0, "number of group parameters"),
        Card::integer("GCOUNT", 1, "number of groups"),
        Card::integer("TFIELDS", fields.len() as i64, "number of table fields"),
    ];
    for (number, (name, form, unit)) in (1..).zip(fields) {
        cards.push(Card::text(&format!("TTYPE{number}"), name, ""));
        cards.push(Card::text(&format!("TFORM{number}"), form, ""));
        if !unit.is_empty() {
            cards.push(Card::text(&format!("TUNIT{number}"), unit, ""));
        }
    }
    cards
}

struct Table<'a> {
    columns: &'a [Column<'a>],
    options: &'a WriteOptions,
    nside: usize,
    /// RING pixels in the order of the file.
    pixels: Vec<usize>,
    /// Pixel numbers of a partial map in the ordering of the file.
    numbers: Option<Vec<usize>>,
    row_values: usize,
}

impl<'a> Table<'a> {
    fn new(columns: &'a [Column<'a>], options: &'a WriteOptions) -> Result<Self, FitsProblem> {
        let Some(first) = columns.first() else {
            return Err(FitsProblem::NoColumn { column: 0, columns: 0 });
        };
        let count = first.values.len();
        let nside = nside_of(count).ok_or(MapError::PixelCount { pixels: count })?;
        if let Some(other) = columns.iter().find(|column| column.values.len() != count) {
            let (found, expected) = (other.values.len() as u64, count as u64);
            return Err(FitsProblem::ValueCount { name: other.name.to_owned(), found, expected, nside });
        }
        let to_ring = |pixel| match options.ordering {
            Ordering::Ring => pixel,
            Ordering::Nested => nested_to_ring(nside, pixel),
        };
        let numbers: Option<Vec<usize>> = options
            .partial
            .then(|| (0..count).filter(|&pixel| !is_unseen(first.values[to_ring(pixel)])).collect());
        let pixels = match &numbers {
            Some(numbers) => numbers.iter().map(|&pixel| to_ring(pixel)).collect(),
            None => (0..count).map(to_ring).collect(),
        };
        let row_values = if options.partial || count <= ROW_VALUES { 1 } else { ROW_VALUES };
        let table = Self { columns, options, nside, pixels, numbers, row_values };
        table.check_range()?;
        Ok(table)
    }

    fn check_range(&self) -> Result<(), FitsProblem> {
        if self.options.precision == Precision::Double {
            return Ok(());
        }
        for column in self.columns {
            let overflows = |value: &f64| value.is_finite() && (*value as f32).is_infinite();
            if let Some(pixel) = column.values.iter().position(overflows) {
                let (name, value) = (column.name.to_owned(), column.values[pixel]);
                return Err(FitsProblem::Overflow { name, pixel, value });
            }
        }
        Ok(())
    }

    /// Length of a pixel number, bytes: the smallest of 16, 32 and 64 bits that fits all, as in healpy.
    fn number_bytes(&self) -> usize {
        match self.numbers.as_ref().map(|numbers| numbers.last().copied().unwrap_or(0)) {
            None => 0,
            Some(last) if last < 1 << 15 => 2,
            Some(last) if last < 1 << 31 => 4,
            Some(_) => 8,
        }
    }

    fn header(&self, frame: Frame) -> Result<Vec<u8>, FitsProblem> {
        let mut cards = self.structure_cards();
        cards.extend(self.map_cards(frame));
        table_header(&cards, &self.options.cards)
    }

    fn structure_cards(&self) -> Vec<Card> {
        let (letter, value_bytes) = match self.options.precision {
            Precision::Single => ("E", 4),
            Precision::Double => ("D", 8),
        };
        let number_bytes = self.number_bytes();
        let row_bytes = number_bytes + self.columns.len() * self.row_values * value_bytes;
        let rows = self.pixels.len() / self.row_values;
        let number_form = match number_bytes {
            0 => None,
            2 => Some("I"),
            4 => Some("J"),
            _ => Some("K"),
        };
        let repeat = if self.row_values == 1 { String::new() } else { self.row_values.to_string() };
        let form = format!("{repeat}{letter}");
        let maps = self.columns.iter().map(|column| (column.name, form.as_str(), column.unit));
        let fields = number_form.map(|form| ("PIXEL", form, "")).into_iter().chain(maps);
        binary_table_cards(row_bytes, rows, &fields.collect::<Vec<_>>())
    }

    fn map_cards(&self, frame: Frame) -> Vec<Card> {
        let ordering = match self.options.ordering {
            Ordering::Ring => "RING",
            Ordering::Nested => "NESTED",
        };
        let coordsys = frame.letter().to_string();
        let last = self.columns[0].values.len() as i64 - 1;
        let mut cards = vec![
            Card::text("PIXTYPE", "HEALPIX", "HEALPIX pixelisation"),
            Card::text("ORDERING", ordering, "Pixel ordering scheme, either RING or NESTED"),
            Card::text("COORDSYS", &coordsys, "Ecliptic, Galactic or Celestial (equatorial)"),
            Card::text("EXTNAME", "xtension", "name of this binary table extension"),
            Card::integer("NSIDE", self.nside as i64, "Resolution parameter of HEALPIX"),
        ];
        let (scheme, object) = if self.numbers.is_some() {
            ("EXPLICIT", "PARTIAL")
        } else {
            cards.push(Card::integer("FIRSTPIX", 0, "First pixel # (0 based)"));
            cards.push(Card::integer("LASTPIX", last, "Last pixel # (0 based)"));
            ("IMPLICIT", "FULLSKY")
        };
        cards.push(Card::text("INDXSCHM", scheme, "Indexing: IMPLICIT or EXPLICIT"));
        cards.push(Card::text("OBJECT", object, "Sky coverage, either FULLSKY or PARTIAL"));
        cards
    }

    fn write_rows(&self, out: &mut impl Write) -> Result<(), FitsProblem> {
        let number_bytes = self.number_bytes();
        let mut row = Vec::new();
        let mut written = 0;
        for (k, pixels) in self.pixels.chunks_exact(self.row_values).enumerate() {
            row.clear();
            if let Some(numbers) = &self.numbers {
                let number = (numbers[k] as u64).to_be_bytes();
                row.extend_from_slice(&number[8 - number_bytes..]);
            }
            for column in self.columns {
                for &pixel in pixels {
                    let value = column.values[pixel];
                    let value = if is_unseen(value) { HEALPIX_UNSEEN } else { value };
                    match self.options.precision {
                        Precision::Single => row.extend_from_slice(&(value as f32).to_be_bytes()),
                        Precision::Double => row.extend_from_slice(&value.to_be_bytes()),
                    }
                }
            }
            out.write_all(&row).map_err(FitsProblem::io("write"))?;
            written += row.len();
        }
        let padding = written.next_multiple_of(BLOCK_BYTES) - written;
        out.write_all(&vec![0; padding]).map_err(FitsProblem::io("write"))
    }
}

/// An empty primary part, and the header of a table, which ends with the caller's cards.
pub(super) fn table_header(structure: &[Card], given: &[Card]) -> Result<Vec<u8>, FitsProblem> {
    let mut header = Vec::new();
    for card in [
        Card::logical("SIMPLE", true, "conforms to FITS standard"),
        Card::integer("BITPIX", 8, "array data type"),
        Card::integer("NAXIS", 0, "number of array dimensions"),
        Card::logical("EXTEND", true, ""),
    ] {
        card.write_to(&mut header)?;
    }
    end_header(&mut header);
    append_header(&mut header, structure, given)?;
    Ok(header)
}

/// Appends a header that ends with the caller's cards, after the program that writes it unless they name one. It has no DATE, so that equal data
/// give equal bytes.
pub(super) fn append_header(
    header: &mut Vec<u8>,
    structure: &[Card],
    given: &[Card],
) -> Result<(), FitsProblem> {
    let creator = Card::text("CREATOR", concat!("lunarray ", env!("CARGO_PKG_VERSION")), "program");
    let creator = (!given.iter().any(|card| card.key == creator.key)).then_some(creator);
    for card in structure.iter().chain(&creator).chain(given) {
        card.write_to(header)?;
    }
    end_header(header);
    Ok(())
}

fn end_header(header: &mut Vec<u8>) {
    header.extend_from_slice(b"END");
    header.resize(header.len().next_multiple_of(BLOCK_BYTES), b' ');
}

/// Runs `write` on a temporary file beside `path`, flushes it to disk and renames it to `path`; removes it on
/// failure.
pub(super) fn write_whole(
    path: &Path,
    write: impl FnOnce(&mut AtomicFile) -> Result<(), FitsProblem>,
) -> Result<(), FitsProblem> {
    let mut file =
        AtomicFile::create(path, IfUnfinished::Remove).map_err(FitsProblem::io("create the file"))?;
    write(&mut file)?;
    file.finish().map(|_| ()).map_err(FitsProblem::io("put the file in place"))
}
