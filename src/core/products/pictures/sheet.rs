//! Draws pages with one or more maps.

use super::canvas::{Canvas, FAINT, INK, Rect, Stroke};
use super::error::PictureError;
use super::mollweide;
use super::mollweide::{MapField, View};
use super::png_file::Picture;
use super::scale::{ColourScale, is_seen};
use super::text::{Align, Style};
use crate::sky::healpix::nside_of;

/// One map of a page.
#[derive(Clone, Debug)]
pub struct MapPanel<'a> {
    /// `12 nside^2` values in RING order. NaN and UNSEEN are drawn in grey, values <= 0 on a logarithmic scale in blue.
    pub values: &'a [f64],
    /// Line above the map.
    pub caption: String,
    /// Colour scale.
    pub scale: ColourScale,
    /// Unit of the values, printed at the colour bar.
    pub unit: String,
}

/// Placement of colour bars.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Bars {
    /// One per map.
    #[default]
    Each,
    /// One for the page, with the scale of the first map, which all maps should share.
    Shared,
}

/// Layout of a page.
#[derive(Clone, Debug, PartialEq)]
pub struct Sheet {
    /// Title of the page; none if empty.
    pub title: String,
    /// Subtitle; none if empty.
    pub subtitle: String,
    /// Maps per row.
    pub columns: usize,
    /// Width of the page, pixels.
    pub width_px: usize,
    /// Placement of colour bars.
    pub bars: Bars,
    /// View of the maps.
    pub view: View,
}

impl Default for Sheet {
    fn default() -> Self {
        Self {
            title: String::new(),
            subtitle: String::new(),
            columns: 1,
            width_px: 1200,
            bars: Bars::Each,
            view: View::default(),
        }
    }
}

/// Draws one map with its colour bar. The caption of the panel is the title.
///
/// # Errors
/// Errors of [`draw_sheet`].
pub fn draw_map(panel: &MapPanel<'_>, subtitle: &str, view: &View) -> Result<Picture, PictureError> {
    let sheet = Sheet {
        title: panel.caption.clone(),
        subtitle: subtitle.to_owned(),
        view: view.clone(),
        ..Sheet::default()
    };
    let panel = MapPanel { caption: String::new(), ..panel.clone() };
    draw_sheet(std::slice::from_ref(&panel), &sheet)
}

