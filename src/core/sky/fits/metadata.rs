//! Metadata of a map in its headers: frequency and unit.

use super::card::{Card, CardValue};
use super::error::FitsProblem;
use super::header::Header;
use crate::units::constants::{BOLTZMANN_J_K, SPEED_OF_LIGHT_M_S};
use crate::units::{Dimension, echo};

const FREQUENCY_KEYS: [&str; 5] = ["FREQ", "FREQUENCY", "OBSFREQ", "RESTFRQ", "RESTFREQ"];
/// Lowest frequency of a map, Hz: the number of a band or of gigahertz is less.
const FREQUENCY_HZ_MIN: f64 = 1e4;
/// Other keywords of a map's frequency, without blanks and underscores.
const OTHER_FREQUENCY_KEYS: [&str; 16] = [
    "NUREF",
    "REFNU",
    "REFFREQ",
    "FREQREF",
    "CENTFREQ",
    "CENFREQ",
    "CENTERFREQ",
    "CENTREFREQ",
    "CFREQ",
    "FREQCENT",
    "FREQ0",
    "OBSFREQ",
    "FREQOBS",
    "MAPFREQ",
    "MAPFREQUENCY",
    "SKYFREQ",
];
/// Parts of keywords of frequency, and those of keywords that are about ends, widths and steps of bands, samples and signals.
const FREQUENCY_WORDS: [&str; 3] = ["FREQ", "NUREF", "REFNU"];
const BAND_WORDS: [&str; 15] = [
    "MIN", "MAX", "LO", "HI", "WID", "RES", "STEP", "DEL", "INC", "BW", "UNIT", "TYPE", "DFREQ", "SAMP",
    "CAL",
];
const FREQUENCY_UNIT_KEYS: [&str; 3] = ["FREQUNIT", "FREQ_UNI", "UNITFREQ"];

/// Relative difference up to which two frequencies count as equal, as headers may lose digits.
const FREQUENCY_TOLERANCE: f64 = 1e-6;

/// Suffixes of kelvin in units of temperature: Rayleigh-Jeans, and thermodynamic at the CMB's.
const KINDS_OF_KELVIN: [&str; 5] = ["", "rj", "ant", "antenna", "b"];
const KINDS_OF_CMB_KELVIN: [&str; 3] = ["cmb", "thermo", "thermodynamic"];

/// Planck's constant over Boltzmann's times the CMB's temperature, 2.7255 K, s.
const PLANCK_OVER_CMB_S: f64 = 6.626_070_15e-34 / (BOLTZMANN_J_K * 2.7255);

/// Whether two frequencies, Hz, are equal within the tolerance.
pub(super) fn is_same_hz(one: f64, other: f64) -> bool {
    (one - other).abs() <= FREQUENCY_TOLERANCE * other
}

/// A frequency that a header states.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct StatedFrequency {
    pub hz: f64,
    /// The keyword that states it.
    pub keyword: String,
}

/// A frequency in a text of a header that need not be the map's.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct QuotedFrequency {
    pub hz: f64,
    /// The keyword of the text.
    pub keyword: String,
    /// The text, shortened.
    pub text: String,
}

/// Words in names of columns that are no maps of the sky's temperature: errors, numbers of observations and pixels, polarisation, spectral
/// indices, logarithms.
const OTHER_WORDS: [&str; 38] = [
    "UNCERTAINTY",
    "UNCERTAINTIES",
    "UNC",
    "SENSITIVITY",
    "EXPOSURE",
    "ALPHA",
    "BETA",
    "LOG",
    "LN",
    "SIGMA",
    "ERR",
    "ERROR",
    "ERRORS",
    "STD",
    "STDDEV",
    "STDEV",
    "RMS",
    "VAR",
    "VARIANCE",
    "COV",
    "COVARIANCE",
    "NOISE",
    "NOBS",
    "HITS",
    "NHITS",
    "PIXEL",
    "PIX",
    "IPIX",
    "UNIQ",
    "INDEX",
    "WEIGHT",
    "WEIGHTS",
    "MASK",
    "Q",
    "U",
    "V",
    "POLARISATION",
    "POLARIZATION",
];

