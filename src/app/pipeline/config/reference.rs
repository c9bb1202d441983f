//! The reference of all keys with defaults and meanings, generated from their declarations.

use std::fmt::Write;

use serde::Serialize;
use toml::Value;

use super::effects::condition_text;
use super::key_list::{FlatKey, flat_keys};
use crate::units::{Key, Level};

/// Maximum length of a line of the reference, characters.
const WIDTH: usize = 110;

/// Description of a key or a section.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct KeyDescription {
    /// Name, with its sections: `map.epsilon`.
    pub key: String,
    /// Default, as TOML; `None` for a section, and for a key that is absent by default.
    pub default: Option<String>,
    /// Meaning.
    pub about: String,
    /// Conditions under which it has an effect; all have to hold.
    pub only_with: Vec<String>,
    /// Whether it is an everyday key, or a section with one.
    pub everyday: bool,
}

/// All keys and sections, in the order of the data path.
#[must_use]
pub fn key_descriptions() -> Vec<KeyDescription> {
    let describe = |FlatKey { path, key, default, only_with }: FlatKey| KeyDescription {
        key: path,
        default: default.as_ref().map(value_text),
        about: about_text(key),
        everyday: is_everyday(key),
        only_with,
    };
    flat_keys().into_iter().map(describe).collect()
}

fn is_everyday(key: &Key) -> bool {
    match key.level {
        Level::Everyday => true,
        Level::Expert => false,
        Level::Section => key.keys.iter().any(is_everyday),
    }
}

fn about_text(key: &Key) -> String {
    let lines: Vec<&str> = key.about.iter().map(|line| line.trim()).collect();
    lines.join(" ")
}

/// A value as TOML, with an exponent if that is shorter.
fn value_text(value: &Value) -> String {
    match value {
        Value::Float(number) if *number != 0.0 && !(1e-3..1e5).contains(&number.abs()) => {
            format!("{number:e}")
        }
        value => value.to_string(),
    }
}

/// Which keys a reference shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shown {
    /// Everyday keys.
    Everyday,
    /// Everyday keys, and the others as comments.
    Folded,
    /// All keys.
    All,
}

/// A pipeline file with the chosen keys, each with its default, unit and meaning.
#[must_use]
pub fn reference(shown: Shown) -> String {
    let mut text = match shown {
        Shown::Everyday => "# The everyday keys of a pipeline file with their defaults; `lunarray config --all` shows the others, too.\n",
        Shown::Folded => {
            "# Every key of a pipeline file with its default: those for every day, and as comments (#key = ...) those for experts.\n"
        }
        Shown::All => "# Every key of a pipeline file with its default.\n",
    }
    .to_owned();
    text += "# A file needs only the keys that it changes. Numbers may have units (\"30d\", \"3MHz\"). Paths are relative to the working\n\
             # directory. Written from the declarations in the code.\n\n";
    let (keys, mut written) = (flat_keys(), Vec::new());
    let top: Vec<&FlatKey> = keys.iter().filter(|key| !key.path.contains('.')).collect();
    for key in top.iter().filter(|key| key.key.level != Level::Section) {
        put_key(&mut text, key, shown);
    }
    for section in keys.iter().filter(|key| key.key.level == Level::Section) {
        if shown == Shown::Everyday && !is_everyday(section.key) {
            continue;
        }
        put_section(&mut text, section);
        // Sections of the same struct have the same keys: they are described once, unless all keys are shown.
        let same = written.iter().find(|(keys, _): &&(&[Key], &str)| are_alike(keys, section.key.keys));
        match same {
            Some((_, first)) if shown != Shown::All => {
                let _ = writeln!(text, "# Keys as in [{first}].");
            }
            _ => {
                written.push((section.key.keys, section.path.as_str()));
                keys.iter()
                    .filter(|key| is_in(&key.path, &section.path) && key.key.level != Level::Section)
                    .for_each(|key| put_key(&mut text, key, shown));
            }
        }
    }
    text
}

