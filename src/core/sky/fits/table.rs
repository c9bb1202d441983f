//! Layout and cells of a binary table with fixed-width columns (FITS Standard 4.0, Sect. 7.3).

use super::card::CardValue;
use super::error::FitsProblem;
use super::header::Header;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CellType {
    /// Unsigned byte, B.
    U8,
    /// 16-bit integer, I.
    I16,
    /// 32-bit integer, J.
    I32,
    /// 64-bit integer, K.
    I64,
    /// Single precision, E.
    F32,
    /// Double precision, D.
    F64,
    /// Any other type, which is skipped.
    Other,
}

#[derive(Clone, Debug)]
pub(super) struct ColumnLayout {
    pub name: String,
    pub cell: CellType,
    /// Number of cells in a row.
    pub repeat: usize,
    /// Offset of the column in a row, bytes.
    pub offset: usize,
    /// Width in a row, bytes.
    pub width: usize,
    scale: f64,
    zero: f64,
    null: Option<i64>,
}

/// Layout of a table whose size was checked against the file.
#[derive(Clone, Debug)]
pub(super) struct TableLayout {
    pub rows: u64,
    pub row_bytes: usize,
    pub columns: Vec<ColumnLayout>,
}

impl TableLayout {
    /// Reads the layout from a header whose data start at byte `start` of a file of `length` bytes.
    pub(super) fn new(header: &Header, start: u64, length: u64) -> Result<Self, FitsProblem> {
        let row_bytes = header.required_count("NAXIS1")?;
        let rows = header.required_count("NAXIS2")?;
        let fields = header.required_count("TFIELDS")?;
        if row_bytes == 0 || fields == 0 || fields > 999 {
            let found = format!("{fields} in rows of {row_bytes} bytes");
            return Err(FitsProblem::keyword("TFIELDS", found, "1 to 999 columns in rows of some bytes"));
        }
        let too_large = || FitsProblem::keyword("NAXIS2", rows, "a table that a file can hold");
        let needed = row_bytes.checked_mul(rows).and_then(|b| b.checked_add(start)).ok_or_else(too_large)?;
        if needed > length {
            return Err(FitsProblem::Truncated { expected: "the rows of its table", needed, length });
        }
        let row_bytes = usize::try_from(row_bytes).map_err(|_| too_large())?;
        let mut columns = Vec::new();
        let mut offset = 0;
        for number in 1..=fields {
            let column = ColumnLayout::new(header, number, offset)?;
            offset = offset.saturating_add(column.width);
            columns.push(column);
        }
        if offset != row_bytes {
            let expected = format!("{offset}, the width of its {fields} columns");
            return Err(FitsProblem::keyword("NAXIS1", row_bytes, expected));
        }
        Ok(Self { rows, row_bytes, columns })
    }

    /// Number of columns, except pixel numbers, with as many cells as `column`.
    pub(super) fn maps_like(&self, column: &ColumnLayout, explicit: bool) -> usize {
        let others = self.columns.iter().skip(usize::from(explicit));
        others.filter(|other| other.cell != CellType::Other && other.repeat == column.repeat).count()
    }
}