/// Whether the name of a column is that of a quantity beside the sky's temperature.
pub(super) fn is_other_quantity(name: &str) -> bool {
    let name = name.to_ascii_uppercase().replace("N_OBS", "NOBS");
    name.split(|c: char| !c.is_ascii_alphabetic()).any(|word| OTHER_WORDS.contains(&word))
}

/// Frequency of a column, from its own metadata ([`column_frequency`]), or else from FREQ in either header, or else the only one of other
/// keywords; `None` if not stated. Columns count from 1, as in keywords. FREQ must be the frequency of a column, if columns state theirs;
/// others may be a reference.
pub(super) fn stated_frequency(
    header: &Header,
    column: usize,
) -> Result<Option<StatedFrequency>, FitsProblem> {
    let (own, of_file) = (column_frequency(header, column)?, file_frequency(header)?);
    if let (Some(own), Some(of_file)) = (&own, &of_file) {
        let columns = header.count("TFIELDS")?.map_or(column, |count| count.min(999) as usize);
        let mut is_known = false;
        for other in 1..=columns.max(column) {
            is_known |=
                column_frequency(header, other)?.is_some_and(|other| is_same_hz(other.hz, of_file.hz));
        }
        if !is_known {
            return Err(contradiction(of_file, own));
        }
    }
    let mut others = other_frequencies(header).filter(|(card, _)| {
        OTHER_FREQUENCY_KEYS.contains(&card.key.to_ascii_uppercase().replace([' ', '_'], "").as_str())
    });
    let other = others.next().filter(|first| others.all(|(_, other)| is_same_hz(other.hz, first.1.hz)));
    Ok(own.or(of_file).or(other.map(|(_, found)| found)))
}

/// Frequency in the metadata of a column: FREQn, its name (such as `10MHz`), or the comment of the name.
pub(super) fn column_frequency(
    header: &Header,
    column: usize,
) -> Result<Option<StatedFrequency>, FitsProblem> {
    let stated = |card: &Card, hz| StatedFrequency { hz, keyword: card.key.clone() };
    if let Some(card) = header.card(&format!("FREQ{column}")) {
        return stated_hz(header, card).map(|hz| Some(stated(card, hz)));
    }
    let Some(card) = header.card(&format!("TTYPE{column}")) else { return Ok(None) };
    let name = header.text(&card.key).and_then(hz_in);
    Ok(name.or_else(|| hz_in(&card.comment)).map(|hz| stated(card, hz)))
}

/// Frequency in FREQ of either header, in keywords like it, or of an axis of frequency, which must not contradict each other.
fn file_frequency(header: &Header) -> Result<Option<StatedFrequency>, FitsProblem> {
    let mut known: Option<StatedFrequency> = None;
    let axes = header.cards().iter().filter_map(|card| match (card.key.strip_prefix("CTYPE"), &card.value) {
        (Some(axis), CardValue::Text(text)) if text.starts_with("FREQ") => {
            header.card(&format!("CRVAL{axis}"))
        }
        _ => None,
    });
    for card in header.cards().iter().filter(|card| states_frequency(card)).chain(axes) {
        let found = StatedFrequency { hz: stated_hz(header, card)?, keyword: card.key.clone() };
        if let Some(other) = known.as_ref().filter(|other| !is_same_hz(found.hz, other.hz)) {
            return Err(contradiction(&found, other));
        }
        known.get_or_insert(found);
    }
    Ok(known)
}

