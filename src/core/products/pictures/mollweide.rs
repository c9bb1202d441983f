//! Draws a HEALPix map in Mollweide projection.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use rayon::prelude::*;

use super::canvas::{Canvas, Colour, FAINT, INK, Rect, Stroke, WHITE};
use super::projection::{LatitudeLine, forward};
use super::scale::{ColourScale, is_seen};
use super::text::{Align, Style};
use crate::sky::healpix::pixel_of;
use crate::sky::{Bilinear, Frame};
use crate::units::vector::{Vec3, dot};

/// Number of samples along each side of a pixel of the picture.
const SUPERSAMPLING: usize = 3;

/// Sampling of a map for its picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Sampling {
    /// Each map pixel has a uniform colour.
    #[default]
    Pixels,
    /// [`Bilinear`] interpolation between pixel centres, which is smoother for coarse maps.
    Interpolated,
}

/// The view of a map: coordinate frame, centre and style.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Rotation from the frame drawn to the map's frame: row `k` is the map's axis `k` in the frame drawn.
    pub rotation: [Vec3; 3],
    /// Name of the frame drawn, printed in the corner.
    pub frame: String,
    /// Longitude of the centre, degrees.
    pub centre_deg: f64,
    /// Sampling of the map.
    pub sampling: Sampling,
    /// Whether meridians and parallels are drawn, 60 and 30 degrees apart.
    pub graticule: bool,
}

impl Default for View {
    /// A map on ecliptic axes in its own frame.
    fn default() -> Self {
        Self {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            frame: "ecliptic coordinates".to_owned(),
            centre_deg: 0.0,
            sampling: Sampling::Pixels,
            graticule: true,
        }
    }
}

impl View {
    /// A map on the axes of `map`, drawn in `frame`.
    #[must_use]
    pub fn of(frame: Frame, map: Frame) -> Self {
        let frame_name = match frame {
            Frame::Galactic => "Galactic coordinates",
            Frame::Ecliptic => "ecliptic coordinates",
            Frame::Equatorial => "equatorial coordinates",
        };
        Self { rotation: frame.to_frame(map), frame: frame_name.to_owned(), ..Self::default() }
    }
}

/// A map with its nside; `values` are in RING order.
#[derive(Clone, Copy)]
pub(super) struct MapField<'a> {
    pub values: &'a [f64],
    pub nside: usize,
}

impl MapField<'_> {
    /// Interpolates among those of the four pixels around a direction that have values; where the nearest has none there is none.
    fn interpolated(&self, bilinear: &Bilinear, direction: Vec3) -> f64 {
        let nearest = self.values[pixel_of(self.nside, direction)];
        if !is_seen(nearest) {
            return nearest;
        }
        let around = bilinear.weights(direction).map(|(pixel, weight)| (self.values[pixel], weight));
        let seen = around.into_iter().filter(|(value, _)| is_seen(*value));
        let (sum, weights) = seen.fold((0.0, 0.0), |(sum, all), (value, w)| (sum + w * value, all + w));
        if weights > 1e-9 { sum / weights } else { nearest }
    }
}

/// Draws a map into the largest ellipse that fits a rectangle.
pub(super) fn draw(canvas: &mut Canvas, area: Rect, field: MapField<'_>, scale: &ColourScale, view: &View) {
    let ellipse = Ellipse::within(area);
    paint(canvas, &ellipse, field, scale, view);
    let centre = view.centre_deg.to_radians();
    if view.graticule {
        let (colour, alpha) = if scale.is_light() { (INK, 0.28) } else { (WHITE, 0.33) };
        let thin = Stroke::solid(colour, alpha, (ellipse.half_height / 300.0).clamp(0.6, 1.2));
        for line in graticule(centre) {
            canvas.polyline(&line.into_iter().map(|p| ellipse.to_page(p)).collect::<Vec<_>>(), thin);
        }
    }
    let rim: Vec<(f64, f64)> = (0..=720)
        .map(|k| (f64::from(k) * TAU / 720.0).sin_cos())
        .map(|(s, c)| ellipse.to_page((2.0 * c, s)))
        .collect();
    canvas.polyline(&rim, Stroke::solid(INK, 1.0, (ellipse.half_height / 220.0).clamp(0.8, 1.6)));
    if view.graticule && ellipse.half_height >= 180.0 {
        label(canvas, &ellipse, scale, centre);
    }
}

