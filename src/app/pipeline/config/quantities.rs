//! Values with units in pipeline files: `duration_s = "30d"`, `channels_hz = ["3MHz", "10MHz"]`.

use toml::{Table, Value};

use crate::units::Dimension;

/// Converts texts with units to numbers, at keys whose names end in a unit. Any other text is kept, and later reported as a value
/// of the wrong type.
pub(in crate::pipeline) fn read_units(table: &mut Table) {
    for (key, value) in table.iter_mut() {
        if let Value::Table(table) = value {
            read_units(table);
        } else if let Some(dimension) = Dimension::from_key(key)
            && let Some(number) = parse_quantity(value, dimension)
        {
            *value = number;
        }
    }
}

/// Parses a text with a unit, a list of such texts, or a text such as `[3MHz, 10MHz]`, which is how `--set` passes a list. In the last
/// case, elements that are not numbers are kept as texts.
fn parse_quantity(value: &Value, dimension: Dimension) -> Option<Value> {
    let number = |text: &str| dimension.parse(text).ok().map(Value::Float);
    let number_or_text = |text: &str| number(text).unwrap_or_else(|| Value::String(text.trim().to_owned()));
    match value {
        Value::String(text) => match text.trim().strip_prefix('[').and_then(|text| text.strip_suffix(']')) {
            Some(list) => Some(Value::Array(list.split(',').map(number_or_text).collect())),
            None => number(text),
        },
        Value::Array(list) if list.iter().any(Value::is_str) => {
            let element = |value: &Value| value.as_str().map_or_else(|| Some(value.clone()), number);
            list.iter().map(element).collect::<Option<_>>().map(Value::Array)
        }
        _ => None,
    }
}