/// Frequencies in keywords that are no others' standard, such as NU_REF of Planck's component maps, CENTFREQ and OBS_FREQ.
fn other_frequencies(header: &Header) -> impl Iterator<Item = (&Card, StatedFrequency)> {
    header.cards().iter().filter_map(|card| {
        let key = card.key.to_ascii_uppercase().replace([' ', '_'], "");
        let has = |words: &[&str]| words.iter().any(|word| key.contains(word));
        let is_column = key.strip_prefix("FREQ").is_some_and(|rest| matches!(rest.parse(), Ok(1..=999)));
        if !has(&FREQUENCY_WORDS) || has(&BAND_WORDS) || is_column || is_width(&card.comment) {
            return None;
        }
        Some((card, StatedFrequency { hz: stated_hz(header, card).ok()?, keyword: card.key.clone() }))
    })
}

fn is_width(text: &str) -> bool {
    ["width", "resolution"].iter().any(|word| text.to_ascii_lowercase().contains(word))
}

/// Whether a keyword is of frequency: FREQ and its like, with a unit at the end (FREQ_MHZ), or NU with a unit.
fn states_frequency(card: &Card) -> bool {
    let has_unit = || match &card.value {
        CardValue::Text(text) => !frequencies_in(text).is_empty(),
        _ => matches!(comment_unit_hz(&card.comment), Some(Some(_))),
    };
    FREQUENCY_KEYS.contains(&card.key.as_str())
        || key_unit_hz(&card.key).is_some()
        || (card.key == "NU" && has_unit())
}

/// Unit at the end of a keyword, such as FREQMHZ, Hz.
fn key_unit_hz(key: &str) -> Option<f64> {
    unit_hz(key.strip_prefix("FREQ")?.trim_start_matches('_'))
}

/// The frequencies in texts of the headers: BAND, EXTNAME, OBJECT, TCOMM of the column, comments, history, and other keywords of
/// frequency. Widths are none.
pub(super) fn quoted_frequencies(header: &Header, column: usize) -> Vec<QuotedFrequency> {
    let of_column = format!("TCOMM{column}");
    let of_cards = header.cards().iter().filter_map(|card| match &card.value {
        CardValue::Text(text) if ["BAND", "EXTNAME", "OBJECT", &of_column].contains(&card.key.as_str()) => {
            Some((card.key.as_str(), text.as_str()))
        }
        _ => None,
    });
    let quoted = |(card, StatedFrequency { hz, keyword }): (&Card, StatedFrequency)| QuotedFrequency {
        hz,
        keyword,
        text: echo(card.value.to_string().trim_matches('\'')),
    };
    let mut found: Vec<QuotedFrequency> = other_frequencies(header).map(quoted).collect();
    let comments = header.comments().iter().map(|(keyword, text)| (*keyword, text.as_str()));
    for (keyword, text) in of_cards.chain(comments).filter(|(_, text)| !is_width(text)) {
        found.extend(frequencies_in(text).into_iter().map(|hz| QuotedFrequency {
            hz,
            keyword: keyword.to_owned(),
            text: echo(text),
        }));
    }
    found
}

/// Refuses a map that states no frequency, if its header names exactly one and that is not `wanted_hz`.
pub(super) fn check_quoted(quoted: &[QuotedFrequency], wanted_hz: f64) -> Result<(), FitsProblem> {
    let Some(QuotedFrequency { hz, keyword, text }) = quoted.first() else { return Ok(()) };
    if is_same_hz(*hz, wanted_hz) || quoted.iter().any(|other| !is_same_hz(other.hz, *hz)) {
        return Ok(());
    }
    let expected = format!(
        "{}, the channel's: give a map of that frequency, or state the map's own as FREQ in its header, which counts before other texts",
        Dimension::Frequency.show(wanted_hz)
    );
    Err(FitsProblem::keyword(keyword, format!("'{text}'"), expected))
}

fn contradiction(found: &StatedFrequency, other: &StatedFrequency) -> FitsProblem {
    let [hz, other_hz] = [found.hz, other.hz].map(|hz| Dimension::Frequency.show(hz));
    let expected = format!("{other_hz}, as {} says elsewhere in the headers", other.keyword);
    FitsProblem::keyword(&found.keyword, hz, expected)
}