struct Ellipse {
    x: f64,
    y: f64,
    half_height: f64,
}

impl Ellipse {
    fn within(area: Rect) -> Self {
        let half_height = (0.25 * area.width).min(0.5 * area.height);
        Self { x: area.middle_x(), y: area.middle_y(), half_height }
    }

    fn to_page(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (self.x + x * self.half_height, self.y - y * self.half_height)
    }
}

/// Gives the colour of any direction of a map.
struct Painter<'a> {
    field: MapField<'a>,
    scale: &'a ColourScale,
    sampler: Sampler,
}

enum Sampler {
    /// Colour of each map pixel.
    Pixels(Vec<Colour>),
    Interpolated(Bilinear),
}

impl<'a> Painter<'a> {
    fn new(field: MapField<'a>, scale: &'a ColourScale, sampling: Sampling) -> Self {
        let sampler = match (sampling, Bilinear::new(field.nside)) {
            (Sampling::Interpolated, Ok(bilinear)) => Sampler::Interpolated(bilinear),
            // An nside that a number of pixels has can be interpolated.
            _ => Sampler::Pixels(field.values.par_iter().map(|v| scale.colour(*v)).collect()),
        };
        Self { field, scale, sampler }
    }

    /// Whether one sample per pixel of the page is enough.
    fn is_smooth(&self) -> bool {
        matches!(self.sampler, Sampler::Interpolated(_))
    }

    fn colour(&self, direction: Vec3) -> Colour {
        match &self.sampler {
            Sampler::Pixels(colours) => colours[pixel_of(self.field.nside, direction)],
            Sampler::Interpolated(bilinear) => {
                self.scale.colour(self.field.interpolated(bilinear, direction))
            }
        }
    }
}

fn paint(canvas: &mut Canvas, ellipse: &Ellipse, field: MapField<'_>, scale: &ColourScale, view: &View) {
    let painter = Painter::new(field, scale, view.sampling);
    let first_row = (ellipse.y - ellipse.half_height).floor().max(0.0) as usize;
    let rows = (2.0 * ellipse.half_height).ceil() as usize + 1;
    let mut lines: Vec<_> = canvas.pixel_rows_mut().enumerate().skip(first_row).take(rows).collect();
    lines.par_iter_mut().for_each(|(y, line)| paint_row(line, *y, ellipse, &painter, view));
}

/// Paints one row of pixels with the mean colours of their samples. Samples outside the ellipse keep the background.
fn paint_row(line: &mut [[f32; 3]], y: usize, ellipse: &Ellipse, painter: &Painter<'_>, view: &View) {
    let centre = view.centre_deg.to_radians();
    let inside = |k: usize| (k as f64 + 0.5) / SUPERSAMPLING as f64;
    let all = (SUPERSAMPLING * SUPERSAMPLING) as f32;
    let first = (ellipse.x - 2.0 * ellipse.half_height).floor().max(0.0) as usize;
    let columns = (4.0 * ellipse.half_height).ceil() as usize + 1;
    let mut sums = vec![([0.0_f32; 3], 0.0_f32); columns.min(line.len() - first)];
    for sub_row in 0..SUPERSAMPLING {
        let up = (ellipse.y - (y as f64 + inside(sub_row))) / ellipse.half_height;
        let Some(parallel) = LatitudeLine::at_height(up) else { continue };
        for (x, (sum, hits)) in sums.iter_mut().enumerate() {
            for sub_column in 0..SUPERSAMPLING {
                let right = ((first + x) as f64 + inside(sub_column) - ellipse.x) / ellipse.half_height;
                let Some(longitude) = parallel.longitude(right) else { continue };
                *hits += 1.0;
                if painter.is_smooth() && *hits > 1.0 {
                    // Interpolated colours vary little within a pixel of the page.
                    continue;
                }
                let (sin, cos) = (longitude + centre).sin_cos();
                let drawn = [parallel.cos_latitude * cos, parallel.cos_latitude * sin, parallel.sin_latitude];
                let colour = painter.colour(view.rotation.map(|row| dot(row, drawn)));
                sum.iter_mut().zip(colour).for_each(|(sum, c)| *sum += f32::from(c));
            }
        }
    }
    for (pixel, (sum, hits)) in line[first..].iter_mut().zip(sums) {
        let weight = if painter.is_smooth() { hits } else { 1.0 };
        for (pixel, sum) in pixel.iter_mut().zip(sum) {
            *pixel = (*pixel * (all - hits) + sum * weight) / all;
        }
    }
}