fn are_alike(a: &[Key], b: &[Key]) -> bool {
    let texts = |keys: &[Key]| keys.iter().map(|key| (key.name, key.about)).collect::<Vec<_>>();
    texts(a) == texts(b)
}

fn is_in(path: &str, section: &str) -> bool {
    path.rsplit_once('.').is_some_and(|(parent, _)| parent == section)
}

fn put_section(text: &mut String, section: &FlatKey) {
    // Writing to a string cannot fail.
    let _ = write!(text, "\n[{}]\n", section.path);
    put_comment(text, &with_condition(section));
    text.push('\n');
}

fn put_key(text: &mut String, key: &FlatKey, shown: Shown) {
    if key.key.level != Level::Everyday && shown == Shown::Everyday {
        return;
    }
    put_comment(text, &with_condition(key));
    let fold = if key.key.level == Level::Everyday || shown == Shown::All { "" } else { "#" };
    let _ = match &key.default {
        Some(value) => writeln!(text, "{fold}{} = {}", key.key.name, value_text(value)),
        None => writeln!(text, "#{} =", key.key.name),
    };
}

/// The meaning of a key and its own condition.
fn with_condition(key: &FlatKey) -> String {
    let about = about_text(key.key);
    match key.only_with.last().filter(|_| !key.key.only_with.is_empty()) {
        Some(only) => format!("{about} Only {}.", condition_text(only)),
        None => about,
    }
}

fn put_comment(text: &mut String, about: &str) {
    let mut line = "#".to_owned();
    for word in about.split(' ') {
        if line.len() + 1 + word.len() > WIDTH {
            *text += &line;
            *text += "\n";
            "#".clone_into(&mut line);
        }
        line.push(' ');
        line += word;
    }
    *text += &line;
    *text += "\n";
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::config::sections::Config;

    #[test]
    fn the_reference_file_matches_the_declarations() {
        let kept =
            std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../pipelines/reference.toml"))
                .unwrap();
        let written = reference(Shown::Folded);
        assert!(
            kept == written,
            "pipelines/reference.toml is not current: write it anew with `lunarray config --print reference`"
        );
    }

    #[test]
    fn every_form_is_a_pipeline_with_the_defaults() {
        for shown in [Shown::Everyday, Shown::Folded, Shown::All] {
            let config: Config = toml::from_str(&reference(shown)).unwrap();
            assert_eq!(config, Config::default(), "{shown:?}");
        }
        let all: toml::Table = toml::from_str(&reference(Shown::All)).unwrap();
        let of_code = toml::Table::try_from(Config::default()).unwrap();
        fn holds(path: &str, of_code: &toml::Table, all: &toml::Table) {
            for (key, value) in of_code {
                let found = all.get(key).unwrap_or_else(|| panic!("{path}.{key} is missing"));
                if let (Some(of_code), Some(all)) = (value.as_table(), found.as_table()) {
                    holds(&format!("{path}.{key}"), of_code, all);
                }
            }
        }
        holds("", &of_code, &all);
    }

    #[test]
    fn descriptions_have_default_meaning_and_condition() {
        let found = key_descriptions();
        let find = |key: &str| found.iter().find(|described| described.key == key).unwrap();
        assert_eq!(find("map.residual_max").default.as_deref(), Some("1e-4"));
        assert!(find("map.epsilon").everyday && !find("map.l_max").everyday && find("map").everyday);
        assert_eq!(find("map.l_max").only_with, ["map.engine = \"harmonic\""]);
        // Conditions of the key and of its section.
        assert_eq!(find("array.propagate.keep").only_with, ["array.propagate.keep_every_days > 0"]);
        assert_eq!(find("daughters.tones.calibration_k_sr").only_with, ["spacecraft.fidelity = \"samples\""]);
        // Absent by default.
        assert!(find("sky.file").default.is_none() && find("sky.file").about.starts_with("Map of the sky"));
    }
}