/// Frequency of a card, Hz. Its unit is in the text, the comment or FREQUNIT; without a unit it is Hz.
fn stated_hz(header: &Header, card: &Card) -> Result<f64, FitsProblem> {
    let wrong = || {
        let found = format!("{} / {}", card.value, card.comment);
        FitsProblem::keyword(
            &card.key,
            found,
            "a positive number of 10 kHz or more, Hz, or with one unit, such as '408 MHz'",
        )
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
    let key_unit = || match card.key.strip_prefix("CRVAL") {
        Some(axis) => header.text(&format!("CUNIT{axis}")).and_then(unit_hz),
        None => key_unit_hz(&card.key)
            .or_else(|| FREQUENCY_UNIT_KEYS.iter().find_map(|key| header.text(key)).and_then(unit_hz)),
    };
    let unit = match own_unit {
        Some(unit) => unit,
        None => comment_unit_hz(&card.comment).ok_or_else(wrong)?.or_else(key_unit).unwrap_or(1.0),
    };
    let hz = number * unit;
    if hz.is_finite() && hz >= FREQUENCY_HZ_MIN { Ok(hz) } else { Err(wrong()) }
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

/// The first frequency in a text, Hz.
fn hz_in(text: &str) -> Option<f64> {
    frequencies_in(text).first().copied()
}

/// Finds the frequencies within a text, such as `T_10MHz` or `3.0 MHz`, Hz; of a range, the upper end and then the lower.
fn frequencies_in(text: &str) -> Vec<f64> {
    let mut found = Vec::new();
    for (at, _) in text.to_ascii_lowercase().match_indices("hz") {
        let before = &text[..at];
        let prefix = before.chars().next_back().filter(|c| "kKMmG".contains(*c));
        let unit =
            prefix.map_or_else(|| "Hz".to_owned(), |prefix| format!("{prefix}Hz").replace("mHz", "MHz"));
        let Some(unit) = unit_hz(&unit) else { continue };
        let mut rest = &before[..before.len() - prefix.map_or(0, char::len_utf8)];
        loop {
            let number = rest.trim_end_matches([' ', '_', '-']);
            let start = number.trim_end_matches(|c: char| c.is_ascii_digit() || c == '.').len();
            match number[start..].parse::<f64>() {
                Ok(number) if number > 0.0 && number.is_finite() => found.push(number * unit),
                _ => break,
            }
            rest = &number[..start];
            if !rest.ends_with('-') {
                break;
            }
        }
    }
    found
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum MapUnit {
    /// Multiple of 1 K.
    Kelvin(f64),
    /// Multiple of 1 K by which the CMB's 2.7255 K changes: at a frequency T = x^2 e^x / (e^x - 1)^2 of it, with x = h nu / k T. At
    /// 408 MHz 4e-6 less than 1, at 30 GHz 2 %.
    CmbKelvin(f64),
    /// Multiple of 1 Jy/sr, which at a frequency is a temperature: T = I c^2 / (2 k nu^2).
    JanskyPerSr(f64),
}

impl MapUnit {
    /// Parses the name of a unit; `None` for a unit of another quantity. A map without a unit is in K.
    pub(super) fn parse(unit: &str) -> Option<Self> {
        let unit = unit.trim().trim_matches(['[', ']', '(', ')']).trim();
        match unit {
            // PyGDSM's names of K_RJ and K_CMB.
            "" | "TRJ" => return Some(Self::Kelvin(1.0)),
            "TCMB" => return Some(Self::CmbKelvin(1.0)),
            _ => {}
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
            if is_kelvin(base, &KINDS_OF_KELVIN) {
                return Some(Self::Kelvin(factor));
            }
            if is_kelvin(base, &KINDS_OF_CMB_KELVIN) {
                return Some(Self::CmbKelvin(factor));
            }
            is_jansky_per_sr(base).then_some(Self::JanskyPerSr(factor))
        })
    }

    /// Factor from this unit to K at a frequency; `None` if the factor depends on the frequency and it is unknown.
    pub(super) fn kelvin(self, frequency_hz: Option<f64>) -> Option<f64> {
        match self {
            Self::Kelvin(factor) => Some(factor),
            // A map without a frequency is one of the channel's, where both agree.
            Self::CmbKelvin(factor) => Some(frequency_hz.map_or(factor, |hz| {
                let x = PLANCK_OVER_CMB_S * hz;
                factor * (x / x.exp_m1()).powi(2) * x.exp()
            })),
            Self::JanskyPerSr(factor) => {
                let wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz?;
                Some(factor * 1e-26 * wavelength_m.powi(2) / (2.0 * BOLTZMANN_J_K))
            }
        }
    }
}

fn is_kelvin(base: &str, kinds: &[&str]) -> bool {
    ["Kelvins", "kelvins", "Kelvin", "kelvin", "KELVIN", "K"].iter().any(|name| {
        let kind = base.strip_prefix(name).map(|kind| kind.trim_matches(['_', '-', ' ', '(', ')', '[', ']']));
        kind.is_some_and(|kind| kinds.contains(&kind.to_ascii_lowercase().as_str()))
    })
}

fn is_jansky_per_sr(base: &str) -> bool {
    let base: String = base.chars().filter(|c| !" .*^_".contains(*c)).collect();
    ["Jy/sr", "Jysr-1", "Jysr", "JY/SR", "jy/sr", "Jy/steradian"].contains(&base.as_str())
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
            (Card::real("FREQMHZ", 408.0, ""), 408e6),
            (Card::real("FREQ_MHZ", 408.0, "centre"), 408e6),
            (Card::real("NU", 408.0, "[MHz]"), 408e6),
            (Card::text("NU", "22 MHz", ""), 22e6),
        ] {
            let found = stated_frequency(&header(std::slice::from_ref(&card)), 1).unwrap().unwrap();
            assert!((found.hz / hz - 1.0).abs() < 1e-12, "{card:?}: {found:?}");
            assert_eq!(found.keyword, card.key);
        }
        let with_key = [Card::real("FREQ", 408.0, ""), Card::text("FREQUNIT", "MHz", "")];
        let found = stated_frequency(&header(&with_key), 1).unwrap();
        assert_eq!(found, Some(StatedFrequency { hz: 408e6, keyword: "FREQ".into() }));
        // An axis of frequency; a number that may be anything.
        let axis = |unit: &[Card]| {
            let cards = [Card::text("CTYPE3", "FREQ-LSR", ""), Card::real("CRVAL3", 408.0, "")];
            stated_frequency(&header(&[&cards[..], unit].concat()), 1).unwrap().unwrap()
        };
        let found = axis(&[Card::text("CUNIT3", "MHz", "")]);
        assert_eq!((found.hz, found.keyword.as_str()), (408e6, "CRVAL3"));
        let other = [
            Card::real("NU", 408.0, "number"),
            Card::real("CRVAL3", 408.0, ""),
            Card::integer("FREQS", 3, ""),
        ];
        assert_eq!(stated_frequency(&header(&other), 1).unwrap(), None);
        for wrong in [
            Card::text("FREQ", "about 10", ""),
            Card::text("FREQ", "10 parsecs", ""),
            Card::real("FREQ", -1.0, ""),
            // As Planck's: a band in GHz without its unit.
            Card::text("FREQ", "030", "Reference frequency"),
            Card::real("FREQ", 10.0, "Hz or MHz"),
            Card::logical("FREQ", true, ""),
        ] {
            assert!(stated_frequency(&header(std::slice::from_ref(&wrong)), 1).is_err(), "{wrong:?}");
        }
        let two = [Card::real("FREQ", 1e7, "Hz"), Card::text("FREQ", "408 MHz", "")];
        let said = stated_frequency(&header(&two), 1).unwrap_err().to_string();
        assert!(said.contains("FREQ is 408 MHz; expected 10 MHz, as FREQ says elsewhere"), "{said}");
        assert_eq!(stated_frequency(&header(&[]), 1).unwrap(), None);
        // FREQ of the file is that of one of its columns.
        let columns = |hz| {
            let names =
                [(1, "T_3MHz"), (2, "T_10MHz")].map(|(k, name)| Card::text(&format!("TTYPE{k}"), name, ""));
            header(
                &[&names[..], &[Card::real("OBSFREQ", hz, "Hz"), Card::integer("TFIELDS", 2, "")]].concat(),
            )
        };
        assert_eq!(stated_frequency(&columns(3e6), 2).unwrap().unwrap().hz, 10e6);
        let said = stated_frequency(&columns(5e6), 2).unwrap_err().to_string();
        assert!(said.contains("OBSFREQ is 5 MHz; expected 10 MHz, as TTYPE2 says"), "{said}");
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
        let of = |column| column_frequency(&header(&cards), column).unwrap();
        let found: Vec<_> = (1..=5).map(|column| of(column).map(|found| found.hz)).collect();
        assert_eq!(found, [Some(1e6), Some(3.5e6), Some(1e7), Some(3e7), None]);
    }

    #[test]
    fn texts_name_frequencies() {
        for (text, expected) in [
            ("HASLAM_408MHZ", &[408e6][..]),
            ("All-sky 408 MHz map", &[408e6]),
            ("10-20 MHz, and 1.4GHz", &[20e6, 10e6, 1.4e9]),
            ("LWA1-38 MHz", &[38e6, 1e6]),
            ("in Hz", &[]),
            ("0 MHz", &[]),
        ] {
            assert_eq!(frequencies_in(text), expected, "{text}");
        }
        let cards = [Card::text("OBJECT", "408 MHz sky", ""), Card::text("TCOMM2", "at 22 MHz", "")];
        let quoted = |column| quoted_frequencies(&header(&cards), column);
        assert_eq!((quoted(1).len(), quoted(2).len()), (1, 2));
        let said = check_quoted(&quoted(1), 10e6).unwrap_err().to_string();
        assert!(said.contains("OBJECT is '408 MHz sky'; expected 10 MHz") && said.contains("FREQ"), "{said}");
        assert!(check_quoted(&quoted(1), 408e6).is_ok() && check_quoted(&quoted(2), 10e6).is_ok());
        let width = [Card::text("BAND", "bandwidth 3 MHz", "")];
        assert_eq!(quoted_frequencies(&header(&width), 1), []);
    }

    #[test]
    fn names_of_other_quantities_are_no_maps() {
        for name in [
            "UNCERTAINTY",
            "Sensitivity",
            "LOG_T",
            "log10(T)",
            "SIGMA_10MHz",
            "t_err",
            "N_OBS",
            "nobs",
            "Hits",
            "PIXEL",
            "Q_POLARISATION",
            "II_COV",
            "STD10",
        ] {
            assert!(is_other_quantity(name), "{name}");
        }
        for name in ["T_10MHz", "TEMPERATURE", "I_STOKES", "", "SIGNAL", "T_OBS", "QUICKLOOK", "VALUE"] {
            assert!(!is_other_quantity(name), "{name}");
        }
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
            ("TRJ", 1.0),
            ("TCMB", 1.0),
            ("T", f64::NAN),
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
        // Planck's 30 GHz: x = 0.52826, from CODATA.
        let found = MapUnit::parse("K_CMB").unwrap().kelvin(Some(30e9)).unwrap();
        assert!((found - 0.977_066).abs() < 1e-6, "{found}");
        for unit in ["MJy sr^-1", "MJysr"] {
            assert_eq!(MapUnit::parse(unit), Some(MapUnit::JanskyPerSr(1e6)));
        }
        assert_eq!(kelvin("MJy/sr"), None);
    }
}
