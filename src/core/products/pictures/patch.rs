//! Draws square cutouts of the sky with a graticule.

use super::canvas::{Canvas, FAINT, INK, Rect, Stroke, WHITE};
use super::error::PictureError;
use super::page::Page;
use super::png_file::Picture;
use super::scale::ColourScale;
use super::sheet::draw_bar;
use super::text::{Align, Style};
use crate::sky::{Cutout, Frame};

/// A cutout of the sky to draw.
#[derive(Clone, Debug)]
pub struct Patch<'a> {
    /// Line above the cutout; none if empty.
    pub caption: String,
    /// The region of the sky.
    pub cutout: Cutout,
    /// Values of the region, as from [`Cutout::values`].
    pub values: &'a [f64],
    /// Colour scale.
    pub scale: ColourScale,
    /// Unit of the values.
    pub unit: String,
    /// Beam, drawn with a bar of a whole length in the lower corners.
    pub beam: Option<BeamMark>,
}

/// The ellipse of a beam at half its maximum.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BeamMark {
    /// Longer axis, degrees.
    pub major_deg: f64,
    /// Shorter axis, degrees.
    pub minor_deg: f64,
    /// Angle of the longer axis from north towards east, degrees.
    pub angle_deg: f64,
}

/// Possible lengths of the bar, degrees, and their names.
const BARS: [(f64, &str); 8] = [
    (1.0 / 60.0, "1'"),
    (2.0 / 60.0, "2'"),
    (5.0 / 60.0, "5'"),
    (10.0 / 60.0, "10'"),
    (0.5, "30'"),
    (1.0, "1°"),
    (2.0, "2°"),
    (5.0, "5°"),
];

/// Side of a cutout, pixels.
const SIDE_PX: f64 = 600.0;
/// Width and height of the area of the page for a cutout, pixels.
const PANEL_PX: (usize, usize) = (740, 840);
const FONT: f64 = 19.0;
/// Possible spacings of the lines of a graticule, degrees.
const STEPS_DEG: [f64; 9] = [0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 30.0, 45.0, 60.0];