/// Meridians every 60 degrees and parallels every 30 degrees, as lines on the ellipse.
fn graticule(centre: f64) -> Vec<Vec<(f64, f64)>> {
    let latitudes = (0..=180).map(|k| (f64::from(k) - 90.0).to_radians());
    let longitudes = (0..=180).map(|k| (f64::from(k) * 2.0 - 180.0).to_radians());
    let mut lines = Vec::new();
    for meridian in 0..6 {
        let longitude = wrapped((f64::from(meridian) * 60.0).to_radians() - centre);
        lines.push(latitudes.clone().map(|b| forward(longitude, b)).collect());
    }
    for parallel in -2..=2 {
        let latitude = (f64::from(parallel) * 30.0).to_radians();
        lines.push(longitudes.clone().map(|l| forward(l, latitude)).collect());
    }
    lines
}

/// Labels the parallels at the edge and the meridians along the equator, degrees.
fn label(canvas: &mut Canvas, ellipse: &Ellipse, scale: &ColourScale, centre: f64) {
    let size = (ellipse.half_height / 19.0).clamp(10.0, 20.0);
    let outside = Style::new(size, FAINT);
    for parallel in [-60.0_f64, -30.0, 0.0, 30.0, 60.0] {
        let (x, y) = ellipse.to_page(forward(PI, parallel.to_radians()));
        let sign = if parallel > 0.0 {
            "+"
        } else if parallel < 0.0 {
            "−"
        } else {
            ""
        };
        let text = format!("{sign}{}°", parallel.abs());
        let lift = -0.45 * size * parallel.to_radians().sin() / 60_f64.to_radians().sin();
        canvas.text(&text, (x - 0.45 * size, y + lift), Align::End, outside);
    }
    let on_map = Style::new(0.9 * size, if scale.is_light() { INK } else { WHITE }).alpha(0.75);
    for meridian in 0..6 {
        let degrees = f64::from(meridian) * 60.0;
        let longitude = wrapped(degrees.to_radians() - centre);
        if longitude.abs() > 0.95 * PI {
            continue;
        }
        let (x, y) = ellipse.to_page(forward(longitude, 0.0));
        canvas.text(&format!("{degrees}°"), (x + 0.3 * size, y + 0.7 * size), Align::Start, on_map);
    }
}

fn wrapped(longitude: f64) -> f64 {
    let turned = (longitude + PI).rem_euclid(TAU) - PI;
    if turned <= -2.0 * FRAC_PI_2 { PI } else { turned }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::healpix::{pixel_count, pixel_directions};

    #[test]
    fn interpolation_is_exact_at_pixel_centres() {
        for nside in [1, 2, 8, 16] {
            let directions = pixel_directions(nside);
            let values: Vec<f64> = directions.iter().map(|d| d[2] + 0.3 * d[0]).collect();
            let (field, bilinear) = (MapField { values: &values, nside }, Bilinear::new(nside).unwrap());
            for (d, v) in directions.iter().zip(&values) {
                assert!((field.interpolated(&bilinear, *d) - v).abs() < 1e-9, "{nside}");
            }
        }
    }

    #[test]
    fn interpolation_bridges_holes_and_keeps_them() {
        let nside = 4;
        let mut values = vec![2.0; pixel_count(nside)];
        values[50] = f64::NAN;
        let (field, bilinear) = (MapField { values: &values, nside }, Bilinear::new(nside).unwrap());
        let directions = pixel_directions(nside);
        assert!(field.interpolated(&bilinear, directions[50]).is_nan());
        for k in 0..1000_u32 {
            let z = 2.0 * (f64::from(k) + 0.5) / 1000.0 - 1.0;
            let (s, c) = (f64::from(k) * 2.4).sin_cos();
            let across = (1.0 - z * z).sqrt();
            let value = field.interpolated(&bilinear, [across * c, across * s, z]);
            assert!(value.is_nan() || (value - 2.0).abs() < 1e-12);
        }
    }
}