impl ColumnLayout {
    fn new(header: &Header, number: u64, offset: usize) -> Result<Self, FitsProblem> {
        let key = format!("TFORM{number}");
        let expected = "a format such as '1024E', 'D' or 'J'";
        let form = header.text(&key).ok_or_else(|| FitsProblem::missing(&key, expected))?;
        let letter_at = form.find(|c: char| !c.is_ascii_digit()).unwrap_or(form.len());
        let (digits, letters) = form.split_at(letter_at);
        let repeat = if digits.is_empty() { Some(1) } else { digits.parse::<usize>().ok() };
        let (cell, cell_bytes) = match letters.chars().next() {
            Some('B') => (CellType::U8, 1),
            Some('I') => (CellType::I16, 2),
            Some('J') => (CellType::I32, 4),
            Some('K') => (CellType::I64, 8),
            Some('E') => (CellType::F32, 4),
            Some('D') => (CellType::F64, 8),
            Some('L' | 'A' | 'X') => (CellType::Other, 1),
            Some('C' | 'P') => (CellType::Other, 8),
            Some('M' | 'Q') => (CellType::Other, 16),
            _ => return Err(FitsProblem::keyword(&key, form, expected)),
        };
        let width = match (repeat, letters.starts_with('X')) {
            (Some(repeat), true) => Some(repeat.div_ceil(8)),
            (Some(repeat), false) => repeat.checked_mul(cell_bytes),
            (None, _) => None,
        };
        let (Some(repeat), Some(width)) = (repeat, width) else {
            return Err(FitsProblem::keyword(&key, form, expected));
        };
        let real = |key: &str, otherwise: f64| {
            header.number(&format!("{key}{number}")).map(|number| number.unwrap_or(otherwise))
        };
        let null_of = |key: &str| match header.get(key) {
            None => Ok(None),
            Some(CardValue::Integer(null)) => Ok(Some(*null)),
            Some(found) => {
                let quoted = header.text(key).and_then(|text| text.parse().ok());
                quoted.map(Some).ok_or_else(|| FitsProblem::keyword(key, found, "an integer"))
            }
        };
        let null = match null_of(&format!("TNULL{number}"))? {
            // The keyword of images.
            None if letters.starts_with(['B', 'I', 'J', 'K']) => null_of("BLANK")?,
            null => null,
        };
        Ok(Self {
            name: header.text(&format!("TTYPE{number}")).unwrap_or("").to_owned(),
            cell,
            repeat,
            offset,
            width,
            scale: real("TSCAL", 1.0)?,
            zero: real("TZERO", 0.0)?,
            null,
        })
    }

    pub(super) fn cells<'a>(&self, row: &'a [u8]) -> &'a [u8] {
        &row[self.offset..self.offset + self.width]
    }

    /// Appends the physical values of the column's part of a row; null integers become `null`.
    pub(super) fn decode(&self, cells: &[u8], null: f64, out: &mut Vec<f64>) {
        let is_unscaled = self.scale == 1.0 && self.zero == 0.0;
        let scaled = |value: f64| if is_unscaled { value } else { self.zero + self.scale * value };
        let integer = |value: i64| if self.null == Some(value) { null } else { scaled(value as f64) };
        match self.cell {
            CellType::U8 => out.extend(cells.iter().map(|&c| integer(i64::from(c)))),
            CellType::I16 => out.extend(words(cells).map(|c| integer(i64::from(i16::from_be_bytes(c))))),
            CellType::I32 => out.extend(words(cells).map(|c| integer(i64::from(i32::from_be_bytes(c))))),
            CellType::I64 => out.extend(words(cells).map(|c| integer(i64::from_be_bytes(c)))),
            CellType::F32 => out.extend(words(cells).map(|c| scaled(f64::from(f32::from_be_bytes(c))))),
            CellType::F64 => out.extend(words(cells).map(|c| scaled(f64::from_be_bytes(c)))),
            CellType::Other => {}
        }
    }

    pub(super) fn decode_integers(&self, cells: &[u8], out: &mut Vec<i64>) {
        let zero = self.zero as i64;
        match self.cell {
            CellType::U8 => out.extend(cells.iter().map(|&c| i64::from(c).saturating_add(zero))),
            CellType::I16 => {
                out.extend(words(cells).map(|c| i64::from(i16::from_be_bytes(c)).saturating_add(zero)));
            }
            CellType::I32 => {
                out.extend(words(cells).map(|c| i64::from(i32::from_be_bytes(c)).saturating_add(zero)));
            }
            CellType::I64 => {
                out.extend(words(cells).map(|c| i64::from_be_bytes(c).saturating_add(zero)));
            }
            CellType::F32 | CellType::F64 | CellType::Other => {}
        }
    }

    pub(super) fn is_integer(&self) -> bool {
        matches!(self.cell, CellType::U8 | CellType::I16 | CellType::I32 | CellType::I64)
    }
}

fn words<const N: usize>(bytes: &[u8]) -> impl Iterator<Item = [u8; N]> {
    bytes.as_chunks::<N>().0.iter().copied()
}
