//! Draws sky maps in Mollweide projection, curves, and values over two axes, as PNG and SVG files.
//!
//! Drawing is antialiased, with an embedded font. It does not depend on the fonts or libraries of the machine, so equal
//! data give equal bytes. Uses [`crate::sky`] and [`crate::files`].

mod canvas;
mod colour;
mod curves;
mod error;
mod labels;
mod mollweide;
mod page;
mod patch;
mod png_file;
mod projection;
mod raster;
mod scale;
mod sheet;
mod svg;
mod text;
mod tile;

pub use curves::{Axis, Curve, Plot, draw_plots};
pub use error::PictureError;
#[doc(hidden)]
pub use mollweide::Sampling;
pub use mollweide::View;
#[doc(hidden)]
pub use patch::{BeamMark, Patch, draw_patches};
pub use png_file::Picture;
#[doc(hidden)]
pub use raster::{Raster, draw_rasters};
pub use scale::{ColourScale, Palette, Scaling};
#[doc(hidden)]
pub use sheet::{Bars, Sheet, draw_sheet};
pub use sheet::{MapPanel, draw_map};
#[doc(hidden)]
pub use tile::tile_png;

#[cfg(test)]
mod tests;
