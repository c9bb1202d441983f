//! Line plots.

use super::canvas::{Canvas, Colour, FAINT, INK, Rect, Stroke, WHITE};
use super::error::PictureError;
use super::labels::Ticks;
use super::png_file::Picture;
use super::text::{Align, Style};
use super::{labels, text};

/// Colours that colour-blind readers can tell apart (Okabe & Ito 2008).
const COLOURS: [Colour; 7] = [
    [0, 114, 178],
    [213, 94, 0],
    [0, 158, 115],
    [204, 121, 167],
    [230, 159, 0],
    [86, 180, 233],
    [80, 80, 86],
];

/// A curve.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Curve {
    /// Name in the legend; none if empty.
    pub label: String,
    /// Points; one that is not finite, or not positive on a logarithmic axis, interrupts the curve.
    pub points: Vec<(f64, f64)>,
    /// Whether dashes are drawn.
    pub dashed: bool,
}

/// An axis of a plot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Axis {
    /// What is shown, with its unit; `_{...}` makes a subscript, here as in every text of a picture.
    pub label: String,
    /// Whether the axis is logarithmic.
    pub log: bool,
    /// Ends of the axis; chosen from the data if not given or not usable.
    pub limits: Option<(f64, f64)>,
}

/// A plot of several curves.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plot {
    /// Line above the plot; none if empty.
    pub title: String,
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// Curves, drawn in order.
    pub curves: Vec<Curve>,
    /// Vertical values marked with a thin horizontal line.
    pub levels: Vec<f64>,
}

/// Width and height of one plot, pixels.
const PLOT_PX: (usize, usize) = (900, 520);
/// Size of text, pixels.
pub(super) const FONT: f64 = 19.0;

/// Draws plots on one page in `columns` columns, below a title (none if empty).
///
/// # Errors
/// [`PictureError::Size`] without plots, or with too many for a page.
pub fn draw_plots(title: &str, plots: &[Plot], columns: usize) -> Result<Picture, PictureError> {
    if plots.is_empty() || plots.len() > 64 {
        let value = plots.len();
        return Err(PictureError::Size { what: "number of plots", value, expected: "1 to 64" });
    }
    let columns = columns.clamp(1, plots.len());
    let head = if title.is_empty() { 0 } else { 62 };
    let (width, height) = (PLOT_PX.0 * columns, head + PLOT_PX.1 * plots.len().div_ceil(columns));
    Picture::check_size(width, height)?;
    let mut canvas = Canvas::new(width, height);
    if !title.is_empty() {
        let style = Style::new(1.45 * FONT, INK).medium();
        text::draw(&mut canvas, title, (0.5 * width as f64, 38.0), Align::Middle, style);
    }
    for (number, plot) in plots.iter().enumerate() {
        let share = Rect {
            x: (number % columns * PLOT_PX.0) as f64,
            y: (head + number / columns * PLOT_PX.1) as f64,
            width: PLOT_PX.0 as f64,
            height: PLOT_PX.1 as f64,
        };
        draw_plot(&mut canvas, share, plot);
    }
    let title = if title.is_empty() { plots[0].title.as_str() } else { title };
    Ok(Picture::from_canvas(canvas, width, height, title))
}

/// An axis with fixed limits.
pub(super) struct Range {
    pub low: f64,
    pub high: f64,
    log: bool,
}

impl Range {
    pub fn new(axis: &Axis, values: impl Iterator<Item = f64>, room: f64) -> Self {
        let usable = |v: &f64| v.is_finite() && v.abs() < 1e300 && (!axis.log || *v > 1e-300);
        if let Some((low, high)) = axis.limits
            && usable(&low)
            && usable(&high)
            && low < high
        {
            return Self { low, high, log: axis.log };
        }
        let (low, high) =
            values.filter(usable).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        if low > high {
            return Self { low: if axis.log { 0.1 } else { 0.0 }, high: 1.0, log: axis.log };
        }
        if axis.log {
            let factor = (high / low).powf(room).max(if room > 0.0 || high <= low { 1.1 } else { 1.0 });
            return Self { low: low / factor, high: high * factor, log: true };
        }
        let span = if high > low { high - low } else { low.abs().max(1.0) };
        let room = if high > low { room } else { 0.1 };
        Self { low: low - room * span, high: high + room * span, log: false }
    }

