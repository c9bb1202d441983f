//! Header cards of 80 characters: a keyword, a value and a comment (FITS Standard 4.0, Sect. 4).

use std::fmt;

use super::error::FitsProblem;

pub(super) const CARD_BYTES: usize = 80;
/// Column at which fixed-format numbers end.
const VALUE_END: usize = 30;
/// Maximum number of characters between the quotes of one card.
const TEXT_MAX: usize = 68;

/// The value of a card.
#[derive(Clone, Debug, PartialEq)]
pub enum CardValue {
    /// Logical value, T or F.
    Logical(bool),
    /// Integer.
    Integer(i64),
    /// Finite real number.
    Real(f64),
    /// Printable ASCII text; text longer than a card is continued (CONTINUE cards).
    Text(String),
}

/// A keyword of a header with its value and comment.
#[derive(Clone, Debug, PartialEq)]
pub struct Card {
    /// Keyword of up to 8 characters A-Z, 0-9, `-` and `_`; of a HIERARCH card as it is read, what follows that word.
    pub key: String,
    /// Value.
    pub value: CardValue,
    /// Comment; truncated where it does not fit.
    pub comment: String,
}

impl fmt::Display for CardValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Logical(value) => f.write_str(if *value { "T" } else { "F" }),
            Self::Integer(value) => write!(f, "{value}"),
            Self::Real(value) => write!(f, "{value:?}"),
            Self::Text(text) => write!(f, "'{text}'"),
        }
    }
}

impl Card {
    /// Creates a card with a text.
    #[must_use]
    pub fn text(key: &str, value: &str, comment: &str) -> Self {
        Self { key: key.into(), value: CardValue::Text(value.into()), comment: comment.into() }
    }

    /// Creates a card with an integer.
    #[must_use]
    pub fn integer(key: &str, value: i64, comment: &str) -> Self {
        Self { key: key.into(), value: CardValue::Integer(value), comment: comment.into() }
    }

    /// Creates a card with a real number.
    #[must_use]
    pub fn real(key: &str, value: f64, comment: &str) -> Self {
        Self { key: key.into(), value: CardValue::Real(value), comment: comment.into() }
    }

    /// Creates a card with a logical value.
    #[must_use]
    pub fn logical(key: &str, value: bool, comment: &str) -> Self {
        Self { key: key.into(), value: CardValue::Logical(value), comment: comment.into() }
    }

    /// Appends the card and its continuation to a header.
    pub(super) fn write_to(&self, header: &mut Vec<u8>) -> Result<(), FitsProblem> {
        let fail = |reason| Err(FitsProblem::Card { key: self.key.clone(), reason });
        let allowed = |c: u8| c.is_ascii_uppercase() || c.is_ascii_digit() || c == b'-' || c == b'_';
        if self.key.is_empty() || self.key.len() > 8 || !self.key.bytes().all(allowed) {
            return fail("expected a keyword of 1 to 8 of A-Z, 0-9, - and _");
        }
        if !is_printable(&self.comment) {
            return fail("expected a comment of printable ASCII");
        }
        let field = match &self.value {
            CardValue::Real(value) if !value.is_finite() => return fail("expected a finite number"),
            CardValue::Real(value) => format!("{value:?}").to_uppercase(),
            CardValue::Text(text) if !is_printable(text) => return fail("expected printable ASCII"),
            CardValue::Text(text) => return self.write_text(text, header),
            other => other.to_string(),
        };
        let width = VALUE_END - 10;
        push_card(&format!("{:<8}= {field:>width$}", self.key), &self.comment, header);
        Ok(())
    }

    fn write_text(&self, text: &str, header: &mut Vec<u8>) -> Result<(), FitsProblem> {
        let escaped = text.replace('\'', "''");
        if escaped.len() <= TEXT_MAX {
            let quoted = format!("'{escaped:<8}'");
            let width = VALUE_END - 10;
            push_card(&format!("{:<8}= {quoted:<width$}", self.key), &self.comment, header);
            return Ok(());
        }
        // A piece must not end within a doubled quote.
        let mut rest = escaped.as_str();
        let mut start = format!("{:<8}= ", self.key);
        while rest.len() > TEXT_MAX {
            let mut cut = TEXT_MAX - 1;
            let quotes = rest[..cut].bytes().rev().take_while(|&c| c == b'\'').count();
            cut -= quotes % 2;
            push_card(&format!("{start}'{}&'", &rest[..cut]), "", header);
            rest = &rest[cut..];
            start = "CONTINUE  ".into();
        }
        push_card(&format!("{start}'{rest}'"), &self.comment, header);
        Ok(())
    }

