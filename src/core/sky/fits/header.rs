//! FITS headers: cards up to END, in blocks of 2880 bytes.

use std::io::{Read, Seek, SeekFrom};

use super::card::{CARD_BYTES, Card, CardValue};
use super::error::FitsProblem;

/// Length of a FITS block, bytes: files consist of whole blocks.
pub(super) const BLOCK_BYTES: usize = 2880;
/// Maximum number of cards in a header; map files have tens.
const CARDS_MAX: usize = 36 * 1000;

/// Cards of a header that have values, and its comments.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Header {
    cards: Vec<Card>,
    /// Keywords and texts of COMMENT and HISTORY cards.
    comments: Vec<(&'static str, String)>,
}

impl Header {
    /// Reads a header that starts at byte `start` of a file of `length` bytes; also returns the offset of its data.
    pub(super) fn read(
        reader: &mut (impl Read + Seek),
        start: u64,
        length: u64,
    ) -> Result<(Self, u64), FitsProblem> {
        reader.seek(SeekFrom::Start(start)).map_err(FitsProblem::io("seek"))?;
        let (mut cards, mut comments) = (Vec::<Card>::new(), Vec::new());
        let mut block = [0_u8; BLOCK_BYTES];
        for count in 1..=CARDS_MAX * CARD_BYTES / BLOCK_BYTES {
            let needed = start + (count * BLOCK_BYTES) as u64;
            if needed > length {
                return Err(FitsProblem::Truncated { expected: "a header block", needed, length });
            }
            reader.read_exact(&mut block).map_err(FitsProblem::io("read"))?;
            for card in block.as_chunks::<CARD_BYTES>().0 {
                if card.starts_with(b"END     ") {
                    return Ok((Self { cards, comments }, needed));
                }
                let is = |keyword: &&str| card.starts_with(keyword.as_bytes()) && card[7] == b' ';
                if let Some(keyword) = ["COMMENT", "HISTORY"].into_iter().find(is) {
                    comments.push((keyword, String::from_utf8_lossy(&card[8..]).trim().to_owned()));
                } else if let Some(card) = Card::parse(card) {
                    push(&mut cards, card);
                }
            }
        }
        Err(FitsProblem::EndlessHeader { start, limit: CARDS_MAX })
    }

    /// All cards with values, in order.
    #[must_use]
    pub fn cards(&self) -> &[Card] {
        &self.cards
    }

    /// Appends the cards of the file's primary header, which may have metadata that the table's header lacks.
    pub(super) fn with_primary(mut self, primary: Self) -> Self {
        self.cards.extend(primary.cards);
        self.comments.extend(primary.comments);
        self
    }

    #[cfg(test)]
    pub(super) fn of(cards: Vec<Card>) -> Self {
        Self { cards, comments: Vec::new() }
    }

    /// Keywords and texts of the COMMENT and HISTORY cards, in order.
    pub(super) fn comments(&self) -> &[(&'static str, String)] {
        &self.comments
    }

    pub(super) fn card(&self, key: &str) -> Option<&Card> {
        self.cards.iter().find(|card| card.key == key)
    }

    /// Returns the value of a keyword's first card.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&CardValue> {
        self.card(key).map(|card| &card.value)
    }

    /// Returns the text of a keyword; `None` for a number.
    #[must_use]
    pub fn text(&self, key: &str) -> Option<&str> {
        match self.get(key)? {
            CardValue::Text(text) => Some(text.trim()),
            _ => None,
        }
    }

    /// Returns the number of a keyword; `None` for a text.
    #[must_use]
    pub fn real(&self, key: &str) -> Option<f64> {
        match self.get(key)? {
            CardValue::Integer(value) => Some(*value as f64),
            CardValue::Real(value) => Some(*value),
            _ => None,
        }
    }

    /// Returns the number of an optional keyword, also of one in quotes, as some software writes it.
    pub(super) fn number(&self, key: &str) -> Result<Option<f64>, FitsProblem> {
        let Some(found) = self.get(key) else { return Ok(None) };
        let number = self.real(key).or_else(|| self.text(key)?.parse().ok());
        number.map(Some).ok_or_else(|| FitsProblem::keyword(key, found, "a number"))
    }