/// Draws maps in rows, with captions and colour bars.
///
/// # Errors
/// [`PictureError::PixelCount`] for values that are not a map, [`PictureError::Size`] for a page without
/// panels or of an invalid size.
pub fn draw_sheet(panels: &[MapPanel<'_>], sheet: &Sheet) -> Result<Picture, PictureError> {
    let fields = panels
        .iter()
        .enumerate()
        .map(|(panel, p)| {
            let nside =
                nside_of(p.values.len()).ok_or(PictureError::PixelCount { panel, pixels: p.values.len() })?;
            Ok(MapField { values: p.values, nside })
        })
        .collect::<Result<Vec<_>, PictureError>>()?;
    if panels.is_empty() || panels.len() > 256 {
        let value = panels.len();
        return Err(PictureError::Size { what: "number of maps", value, expected: "1 to 256" });
    }
    Picture::check_size(sheet.width_px, sheet.width_px)?;
    let layout = Layout::new(panels, sheet);
    Picture::check_size(sheet.width_px, layout.height)?;

    let mut canvas = Canvas::new(sheet.width_px, layout.height);
    layout.write_head(&mut canvas, sheet);
    for (number, (panel, field)) in panels.iter().zip(fields).enumerate() {
        let area = layout.panel(number);
        if !panel.caption.is_empty() {
            let anchor = (area.middle_x(), area.y + 0.5 * layout.caption);
            let style = Style::new(layout.font, INK).medium();
            canvas.text(&panel.caption, anchor, Align::Middle, style);
        }
        let map = Rect { y: area.y + layout.caption, height: layout.map_height, ..area };
        mollweide::draw(&mut canvas, map, field, &panel.scale, &sheet.view);
        if sheet.bars == Bars::Each {
            let y = map.bottom() + layout.gap;
            let bar = Rect { x: map.x + 0.15 * map.width, y, width: 0.7 * map.width, height: layout.bar };
            draw_bar(&mut canvas, bar, (&panel.scale, &panel.unit), layout.font);
        }
    }
    if sheet.bars == Bars::Shared {
        let width = (0.6 * sheet.width_px as f64).min(900.0);
        let bar = Rect {
            x: 0.5 * (sheet.width_px as f64 - width),
            y: layout.panels_bottom() + layout.gap,
            width,
            height: layout.bar,
        };
        draw_bar(&mut canvas, bar, (&panels[0].scale, &panels[0].unit), layout.font);
    }
    let footnote = footnote(panels);
    if !footnote.is_empty() {
        let size = 0.85 * layout.font;
        let anchor = (1.2 * size, layout.height as f64 - 1.2 * size);
        canvas.text(&footnote, anchor, Align::Start, Style::new(size, FAINT));
    }
    if !sheet.view.frame.is_empty() {
        let size = 0.85 * layout.font;
        let anchor = (sheet.width_px as f64 - 1.2 * size, layout.height as f64 - 1.2 * size);
        canvas.text(&sheet.view.frame, anchor, Align::End, Style::new(size, FAINT));
    }
    Ok(Picture::from_canvas(canvas, sheet.width_px, layout.height, &sheet.title))
}

/// Explains colours that are not in the colour bars; empty if there are none.
fn footnote(panels: &[MapPanel<'_>]) -> String {
    let negative = panels.iter().any(|p| p.values.iter().any(|&value| p.scale.is_off_scale(value)));
    let unseen = panels.iter().any(|p| p.values.iter().any(|&value| !is_seen(value)));
    let notes = [(negative, "blue: negative"), (unseen, "grey: not measured")];
    notes.into_iter().filter(|(is_shown, _)| *is_shown).map(|(_, note)| note).collect::<Vec<_>>().join("; ")
}

struct Layout {
    height: usize,
    columns: usize,
    rows: usize,
    margin: f64,
    gap: f64,
    font: f64,
    title: f64,
    head: f64,
    caption: f64,
    map_width: f64,
    map_height: f64,
    bar: f64,
    panel_height: f64,
}

impl Layout {
    fn new(panels: &[MapPanel<'_>], sheet: &Sheet) -> Self {
        let columns = sheet.columns.clamp(1, panels.len());
        let rows = panels.len().div_ceil(columns);
        let width = sheet.width_px as f64;
        let margin = if columns == 1 { 0.055 * width } else { 0.02 * width };
        let gutter = 0.018 * width;
        let map_width = (width - 2.0 * margin - gutter * (columns - 1) as f64) / columns as f64;
        let map_height = 0.5 * map_width;
        let title = (width / 42.0).clamp(14.0, 34.0);
        let font = (map_width / 28.0).clamp(12.0, 22.0).min(0.85 * title);
        let head = if sheet.title.is_empty() { 0.0 } else { 1.7 * title }
            + if sheet.subtitle.is_empty() { 0.0 } else { 1.1 * title }
            + 0.7 * title;
        let caption = if panels.iter().all(|p| p.caption.is_empty()) { 0.0 } else { 2.0 * font };
        let (bar, gap) = (1.0 * font, 1.0 * font);
        let bar_block = gap + bar + 2.1 * font;
        let panel_bar = if sheet.bars == Bars::Each { bar_block } else { 0.0 };
        let panel_height = caption + map_height + panel_bar + if rows > 1 { 0.8 * font } else { 0.0 };
        let shared_bar = if sheet.bars == Bars::Shared { bar_block } else { 0.0 };
        let height = (head + rows as f64 * panel_height + shared_bar + 1.5 * font).ceil() as usize;
        Self {
            height,
            columns,
            rows,
            margin,
            gap,
            font,
            title,
            head,
            caption,
            map_width,
            map_height,
            bar,
            panel_height,
        }
    }

    fn panel(&self, number: usize) -> Rect {
        let (row, column) = (number / self.columns, number % self.columns);
        let pitch = self.map_width + self.gutter();
        Rect {
            x: self.margin + column as f64 * pitch,
            y: self.head + row as f64 * self.panel_height,
            width: self.map_width,
            height: self.panel_height,
        }
    }

    fn gutter(&self) -> f64 {
        // Margins are 0.02 and gutters 0.018 of the width.
        if self.columns == 1 { 0.0 } else { 0.9 * self.margin }
    }

    fn panels_bottom(&self) -> f64 {
        self.head + self.rows as f64 * self.panel_height
    }

    fn write_head(&self, canvas: &mut Canvas, sheet: &Sheet) {
        let middle = 0.5 * sheet.width_px as f64;
        let mut y = 1.4 * self.title;
        if !sheet.title.is_empty() {
            let style = Style::new(self.title, INK).medium();
            canvas.text(&sheet.title, (middle, y), Align::Middle, style);
            y += 1.2 * self.title;
        }
        if !sheet.subtitle.is_empty() {
            let style = Style::new(0.66 * self.title, FAINT);
            canvas.text(&sheet.subtitle, (middle, y), Align::Middle, style);
        }
    }
}

/// Draws a horizontal colour bar with ticks below and the unit at its right end.
pub(super) fn draw_bar(canvas: &mut Canvas, bar: Rect, (scale, unit): (&ColourScale, &str), font: f64) {
    let (first, last) = (bar.x.floor() as usize, bar.right().ceil() as usize);
    for x in first..last {
        let colour = scale.colour_at((x as f64 + 0.5 - bar.x) / bar.width);
        let column = Rect { x: x as f64, width: 1.0, ..bar };
        canvas.fill(column, colour, 1.0);
    }
    canvas.outline(bar, Stroke::solid(INK, 1.0, 1.0));
    let wanted = ((bar.width / (3.0 * font)) as usize).clamp(3, 10);
    let ticks = scale.ticks(wanted);
    let x_of = |value: f64| bar.x + scale.position(value).clamp(0.0, 1.0) * bar.width;
    let thin = Stroke::solid(INK, 1.0, 1.0);
    for value in &ticks.minor {
        let x = x_of(*value);
        canvas.polyline(&[(x, bar.bottom()), (x, bar.bottom() + 0.2 * font)], thin);
    }
    for (value, label) in &ticks.labelled {
        let x = x_of(*value);
        canvas.polyline(&[(x, bar.bottom()), (x, bar.bottom() + 0.4 * font)], thin);
        let anchor = (x, bar.bottom() + 1.1 * font);
        canvas.text(label, anchor, Align::Middle, Style::new(font, INK));
    }
    let anchor = (bar.right() + 0.7 * font, bar.middle_y());
    canvas.text(&ticks.unit(unit), anchor, Align::Start, Style::new(font, INK));
}
