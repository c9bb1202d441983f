//! Draws values over two axes in colour.

use super::canvas::{Canvas, INK, Rect, Stroke};
use super::curves::{Axis, FONT, Plot, Range, write_axes};
use super::error::PictureError;
use super::page::Page;
use super::png_file::Picture;
use super::scale::ColourScale;
use super::sheet::draw_bar;
use super::text;
use super::text::Style;

/// Values in equal cells over two axes.
#[derive(Clone, Debug)]
pub struct Raster<'a> {
    /// Line above the raster; none if empty.
    pub title: String,
    /// Horizontal axis, with its limits.
    pub x: Axis,
    /// Vertical axis, with its limits.
    pub y: Axis,
    /// Values, row by row from the lowest. NaN is drawn in grey.
    pub values: &'a [f64],
    /// Number of values in a row.
    pub columns: usize,
    /// Colour scale.
    pub scale: ColourScale,
    /// Unit of the values, printed at the colour bar.
    pub unit: String,
}

/// Width and height of one raster with axes and colour bar, pixels.
const RASTER_PX: (usize, usize) = (700, 760);

/// Draws rasters on one page in `columns` columns, below a title (none if empty).
///
/// # Errors
/// [`PictureError::Size`] without rasters, with too many for a page, or with an incomplete row.
pub fn draw_rasters(title: &str, rasters: &[Raster<'_>], columns: usize) -> Result<Picture, PictureError> {
    for raster in rasters {
        let value = raster.values.len();
        if raster.columns == 0 || value == 0 || !value.is_multiple_of(raster.columns) {
            let expected = "whole rows, at least one";
            return Err(PictureError::Size { what: "number of values of a raster", value, expected });
        }
    }
    let page =
        Page { what: "number of rasters", title, title_size: 1.3 * FONT, columns, panel_px: RASTER_PX };
    page.draw(rasters, |raster| &raster.title, draw_raster)
}

fn draw_raster(canvas: &mut Canvas, area: Rect, raster: &Raster<'_>) {
    let [x_range, y_range] = [&raster.x, &raster.y].map(|axis| Range::new(axis, std::iter::empty(), 0.0));
    let (x_ticks, y_ticks) = (x_range.ticks(6), y_range.ticks(6));
    let labels = y_ticks.labelled.iter().map(|(_, label)| text::length(label, Style::new(FONT, INK)));
    let left = (3.4 * FONT + labels.fold(0.0, f64::max)).ceil();
    let top = if raster.title.is_empty() { 24.0 } else { 52.0 };
    let frame = Rect {
        x: area.x + left,
        y: area.y + top,
        width: area.width - left - 50.0,
        height: area.height - top - 160.0,
    };
    let rows = raster.values.len() / raster.columns;
    // Cells have equal sizes on the page.
    let cell = |position: f64, count: usize| ((position * count as f64) as usize).min(count - 1);
    for y in frame.y as usize..frame.bottom() as usize {
        let row = cell((frame.bottom() - y as f64 - 0.5) / frame.height, rows);
        for x in frame.x as usize..frame.right() as usize {
            let column = cell((x as f64 + 0.5 - frame.x) / frame.width, raster.columns);
            let colour = raster.scale.colour(raster.values[row * raster.columns + column]);
            canvas.blend(x, y, colour, 1.0);
        }
    }
    canvas.outline(frame, Stroke::solid(INK, 1.0, 1.2));
    let to_page = |x: f64, y: f64| {
        (frame.x + x_range.position(x) * frame.width, frame.bottom() - y_range.position(y) * frame.height)
    };
    let axes =
        Plot { title: raster.title.clone(), x: raster.x.clone(), y: raster.y.clone(), ..Plot::default() };
    write_axes(canvas, frame, &axes, &x_ticks, &y_ticks, &to_page);
    let bar = Rect {
        x: frame.x + 0.08 * frame.width,
        y: frame.bottom() + 4.2 * FONT,
        width: 0.72 * frame.width,
        height: FONT,
    };
    draw_bar(canvas, bar, (&raster.scale, &raster.unit), FONT);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::products::pictures::{Palette, Scaling};

    fn raster(values: &[f64]) -> Raster<'_> {
        let axis = |limits| Axis { limits: Some(limits), ..Axis::default() };
        Raster {
            title: "t".to_owned(),
            x: axis((0.0, 1.0)),
            y: axis((-1.0, 1.0)),
            values,
            columns: 2,
            scale: ColourScale::new(0.0, 1.0, Scaling::Linear, Palette::Inferno).unwrap(),
            unit: "h".to_owned(),
        }
    }

    #[test]
    fn the_first_row_is_the_lowest() {
        // Only the lower right cell is bright.
        let picture = draw_rasters("", &[raster(&[0.0, 1.0, 0.0, 0.0])], 1).unwrap();
        let brightness = |x: usize, y: usize| {
            let start = 3 * (y * picture.width() + x);
            picture.rgb()[start..start + 3].iter().map(|&c| u32::from(c)).sum::<u32>()
        };
        assert!(brightness(500, 450) > 500);
        for (x, y) in [(200, 450), (200, 150), (500, 150)] {
            assert!(brightness(x, y) < 50, "{x} {y}");
        }
    }

    #[test]
    fn values_that_fill_no_rows_are_refused() {
        for values in [&[][..], &[1.0; 3]] {
            assert!(matches!(draw_rasters("", &[raster(values)], 1), Err(PictureError::Size { .. })));
        }
        assert!(matches!(draw_rasters("", &[], 1), Err(PictureError::Size { .. })));
        assert!(draw_rasters("", &[raster(&[f64::NAN, f64::INFINITY])], 3).is_ok());
    }
}
