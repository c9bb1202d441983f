//! Measures and paints text in the embedded font.

use std::sync::LazyLock;

use ab_glyph::{Font, FontRef, Glyph, PxScaleFont, ScaleFont, point};

use super::colour::Colour;

static REGULAR: LazyLock<FontRef<'static>> =
    LazyLock::new(|| parse(include_bytes!("font/Roboto-Regular.subset.ttf")));
static MEDIUM: LazyLock<FontRef<'static>> =
    LazyLock::new(|| parse(include_bytes!("font/Roboto-Medium.subset.ttf")));

#[expect(clippy::expect_used, reason = "the fonts are embedded, and a test parses both")]
fn parse(bytes: &'static [u8]) -> FontRef<'static> {
    FontRef::try_from_slice(bytes).expect("the embedded font is valid")
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Align {
    Start,
    Middle,
    End,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Style {
    pub size: f64,
    pub colour: Colour,
    pub alpha: f32,
    pub medium: bool,
    pub upwards: bool,
}

impl Style {
    pub fn new(size: f64, colour: Colour) -> Self {
        Self { size, colour, alpha: 1.0, medium: false, upwards: false }
    }

    pub fn medium(self) -> Self {
        Self { medium: true, ..self }
    }

    pub fn upwards(self) -> Self {
        Self { upwards: true, ..self }
    }

    pub fn alpha(self, alpha: f32) -> Self {
        Self { alpha, ..self }
    }

    fn font(&self) -> PxScaleFont<&'static FontRef<'static>> {
        let font: &'static FontRef<'static> = if self.medium { &MEDIUM } else { &REGULAR };
        font.as_scaled(self.size as f32)
    }
}

/// Size of a subscript, relative to the size of the text.
pub(super) const SUBSCRIPT_SIZE: f64 = 0.72;
/// Drop of a subscript below the line, relative to the size of the text.
pub(super) const SUBSCRIPT_DROP: f64 = 0.16;

/// Splits a text into runs, each with whether it is a subscript, marked by `_{...}`.
pub(super) fn runs(text: &str) -> Vec<(&str, bool)> {
    let mut runs = Vec::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once("_{") {
        let Some((inside, after)) = after.split_once('}') else { break };
        runs.extend([(before, false), (inside, true)]);
        rest = after;
    }
    runs.push((rest, false));
    runs
}

fn run_style(style: Style, subscript: bool) -> (Style, f64) {
    if subscript {
        (Style { size: SUBSCRIPT_SIZE * style.size, ..style }, SUBSCRIPT_DROP * style.size)
    } else {
        (style, 0.0)
    }
}

/// Length of a line of text, pixels; `_{...}` marks subscripts.
pub(super) fn length(text: &str, style: Style) -> f64 {
    runs(text)
        .into_iter()
        .map(|(run, subscript)| {
            let font = run_style(style, subscript).0.font();
            run.chars().map(|c| f64::from(font.h_advance(font.glyph_id(c)))).sum::<f64>()
        })
        .sum()
}

/// Half the height of capitals for a size of 1. Capitals of Roboto are 0.711 em high.
pub(super) const HALF_CAPITAL: f64 = 0.5 * 0.711 * EM;

/// Length of an em for a size of 1, which is ascent plus descent.
pub(super) const EM: f64 = 0.853;

/// Paints a line of text with a function that blends a colour into one pixel.
pub(super) fn paint(
    blend: &mut dyn FnMut(usize, usize, Colour, f32),
    text: &str,
    anchor: (f64, f64),
    align: Align,
    style: Style,
) {
    let back = match align {
        Align::Start => 0.0,
        Align::Middle => 0.5 * length(text, style),
        Align::End => length(text, style),
    };
    let half_capital = HALF_CAPITAL * style.size;
    let mut along = 0.0;
    for (run, subscript) in runs(text) {
        let (style, drop) = run_style(style, subscript);
        let font = style.font();
        for c in run.chars() {
            let id = font.glyph_id(c);
            // In upward text, the downward direction of the glyphs points right.
            let origin = if style.upwards {
                (along, drop)
            } else {
                (anchor.0 - back + along, anchor.1 + half_capital + drop)
            };
            along += f64::from(font.h_advance(id));
            let position = point(origin.0 as f32, origin.1 as f32);
            let glyph: Glyph = id.with_scale_and_position(font.scale(), position);
            let Some(outline) = font.outline_glyph(glyph) else { continue };
            let corner = outline.px_bounds().min;
            outline.draw(|column, row, covered| {
                let (x, y) = (f64::from(corner.x) + f64::from(column), f64::from(corner.y) + f64::from(row));
                let (x, y) = if style.upwards {
                    ((anchor.0 + half_capital).round() + y, (anchor.1 + back).round() - x - 1.0)
                } else {
                    (x, y)
                };
                if x >= 0.0 && y >= 0.0 {
                    blend(x as usize, y as usize, style.colour, style.alpha * covered.clamp(0.0, 1.0));
                }
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn subscripts_are_found() {
        assert_eq!(runs("C_{ℓ} (K)"), [("C", false), ("ℓ", true), (" (K)", false)]);
        assert_eq!(runs("map_1.fits"), [("map_1.fits", false)]);
        assert_eq!(runs("open_{"), [("open_{", false)]);
        assert!(length("ρ_{ℓ}", Style::new(20.0, [0; 3])) < length("ρℓ", Style::new(20.0, [0; 3])));
    }

    #[test]
    fn the_fonts_hold_the_characters_of_labels() {
        let wanted = "ABCxyz 0123456789 +-−×·°%()[]/ ρσνλΩℓ ⁰¹²³⁴⁵⁶⁷⁸⁹⁻ ₀₁₂₉ ≤≥";
        for font in [&*REGULAR, &*MEDIUM] {
            for c in wanted.chars() {
                assert_ne!(font.glyph_id(c).0, 0, "{c}");
            }
        }
    }
}