    pub fn place(&self, value: f64) -> f64 {
        if self.log {
            if value > 0.0 { (value / self.low).ln() / (self.high / self.low).ln() } else { f64::NAN }
        } else {
            (value - self.low) / (self.high - self.low)
        }
    }

    pub fn ticks(&self, wanted: usize) -> Ticks {
        if self.log {
            labels::logarithmic(self.low, self.high, wanted)
        } else {
            labels::linear(self.low, self.high, wanted)
        }
    }
}

fn draw_plot(canvas: &mut Canvas, share: Rect, plot: &Plot) {
    let points = || plot.curves.iter().flat_map(|curve| curve.points.iter().copied());
    let x_range = Range::new(&plot.x, points().map(|p| p.0), 0.0);
    let y_range = Range::new(&plot.y, points().map(|p| p.1).chain(plot.levels.iter().copied()), 0.06);
    let (x_ticks, y_ticks) = (x_range.ticks(8), y_range.ticks(6));
    let widest = y_ticks
        .labelled
        .iter()
        .map(|(_, label)| text::length(label, Style::new(FONT, INK)))
        .fold(0.0, f64::max);
    let top = if plot.title.is_empty() { 24.0 } else { 52.0 };
    let left = 3.4 * FONT + widest;
    let frame = Rect {
        x: share.x + left,
        y: share.y + top,
        width: share.width - left - 36.0,
        height: share.height - top - 78.0,
    };
    let to_page = |x: f64, y: f64| {
        (frame.x + x_range.place(x) * frame.width, frame.bottom() - y_range.place(y) * frame.height)
    };

    grid(canvas, frame, &x_ticks, &y_ticks, &to_page);
    canvas.set_clip(Some(frame));
    for &level in &plot.levels {
        let y = to_page(x_range.low, level).1;
        canvas.polyline(
            &[(frame.x, y), (frame.right(), y)],
            Stroke { dash: Some((3.0, 4.0)), ..Stroke::solid(INK, 0.7, 1.2) },
        );
    }
    let drawn: Vec<Vec<(f64, f64)>> =
        plot.curves.iter().map(|curve| curve.points.iter().map(|&(x, y)| to_page(x, y)).collect()).collect();
    for (number, (curve, line)) in plot.curves.iter().zip(&drawn).enumerate() {
        canvas.polyline(line, stroke_of(number, curve));
    }
    canvas.set_clip(None);
    canvas.outline(frame, Stroke::solid(INK, 1.0, 1.2));
    write_axes(canvas, frame, plot, &x_ticks, &y_ticks, &to_page);
    legend(canvas, frame, plot, &drawn);
}

fn stroke_of(number: usize, curve: &Curve) -> Stroke {
    let dash = curve.dashed.then_some((9.0, 6.0));
    Stroke { dash, ..Stroke::solid(COLOURS[number % COLOURS.len()], 1.0, 2.4) }
}

fn grid(
    canvas: &mut Canvas,
    frame: Rect,
    x_ticks: &Ticks,
    y_ticks: &Ticks,
    to_page: &impl Fn(f64, f64) -> (f64, f64),
) {
    let faint = Stroke::solid(FAINT, 0.25, 1.0);
    for (value, _) in &x_ticks.labelled {
        let x = to_page(*value, 1.0).0;
        canvas.polyline(&[(x, frame.y), (x, frame.bottom())], faint);
    }
    for (value, _) in &y_ticks.labelled {
        let y = to_page(1.0, *value).1;
        canvas.polyline(&[(frame.x, y), (frame.right(), y)], faint);
    }
}

