//! Two-dimensional images in the primary part of a file.

use std::path::Path;

use super::card::Card;
use super::error::{FitsError, FitsProblem};
use super::header::BLOCK_BYTES;
use super::write::append_header;

/// Creates in memory a file with an image of `width` columns in single precision. `rows` are from top to bottom, and FITS stores
/// them from bottom to top; NaN means no value.
///
/// # Errors
/// [`FitsError`] for cards that FITS cannot represent, and values that do not fill whole rows.
pub fn image_bytes(width: usize, rows: &[f32], cards: &[Card]) -> Result<Vec<u8>, FitsError> {
    let write = || {
        if width == 0 || !rows.len().is_multiple_of(width) {
            let (found, expected) = (rows.len() as u64, width as u64);
            return Err(FitsProblem::ImageSize { found, expected });
        }
        let structure = [
            Card::logical("SIMPLE", true, "conforms to FITS standard"),
            Card::integer("BITPIX", -32, "array data type"),
            Card::integer("NAXIS", 2, "number of array dimensions"),
            Card::integer("NAXIS1", width as i64, "length of dimension 1"),
            Card::integer("NAXIS2", (rows.len() / width) as i64, "length of dimension 2"),
        ];
        let mut bytes = Vec::with_capacity(4 * rows.len() + 2 * BLOCK_BYTES);
        append_header(&mut bytes, &structure, cards)?;
        for row in rows.chunks_exact(width).rev() {
            bytes.extend(row.iter().flat_map(|value| value.to_be_bytes()));
        }
        bytes.resize(bytes.len().next_multiple_of(BLOCK_BYTES), 0);
        Ok(bytes)
    };
    write().map_err(|problem| FitsError::new(Path::new("memory"), problem))
}
