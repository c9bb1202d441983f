//! Every key of a pipeline file with its default and what it means, as `pipelines/reference.toml` has them.

use serde::Serialize;

/// The reference file: every key with its default, unit and meaning.
pub const REFERENCE: &str = include_str!("../../pipelines/reference.toml");

/// A key, or a section.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct KeyDescription {
    /// Name, with its sections: `map.epsilon`.
    pub key: String,
    /// Default, as TOML; `None` for a section, and for a key that is not there by default.
    pub default: Option<String>,
    /// What it means.
    pub about: String,
}

/// All keys and sections, in the order of the reference file.
#[must_use]
pub fn key_descriptions() -> Vec<KeyDescription> {
    let mut found: Vec<KeyDescription> = Vec::new();
    let mut section = String::new();
    for line in REFERENCE.lines() {
        let (code, about) = comment_of(line);
        let optional =
            line.strip_prefix("# ").filter(|rest| rest.split_once(" = ").is_some_and(|(key, _)| is_key(key)));
        if let Some(name) = code.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            name.trim_matches(['[', ']']).clone_into(&mut section);
            found.push(KeyDescription { key: section.clone(), default: None, about: about.to_owned() });
        } else if let Some((key, value)) = code.split_once('=') {
            let default = Some(value.trim().to_owned());
            found.push(KeyDescription { key: joined(&section, key), default, about: about.to_owned() });
        } else if let Some((key, rest)) = optional.and_then(|rest| rest.split_once(" = ")) {
            let (example, about) = comment_of(rest);
            // First, so that lines that go on with the text follow it.
            let about = format!("for example {example}: {about}");
            found.push(KeyDescription { key: joined(&section, key), default: None, about });
        } else if line.starts_with(' ')
            && !about.is_empty()
            && let Some(last) = found.last_mut()
        {
            last.about = format!("{} {about}", last.about);
        }
    }
    found
}

/// A line before its comment, and the comment.
fn comment_of(line: &str) -> (&str, &str) {
    match line.split_once('#') {
        Some((code, about)) => (code.trim(), about.trim()),
        None => (line.trim(), ""),
    }
}

fn is_key(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
}

fn joined(section: &str, key: &str) -> String {
    let key = key.trim();
    if section.is_empty() { key.to_owned() } else { format!("{section}.{key}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Keys of a table with their sections.
    fn keys(path: &str, table: &toml::Table, found: &mut Vec<String>) {
        for (key, value) in table {
            let path = joined(path, key);
            if let Some(table) = value.as_table() {
                keys(&path, table, found);
            }
            found.push(path);
        }
    }

    #[test]
    fn every_key_is_described() {
        let mut expected = Vec::new();
        keys("", &toml::from_str(REFERENCE).unwrap(), &mut expected);
        let found = key_descriptions();
        for key in &expected {
            assert!(found.iter().any(|described| described.key == *key), "{key}");
        }
        let of = |key: &str| found.iter().find(|described| described.key == key).unwrap();
        assert_eq!(of("map.residual_max").default.as_deref(), Some("1e-4"));
        assert!(of("sky.frequency").about.ends_with("T(nu) = T(FREQ) (nu / FREQ)^index"));
        assert_eq!(of("sky").about, "the simulated sky");
        // Not there by default.
        assert!(
            of("sky.file").default.is_none()
                && of("sky.file").about.starts_with("for example \"map.fits\": ")
        );
        let bare: Vec<&str> =
            found.iter().filter(|described| described.key.contains(' ')).map(|d| d.key.as_str()).collect();
        assert!(bare.is_empty(), "{bare:?}");
    }
}
