//! Summaries against the schema that the program publishes.
#![allow(clippy::panic)] // A test fails by panicking.

use serde_json::Value;

/// Requires that a summary is as `docs/summary.schema.json` says, without a property that it does not name.
pub fn check_summary(summary: &Value) {
    let schema: Value = serde_json::from_str(include_str!("../../docs/summary.schema.json")).unwrap();
    let mut found = Vec::new();
    problems(&schema, &schema, summary, "summary", &mut found);
    assert!(found.is_empty(), "not as docs/summary.schema.json says: {found:#?}");
}

/// Every keyword that the schema uses, and none beside. That a validator of other people agrees is a test of `chain`.
pub fn problems(root: &Value, schema: &Value, value: &Value, at: &str, found: &mut Vec<String>) {
    for (keyword, wanted) in schema.as_object().unwrap() {
        let good = match keyword.as_str() {
            "$schema" | "$defs" | "title" | "description" | "properties" => true,
            "$ref" => {
                let path = wanted.as_str().unwrap().strip_prefix('#').unwrap();
                problems(root, root.pointer(path).unwrap(), value, at, found);
                true
            }
            "type" => match wanted {
                Value::Array(kinds) => kinds.iter().any(|kind| is_kind(value, kind)),
                kind => is_kind(value, kind),
            },
            "enum" => wanted.as_array().unwrap().contains(value),
            "anyOf" => wanted.as_array().unwrap().iter().any(|one| {
                let mut of_one = Vec::new();
                problems(root, one, value, at, &mut of_one);
                of_one.is_empty()
            }),
            // It is a hash.
            "pattern" => {
                assert_eq!(wanted, "^[0-9a-f]{16}$");
                let is_digit = |c| matches!(c, '0'..='9' | 'a'..='f');
                value.as_str().is_none_or(|text| text.len() == 16 && text.chars().all(is_digit))
            }
            "minimum" => value.as_f64().is_none_or(|value| value >= wanted.as_f64().unwrap()),
            "exclusiveMinimum" => value.as_f64().is_none_or(|value| value > wanted.as_f64().unwrap()),
            "maximum" => value.as_f64().is_none_or(|value| value <= wanted.as_f64().unwrap()),
            "minItems" => value.as_array().is_none_or(|list| list.len() as u64 >= wanted.as_u64().unwrap()),
            "maxItems" => value.as_array().is_none_or(|list| list.len() as u64 <= wanted.as_u64().unwrap()),
            "items" => {
                for (k, item) in value.as_array().into_iter().flatten().enumerate() {
                    problems(root, wanted, item, &format!("{at}[{k}]"), found);
                }
                true
            }
            "required" => {
                let has = |name: &Value| value.get(name.as_str().unwrap()).is_some();
                !value.is_object() || wanted.as_array().unwrap().iter().all(has)
            }
            "propertyNames" => {
                for name in value.as_object().into_iter().flatten().map(|(name, _)| name) {
                    problems(root, wanted, &Value::from(name.as_str()), &format!("{at}.{name}"), found);
                }
                true
            }
            "additionalProperties" => {
                let known = |name: &String| schema.pointer("/properties").and_then(|all| all.get(name));
                for (name, inner) in value.as_object().into_iter().flatten() {
                    let at = format!("{at}.{name}");
                    match (known(name), wanted) {
                        (Some(schema), _) => problems(root, schema, inner, &at, found),
                        (None, Value::Bool(false)) => found.push(format!("{at}: unknown")),
                        (None, schema) => problems(root, schema, inner, &at, found),
                    }
                }
                true
            }
            _ => panic!("keyword {keyword} at {at}"),
        };
        if !good {
            found.push(format!("{at} = {value}: expected {keyword} {wanted}"));
        }
    }
}

fn is_kind(value: &Value, kind: &Value) -> bool {
    match kind.as_str().unwrap() {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "null" => value.is_null(),
        "number" => value.is_number(),
        "integer" => value.is_u64() || value.is_i64(),
        _ => panic!("type {kind}"),
    }
}
