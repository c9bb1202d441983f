//! Metadata of a map in its headers: frequency and unit.

use super::card::{Card, CardValue};
use super::error::FitsProblem;
use super::header::Header;
use crate::units::Dimension;
use crate::units::constants::{BOLTZMANN_J_K, SPEED_OF_LIGHT_M_S};

const FREQUENCY_KEYS: [&str; 5] = ["FREQ", "FREQUENCY", "OBSFREQ", "RESTFRQ", "RESTFREQ"];
const FREQUENCY_UNIT_KEYS: [&str; 3] = ["FREQUNIT", "FREQ_UNI", "UNITFREQ"];

/// Relative difference up to which two frequencies count as equal, as headers may lose digits.
const FREQUENCY_TOLERANCE: f64 = 1e-6;

/// Suffixes of kelvin in units of temperature. Thermodynamic and Rayleigh-Jeans temperatures agree at these frequencies, to
/// (h nu / k T)^2 / 12 of the CMB's 2.7 K, 4e-6 at 408 MHz.
const KINDS_OF_KELVIN: [&str; 8] = ["", "cmb", "rj", "thermo", "thermodynamic", "ant", "antenna", "b"];

/// Whether two frequencies, Hz, are equal within the tolerance.
pub(super) fn is_same_hz(one: f64, other: f64) -> bool {
    (one - other).abs() <= FREQUENCY_TOLERANCE * other
}

/// Frequency of a column, Hz, from its own metadata ([`column_hz`]) or else from FREQ in either header; `None` if not stated.
/// Columns count from 1, as in keywords.
pub(super) fn frequency_hz(header: &Header, column: usize) -> Result<Option<f64>, FitsProblem> {
    match column_hz(header, column)? {
        None => file_hz(header),
        found => Ok(found),
    }
}

/// Frequency in the metadata of a column, Hz: FREQn, its name (such as `10MHz`), or the comment of the name.
pub(super) fn column_hz(header: &Header, column: usize) -> Result<Option<f64>, FitsProblem> {
    if let Some(card) = header.card(&format!("FREQ{column}")) {
        return stated_hz(header, card).map(Some);
    }
    let Some(card) = header.card(&format!("TTYPE{column}")) else { return Ok(None) };
    let name = header.text(&card.key).and_then(hz_in);
    Ok(name.or_else(|| hz_in(&card.comment)))
}

/// Frequency in FREQ of either header, Hz, which must not contradict each other.
fn file_hz(header: &Header) -> Result<Option<f64>, FitsProblem> {
    let mut known: Option<f64> = None;
    for card in header.cards().iter().filter(|card| FREQUENCY_KEYS.contains(&card.key.as_str())) {
        let hz = stated_hz(header, card)?;
        if let Some(other) = known.filter(|&other| !is_same_hz(hz, other)) {
            let [hz, other] = [hz, other].map(|hz| Dimension::Frequency.show(hz));
            return Err(FitsProblem::keyword(
                &card.key,
                hz,
                format!("{other}, as the headers say elsewhere"),
            ));
        }
        known.get_or_insert(hz);
    }
    Ok(known)
}

/// Frequency of a card, Hz. Its unit is in the text, the comment or FREQUNIT; without a unit it is Hz.
fn stated_hz(header: &Header, card: &Card) -> Result<f64, FitsProblem> {
    let wrong = || {
        let found = format!("{} / {}", card.value, card.comment);
        FitsProblem::keyword(&card.key, found, "a positive number, Hz, or with one unit, such as '408 MHz'")
    };
    let (number, own_unit) = match &card.value {
        CardValue::Integer(value) => (*value as f64, None),
        CardValue::Real(value) => (*value, None),
        CardValue::Text(text) => {
            let text = text.trim();
            let end = text.find(|c: char| c.is_whitespace() || (c.is_alphabetic() && !"eEdD".contains(c)));
            let (number, unit) = text.split_at(end.unwrap_or(text.len()));
            let number = number.replace(['d', 'D'], "e").parse().map_err(|_| wrong())?;
            let unit = unit.trim().trim_matches(['[', ']', '(', ')']);
            (number, (!unit.is_empty()).then(|| unit_hz(unit).ok_or_else(wrong)).transpose()?)
        }
        CardValue::Logical(_) => return Err(wrong()),
    };
    let key_unit = || FREQUENCY_UNIT_KEYS.iter().find_map(|key| header.text(key)).and_then(unit_hz);
    let unit = match own_unit {
        Some(unit) => unit,
        None => comment_unit_hz(&card.comment).ok_or_else(wrong)?.or_else(key_unit).unwrap_or(1.0),
    };
    let hz = number * unit;
    if hz.is_finite() && hz > 0.0 { Ok(hz) } else { Err(wrong()) }
}

