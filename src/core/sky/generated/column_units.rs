//! Units of a catalogue's columns: in the row of units, in comments, in brackets after the name, and at the name's end, which have to agree.

use super::columns::normalise;

/// Names of units of angles, without case, and their degrees; `NaN` for hours.
const ANGLES: [(&[&str], f64); 5] = [
    (&["deg", "degree", "degrees", "d:m:s", "d m s", "dms", "\u{b0}"], 1.0),
    (&["h", "hr", "hour", "hours", "hourangle", "h:m:s", "h m s", "hms"], f64::NAN),
    (&["rad", "radian", "radians"], 180.0 / std::f64::consts::PI),
    (&["arcmin", "arcminute", "arcminutes"], 1.0 / 60.0),
    (&["arcsec", "arcsecond", "arcseconds"], 1.0 / 3600.0),
];
const FLUXES: [(&[&str], f64); 2] = [(&["jy"], 1.0), (&["mjy"], 1e-3)];
const FREQUENCIES: [(&[&str], f64); 4] = [(&["hz"], 1.0), (&["khz"], 1e3), (&["mhz"], 1e6), (&["ghz"], 1e9)];

/// Words that stand for the columns of positions and of fluxes in comments.
pub(super) const POSITION_WORDS: [&str; 3] = ["positions", "coordinates", "angles"];
pub(super) const FLUX_WORDS: [&str; 4] = ["flux", "fluxes", "density", "densities"];

fn value_of(units: &[(&[&str], f64)], unit: &str) -> Option<f64> {
    units.iter().find(|(names, _)| names.contains(&unit)).map(|(_, value)| *value)
}

fn cleaned(unit: &str) -> String {
    unit.trim_matches(['"', '\'', '(', ')', '[', ']', ' ']).to_ascii_lowercase()
}

/// Whether a cell is a unit that is usual in catalogues.
pub(super) fn is_unit(cell: &str) -> bool {
    let cell = cleaned(cell);
    cell.len() > 1
        && [&ANGLES[..], &FLUXES, &FREQUENCIES].iter().any(|units| value_of(units, &cell).is_some())
}

/// Units that comments give, with the names of their columns: of ECSV (`{name: flux, unit: mJy}`), in brackets (`ra [deg], flux [mJy]`),
/// and in words (`fluxes in mJy`).
pub(super) fn in_comments(comments: &[&str]) -> Vec<(String, String)> {
    let (mut found, mut ecsv_name) = (Vec::new(), None);
    let mut add = |name: &str, unit: &str| {
        let name = normalise(name);
        // Of "positions of J2000, fluxes in mJy" the unit is that of the fluxes.
        let is_of = |units| value_of(units, &cleaned(unit)).is_some();
        let is_other = (is_of(&FLUXES) && POSITION_WORDS.contains(&&*name))
            || (is_of(&ANGLES) && FLUX_WORDS.contains(&&*name));
        if !is_other {
            found.push((name, unit.to_owned()));
        }
    };
    for line in comments {
        for part in line.split(['{', '}', ',']).map(|part| part.trim_matches([' ', '\t', '-'])) {
            match part.split_once(':') {
                Some(("name", name)) => ecsv_name = Some(cleaned(name)),
                Some(("unit", unit)) => ecsv_name.take().into_iter().for_each(|name| add(&name, unit.trim())),
                _ => {}
            }
        }
        let brackets: Vec<(usize, &str)> = line.match_indices(['[', '(']).collect();
        for &(at, bracket) in &brackets {
            let unit = line[at + 1..].split([']', ')']).next().unwrap_or_default();
            // Round brackets may have anything; square ones also references.
            let is_flux = unit.to_ascii_lowercase().contains("jy");
            // VizieR's [ucd=..] is the kind of quantity.
            let is_word = unit.chars().all(|c| !c.is_whitespace() && !c.is_ascii_digit() && c != '=')
                && !is_reference(unit);
            if is_unit(unit) || is_flux || (bracket == "[" && is_word) {
                let before = words(&line[..at]);
                let first = before.clone().next().filter(|_| brackets.len() == 1);
                before.last().into_iter().chain(first).for_each(|name| add(name, unit));
            }
        }
        let mut names = Vec::new();
        for word in words(line) {
            let unit = word.trim_end_matches('.');
            if names.last() == Some(&"in")
                && is_unit(unit)
                && value_of(&FREQUENCIES, &cleaned(unit)).is_none()
            {
                names.drain(..).for_each(|name| add(name, unit));
            } else {
                names.push(word);
            }
        }
    }
    found
}

fn words(text: &str) -> impl Iterator<Item = &str> + Clone {
    text.split([' ', '\t', ',', ';', ':', '|']).filter(|word| !word.is_empty())
}

/// Whether a text names axes, such as J2000, and no unit.
fn is_reference(text: &str) -> bool {
    let text = text.to_ascii_lowercase();
    ["1950", "2000", "icrs", "fk5"].iter().any(|reference| text.contains(reference))
}

/// Units that a column's row, comments and brackets name. Brackets may also have a reference, such as (J2000).
fn stated((name, units): &(&str, Vec<String>)) -> impl Iterator<Item = String> {
    let bracketed = name.split_once(['(', '[']).map_or_else(String::new, |(_, unit)| cleaned(unit));
    let bracketed = if is_reference(&bracketed) { String::new() } else { bracketed };
    let units: Vec<String> = units.iter().map(|unit| cleaned(unit)).chain([bracketed]).collect();
    units.into_iter().filter(|unit| !unit.is_empty())
}

/// The unit of a column of angles that are one number, degrees; `hours_deg` is that of hours, where there may be any. The error is
/// the unit that is unknown or contradicts the name.
pub(super) fn angle_deg(column: &(&str, Vec<String>), hours_deg: Option<f64>) -> Result<f64, String> {
    let mut known = normalise(column.0).ends_with("deg").then_some(1.0);
    for unit in stated(column) {
        let value = value_of(&ANGLES, &unit).map(|deg| if deg.is_nan() { hours_deg } else { Some(deg) });
        match value.flatten() {
            Some(deg) if known.is_none_or(|known| known == deg) => known = Some(deg),
            _ => return Err(unit),
        }
    }
    Ok(known.unwrap_or(1.0))
}

/// The unit of a column of flux densities, Jy. The error is the unit that is unknown or contradicts the name.
pub(super) fn flux_jy(column: &(&str, Vec<String>)) -> Result<f64, String> {
    let name = normalise(column.0);
    let mut known =
        ["mjy", "jy"].iter().find(|unit| name.ends_with(*unit)).and_then(|unit| value_of(&FLUXES, unit));
    for unit in stated(column) {
        match value_of(&FLUXES, &unit) {
            Some(jy) if known.is_none_or(|known| known == jy) => known = Some(jy),
            _ => return Err(unit),
        }
    }
    Ok(known.unwrap_or(1.0))
}

/// Requires that a column of frequencies has the unit of its name, Hz. The error is the other one.
pub(super) fn require_unit(column: &(&str, Vec<String>), unit_hz: f64) -> Result<(), String> {
    stated(column).find(|unit| value_of(&FREQUENCIES, unit) != Some(unit_hz)).map_or(Ok(()), Err)
}
