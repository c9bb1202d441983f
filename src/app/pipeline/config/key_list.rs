//! All keys of a pipeline file, section by section, from their declarations.

use toml::{Table, Value};

use super::sections::Config;
use crate::units::{Key, Level};

/// A key with its full path.
#[derive(Clone, Debug)]
pub(super) struct FlatKey {
    pub(super) path: String,
    pub(super) key: &'static Key,
    /// Default value; `None` for a section or an optional key.
    pub(super) default: Option<Value>,
    /// Conditions under which the key has an effect: those of its sections and its own. All have to hold.
    pub(super) only_with: Vec<String>,
}

/// All keys and sections; each section precedes its keys.
pub(super) fn flat_keys() -> Vec<FlatKey> {
    let mut found = Vec::new();
    collect("", Config::KEYS, &[], &mut found);
    found
}

fn collect(section: &str, keys: &'static [Key], only_with: &[String], found: &mut Vec<FlatKey>) {
    for key in keys {
        let path = joined(section, key.name);
        let condition = (!key.only_with.is_empty()).then(|| in_section(section, key.only_with));
        let only_with: Vec<String> = only_with.iter().cloned().chain(condition).collect();
        let is_section = key.level == Level::Section;
        let default = if is_section { None } else { (key.default)() };
        found.push(FlatKey { path: path.clone(), key, default, only_with: only_with.clone() });
        collect(&path, key.keys, &only_with, found);
    }
}

/// A condition with the full paths of its keys.
fn in_section(section: &str, condition: &str) -> String {
    let full = |word: &str| if word.starts_with('.') { format!("{section}{word}") } else { word.to_owned() };
    condition.split(' ').map(full).collect::<Vec<_>>().join(" ")
}

fn joined(section: &str, key: &str) -> String {
    if section.is_empty() { key.to_owned() } else { format!("{section}.{key}") }
}

/// All keys as nested tables, including keys that are absent by default. Each key has the value `false`.
pub(super) fn known_keys(keys: &'static [Key]) -> Table {
    let value = |key: &'static Key| match key.level {
        Level::Section => Value::Table(known_keys(key.keys)),
        _ => Value::Boolean(false),
    };
    keys.iter().map(|key| (key.name.to_owned(), value(key))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_most_sixty_keys_are_everyday() {
        let everyday = flat_keys().iter().filter(|key| key.key.level == Level::Everyday).count();
        assert!((20..=60).contains(&everyday), "{everyday}");
    }

    #[test]
    fn every_field_is_declared_with_its_default() {
        fn compare(path: &str, all: &Table, keys: &[FlatKey]) {
            for (name, value) in all {
                let path = joined(path, name);
                let declared = keys.iter().find(|key| key.path == path);
                let declared = declared.unwrap_or_else(|| panic!("{path} is not declared"));
                match (declared.key.level, value) {
                    (Level::Section, Value::Table(table)) => compare(&path, table, keys),
                    (_, value) => assert_eq!(declared.default.as_ref(), Some(value), "{path}"),
                }
            }
        }
        compare("", &Table::try_from(Config::default()).unwrap(), &flat_keys());
    }

    #[test]
    fn every_key_says_what_it_means_in_a_sentence() {
        for FlatKey { path, key, .. } in flat_keys() {
            let about = key.about.join(" ");
            let about = about.trim();
            assert!(about.ends_with('.') && about.starts_with(|c: char| c.is_uppercase()), "{path}: {about}");
        }
    }
}