    /// Returns an optional keyword, which must be an integer of at least 0.
    pub(super) fn count(&self, key: &str) -> Result<Option<u64>, FitsProblem> {
        let wrong = |found: &CardValue| FitsProblem::keyword(key, found, "an integer of at least 0");
        match self.get(key) {
            None => Ok(None),
            Some(found @ CardValue::Integer(value)) => {
                u64::try_from(*value).map(Some).map_err(|_| wrong(found))
            }
            Some(CardValue::Real(value)) if *value >= 0.0 && *value < 1e15 && value.fract() == 0.0 => {
                Ok(Some(*value as u64))
            }
            Some(found) => Err(wrong(found)),
        }
    }

    /// Returns a required keyword, which must be an integer of at least 0.
    pub(super) fn required_count(&self, key: &str) -> Result<u64, FitsProblem> {
        self.count(key)?.ok_or_else(|| FitsProblem::missing(key, "an integer of at least 0"))
    }

    /// Length of the data after the header, bytes, without padding (FITS Standard 4.0, Eqs. 1 and 2).
    pub(super) fn data_bytes(&self) -> Result<u64, FitsProblem> {
        let axes = self.required_count("NAXIS")?;
        if axes == 0 {
            return Ok(0);
        }
        if axes > 999 {
            return Err(FitsProblem::keyword("NAXIS", axes, "0 to 999"));
        }
        let bits = self.real("BITPIX").unwrap_or(0.0).abs();
        if ![8.0, 16.0, 32.0, 64.0].contains(&bits) {
            return Err(FitsProblem::keyword("BITPIX", bits, "8, 16, 32, 64, -32 or -64"));
        }
        let mut values = Some(1_u64);
        for axis in 1..=axes {
            let length = self.required_count(&format!("NAXIS{axis}"))?;
            values = values.and_then(|values| values.checked_mul(length));
        }
        let heap = self.count("PCOUNT")?.unwrap_or(0);
        let groups = self.count("GCOUNT")?.unwrap_or(1);
        values
            .and_then(|values| values.checked_add(heap)?.checked_mul(groups)?.checked_mul(bits as u64 / 8))
            .filter(|&bytes| bytes <= i64::MAX as u64)
            .ok_or_else(|| FitsProblem::keyword("NAXISn", "out of range", "a size that a file can have"))
    }
}

/// Appends a card, or joins a CONTINUE card to the previous text.
fn push(cards: &mut Vec<Card>, card: Card) {
    if card.key != "CONTINUE" {
        cards.push(card);
        return;
    }
    if let (Some(Card { value: CardValue::Text(text), comment, .. }), CardValue::Text(more)) =
        (cards.last_mut(), card.value)
        && text.ends_with('&')
    {
        text.pop();
        text.push_str(&more);
        *comment = card.comment;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    fn bytes_of(cards: &[Card]) -> Vec<u8> {
        let mut bytes = Vec::new();
        for card in cards {
            card.write_to(&mut bytes).unwrap();
        }
        bytes.extend_from_slice(b"END");
        bytes.resize(bytes.len().next_multiple_of(BLOCK_BYTES), b' ');
        bytes
    }

    #[test]
    fn long_texts_are_continued() {
        for length in [67, 68, 69, 135, 136, 500] {
            for quote_every in [1, 2, 5, 67, 1000] {
                let text: String =
                    (1..=length).map(|k| if k % quote_every == 0 { '\'' } else { 'a' }).collect();
                let cards = [Card::text("LONG", &text, "why"), Card::integer("NEXT", 1, "")];
                let bytes = bytes_of(&cards);
                let length = bytes.len() as u64;
                let (header, end) = Header::read(&mut Cursor::new(&bytes), 0, length).unwrap();
                assert_eq!(header.text("LONG"), Some(text.as_str()));
                assert_eq!(header.count("NEXT").unwrap(), Some(1));
                assert_eq!(end, length);
            }
        }
    }

    #[test]
    fn forged_sizes_are_errors() {
        for (key, value) in [("NAXIS1", i64::MAX), ("NAXIS1", -1), ("PCOUNT", i64::MAX), ("NAXIS", 1 << 60)] {
            let mut cards = vec![Card::integer(key, value, "")];
            for (key, value) in
                [("BITPIX", 8), ("NAXIS", 2), ("NAXIS1", 4), ("NAXIS2", 1 << 40), ("GCOUNT", 1)]
            {
                cards.push(Card::integer(key, value, ""));
            }
            let header = Header::of(cards);
            assert!(header.data_bytes().is_err(), "{key} = {value}");
        }
    }
}
