//! Writes pages as SVG. Shapes stay vector graphics, which are sharp at any size and can be edited.

use std::fmt::Write;

use super::canvas::{Colour, Rect, Shape, Stroke};
use super::text::{Align, EM, HALF_CAPITAL, SUBSCRIPT_DROP, SUBSCRIPT_SIZE, Style, runs};

/// The font of pictures, and similar ones.
const FONTS: &str = "Roboto, Helvetica, Arial, 'DejaVu Sans', sans-serif";

/// Coordinate beyond which a point is off any page, pixels.
const OFF_PAGE: f64 = 1e6;

/// The page as SVG, with a PNG image, if given, below all shapes.
pub(super) fn svg_of(
    width: usize,
    height: usize,
    title: &str,
    image: Option<&[u8]>,
    shapes: &[Shape],
) -> String {
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\" \
         font-family=\"{FONTS}\">\n<title>{}</title>\n<rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n",
        escaped(title)
    );
    if let Some(png) = image {
        let data = base64(png);
        let _ = writeln!(
            out,
            "<image width=\"{width}\" height=\"{height}\" href=\"data:image/png;base64,{data}\"/>"
        );
    }
    let page = Rect { x: 0.0, y: 0.0, width: width as f64, height: height as f64 };
    let mut clips: Vec<Rect> = Vec::new();
    for shape in shapes {
        let _ = match shape {
            Shape::Fill { rect, colour, alpha, clip } => {
                fill(&mut out, within(*rect, *clip), *colour, *alpha)
            }
            Shape::Line { points, stroke, clip } => {
                let clip = (*clip != page).then(|| clip_number(&mut out, &mut clips, *clip));
                line(&mut out, points, *stroke, clip)
            }
            Shape::Text { text, anchor, align, style } => write_text(&mut out, text, *anchor, *align, *style),
        };
    }
    out + "</svg>\n"
}

fn within(rect: Rect, clip: Rect) -> Rect {
    let (x, y) = (rect.x.max(clip.x), rect.y.max(clip.y));
    let (right, bottom) = (rect.right().min(clip.right()), rect.bottom().min(clip.bottom()));
    Rect { x, y, width: (right - x).max(0.0), height: (bottom - y).max(0.0) }
}

/// The number of a clip, whose definition is written at its first use.
fn clip_number(out: &mut String, clips: &mut Vec<Rect>, clip: Rect) -> usize {
    if let Some(known) = clips.iter().position(|known| *known == clip) {
        return known;
    }
    let Rect { x, y, width, height } = clip;
    let number = clips.len();
    let _ = writeln!(
        out,
        "<clipPath id=\"c{number}\"><rect x=\"{x:.2}\" y=\"{y:.2}\" width=\"{width:.2}\" height=\"{height:.2}\"/></clipPath>"
    );
    clips.push(clip);
    number
}

fn colour_of([red, green, blue]: Colour) -> String {
    format!("#{red:02x}{green:02x}{blue:02x}")
}

fn fill(out: &mut String, rect: Rect, colour: Colour, alpha: f32) -> std::fmt::Result {
    let Rect { x, y, width, height } = rect;
    let colour = colour_of(colour);
    writeln!(
        out,
        "<rect x=\"{x:.2}\" y=\"{y:.2}\" width=\"{width:.2}\" height=\"{height:.2}\" fill=\"{colour}\" fill-opacity=\"{alpha}\"/>"
    )
}

fn line(out: &mut String, points: &[(f64, f64)], stroke: Stroke, clip: Option<usize>) -> std::fmt::Result {
    let mut path = String::new();
    let mut is_connected = false;
    for &(x, y) in points {
        if !(x.abs() <= OFF_PAGE && y.abs() <= OFF_PAGE) {
            is_connected = false;
            continue;
        }
        write!(path, "{}{x:.2} {y:.2}", if is_connected { "L" } else { "M" })?;
        is_connected = true;
    }
    let Stroke { colour, alpha, width, dash } = stroke;
    let colour = colour_of(colour);
    write!(
        out,
        "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-opacity=\"{alpha}\" stroke-width=\"{width}\" \
         stroke-linejoin=\"round\""
    )?;
    if let Some((dash, gap)) = dash {
        write!(out, " stroke-dasharray=\"{dash} {gap}\"")?;
    }
    if let Some(clip) = clip {
        write!(out, " clip-path=\"url(#c{clip})\"")?;
    }
    writeln!(out, "/>")
}

