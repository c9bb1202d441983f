//! Tiles, which are pictures of values in colours without any decoration.

use super::error::PictureError;
use super::scale::{ColourScale, is_seen};

/// Encodes values as a PNG of `width` columns, row by row from the top, in the colours of a scale. Pixels without a value are
/// transparent.
///
/// # Errors
/// [`PictureError::Size`] if the last row is incomplete; [`PictureError::EncodeTile`].
pub fn tile_png(scale: &ColourScale, width: usize, values: &[f32]) -> Result<Vec<u8>, PictureError> {
    if width == 0 || !values.len().is_multiple_of(width) {
        return Err(PictureError::Size { what: "tile width", value: width, expected: "whole rows" });
    }
    let colour = |value: f32| {
        let [r, g, b] = scale.colour(value.into());
        if is_seen(value.into()) { [r, g, b, 255] } else { [0; 4] }
    };
    let pixels: Vec<u8> = values.iter().flat_map(|&value| colour(value)).collect();
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width as u32, (values.len() / width) as u32);
    encoder.set_color(png::ColorType::Rgba);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let written = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(&pixels)?;
        writer.finish()
    });
    written.map_err(|source| PictureError::EncodeTile { source })?;
    Ok(bytes)
}
