//! Adapts lists with a value for each channel when an override changes the channels.

use toml::{Table, Value};

/// Keys that take one value, or a list with one for each channel. Keys of files are left out: a map of one frequency does not
/// serve another.
const KEYS: [[&str; 2]; 5] = [
    ["spacecraft", "every_nth_integration"],
    ["spacecraft", "baseline_wavelengths_max"],
    ["map", "epsilon"],
    ["map", "prior_k"],
    ["joint", "power_constant_k_sr"],
];

/// The frequencies of a table's channels, Hz; `None` if they are not a list of positive numbers.
pub(in crate::pipeline) fn channels_hz(table: &Table) -> Option<Vec<f64>> {
    let list = table.get("spacecraft")?.get("channels_hz")?.as_array()?;
    let number = |value: &Value| value.as_float().or_else(|| value.as_integer().map(|whole| whole as f64));
    list.iter().map(|value| number(value).filter(|hz| *hz > 0.0)).collect()
}

/// Replaces a single frequency by a list with one channel.
pub(in crate::pipeline) fn wrap_single_channel(table: &mut Table) {
    let found = table.get_mut("spacecraft").and_then(|table| table.get_mut("channels_hz"));
    if let Some(value) = found.filter(|value| value.is_float() || value.is_integer()) {
        *value = Value::Array(vec![value.clone()]);
    }
}

/// Gives each channel of `table` the values of the nearest channel in `before`, for every list that has a value for each channel of
/// `before` and for which `is_set` is false. Returns one note for each changed list.
pub(in crate::pipeline) fn adapt_lists(
    table: &mut Table,
    before: &[f64],
    is_set: impl Fn(&str) -> bool,
) -> Vec<String> {
    let Some(now) = channels_hz(table).filter(|now| now != before && !before.is_empty()) else {
        return Vec::new();
    };
    let distance = |a: f64, b: f64| (a / b).ln().abs();
    let nearest = |hz: f64| {
        (0..before.len()).min_by(|&a, &b| distance(before[a], hz).total_cmp(&distance(before[b], hz)))
    };
    let mut notes = Vec::new();
    for [section, key] in KEYS {
        let name = format!("{section}.{key}");
        let list = table.get_mut(section).and_then(|table| table.get_mut(key)).and_then(Value::as_array_mut);
        let Some(list) = list.filter(|list| list.len() == before.len() && !is_set(&name)) else { continue };
        *list = now.iter().filter_map(|&hz| nearest(hz).and_then(|k| list.get(k)).cloned()).collect();
        let values: Vec<String> = list.iter().map(ToString::to_string).collect();
        notes.push(format!(
            "{name} = [{}]: values of the nearest channels of the pipeline file",
            values.join(", ")
        ));
    }
    notes
}