pub(super) fn write_axes(
    canvas: &mut Canvas,
    frame: Rect,
    plot: &Plot,
    x_ticks: &Ticks,
    y_ticks: &Ticks,
    to_page: &impl Fn(f64, f64) -> (f64, f64),
) {
    let thin = Stroke::solid(INK, 1.0, 1.2);
    let style = Style::new(FONT, INK);
    for (value, label) in &x_ticks.labelled {
        let x = to_page(*value, 1.0).0;
        canvas.polyline(&[(x, frame.bottom()), (x, frame.bottom() - 7.0)], thin);
        text::draw(canvas, label, (x, frame.bottom() + 0.95 * FONT), Align::Middle, style);
    }
    for value in &x_ticks.minor {
        let x = to_page(*value, 1.0).0;
        canvas.polyline(&[(x, frame.bottom()), (x, frame.bottom() - 4.0)], thin);
    }
    for (value, label) in &y_ticks.labelled {
        let y = to_page(1.0, *value).1;
        canvas.polyline(&[(frame.x, y), (frame.x + 7.0, y)], thin);
        text::draw(canvas, label, (frame.x - 0.5 * FONT, y), Align::End, style);
    }
    for value in &y_ticks.minor {
        let y = to_page(1.0, *value).1;
        canvas.polyline(&[(frame.x, y), (frame.x + 4.0, y)], thin);
    }
    let named = |label: &str, ticks: &Ticks| match ticks.exponent {
        0 => label.to_owned(),
        exponent => format!("{label}  [{}]", labels::power_of_ten(exponent)),
    };
    let below = (frame.middle_x(), frame.bottom() + 2.6 * FONT);
    text::draw(canvas, &named(&plot.x.label, x_ticks), below, Align::Middle, Style::new(1.05 * FONT, INK));
    let widest = y_ticks.labelled.iter().map(|(_, label)| text::length(label, style)).fold(0.0, f64::max);
    let beside = (frame.x - widest - 1.7 * FONT, frame.middle_y());
    let upwards = Style::new(1.05 * FONT, INK).upwards();
    text::draw(canvas, &named(&plot.y.label, y_ticks), beside, Align::Middle, upwards);
    if !plot.title.is_empty() {
        let above = (frame.middle_x(), frame.y - 0.95 * FONT);
        text::draw(canvas, &plot.title, above, Align::Middle, Style::new(1.1 * FONT, INK).medium());
    }
}

/// Draws the legend in the corner that hides least of the curves.
fn legend(canvas: &mut Canvas, frame: Rect, plot: &Plot, drawn: &[Vec<(f64, f64)>]) {
    let style = Style::new(0.92 * FONT, INK);
    let named: Vec<(usize, &Curve)> =
        plot.curves.iter().enumerate().filter(|(_, curve)| !curve.label.is_empty()).collect();
    if named.is_empty() {
        return;
    }
    let (sample, row) = (2.2 * FONT, 1.35 * FONT);
    let widest = named.iter().map(|(_, curve)| text::length(&curve.label, style)).fold(0.0, f64::max);
    let (width, height) = (widest + sample + 1.5 * FONT, row * named.len() as f64 + 0.6 * FONT);
    let inset = 0.7 * FONT;
    let corner = |right: bool, low: bool| Rect {
        x: if right { frame.right() - width - inset } else { frame.x + inset },
        y: if low { frame.bottom() - height - inset } else { frame.y + inset },
        width,
        height,
    };
    let hidden = |place: &Rect| {
        let inside = |p: &&(f64, f64)| {
            (place.x..place.right()).contains(&p.0) && (place.y..place.bottom()).contains(&p.1)
        };
        drawn.iter().flatten().filter(inside).count()
    };
    let corners = [corner(true, false), corner(true, true), corner(false, false), corner(false, true)];
    let place = corners.into_iter().min_by_key(hidden).unwrap_or(corners[0]);
    canvas.fill(place, WHITE, 0.85);
    canvas.outline(place, Stroke::solid(FAINT, 0.5, 1.0));
    for (line, (number, curve)) in named.into_iter().enumerate() {
        let y = place.y + 0.3 * FONT + row * (line as f64 + 0.5);
        let x = place.x + 0.5 * FONT;
        canvas.polyline(&[(x, y), (x + sample, y)], stroke_of(number, curve));
        text::draw(canvas, &curve.label, (x + sample + 0.5 * FONT, y), Align::Start, style);
    }
}
