//! Values with units in pipeline files: `duration_s = "30d"`, `channels_hz = ["3MHz", "10MHz"]`.

use toml::{Table, Value};

use crate::units::Dimension;

/// Replaces texts at keys whose names end in a unit by the numbers that they stand for. Any other text stays, and is then
/// told as a value of the wrong type.
pub(in crate::pipeline) fn read_units(table: &mut Table) {
    for (key, value) in table.iter_mut() {
        if let Value::Table(table) = value {
            read_units(table);
        } else if let Some(dimension) = Dimension::from_key(key)
            && let Some(number) = with_units(value, dimension)
        {
            *value = number;
        }
    }
}

/// The numbers of a text, of a list of texts, or of a text such as `[3MHz, 10MHz]`, which `--set` leaves as it is: a list in which what
/// is no number stays a text.
fn with_units(value: &Value, dimension: Dimension) -> Option<Value> {
    let number = |text: &str| dimension.parse(text).ok().map(Value::Float);
    let number_or_text = |text: &str| number(text).unwrap_or_else(|| Value::String(text.trim().to_owned()));
    match value {
        Value::String(text) => match text.trim().strip_prefix('[').and_then(|text| text.strip_suffix(']')) {
            Some(list) => Some(Value::Array(list.split(',').map(number_or_text).collect())),
            None => number(text),
        },
        Value::Array(list) if list.iter().any(Value::is_str) => {
            let one = |value: &Value| value.as_str().map_or_else(|| Some(value.clone()), number);
            list.iter().map(one).collect::<Option<_>>().map(Value::Array)
        }
        _ => None,
    }
}
