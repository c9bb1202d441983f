//! Pages of equal panels below a title.

use super::canvas::{Canvas, INK, Rect};
use super::error::PictureError;
use super::png_file::Picture;
use super::text::{Align, Style};

/// A page of panels in columns.
pub(super) struct Page<'a> {
    /// What a panel is called in errors.
    pub(super) what: &'static str,
    /// Title of the page; none if empty.
    pub(super) title: &'a str,
    /// Size of the title's letters.
    pub(super) title_size: f64,
    pub(super) columns: usize,
    /// Width and height of a panel, pixels.
    pub(super) panel_px: (usize, usize),
}

impl Page<'_> {
    /// Draws a panel for each item into its area. A page without a title is named like its first item.
    ///
    /// # Errors
    /// [`PictureError::Size`] without items, or with too many for a page.
    pub(super) fn draw<T>(
        &self,
        items: &[T],
        name: impl Fn(&T) -> &str,
        draw: impl Fn(&mut Canvas, Rect, &T),
    ) -> Result<Picture, PictureError> {
        let &Self { what, title, title_size, panel_px, .. } = self;
        let (first, value) = (items.first(), items.len());
        let Some(first) = first.filter(|_| value <= 64) else {
            return Err(PictureError::Size { what, value, expected: "1 to 64" });
        };
        let columns = self.columns.clamp(1, items.len());
        let head = if title.is_empty() { 0 } else { 62 };
        let (width, height) = (panel_px.0 * columns, head + panel_px.1 * items.len().div_ceil(columns));
        Picture::check_size(width, height)?;
        let mut canvas = Canvas::new(width, height);
        if !title.is_empty() {
            let style = Style::new(title_size, INK).medium();
            canvas.text(title, (0.5 * width as f64, 38.0), Align::Middle, style);
        }
        for (number, item) in items.iter().enumerate() {
            let area = Rect {
                x: (number % columns * panel_px.0) as f64,
                y: (head + number / columns * panel_px.1) as f64,
                width: panel_px.0 as f64,
                height: panel_px.1 as f64,
            };
            draw(&mut canvas, area, item);
        }
        let title = if title.is_empty() { name(first) } else { title };
        Ok(Picture::from_canvas(canvas, width, height, title))
    }
}
