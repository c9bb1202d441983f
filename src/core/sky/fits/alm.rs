//! Writing of harmonic coefficients in the format of healpy's `write_alm`.

use std::io::Write;
use std::path::Path;

use super::card::Card;
use super::error::{FitsError, FitsProblem};
use super::header::BLOCK_BYTES;
use super::write::{binary_table_cards, table_header, write_whole};
use crate::sky::harmonics::Alm;

/// Length of a row, bytes: an index of 32 bits and two doubles.
const ROW_BYTES: usize = 20;

/// Writes coefficients as a table INDEX = l^2 + l + m + 1, REAL, IMAG, which healpy's `read_alm` reads; replaces any file at `path`.
///
/// # Errors
/// [`FitsError`]: cards that FITS cannot represent, or an error of the operating system.
pub fn write_alm(path: &Path, alm: &Alm, cards: &[Card]) -> Result<(), FitsError> {
    let write = || {
        let header = table_header(&structure(alm), cards)?;
        write_whole(path, |out| {
            out.write_all(&header).map_err(FitsProblem::io("write"))?;
            out.write_all(&rows(alm)).map_err(FitsProblem::io("write"))
        })
    };
    write().map_err(|problem| FitsError::new(path, problem))
}

fn structure(alm: &Alm) -> Vec<Card> {
    let fields = [("INDEX", "J", ""), ("REAL", "D", "K"), ("IMAG", "D", "K")];
    let mut cards = binary_table_cards(ROW_BYTES, alm.values().len(), &fields);
    let l_max = alm.l_max() as i64;
    cards.push(Card::text("EXTNAME", "ALM", "harmonic coefficients of a real field, m >= 0"));
    cards.push(Card::integer("MAX-LPOL", l_max, "greatest degree l"));
    cards.push(Card::integer("MAX-MPOL", l_max, "greatest order m"));
    cards
}

/// The rows by degree, then order, so that the index increases; padded to whole blocks.
fn rows(alm: &Alm) -> Vec<u8> {
    let mut rows = Vec::with_capacity(ROW_BYTES * alm.values().len() + BLOCK_BYTES);
    for l in 0..=alm.l_max() {
        for m in 0..=l {
            let value = alm.get(l, m);
            // Degrees are bounded by those of a map: some thousands.
            rows.extend_from_slice(&((l * l + l + m + 1) as i32).to_be_bytes());
            rows.extend_from_slice(&value.re.to_be_bytes());
            rows.extend_from_slice(&value.im.to_be_bytes());
        }
    }
    rows.resize(rows.len().next_multiple_of(BLOCK_BYTES), 0);
    rows
}
