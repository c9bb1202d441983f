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
    let mut collector = Collector::default();
    let mut state = State::default();
    let (mut messages, mut depth) = (0, 0_usize);
    // The elements around: what a value is of.
    let (mut around, mut value) = (Around::Nothing, String::new());
    loop {
        let event = reader.read_event();
        let line = lines.at(reader.buffer_position());
        let event = event.map_err(|error| Fault::new(line, error.to_string(), "XML"))?;
        match event {
            Event::Start(element) => {
                depth += 1;
                value.clear();
                let name = name_of(&element);
                match name.as_str() {
                    "oem" => {
                        messages += 1;
                        if messages > 1 {
                            return Err(Fault::new(line, "another oem", "one satellite a file"));
                        }
                    }
                    _ if depth == 1 && name != "ndm" => {
                        return Err(Fault::new(line, format!("<{name}>"), "<oem>, alone or in <ndm>"));
                    }
                    "metadata" => {
                        collector.end_segment(line)?;
                        collector.begin_metadata();
                        around = Around::Metadata;
                    }
                    "stateVector" => (around, state) = (Around::State, State::default()),
                    "covarianceMatrix" => {
                        collector.covariances += 1;
                        around = Around::Nothing;
                    }
                    _ if around == Around::State => require_unit(&element, &name, line)?,
                    _ => {}
                }
            }
            Event::Text(text) => {
                if value.len() + text.len() <= VALUE_BYTES_MAX {
                    value.push_str(&text);
                }
            }
            Event::End(element) => {
                depth = depth.saturating_sub(1);
                let name = element.local_name().as_ref().to_owned();
                match (around, name.as_str()) {
                    (_, "metadata") => {
                        collector.end_metadata(line)?;
                        around = Around::Nothing;
                    }
                    (_, "stateVector") => {
                        state.add_to(&mut collector, line)?;
                        around = Around::Nothing;
                    }
                    (Around::Metadata, _) => collector.set(&name, value.trim(), line),
                    (Around::State, _) => state.set(&name, value.trim(), line)?,
                    (Around::Nothing, _) => {}
                }
                value.clear();
            }
            Event::Eof => break,
            _ => {}
        }
    }
    let line = lines.line;
    if depth > 0 {
        return Err(Fault::new(line, "the end", "the ends of all elements"));
    }
    collector.finish(line)
}

/// What is around a value.
#[derive(Clone, Copy, PartialEq)]
enum Around {
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

fn name_of(element: &BytesStart<'_>) -> String {
    element.local_name().as_ref().to_owned()
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