fn unit_hz(word: &str) -> Option<f64> {
    match word.to_ascii_lowercase().as_str() {
        "hz" => Some(1.0),
        "khz" => Some(1e3),
        // mHz in lower case is meant as megahertz; millihertz do not occur.
        "mhz" if word.starts_with('M') || word.chars().all(char::is_lowercase) => Some(1e6),
        "ghz" => Some(1e9),
        _ => None,
    }
}

/// Unit of frequency in a comment, `Some(None)` if there is none; `None` if there are several and none in brackets.
fn comment_unit_hz(comment: &str) -> Option<Option<f64>> {
    let bracketed = comment.split_once('[').and_then(|(_, rest)| rest.split_once(']'));
    if let Some(unit) = bracketed.and_then(|(unit, _)| unit_hz(unit.trim())) {
        return Some(Some(unit));
    }
    let mut units: Vec<f64> = comment.split(|c: char| !c.is_alphabetic()).filter_map(unit_hz).collect();
    units.dedup();
    match units[..] {
        [] => Some(None),
        [unit] => Some(Some(unit)),
        _ => None,
    }
}

/// Finds a frequency within a text, such as `T_10MHz` or `3.0 MHz`, Hz.
fn hz_in(text: &str) -> Option<f64> {
    let at = text.to_ascii_lowercase().find("hz")?;
    let before = &text[..at];
    let prefix = before.chars().next_back().filter(|c| "kKMmG".contains(*c));
    let unit = unit_hz(
        &prefix.map_or_else(|| "Hz".to_owned(), |prefix| format!("{prefix}Hz").replace("mHz", "MHz")),
    )?;
    let number = before[..before.len() - prefix.map_or(0, char::len_utf8)].trim_end_matches([' ', '_', '-']);
    let start = number.rfind(|c: char| !c.is_ascii_digit() && c != '.').map_or(0, |at| at + 1);
    let number: f64 = number.get(start..)?.parse().ok()?;
    (number > 0.0 && number.is_finite()).then_some(number * unit)
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum MapUnit {
    /// Multiple of 1 K.
    Kelvin(f64),
    /// Multiple of 1 Jy/sr, which at a frequency is a temperature: T = I c^2 / (2 k nu^2).
    JanskyPerSr(f64),
}

impl MapUnit {
    /// Parses the name of a unit; `None` for a unit of another quantity. A map without a unit is in K.
    pub(super) fn parse(unit: &str) -> Option<Self> {
        let unit = unit.trim().trim_matches(['[', ']', '(', ')']).trim();
        if unit.is_empty() {
            return Some(Self::Kelvin(1.0));
        }
        let prefixes = [
            ("", 1.0),
            ("m", 1e-3),
            ("milli", 1e-3),
            ("u", 1e-6),
            ("\u{b5}", 1e-6),
            ("\u{3bc}", 1e-6),
            ("mu", 1e-6),
            ("micro", 1e-6),
            ("k", 1e3),
            ("M", 1e6),
            ("G", 1e9),
        ];
        prefixes.iter().find_map(|&(prefix, factor)| {
            let base = unit.strip_prefix(prefix)?;
            if is_kelvin(base) {
                return Some(Self::Kelvin(factor));
            }
            is_jansky_per_sr(base).then_some(Self::JanskyPerSr(factor))
        })
    }

    /// Factor from this unit to K at a frequency; `None` if the factor depends on the frequency and it is unknown.
    pub(super) fn kelvin(self, frequency_hz: Option<f64>) -> Option<f64> {
        match self {
            Self::Kelvin(factor) => Some(factor),
            Self::JanskyPerSr(factor) => {
                let wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz?;
                Some(factor * 1e-26 * wavelength_m.powi(2) / (2.0 * BOLTZMANN_J_K))
            }
        }
    }
}

fn is_kelvin(base: &str) -> bool {
    ["Kelvins", "kelvins", "Kelvin", "kelvin", "KELVIN", "K"].iter().any(|name| {
        let kind = base.strip_prefix(name).map(|kind| kind.trim_matches(['_', '-', ' ', '(', ')', '[', ']']));
        kind.is_some_and(|kind| KINDS_OF_KELVIN.contains(&kind.to_ascii_lowercase().as_str()))
    })
}

fn is_jansky_per_sr(base: &str) -> bool {
    let base: String = base.chars().filter(|c| !" .*^_".contains(*c)).collect();
    ["Jy/sr", "Jysr-1", "JY/SR", "jy/sr", "Jy/steradian"].contains(&base.as_str())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(cards: &[Card]) -> Header {
        Header::of(cards.to_vec())
    }

    #[test]
    fn frequencies_have_their_units() {
        for (card, hz) in [
            (Card::real("FREQ", 1e7, "[Hz] centre frequency"), 1e7),
            (Card::real("FREQ", 408.0, "MHz"), 408e6),
            (Card::integer("FREQ", 22, "frequency in MHz"), 22e6),
            (Card::text("FREQ", "408 MHz", ""), 408e6),
            (Card::text("FREQ", "4.08D2", "[MHz]"), 408e6),
            (Card::text("FREQUENCY", "1.42GHz", ""), 1.42e9),
            (Card::real("RESTFRQ", 3e6, ""), 3e6),
        ] {
            let found = frequency_hz(&header(std::slice::from_ref(&card)), 1).unwrap().unwrap();
            assert!((found / hz - 1.0).abs() < 1e-12, "{card:?}: {found}");
        }
        let with_key = [Card::real("FREQ", 408.0, ""), Card::text("FREQUNIT", "MHz", "")];
        assert_eq!(frequency_hz(&header(&with_key), 1).unwrap(), Some(408e6));
        for wrong in [
            Card::text("FREQ", "about 10", ""),
            Card::text("FREQ", "10 parsecs", ""),
            Card::real("FREQ", -1.0, ""),
            Card::real("FREQ", 10.0, "Hz or MHz"),
            Card::logical("FREQ", true, ""),
        ] {
            assert!(frequency_hz(&header(std::slice::from_ref(&wrong)), 1).is_err(), "{wrong:?}");
        }
        let two = [Card::real("FREQ", 1e7, "Hz"), Card::text("FREQ", "408 MHz", "")];
        assert!(
            frequency_hz(&header(&two), 1).unwrap_err().to_string().contains("as the headers say elsewhere")
        );
        assert_eq!(frequency_hz(&header(&[]), 1).unwrap(), None);
    }

    #[test]
    fn columns_say_their_frequencies() {
        let cards = [
            Card::text("TTYPE1", "T_1MHz", ""),
            Card::text("TTYPE2", "TEMPERATURE", "map at 3.5 MHz"),
            Card::text("TTYPE3", "N_OBS", "number of observations"),
            Card::text("TTYPE4", "30000 kHz", ""),
            Card::real("FREQ3", 10.0, "MHz"),
        ];
        let found: Vec<_> = (1..=5).map(|column| column_hz(&header(&cards), column).unwrap()).collect();
        assert_eq!(found, [Some(1e6), Some(3.5e6), Some(1e7), Some(3e7), None]);
    }

    #[test]
    fn units_are_those_of_the_table() {
        let kelvin = |unit| MapUnit::parse(unit).and_then(|unit| unit.kelvin(None));
        for (unit, factor) in [
            ("", 1.0),
            ("K", 1.0),
            ("Kelvin", 1.0),
            ("Kcmb", 1.0),
            ("K_CMB", 1.0),
            ("KRJ", 1.0),
            ("K_RJ", 1.0),
            ("K (Rayleigh", f64::NAN),
            ("mK", 1e-3),
            ("[uK]", 1e-6),
            ("\u{b5}K_CMB", 1e-6),
            ("MK", 1e6),
            ("K km/s", f64::NAN),
            ("K_RJ km/s", f64::NAN),
            ("K^2", f64::NAN),
            ("K-1", f64::NAN),
            ("k", f64::NAN),
            ("Jy/beam", f64::NAN),
            ("log10(K)", f64::NAN),
        ] {
            assert_eq!(kelvin(unit), (!factor.is_nan()).then_some(factor), "{unit}");
        }
        // 1 MJy/sr at 408 MHz is 195.5 K: c^2 / (2 k nu^2) times 1e-20, by hand.
        let found = MapUnit::parse("MJy/sr").unwrap().kelvin(Some(408e6)).unwrap();
        let by_hand = 1e-20 * (299_792_458.0_f64 / 408e6).powi(2) / (2.0 * 1.380_649e-23);
        assert!((found / by_hand - 1.0).abs() < 1e-12 && (found - 195.5).abs() < 0.1, "{found}");
        assert_eq!(MapUnit::parse("MJy sr^-1"), Some(MapUnit::JanskyPerSr(1e6)));
        assert_eq!(kelvin("MJy/sr"), None);
    }
}
