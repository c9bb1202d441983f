//! What the keywords of a header say of a map: unit, pixelisation, columns, nside, order, frame.

use super::card::{Card, CardValue};
use super::error::FitsProblem;
use super::header::Header;
use super::table::{CellType, ColumnLayout, TableLayout};
use crate::sky::Frame;
use crate::sky::healpix::{is_valid_nside, nside_of};

pub(super) fn unit(header: &Header, column: usize) -> Result<String, FitsProblem> {
    let key = format!("TUNIT{column}");
    match header.get(&key) {
        None => Ok(String::new()),
        Some(CardValue::Text(text)) => Ok(text.trim().to_owned()),
        Some(other) => Err(FitsProblem::keyword(&key, other, "a unit such as 'K'")),
    }
}

/// Requires HEALPix pixels, if the header states the pixelisation.
pub(super) fn check_pixels(header: &Header) -> Result<(), FitsProblem> {
    match header.get("PIXTYPE") {
        None => Ok(()),
        Some(CardValue::Text(text)) if text.trim().eq_ignore_ascii_case("HEALPIX") => Ok(()),
        Some(other) => Err(FitsProblem::keyword("PIXTYPE", other, "'HEALPIX'")),
    }
}

/// Whether the table gives pixel numbers, from INDXSCHM or else OBJECT.
pub(super) fn is_explicit(header: &Header) -> Result<bool, FitsProblem> {
    match (header.text("INDXSCHM"), header.text("OBJECT")) {
        (Some("EXPLICIT"), _) => Ok(true),
        (Some("IMPLICIT"), Some("PARTIAL")) => {
            Err(FitsProblem::keyword("INDXSCHM", "'IMPLICIT' with OBJECT 'PARTIAL'", "EXPLICIT for that"))
        }
        (Some("IMPLICIT"), _) => Ok(false),
        (None, object) => Ok(object == Some("PARTIAL")),
        (Some(other), _) => Err(FitsProblem::keyword("INDXSCHM", other, "IMPLICIT or EXPLICIT")),
    }
}

/// Returns the column of pixel numbers, if there is one, and the column of the map.
pub(super) fn choose_columns(
    table: &TableLayout,
    explicit: bool,
    column: usize,
) -> Result<(Option<&ColumnLayout>, &ColumnLayout), FitsProblem> {
    let (index, maps) = match table.columns.split_first() {
        Some((first, rest)) if explicit => (Some(first), rest),
        _ => (None, table.columns.as_slice()),
    };
    let no_column = || FitsProblem::NoColumn { column, columns: maps.len() };
    let map = maps.get(column).ok_or_else(no_column)?;
    let key = |number: usize| format!("TFORM{number}");
    if map.cell == CellType::Other || map.repeat == 0 {
        let found = format!("no numbers ({} cells)", map.repeat);
        let number = column + 1 + usize::from(explicit);
        return Err(FitsProblem::keyword(&key(number), found, "B, I, J, K, E or D cells"));
    }
    if let Some(index) = index
        && !(index.is_integer() && index.repeat == map.repeat)
    {
        let expected = "one integer pixel number for every value";
        return Err(FitsProblem::keyword(&key(1), format!("{} cells", index.repeat), expected));
    }
    Ok((index, map))
}

/// The value of a keyword in either header; both have to say the same.
fn stated_once<T: PartialEq>(
    header: &Header,
    key: &str,
    parse: impl Fn(&CardValue) -> Result<T, FitsProblem>,
) -> Result<Option<T>, FitsProblem> {
    let mut known: Option<(&CardValue, T)> = None;
    for Card { value: found, .. } in header.cards().iter().filter(|card| card.key == key) {
        let value = parse(found)?;
        if let Some((other, _)) = known.as_ref().filter(|(_, known)| *known != value) {
            return Err(FitsProblem::keyword(key, found, format!("{other}, as the headers say elsewhere")));
        }
        known = Some((found, value));
    }
    Ok(known.map(|(_, value)| value))
}

pub(super) fn nside(header: &Header, cells: u64, explicit: bool) -> Result<usize, FitsProblem> {
    let expected = "a power of two from 1 to 8192";
    let Some(nside) = header.count("NSIDE")? else {
        let known = if explicit { None } else { usize::try_from(cells).ok().and_then(nside_of) };
        return known.ok_or_else(|| FitsProblem::missing("NSIDE", expected));
    };
    stated_once(header, "NSIDE", |found| match found {
        CardValue::Integer(value) => Ok(*value as f64),
        CardValue::Real(value) => Ok(*value),
        other => Err(FitsProblem::keyword("NSIDE", other, expected)),
    })?;
    match usize::try_from(nside) {
        Ok(nside) if is_valid_nside(nside) => Ok(nside),
        _ => Err(FitsProblem::keyword("NSIDE", nside, expected)),
    }
}

fn is_one_of<const N: usize>(text: &str, names: [&str; N]) -> bool {
    names.iter().any(|name| text.trim().eq_ignore_ascii_case(name))
}

/// Whether the pixels are in NESTED order; `None` if the header does not say.
pub(super) fn stated_nested(header: &Header) -> Result<Option<bool>, FitsProblem> {
    stated_once(header, "ORDERING", |found| match found {
        CardValue::Text(text) if is_one_of(text, ["RING"]) => Ok(false),
        CardValue::Text(text) if is_one_of(text, ["NEST", "NESTED"]) => Ok(true),
        other => Err(FitsProblem::keyword("ORDERING", other, "RING or NESTED")),
    })
}

/// The frame that COORDSYS and SKYCOORD of both headers name, or else `if_missing`, and whether it is that one.
pub(super) fn frame(header: &Header, if_missing: Option<Frame>) -> Result<(Frame, bool), FitsProblem> {
    let mut named: Option<Frame> = None;
    for Card { key, value, .. } in header.cards() {
        let frame = match value {
            CardValue::Text(text) => Frame::from_coordsys(text),
            _ => None,
        };
        match (key.as_str(), frame) {
            ("COORDSYS", None) => return Err(FitsProblem::keyword(key, value, "'E', 'G' or 'C'")),
            ("COORDSYS" | "SKYCOORD", Some(frame)) => {
                if let Some(other) = named.filter(|other| *other != frame) {
                    let expected = format!("{other}, as the headers say elsewhere");
                    return Err(FitsProblem::keyword(key, value, expected));
                }
                named = Some(frame);
            }
            _ => {}
        }
    }
    let frame = named.or(if_missing).ok_or(FitsProblem::NoFrame)?;
    if frame != Frame::Galactic {
        require_j2000(header)?;
    }
    Ok((frame, named.is_none()))
}

/// Requires axes of J2000 or ICRS, where the header says which: those of B1950 differ by 0.6 degrees.
fn require_j2000(header: &Header) -> Result<(), FitsProblem> {
    let expected = "2000 (FK5 or ICRS): convert the map to axes of J2000";
    for Card { key, value, .. } in header.cards() {
        let text = match value {
            CardValue::Text(text) => text.trim().to_ascii_uppercase(),
            other => other.to_string(),
        };
        let year = text.trim_start_matches(['J', 'B']).parse::<f64>().ok();
        let is_other = match key.as_str() {
            "EQUINOX" => year != Some(2000.0),
            // Often the date of the observation.
            "EPOCH" => year == Some(1950.0),
            "RADESYS" | "RADECSYS" => text.starts_with("FK4") || text == "GAPPT",
            _ => false,
        };
        if is_other {
            return Err(FitsProblem::keyword(key, value, expected));
        }
    }
    Ok(())
}
