//! Draws line plots.

use super::canvas::{Canvas, Colour, FAINT, INK, Rect, Stroke, WHITE};
use super::error::PictureError;
use super::labels::Ticks;
use super::page::Page;
use super::png_file::Picture;
use super::text::{Align, Style};
use super::{labels, text};

/// Colours that colour-blind readers can distinguish (Okabe & Ito 2008, and wine from Tol 2021), one per daughter.
const COLOURS: [Colour; 8] = [
    [0, 114, 178],
    [213, 94, 0],
    [0, 158, 115],
    [204, 121, 167],
    [230, 159, 0],
    [86, 180, 233],
    [80, 80, 86],
    [136, 34, 85],
];

/// A curve of a plot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Curve {
    /// Name in the legend; none if empty.
    pub label: String,
    /// Points. One that is not finite, or not positive on a logarithmic axis, interrupts the curve.
    pub points: Vec<(f64, f64)>,
    /// Whether the curve is dashed.
    pub dashed: bool,
}

/// An axis of a plot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Axis {
    /// Quantity and unit. `_{...}` makes a subscript, as in all texts of a picture.
    pub label: String,
    /// Whether the axis is logarithmic.
    pub log: bool,
    /// Limits of the axis, chosen from the data if `None` or unusable.
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
    /// Vertical values marked by a thin horizontal line.
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
    let page = Page { what: "number of plots", title, title_size: 1.45 * FONT, columns, panel_px: PLOT_PX };
    page.draw(plots, |plot| &plot.title, draw_plot)
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Range {
    pub low: f64,
    pub high: f64,
    log: bool,
}