    /// Reads one card; `None` if it has no value (comments, blank cards, anything unreadable).
    pub(super) fn parse(card: &[u8; CARD_BYTES]) -> Option<Self> {
        let text: String = card.iter().map(|&c| if c.is_ascii() { c as char } else { '?' }).collect();
        let (key, field) = match text.strip_prefix("HIERARCH ") {
            // ESO's convention of long keywords, in which astropy writes those of more than eight letters.
            Some(long) => long.split_once('=')?,
            None if text.starts_with("CONTINUE") || &text[8..10] == "= " => (&text[..8], &text[10..]),
            None => return None,
        };
        let (key, field) = (key.trim().to_owned(), field.trim_start());
        let (value, rest) = match field.strip_prefix('\'') {
            Some(quoted) => {
                let (text, rest) = unquote(quoted)?;
                (CardValue::Text(text), rest)
            }
            None => {
                let (word, rest) = field.split_at(field.find('/').unwrap_or(field.len()));
                (parse_word(word.trim())?, rest)
            }
        };
        let comment = rest.trim_start().strip_prefix('/').unwrap_or("").trim().to_owned();
        Some(Self { key, value, comment })
    }
}

fn is_printable(text: &str) -> bool {
    text.bytes().all(|c| (0x20..=0x7e).contains(&c))
}

/// Appends `field`, at most a card long, and as much of the comment as fits.
fn push_card(field: &str, comment: &str, header: &mut Vec<u8>) {
    let text = if comment.is_empty() { field.to_owned() } else { format!("{field} / {comment}") };
    let mut card = text.into_bytes();
    card.resize(CARD_BYTES, b' ');
    header.extend_from_slice(&card);
}

/// Returns the text up to the closing quote, unescaped and without trailing blanks, and the rest.
fn unquote(quoted: &str) -> Option<(String, &str)> {
    let mut text = String::new();
    let mut rest = quoted;
    loop {
        let (before, after) = rest.split_once('\'')?;
        text.push_str(before);
        match after.strip_prefix('\'') {
            Some(after) => {
                text.push('\'');
                rest = after;
            }
            None => return Some((text.trim_end().to_owned(), after)),
        }
    }
}

fn parse_word(word: &str) -> Option<CardValue> {
    match word {
        "T" => return Some(CardValue::Logical(true)),
        "F" => return Some(CardValue::Logical(false)),
        _ => {}
    }
    if let Ok(value) = word.parse() {
        return Some(CardValue::Integer(value));
    }
    let number = word.replace(['D', 'd'], "E");
    let value: f64 = number.parse().ok()?;
    value.is_finite().then_some(CardValue::Real(value))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(card: &Card) -> Vec<u8> {
        let mut bytes = Vec::new();
        card.write_to(&mut bytes).unwrap();
        assert_eq!(bytes.len() % CARD_BYTES, 0);
        bytes
    }

    #[test]
    fn cards_look_as_astropy_writes_them() {
        let shown = |card| String::from_utf8(written(&card)).unwrap().trim_end().to_owned();
        assert_eq!(
            shown(Card::text("INDXSCHM", "IMPLICIT", "Indexing: IMPLICIT or EXPLICIT")),
            "INDXSCHM= 'IMPLICIT'           / Indexing: IMPLICIT or EXPLICIT"
        );
        assert_eq!(
            shown(Card::integer("NSIDE", 64, "Resolution parameter of HEALPIX")),
            "NSIDE   =                   64 / Resolution parameter of HEALPIX"
        );
        assert_eq!(shown(Card::real("FREQ", 1e7, "Hz")), "FREQ    =           10000000.0 / Hz");
        assert_eq!(shown(Card::text("TUNIT1", "K", "")), "TUNIT1  = 'K       '");
    }

    #[test]
    fn cards_are_read_as_they_are_written() {
        let cards = [
            Card::text("A", "it's", "a comment / with a slash"),
            Card::text("B", "", ""),
            Card::integer("C-D_1", -17, "x"),
            Card::real("E", 1.25e-300, ""),
            Card::real("F", -3.0, "y"),
            Card::logical("G", true, "z"),
        ];
        for card in cards {
            let bytes = written(&card);
            assert_eq!(Card::parse(bytes.as_slice().try_into().unwrap()), Some(card));
        }
    }

    #[test]
    fn long_keywords_are_read() {
        let read = |text: &str| Card::parse(format!("{text:<80}").as_bytes().try_into().unwrap());
        // As astropy 8 writes them.
        assert_eq!(read("HIERARCH FREQUENCY = 408000000.0 / Hz"), Some(Card::real("FREQUENCY", 408e6, "Hz")));
        assert_eq!(
            read("HIERARCH map frequency = '408 = x' / y"),
            Some(Card::text("map frequency", "408 = x", "y"))
        );
        assert_eq!((read("HIERARCH"), read("HIERARCH no value")), (None, None));
    }

    #[test]
    fn what_fits_cannot_hold_is_refused() {
        for card in [
            Card::text("lower", "x", ""),
            Card::text("TOOLONGKEY", "x", ""),
            Card::text("", "x", ""),
            Card::text("A", "caf\u{e9}", ""),
            Card::text("A", "x", "\n"),
            Card::real("A", f64::NAN, ""),
        ] {
            assert!(card.write_to(&mut Vec::new()).is_err(), "{card:?}");
        }
    }
}
