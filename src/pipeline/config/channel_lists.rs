//! Lists with a value for each channel, where an override changes the channels.

use toml::{Table, Value};

/// Keys that take one value, or a list with one for each channel. Those of files are not among them: a sky or a prior of
/// another frequency is another sky.
const KEYS: [[&str; 2]; 4] = [
    ["spacecraft", "every_nth_integration"],
    ["spacecraft", "baseline_wavelengths_max"],
    ["map", "epsilon"],
    ["map", "prior_k"],
];

/// The frequencies of a table's channels, Hz; `None` if they are not a list of positive numbers.
pub(in crate::pipeline) fn channels_hz(table: &Table) -> Option<Vec<f64>> {
    let list = table.get("spacecraft")?.get("channels_hz")?.as_array()?;
    let number = |value: &Value| value.as_float().or_else(|| value.as_integer().map(|whole| whole as f64));
    list.iter().map(|value| number(value).filter(|hz| *hz > 0.0)).collect()
}

/// Makes a list of a single frequency: one channel.
pub(in crate::pipeline) fn of_one(table: &mut Table) {
    let found = table.get_mut("spacecraft").and_then(|table| table.get_mut("channels_hz"));
    if let Some(value) = found.filter(|value| value.is_float() || value.is_integer()) {
        *value = Value::Array(vec![value.clone()]);
    }
}

/// Gives each channel of `table` the values of that of `before` whose frequency is nearest, in all lists for `before` that
/// `is_set` does not name. Returns what was done, a line a list.
pub(in crate::pipeline) fn follow(
    table: &mut Table,
    before: &[f64],
    is_set: impl Fn(&str) -> bool,
) -> Vec<String> {
    let Some(now) = channels_hz(table).filter(|now| now != before && !before.is_empty()) else {
        return Vec::new();
    };
    let apart = |a: f64, b: f64| (a / b).ln().abs();
    let nearest =
        |hz: f64| (0..before.len()).min_by(|&a, &b| apart(before[a], hz).total_cmp(&apart(before[b], hz)));
    let mut told = Vec::new();
    for [section, key] in KEYS {
        let name = format!("{section}.{key}");
        let list = table.get_mut(section).and_then(|table| table.get_mut(key)).and_then(Value::as_array_mut);
        let Some(list) = list.filter(|list| list.len() == before.len() && !is_set(&name)) else { continue };
        let followed: Vec<Value> =
            now.iter().filter_map(|&hz| nearest(hz).and_then(|k| list.get(k)).cloned()).collect();
        *list = followed;
        let values: Vec<String> = list.iter().map(ToString::to_string).collect();
        told.push(format!("{name} = [{}]: as for the nearest of the file's channels", values.join(", ")));
    }
    told
}