/// Draws cutouts of the sky on one page in `columns` columns, below a title (none if empty).
///
/// # Errors
/// [`PictureError::Size`] without cutouts, with too many for a page, or with a wrong number of values.
pub fn draw_patches(title: &str, patches: &[Patch<'_>], columns: usize) -> Result<Picture, PictureError> {
    if let Some(bad) =
        patches.iter().find(|p| p.values.is_empty() || p.values.len() != p.cutout.pixels.pow(2))
    {
        let value = bad.values.len();
        return Err(PictureError::Size { what: "number of values", value, expected: "pixels squared" });
    }
    let page = Page { what: "number of cutouts", title, title_size: 1.3 * FONT, columns, panel_px: PANEL_PX };
    page.draw(patches, |patch| &patch.caption, draw_patch)
}

fn draw_patch(canvas: &mut Canvas, area: Rect, patch: &Patch<'_>) {
    let frame = Rect { x: area.x + 90.0, y: area.y + 50.0, width: SIDE_PX, height: SIDE_PX };
    let pixels = patch.cutout.pixels;
    let cell = |place: f64| ((place / SIDE_PX * pixels as f64) as usize).min(pixels - 1);
    for y in 0..SIDE_PX as usize {
        for x in 0..SIDE_PX as usize {
            let row = cell(SIDE_PX - y as f64 - 0.5);
            let value = patch.values[row * pixels + cell(x as f64 + 0.5)];
            let colour = patch.scale.colour(value);
            canvas.blend(frame.x as usize + x, frame.y as usize + y, colour, 1.0);
        }
    }
    graticule(canvas, frame, patch);
    if let Some(beam) = &patch.beam {
        draw_beam(canvas, frame, patch.cutout.size_deg, beam);
    }
    canvas.outline(frame, Stroke::solid(INK, 1.0, 1.4));
    if !patch.caption.is_empty() {
        let style = Style::new(1.1 * FONT, INK).medium();
        canvas.text(&patch.caption, (frame.middle_x(), frame.y - 0.95 * FONT), Align::Middle, style);
    }
    let axes = match patch.cutout.frame {
        Frame::Galactic => "Galactic longitude and latitude",
        Frame::Ecliptic => "ecliptic longitude and latitude",
        Frame::Equatorial => "right ascension and declination (J2000)",
    };
    let below = (frame.middle_x(), frame.bottom() + 2.7 * FONT);
    canvas.text(axes, below, Align::Middle, Style::new(FONT, FAINT));
    let bar = Rect {
        x: frame.x + 0.08 * frame.width,
        y: frame.bottom() + 4.2 * FONT,
        width: 0.76 * frame.width,
        height: FONT,
    };
    draw_bar(canvas, bar, (&patch.scale, &patch.unit), FONT);
}

/// Draws a beam in the lower left corner, at least a few pixels wide, and a bar in the lower right one.
fn draw_beam(canvas: &mut Canvas, frame: Rect, size_deg: f64, beam: &BeamMark) {
    let scale = SIDE_PX / size_deg;
    let (sin, cos) = beam.angle_deg.to_radians().sin_cos();
    let (x, y) = (frame.x + 0.05 * frame.width, frame.bottom() - 0.05 * frame.height);
    let outline = (0..=48).map(|k| {
        let (up, across) = (std::f64::consts::TAU * f64::from(k) / 48.0).sin_cos();
        let along = 0.5 * (scale * beam.major_deg).max(3.0) * up;
        let across = 0.5 * (scale * beam.minor_deg).max(3.0) * across;
        // East is to the left.
        (x - along * sin - across * cos, y - along * cos + across * sin)
    });
    let line = Stroke::solid(WHITE, 1.0, 1.6);
    canvas.polyline(&outline.collect::<Vec<_>>(), line);
    let Some((length_deg, name)) = BARS.into_iter().rev().find(|(deg, _)| *deg < 0.3 * size_deg) else {
        return;
    };
    let right = frame.right() - 0.05 * frame.width;
    canvas.polyline(&[(right - length_deg * scale, y), (right, y)], Stroke::solid(WHITE, 1.0, 2.5));
    let middle = (right - 0.5 * length_deg * scale, y - 0.7 * FONT);
    canvas.text(name, middle, Align::Middle, Style::new(FONT, WHITE));
}

/// The smallest spacing that gives at most six lines.
fn step_deg(span_deg: f64) -> f64 {
    STEPS_DEG.into_iter().find(|step| span_deg / step <= 6.0).unwrap_or(90.0)
}

fn graticule(canvas: &mut Canvas, frame: Rect, patch: &Patch<'_>) {
    let Cutout { centre_deg: [longitude, latitude], size_deg, .. } = patch.cutout;
    let half = 0.5 * size_deg;
    let to_page = |[right, up]: [f64; 2]| {
        (frame.middle_x() + right / size_deg * SIDE_PX, frame.middle_y() - up / size_deg * SIDE_PX)
    };
    // Meridians up to the corner; all of them around a pole.
    let reach = 1.5 * half;
    let latitude_max = latitude.abs() + reach;
    let wide = if latitude_max < 89.0 { (reach / latitude_max.to_radians().cos()).min(180.0) } else { 180.0 };
    let (along, up) = (step_deg(2.0 * half / latitude.to_radians().cos().max(0.05)), step_deg(size_deg));
    let (low, high) = ((latitude - reach).max(-90.0), (latitude + reach).min(90.0));
    let steps = |from: f64, to: f64, step: f64| {
        let first = (from / step).ceil() as i64;
        (first..=(to / step).floor() as i64).map(move |k| k as f64 * step)
    };
    let inside = |p: &[f64; 2]| p[0].abs() <= half && p[1].abs() <= half;
    let (colour, alpha) = if patch.scale.is_light() { (INK, 0.35) } else { (WHITE, 0.45) };
    let thin = Stroke::solid(colour, alpha, 1.0);
    let label = Style::new(0.85 * FONT, INK);
    canvas.set_clip(Some(frame));
    let fine = |k: usize, from: f64, to: f64| from + (to - from) * k as f64 / 200.0;
    let line = |canvas: &mut Canvas, points: Vec<Option<[f64; 2]>>| {
        let page = |p: Option<[f64; 2]>| p.map_or((f64::NAN, f64::NAN), to_page);
        canvas.polyline(&points.into_iter().map(page).collect::<Vec<_>>(), thin);
    };
    let meridians: Vec<f64> = steps(longitude - wide, longitude + wide - 1e-9, along).collect();
    let parallels: Vec<f64> = steps(low, high, up).collect();
    let meridian =
        |l: f64| (0..=200).map(|k| patch.cutout.place_deg(l, fine(k, low, high))).collect::<Vec<_>>();
    let parallel = |b: f64| {
        let point = |k| patch.cutout.place_deg(fine(k, longitude - wide, longitude + wide), b);
        (0..=200).map(point).collect::<Vec<_>>()
    };
    meridians.iter().for_each(|&l| line(canvas, meridian(l)));
    parallels.iter().for_each(|&b| line(canvas, parallel(b)));
    canvas.set_clip(None);
    // Labels where lines leave the cutout at the bottom and the left.
    for &l in &meridians {
        let crossing = edge(&meridian(l), 1, -half).filter(inside);
        if let Some(place) = crossing {
            let (x, y) = to_page(place);
            let text = format!("{}°", format_degrees(l.rem_euclid(360.0)));
            canvas.text(&text, (x, y + 0.9 * FONT), Align::Middle, label);
        }
    }
    for &b in &parallels {
        if let Some(place) = edge(&parallel(b), 0, -half).filter(inside) {
            let (x, y) = to_page(place);
            let sign = if b > 0.0 { "+" } else { "" };
            let text = format!("{sign}{}°", format_degrees(b)).replace('-', "−");
            canvas.text(&text, (x - 0.4 * FONT, y), Align::End, label);
        }
    }
}

/// Formats a multiple of half a degree.
fn format_degrees(degrees: f64) -> String {
    if degrees.fract() == 0.0 { format!("{degrees:.0}") } else { format!("{degrees:.1}") }
}

/// The point at which a line crosses the edge on which coordinate `axis` is `value`.
fn edge(line: &[Option<[f64; 2]>], axis: usize, value: f64) -> Option<[f64; 2]> {
    line.windows(2).find_map(|two| {
        let (a, b) = (two[0]?, two[1]?);
        let (da, db) = (a[axis] - value, b[axis] - value);
        // A jump from one side of the plane to the other is not a crossing.
        let near = (a[0] - b[0]).abs() + (a[1] - b[1]).abs() < 30.0;
        (da * db <= 0.0 && da != db && near).then(|| {
            let t = da / (da - db);
            let mut point = [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
            point[axis] = value;
            point
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::products::pictures::{Palette, Scaling};
    use crate::sky::PlaneProjection;

    #[test]
    fn cutouts_anywhere_are_drawn_and_invalid_ones_refused() {
        let values = vec![0.5; 16];
        for projection in [PlaneProjection::Gnomonic, PlaneProjection::Cartesian] {
            for centre_deg in [[0.0, 0.0], [359.0, 89.9], [120.0, -90.0], [200.0, 45.0]] {
                let patch = Patch {
                    caption: "p".to_owned(),
                    cutout: Cutout {
                        projection,
                        frame: Frame::Galactic,
                        centre_deg,
                        size_deg: 20.0,
                        pixels: 4,
                    },
                    values: &values,
                    scale: ColourScale::new(0.0, 1.0, Scaling::Linear, Palette::Inferno).unwrap(),
                    unit: "K".to_owned(),
                    beam: Some(BeamMark { major_deg: 1.0, minor_deg: 0.5, angle_deg: 30.0 }),
                };
                assert!(draw_patches("", std::slice::from_ref(&patch), 1).is_ok());
                let short = Patch { values: &values[1..], ..patch };
                assert!(matches!(draw_patches("", &[short], 1), Err(PictureError::Size { .. })));
            }
        }
        assert!(matches!(draw_patches("", &[], 1), Err(PictureError::Size { .. })));
    }
}