fn write_text(
    out: &mut String,
    text: &str,
    (x, y): (f64, f64),
    align: Align,
    style: Style,
) -> std::fmt::Result {
    let anchor = match align {
        Align::Start => "start",
        Align::Middle => "middle",
        Align::End => "end",
    };
    let turn = if style.upwards { " rotate(-90)" } else { "" };
    let weight = if style.medium { " font-weight=\"500\"" } else { "" };
    let (colour, size, drop) = (colour_of(style.colour), EM * style.size, HALF_CAPITAL * style.size);
    write!(
        out,
        "<text transform=\"translate({x:.2} {y:.2}){turn}\" y=\"{drop:.2}\" font-size=\"{size:.2}\" fill=\"{colour}\" \
         fill-opacity=\"{}\" text-anchor=\"{anchor}\"{weight} xml:space=\"preserve\">",
        style.alpha
    )?;
    let lowered = SUBSCRIPT_DROP * style.size;
    let mut is_low = false;
    for (run, subscript) in runs(text).into_iter().filter(|(run, _)| !run.is_empty()) {
        // Raises the line again after a subscript.
        let shift = match (is_low, subscript) {
            (false, true) => lowered,
            (true, false) => -lowered,
            _ => 0.0,
        };
        let size = if subscript { SUBSCRIPT_SIZE * size } else { size };
        write!(out, "<tspan dy=\"{shift:.2}\" font-size=\"{size:.2}\">{}</tspan>", escaped(run))?;
        is_low = subscript;
    }
    writeln!(out, "</text>")
}

fn escaped(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).fold(String::new(), |mut out, c| {
        match c {
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '&' => out.push_str("&amp;"),
            '"' => out.push_str("&quot;"),
            c => out.push(c),
        }
        out
    })
}

/// Base64 of RFC 4648.
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let byte = |k: usize| u32::from(group.get(k).copied().unwrap_or(0));
        let number = byte(0) << 16 | byte(1) << 8 | byte(2);
        for k in 0..4 {
            let digit = DIGITS[(number >> (18 - 6 * k) & 63) as usize];
            out.push(if k <= group.len() { char::from(digit) } else { '=' });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::products::pictures::{Axis, Curve, Plot, Raster, draw_plots, draw_rasters};
    use crate::products::pictures::{ColourScale, Palette, Scaling};

    #[test]
    fn base64_is_that_of_the_rfc() {
        // RFC 4648, section 10.
        for (bytes, text) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("fooba", "Zm9vYmE="),
            ("foobar", "Zm9vYmFy"),
        ] {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
    }

    #[test]
    fn curves_stay_lines_and_labels_stay_text() {
        let curve = Curve {
            label: "a < b & c".into(),
            points: vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, 3.0), (3.0, 2.0)],
            dashed: true,
        };
        let axis = |label: &str| Axis { label: label.into(), ..Axis::default() };
        let plot = Plot {
            title: "T".into(),
            x: axis("l"),
            y: axis("C_{l} (K)"),
            curves: vec![curve],
            ..Plot::default()
        };
        let svg = draw_plots("", &[plot], 1).unwrap().to_svg().unwrap();
        assert!(svg.contains(">a &lt; b &amp; c</tspan>"), "{svg}");
        assert!(svg.contains("rotate(-90)") && svg.contains(">l</tspan>"), "{svg}");
        // Without values in colour there is no image.
        assert!(!svg.contains("<image"));
        // NaN interrupts the line.
        let dashed: Vec<&str> = svg.lines().filter(|line| line.contains("stroke-dasharray")).collect();
        assert!(dashed.iter().any(|line| line.matches('M').count() == 1 && line.contains('L')), "{dashed:?}");
        assert!(svg.matches("<clipPath").count() == 1 && svg.contains("clip-path=\"url(#c0)\""));
    }

    #[test]
    fn values_are_an_image_without_the_text() {
        let axis = || Axis { limits: Some((0.0, 1.0)), ..Axis::default() };
        let raster = Raster {
            title: "t".into(),
            x: axis(),
            y: axis(),
            values: &[0.0, 1.0],
            columns: 2,
            scale: ColourScale::new(0.0, 1.0, Scaling::Linear, Palette::Inferno).unwrap(),
            unit: "h".into(),
        };
        let picture = draw_rasters("", &[raster], 1).unwrap();
        let svg = picture.to_svg().unwrap();
        assert!(svg.matches("<image").count() == 1 && svg.contains(">h</tspan>"));
        // The image does not contain the title.
        assert!(picture.to_png().unwrap().len() > svg.matches("iVBOR").count());
    }
}