impl Range {
    pub fn new(axis: &Axis, values: impl Iterator<Item = f64>, margin: f64) -> Self {
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
            let factor = (high / low).powf(margin).max(if margin > 0.0 || high <= low { 1.1 } else { 1.0 });
            return Self { low: low / factor, high: high * factor, log: true };
        }
        // Less than this share is rounding of one value.
        let varies = high - low > 1e-9 * high.abs().max(low.abs());
        let span = if varies { high - low } else { low.abs().max(1.0) };
        let margin = if varies { margin } else { 0.1 };
        Self { low: low - margin * span, high: high + margin * span, log: false }
    }

    pub fn position(&self, value: f64) -> f64 {
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

fn draw_plot(canvas: &mut Canvas, area: Rect, plot: &Plot) {
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
    let whole = Rect {
        x: area.x + left,
        y: area.y + top,
        width: area.width - left - 36.0,
        height: area.height - top - 78.0,
    };
    let on_page = |frame: Rect| {
        move |x: f64, y: f64| {
            (frame.x + x_range.position(x) * frame.width, frame.bottom() - y_range.position(y) * frame.height)
        }
    };
    let drawn_in = |frame: Rect| -> Vec<Vec<(f64, f64)>> {
        let to_page = on_page(frame);
        plot.curves.iter().map(|curve| curve.points.iter().map(|&(x, y)| to_page(x, y)).collect()).collect()
    };
    let legend = Legend::new(plot);
    // The legend is inside where it hides no curve, otherwise beside the frame.
    let (frame, corner) = match legend.size() {
        None => (whole, None),
        Some(size) => match free_corner(whole, size, &drawn_in(whole)) {
            Some(corner) => (whole, Some(corner)),
            None => {
                let frame = Rect { width: whole.width - size.0 - LEGEND_INSET, ..whole };
                (frame, Some((frame.right() + LEGEND_INSET, frame.y)))
            }
        },
    };
    let (to_page, drawn) = (on_page(frame), drawn_in(frame));

    grid(canvas, frame, &x_ticks, &y_ticks, &to_page);
    canvas.set_clip(Some(frame));
    for &level in &plot.levels {
        let y = to_page(x_range.low, level).1;
        canvas.polyline(
            &[(frame.x, y), (frame.right(), y)],
            Stroke { dash: Some((3.0, 4.0)), ..Stroke::solid(INK, 0.7, 1.2) },
        );
    }
    for (number, (curve, line)) in plot.curves.iter().zip(&drawn).enumerate() {
        canvas.polyline(line, stroke_of(number, curve));
    }
    canvas.set_clip(None);
    canvas.outline(frame, Stroke::solid(INK, 1.0, 1.2));
    write_axes(canvas, frame, plot, &x_ticks, &y_ticks, &to_page);
    if let Some(corner) = corner {
        legend.draw(canvas, corner);
    }
}

/// Style of a curve. Curves beyond the number of colours are dotted, so that sixteen curves are distinct.
fn stroke_of(number: usize, curve: &Curve) -> Stroke {
    let dash = match (curve.dashed, number / COLOURS.len() % 2) {
        (true, _) => Some((9.0, 6.0)),
        (false, 1) => Some((3.0, 3.0)),
        (false, _) => None,
    };
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
        canvas.text(label, (x, frame.bottom() + 0.95 * FONT), Align::Middle, style);
    }
    for value in &x_ticks.minor {
        let x = to_page(*value, 1.0).0;
        canvas.polyline(&[(x, frame.bottom()), (x, frame.bottom() - 4.0)], thin);
    }
    for (value, label) in &y_ticks.labelled {
        let y = to_page(1.0, *value).1;
        canvas.polyline(&[(frame.x, y), (frame.x + 7.0, y)], thin);
        canvas.text(label, (frame.x - 0.5 * FONT, y), Align::End, style);
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
    canvas.text(&named(&plot.x.label, x_ticks), below, Align::Middle, Style::new(1.05 * FONT, INK));
    let widest = y_ticks.labelled.iter().map(|(_, label)| text::length(label, style)).fold(0.0, f64::max);
    let beside = (frame.x - widest - 1.7 * FONT, frame.middle_y());
    let upwards = Style::new(1.05 * FONT, INK).upwards();
    canvas.text(&named(&plot.y.label, y_ticks), beside, Align::Middle, upwards);
    if !plot.title.is_empty() {
        let above = (frame.middle_x(), frame.y - 0.95 * FONT);
        canvas.text(&plot.title, above, Align::Middle, Style::new(1.1 * FONT, INK).medium());
    }
}

/// Distance of the legend from the frame, pixels.
const LEGEND_INSET: f64 = 0.7 * FONT;
/// Height of a row of the legend, pixels.
const LEGEND_ROW: f64 = 1.35 * FONT;
/// Length of the line in a row of the legend, pixels.
const LEGEND_SAMPLE: f64 = 2.2 * FONT;

/// Number of steps between two points of a curve at which it is tested for overlap with the legend.
const OVERLAP_STEPS: usize = 16;

/// The legend, with the curves that have a name and visible points.
struct Legend<'a> {
    named: Vec<(usize, &'a Curve)>,
}

impl<'a> Legend<'a> {
    fn new(plot: &'a Plot) -> Self {
        let is_shown = |curve: &Curve| {
            let positive = |v: f64, axis: &Axis| v.is_finite() && (!axis.log || v > 0.0);
            let is_drawn = |(x, y): &(f64, f64)| positive(*x, &plot.x) && positive(*y, &plot.y);
            !curve.label.is_empty() && curve.points.iter().any(is_drawn)
        };
        Self { named: plot.curves.iter().enumerate().filter(|(_, curve)| is_shown(curve)).collect() }
    }

    fn style() -> Style {
        Style::new(0.92 * FONT, INK)
    }

    /// Width and height; `None` for an empty legend.
    fn size(&self) -> Option<(f64, f64)> {
        let length = |(_, curve): &(usize, &Curve)| text::length(&curve.label, Self::style());
        let widest = self.named.iter().map(length).fold(0.0, f64::max);
        let rows = self.named.len() as f64;
        (rows > 0.0).then_some((widest + LEGEND_SAMPLE + 1.5 * FONT, LEGEND_ROW * rows + 0.6 * FONT))
    }

    fn draw(&self, canvas: &mut Canvas, (x, y): (f64, f64)) {
        let Some((width, height)) = self.size() else { return };
        let frame = Rect { x, y, width, height };
        canvas.fill(frame, WHITE, 0.85);
        canvas.outline(frame, Stroke::solid(FAINT, 0.5, 1.0));
        for (line, (number, curve)) in self.named.iter().enumerate() {
            let y = frame.y + 0.3 * FONT + LEGEND_ROW * (line as f64 + 0.5);
            let x = frame.x + 0.5 * FONT;
            canvas.polyline(&[(x, y), (x + LEGEND_SAMPLE, y)], stroke_of(*number, curve));
            let anchor = (x + LEGEND_SAMPLE + 0.5 * FONT, y);
            canvas.text(&curve.label, anchor, Align::Start, Self::style());
        }
    }
}

/// Upper left corner of a position in a frame at which a legend of this size hides no curve.
fn free_corner(frame: Rect, (width, height): (f64, f64), drawn: &[Vec<(f64, f64)>]) -> Option<(f64, f64)> {
    let [left, right] = [frame.x + LEGEND_INSET, frame.right() - width - LEGEND_INSET];
    let [upper, lower] = [frame.y + LEGEND_INSET, frame.bottom() - height - LEGEND_INSET];
    let is_free = |&(x, y): &(f64, f64)| {
        let hides = |p: (f64, f64)| (x..x + width).contains(&p.0) && (y..y + height).contains(&p.1);
        let crosses = |two: &[(f64, f64)]| {
            (0..=OVERLAP_STEPS).any(|k| {
                let fraction = k as f64 / OVERLAP_STEPS as f64;
                hides((
                    two[0].0 + fraction * (two[1].0 - two[0].0),
                    two[0].1 + fraction * (two[1].1 - two[0].1),
                ))
            })
        };
        !drawn.iter().any(|line| line.iter().any(|p| hides(*p)) || line.windows(2).any(crosses))
    };
    [(right, upper), (right, lower), (left, upper), (left, lower)].into_iter().find(is_free)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(label: &str, points: Vec<(f64, f64)>) -> Curve {
        Curve { label: label.to_owned(), points, dashed: false }
    }

    #[test]
    fn sixteen_curves_are_distinct() {
        let plain = Curve::default();
        let strokes: Vec<Stroke> = (0..16).map(|number| stroke_of(number, &plain)).collect();
        for (k, one) in strokes.iter().enumerate() {
            assert!(strokes[..k].iter().all(|other| other != one), "{k}");
        }
    }

    #[test]
    fn rounding_of_one_value_is_not_spread_over_an_axis() {
        let axis = Axis::default();
        let range = Range::new(&axis, [200.0, 200.0 + 3e-11].into_iter(), 0.06);
        assert!(range.low < 190.0 && range.high > 210.0, "{range:?}");
        let range = Range::new(&axis, [200.0, 200.001].into_iter(), 0.0);
        assert_eq!((range.low, range.high), (200.0, 200.001));
    }

    #[test]
    fn a_legend_hides_no_curve() {
        let frame = Rect { x: 0.0, y: 0.0, width: 900.0, height: 500.0 };
        let size = (200.0, 150.0);
        assert!(free_corner(frame, size, &[vec![(0.0, 250.0), (900.0, 250.0)]]).is_some());
        // Lines through all corners whose ends are outside the frame.
        let ends = |y: f64| vec![(-400.0, y), (1300.0, y)];
        assert_eq!(free_corner(frame, size, &[ends(80.0), ends(420.0)]), None);
        let points = vec![(0.0, 1.0), (1.0, f64::NAN)];
        let plot = Plot {
            curves: vec![
                curve("drawn", points),
                curve("", vec![(0.0, 1.0)]),
                curve("empty", vec![(0.0, f64::NAN)]),
            ],
            ..Plot::default()
        };
        let named: Vec<usize> = Legend::new(&plot).named.iter().map(|(number, _)| *number).collect();
        assert_eq!(named, [0]);
    }
}
