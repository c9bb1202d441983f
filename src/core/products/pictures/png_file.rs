//! Finished pictures, which are written as PNG or SVG files.

use std::path::Path;

use super::canvas::{Canvas, Shape};
use super::error::PictureError;
use super::svg::svg_of;
use crate::files::write_atomically;

const SIDE_MAX: usize = 16_384;
const PIXELS_MAX: usize = 1 << 27;

/// A finished picture.
#[derive(Clone, Debug)]
pub struct Picture {
    width: usize,
    height: usize,
    rgb: Vec<u8>,
    /// The pixels without the shapes.
    background: Vec<u8>,
    shapes: Vec<Shape>,
    /// Keywords and texts of the PNG text chunks.
    texts: Vec<(String, String)>,
}

impl Picture {
    pub(super) fn from_canvas(mut canvas: Canvas, width: usize, height: usize, title: &str) -> Self {
        let software = concat!("lunarray ", env!("CARGO_PKG_VERSION")).to_owned();
        let texts = vec![("Software".to_owned(), software), ("Title".to_owned(), title.to_owned())];
        let background = canvas.rgb();
        let shapes = canvas.flatten();
        Self { width, height, rgb: canvas.rgb(), background, shapes, texts }
    }

    pub(super) fn check_size(width: usize, height: usize) -> Result<(), PictureError> {
        for (what, value) in [("picture width", width), ("picture height", height)] {
            if !(16..=SIDE_MAX).contains(&value) {
                return Err(PictureError::Size { what, value, expected: "16 to 16384 pixels" });
            }
        }
        if width * height > PIXELS_MAX {
            let value = width * height;
            return Err(PictureError::Size {
                what: "number of pixels",
                value,
                expected: "at most 134217728",
            });
        }
        Ok(())
    }

    /// Width, pixels.
    #[must_use]
    #[doc(hidden)]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height, pixels.
    #[must_use]
    #[doc(hidden)]
    pub fn height(&self) -> usize {
        self.height
    }

    /// The pixels, three bytes each, row by row from the top.
    #[must_use]
    #[doc(hidden)]
    pub fn rgb(&self) -> &[u8] {
        &self.rgb
    }

    /// The picture as a PNG file in memory.
    ///
    /// # Errors
    /// Errors of the encoder.
    pub fn to_png(&self) -> Result<Vec<u8>, png::EncodingError> {
        self.encoded(&self.rgb)
    }

    fn encoded(&self, rgb: &[u8]) -> Result<Vec<u8>, png::EncodingError> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        // Pictures of snapshots are written while maps are solved: speed counts more than size.
        encoder.set_compression(png::Compression::Fast);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        for (keyword, text) in &self.texts {
            encoder.add_itxt_chunk(keyword.clone(), text.clone())?;
        }
        let mut writer = encoder.write_header()?;
        writer.write_image_data(rgb)?;
        writer.finish()?;
        Ok(bytes)
    }

    /// The picture as an SVG file in memory, with shapes as vector graphics, and values in colour as an embedded image.
    ///
    /// # Errors
    /// Errors of the encoder of the image.
    pub fn to_svg(&self) -> Result<String, png::EncodingError> {
        let is_blank = self.background.iter().all(|&value| value == 255);
        let image = if is_blank { None } else { Some(self.encoded(&self.background)?) };
        let title = self.texts.iter().find(|(keyword, _)| keyword == "Title").map_or("", |(_, title)| title);
        Ok(svg_of(self.width, self.height, title, image.as_deref(), &self.shapes))
    }

    /// Writes the picture atomically, as SVG if the path has that extension, otherwise as PNG.
    ///
    /// # Errors
    /// [`PictureError::Write`] or [`PictureError::Encode`].
    pub fn write(&self, path: &Path) -> Result<(), PictureError> {
        let is_svg = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("svg"));
        let bytes = if is_svg { self.to_svg().map(String::into_bytes) } else { self.to_png() };
        let bytes = bytes.map_err(|source| PictureError::Encode { path: path.to_path_buf(), source })?;
        write_atomically(path, &bytes)
            .map_err(|source| PictureError::Write { path: path.to_path_buf(), source })
    }
}
