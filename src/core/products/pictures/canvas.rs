//! A page: pixels with values in colour, and lines, fills and text above them, which are kept as shapes until flattened.

use std::ops::Range;

pub(super) use super::colour::{Colour, FAINT, INK, WHITE};
use super::text::{self, Align, Style};

/// A rectangle of the page, pixels, y downwards.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rect {
    pub x: f64,
    pub y: f64,
    pub width: f64,
    pub height: f64,
}

impl Rect {
    pub fn right(&self) -> f64 {
        self.x + self.width
    }

    pub fn bottom(&self) -> f64 {
        self.y + self.height
    }

    pub fn middle_x(&self) -> f64 {
        self.x + 0.5 * self.width
    }

    pub fn middle_y(&self) -> f64 {
        self.y + 0.5 * self.height
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Stroke {
    pub colour: Colour,
    /// Opacity, 0-1.
    pub alpha: f32,
    /// Width, pixels.
    pub width: f64,
    /// Length of dashes and of gaps, pixels.
    pub dash: Option<(f64, f64)>,
}

impl Stroke {
    pub fn solid(colour: Colour, alpha: f32, width: f64) -> Self {
        Self { colour, alpha, width, dash: None }
    }
}

#[derive(Clone, Debug)]
pub(super) enum Shape {
    Fill { rect: Rect, colour: Colour, alpha: f32, clip: Rect },
    Line { points: Vec<(f64, f64)>, stroke: Stroke, clip: Rect },
    Text { text: String, anchor: (f64, f64), align: Align, style: Style },
}

pub(super) struct Canvas {
    width: usize,
    height: usize,
    pixels: Vec<[f32; 3]>,
    clip: Rect,
    shapes: Vec<Shape>,
}

impl Canvas {
    pub fn new(width: usize, height: usize) -> Self {
        let clip = Rect { x: 0.0, y: 0.0, width: width as f64, height: height as f64 };
        Self { width, height, pixels: vec![[255.0; 3]; width * height], clip, shapes: Vec::new() }
    }

    /// Limits strokes and fills to a rectangle; `None` for the whole page.
    pub fn set_clip(&mut self, clip: Option<Rect>) {
        let page = Rect { x: 0.0, y: 0.0, width: self.width as f64, height: self.height as f64 };
        self.clip = clip.unwrap_or(page);
    }

    pub fn fill(&mut self, rect: Rect, colour: Colour, alpha: f32) {
        self.shapes.push(Shape::Fill { rect, colour, alpha, clip: self.clip });
    }

    /// Draws a line through points; a point that is not finite interrupts it.
    pub fn polyline(&mut self, points: &[(f64, f64)], stroke: Stroke) {
        self.shapes.push(Shape::Line { points: points.to_vec(), stroke, clip: self.clip });
    }

    /// Draws a line of text; `anchor` is at mid-height of its capitals, `_{...}` marks subscripts.
    pub fn text(&mut self, text: &str, anchor: (f64, f64), align: Align, style: Style) {
        self.shapes.push(Shape::Text { text: text.to_owned(), anchor, align, style });
    }

    /// Paints all shapes into the pixels, and returns them.
    pub fn flatten(&mut self) -> Vec<Shape> {
        let shapes = std::mem::take(&mut self.shapes);
        for shape in &shapes {
            match shape {
                Shape::Fill { rect, colour, alpha, clip } => {
                    self.clip = *clip;
                    self.paint_fill(*rect, *colour, *alpha);
                }
                Shape::Line { points, stroke, clip } => {
                    self.clip = *clip;
                    self.paint_line(points, *stroke);
                }
                Shape::Text { text, anchor, align, style } => {
                    text::paint(
                        &mut |x, y, colour, alpha| self.blend(x, y, colour, alpha),
                        text,
                        *anchor,
                        *align,
                        *style,
                    );
                }
            }
        }
        shapes
    }

    /// The columns of pixels from `low` to `high`, within the page and the clip.
    fn columns(&self, low: f64, high: f64) -> Range<usize> {
        span(low.max(self.clip.x), high.min(self.clip.right()), self.width)
    }

    fn rows(&self, low: f64, high: f64) -> Range<usize> {
        span(low.max(self.clip.y), high.min(self.clip.bottom()), self.height)
    }

    /// The rows of pixels, for parallel drawing.
    pub fn pixel_rows_mut(&mut self) -> std::slice::ChunksExactMut<'_, [f32; 3]> {
        self.pixels.chunks_exact_mut(self.width.max(1))
    }

    pub fn blend(&mut self, x: usize, y: usize, colour: Colour, alpha: f32) {
        if x < self.width && y < self.height {
            mix(&mut self.pixels[y * self.width + x], colour, alpha);
        }
    }

    /// Fills a rectangle, with edge pixels by the fraction covered.
    fn paint_fill(&mut self, rect: Rect, colour: Colour, alpha: f32) {
        for y in self.rows(rect.y, rect.bottom()) {
            let covered_y = overlap(y, rect.y, rect.bottom());
            for x in self.columns(rect.x, rect.right()) {
                let covered = covered_y * overlap(x, rect.x, rect.right());
                self.blend(x, y, colour, alpha * covered as f32);
            }
        }
    }

    pub fn outline(&mut self, rect: Rect, stroke: Stroke) {
        let (x, y, right, bottom) = (rect.x, rect.y, rect.right(), rect.bottom());
        self.polyline(&[(x, y), (right, y), (right, bottom), (x, bottom), (x, y)], stroke);
    }

    fn paint_line(&mut self, points: &[(f64, f64)], stroke: Stroke) {
        let pieces = pieces(points, stroke.dash);
        let reach = 0.5 * stroke.width + 1.0;
        let bounds = |a: usize, b: usize| {
            let low = pieces.iter().map(|p| p[a].min(p[b])).fold(f64::INFINITY, f64::min);
            let high = pieces.iter().map(|p| p[a].max(p[b])).fold(f64::NEG_INFINITY, f64::max);
            (low - reach, high + reach)
        };
        if pieces.is_empty() {
            return;
        }
        let ((left, right), (top, bottom)) = (bounds(0, 2), bounds(1, 3));
        let (columns, rows) = (self.columns(left, right), self.rows(top, bottom));
        // Compute the coverage of the whole line first, so that segments join without seams and alpha applies once.
        let mut coverage = StrokeCoverage {
            values: vec![0.0; columns.len() * rows.len()],
            columns: columns.clone(),
            rows: rows.clone(),
        };
        for piece in pieces {
            coverage.add(piece, stroke.width);
        }
        for (y, line) in rows.zip(coverage.values.chunks_exact(columns.len().max(1))) {
            for (x, covered) in columns.clone().zip(line) {
                if *covered > 0.0 {
                    self.blend(x, y, stroke.colour, stroke.alpha * covered);
                }
            }
        }
    }

    /// The pixels as three bytes each, without shapes that are not flattened yet.
    pub fn rgb(&self) -> Vec<u8> {
        self.pixels.iter().flat_map(|pixel| pixel.map(|v| v.round().clamp(0.0, 255.0) as u8)).collect()
    }
}

/// The fraction of each pixel that a line covers, in a part of the page.
struct StrokeCoverage {
    values: Vec<f32>,
    columns: Range<usize>,
    rows: Range<usize>,
}

impl StrokeCoverage {
    fn add(&mut self, [x0, y0, x1, y1]: [f64; 4], width: f64) {
        let reach = 0.5 * width + 1.0;
        let (dx, dy) = (x1 - x0, y1 - y0);
        let length2 = dx * dx + dy * dy;
        for y in within(y0.min(y1) - reach, y0.max(y1) + reach, &self.rows) {
            let py = y as f64 + 0.5;
            let (mut low, mut high) = (x0.min(x1), x0.max(x1));
            if dy.abs() > 1.0 {
                // A steep segment crosses a row in a few columns only.
                let (a, b) = (x0 + (py - reach - 1.0 - y0) * dx / dy, x0 + (py + reach + 1.0 - y0) * dx / dy);
                low = low.max(a.min(b));
                high = high.min(a.max(b));
            }
            for x in within(low - reach, high + reach, &self.columns) {
                let px = x as f64 + 0.5;
                let along = (px - x0) * dx + (py - y0) * dy;
                let t = if length2 > 0.0 { (along / length2).clamp(0.0, 1.0) } else { 0.0 };
                let distance = (px - x0 - t * dx).hypot(py - y0 - t * dy);
                let covered = (0.5 + 0.5 * width - distance).clamp(0.0, 1.0) * width.min(1.0);
                let index = (y - self.rows.start) * self.columns.len() + x - self.columns.start;
                self.values[index] = self.values[index].max(covered as f32);
            }
        }
    }
}

/// The straight segments of a line, cut into dashes if required.
fn pieces(points: &[(f64, f64)], dash: Option<(f64, f64)>) -> Vec<[f64; 4]> {
    // A point farther away than a million pixels is off any page, and could overflow.
    let is_off_page = |v: f64| !v.is_finite() || v.abs() > 1e6;
    let mut pieces = Vec::new();
    let mut travelled = 0.0;
    for pair in points.windows(2) {
        let ((x0, y0), (x1, y1)) = (pair[0], pair[1]);
        if [x0, y0, x1, y1].into_iter().any(is_off_page) {
            continue;
        }
        let Some((dash, gap)) = dash else {
            pieces.push([x0, y0, x1, y1]);
            continue;
        };
        let length = (x1 - x0).hypot(y1 - y0);
        let point_at = |s: f64| (x0 + s / length * (x1 - x0), y0 + s / length * (y1 - y0));
        let mut start = -(travelled % (dash + gap));
        while start < length {
            if start + dash > 0.0 {
                let ((ax, ay), (bx, by)) = (point_at(start.max(0.0)), point_at((start + dash).min(length)));
                pieces.push([ax, ay, bx, by]);
            }
            start += dash + gap;
        }
        travelled += length;
    }
    pieces
}

fn within(low: f64, high: f64, limits: &Range<usize>) -> Range<usize> {
    let whole = span(low, high, limits.end);
    let first = whole.start.max(limits.start);
    first..whole.end.max(first)
}

fn mix(pixel: &mut [f32; 3], colour: Colour, alpha: f32) {
    for (current, target) in pixel.iter_mut().zip(colour) {
        *current += alpha * (f32::from(target) - *current);
    }
}

fn span(low: f64, high: f64, size: usize) -> Range<usize> {
    let first = low.floor().max(0.0) as usize;
    let last = (high.ceil().max(0.0) as usize).min(size);
    first.min(last)..last
}

fn overlap(pixel: usize, low: f64, high: f64) -> f64 {
    let left = pixel as f64;
    ((left + 1.0).min(high) - left.max(low)).clamp(0.0, 1.0)
}
