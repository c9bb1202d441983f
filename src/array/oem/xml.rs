//! Messages as XML (CCSDS 505.0-B), alone or within a navigation data message (NDM).

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::message::{Collector, Fault, Reading, short};

/// Values of a state, in their order.
const STATE: [&str; 9] = ["X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT", "X_DDOT", "Y_DDOT", "Z_DDOT"];

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
pub(super) fn parse(bytes: &[u8]) -> Result<Reading, Fault> {
    // Bytes that are no text may stand where nothing is read: in comments and names.
    let text = String::from_utf8_lossy(bytes);
    let mut reader = Reader::from_str(&text);
    let mut lines = LineCount { bytes: text.as_bytes(), place: 0, line: 1 };
    let mut elements = Elements::default();
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
        0 => elements.collector.finish(lines.line),
        _ => Err(Fault::new(lines.line, "the end", "the ends of all elements")),
    }
}

/// Elements as they come.
#[derive(Default)]
struct Elements {
    collector: Collector,
    messages: usize,
    depth: usize,
    around: XmlContext,
    state: State,
    /// Text of the latest element.
    value: String,
}

impl Elements {
    fn start(&mut self, element: &BytesStart<'_>, line: usize) -> Result<(), Fault> {
        self.depth += 1;
        self.value.clear();
        match element.local_name().as_ref() {
            "oem" => {
                self.messages += 1;
                if self.messages > 1 {
                    return Err(Fault::new(line, "another oem", "one satellite a file"));
                }
            }
            name if self.depth == 1 && name != "ndm" => {
                return Err(Fault::new(line, format!("<{}>", short(name)), "<oem>, alone or in <ndm>"));
            }
            "metadata" => {
                self.collector.end_segment(line)?;
                self.collector.begin_metadata();
                self.around = XmlContext::Metadata;
            }
            "stateVector" => (self.around, self.state) = (XmlContext::State, State::default()),
            "covarianceMatrix" => {
                self.collector.covariances += 1;
                self.around = XmlContext::Nothing;
            }
            name if self.around == XmlContext::State => require_unit(element, name, line)?,
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
                self.collector.end_metadata(line)?;
                self.around = XmlContext::Nothing;
            }
            (_, "stateVector") => {
                self.state.add_to(&mut self.collector, line)?;
                self.around = XmlContext::Nothing;
            }
            (XmlContext::Metadata, _) => self.collector.set(name, value, line),
            (XmlContext::State, _) => self.state.set(name, value, line)?,
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
    fn set(&mut self, name: &str, value: &str, line: usize) -> Result<(), Fault> {
        if name == "EPOCH" {
            value.clone_into(&mut self.epoch);
        } else if let Some(place) = STATE.iter().position(|known| *known == name) {
            let Ok(number) = value.parse() else {
                return Err(Fault::new(line, format!("{name} = {}", short(value)), "a number"));
            };
            self.numbers[place] = Some(number);
        }
        Ok(())
    }

    fn add_to(&mut self, collector: &mut Collector, line: usize) -> Result<(), Fault> {
        let State { epoch, numbers } = std::mem::take(self);
        let numbers: Vec<f64> = numbers.into_iter().map_while(|number| number).collect();
        collector.state(&epoch, &numbers, line)
    }
}

/// Requires km and km/s, where a value of a state says its unit.
fn require_unit(element: &BytesStart<'_>, name: &str, line: usize) -> Result<(), Fault> {
    let expected = match STATE.iter().position(|known| *known == name) {
        Some(0..3) => "km",
        Some(3..6) => "km/s",
        _ => return Ok(()),
    };
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
