//! Messages as XML (CCSDS 505.0-B), alone or within a navigation data message (NDM).

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::form::{Fault, Message, short};

/// Longest value that is kept, bytes: a number, a date or a name.
const VALUE_BYTES_MAX: usize = 1 << 10;

/// A state as its elements come.
#[derive(Default)]
struct State {
    epoch: String,
    numbers: [Option<f64>; 9],
}

/// Reads a message.
///
/// # Errors
/// The first thing that is wrong.
pub(super) fn parse<M: Message>(bytes: &[u8]) -> Result<(M, usize), Fault> {
    // Bytes that are no text may stand where nothing is read: in comments and names.
    let text = String::from_utf8_lossy(bytes);
    let mut reader = Reader::from_str(&text);
    let mut lines = LineCount { bytes: text.as_bytes(), place: 0, line: 1 };
    let mut elements = Elements::<M>::default();
    loop {
        let event = reader.read_event();
        let line = lines.at(reader.buffer_position());
        match event.map_err(|error| Fault::new(line, error.to_string(), "XML"))? {
            Event::Start(element) => elements.start(&element, line)?,
            Event::Text(text) => elements.text(&text),
            Event::End(element) => elements.end(element.local_name().as_ref(), line)?,
            Event::Eof => break,
            _ => {}
        }
    }
    match elements.depth {
        0 => Ok((elements.message, lines.line)),
        _ => Err(Fault::new(lines.line, "the end", "the ends of all elements")),
    }
}

/// Elements as they come.
#[derive(Default)]
struct Elements<M> {
    message: M,
    messages: usize,
    depth: usize,
    around: XmlContext,
    state: State,
    /// Text of the latest element.
    value: String,
}

impl<M: Message> Elements<M> {
    fn start(&mut self, element: &BytesStart<'_>, line: usize) -> Result<(), Fault> {
        self.depth += 1;
        self.value.clear();
        match element.local_name().as_ref() {
            name if name.eq_ignore_ascii_case(M::NAME) => {
                self.messages += 1;
                if self.messages > 1 {
                    return Err(Fault::new(line, format!("another {name}"), "one message a file"));
                }
            }
            name if self.depth == 1 && name != "ndm" => {
                let expected = format!("<{}>, alone or in <ndm>", M::NAME.to_ascii_lowercase());
                return Err(Fault::new(line, format!("<{}>", short(name)), expected));
            }
            "metadata" => {
                self.message.end_segment(line)?;
                self.message.begin_metadata();
                self.around = XmlContext::Metadata;
            }
            name if name == M::STATE => (self.around, self.state) = (XmlContext::State, State::default()),
            "covarianceMatrix" => {
                self.message.covariance();
                self.around = XmlContext::Nothing;
            }
            name if self.around == XmlContext::State => require_unit::<M>(element, name, line)?,
            _ => {}
        }
        Ok(())
    }

    fn text(&mut self, text: &str) {
        if self.value.len() + text.len() <= VALUE_BYTES_MAX {
            self.value.push_str(text);
        }
    }

    fn end(&mut self, name: &str, line: usize) -> Result<(), Fault> {
        self.depth = self.depth.saturating_sub(1);
        let value = self.value.trim();
        match (self.around, name) {
            (_, "metadata") => {
                self.message.end_metadata(line)?;
                self.around = XmlContext::Nothing;
            }
            (_, name) if name == M::STATE => {
                self.state.add_to(&mut self.message, line)?;
                self.around = XmlContext::Nothing;
            }
            (XmlContext::Metadata, _) => self.message.set(name, value, line)?,
            (XmlContext::State, _) => self.state.set::<M>(name, value, line)?,
            (XmlContext::Nothing, _) => {}
        }
        self.value.clear();
        Ok(())
    }
}

/// The element in which a value stands.
#[derive(Clone, Copy, Default, PartialEq)]
enum XmlContext {
    #[default]
    Nothing,
    Metadata,
    State,
}

impl State {
    fn set<M: Message>(&mut self, name: &str, value: &str, line: usize) -> Result<(), Fault> {
        let place = M::NUMBERS.iter().position(|known| *known == name);
        let is_given = match place {
            Some(place) => self.numbers[place].is_some(),
            None => name == "EPOCH" && !self.epoch.is_empty(),
        };
        if is_given {
            return Err(Fault::new(line, format!("{name} again"), "one of each in a state"));
        }
        if name == "EPOCH" {
            value.clone_into(&mut self.epoch);
        } else if let Some(place) = place {
            let Ok(number) = value.parse() else {
                return Err(Fault::new(line, format!("{name} = {}", short(value)), "a number"));
            };
            self.numbers[place] = Some(number);
        }
        Ok(())
    }

    fn add_to<M: Message>(&mut self, message: &mut M, line: usize) -> Result<(), Fault> {
        let State { epoch, numbers } = std::mem::take(self);
        let numbers: Vec<f64> = numbers.into_iter().map_while(|number| number).collect();
        message.named_state(&epoch, &numbers, line)
    }
}

/// Requires the unit of a number of a state, where it says one.
fn require_unit<M: Message>(element: &BytesStart<'_>, name: &str, line: usize) -> Result<(), Fault> {
    let number = M::NUMBERS.iter().position(|known| *known == name);
    let Some(expected) = number.and_then(M::unit) else { return Ok(()) };
    for attribute in element.attributes() {
        let attribute = attribute.map_err(|error| Fault::new(line, error.to_string(), "XML"))?;
        let unit = &attribute.value;
        if attribute.key.as_ref() == "units" && unit.trim() != expected {
            return Err(Fault::new(
                line,
                format!("{name} in {}", short(unit)),
                format!("units=\"{expected}\""),
            ));
        }
    }
    Ok(())
}

/// Lines of growing places.
struct LineCount<'a> {
    bytes: &'a [u8],
    place: usize,
    line: usize,
}

impl LineCount<'_> {
    fn at(&mut self, place: u64) -> usize {
        let place = usize::try_from(place).unwrap_or(usize::MAX).min(self.bytes.len());
        let passed = self.bytes.get(self.place..place).unwrap_or_default();
        self.line += passed.iter().filter(|byte| **byte == b'\n').count();
        self.place = place;
        self.line
    }
}
