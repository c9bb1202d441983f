//! `lunarray explain` and `lunarray config`: settings explain themselves.

use clap::{Args, ValueEnum};

use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::pipeline::{KeyDescription, QUICKLOOK, REFERENCE, key_descriptions};
use crate::units::echo;

/// Explain keys of pipeline files: their defaults, units and meaning.
///
/// Takes whole keys (map.epsilon), sections (map), or a part of a name (epsilon), which finds all keys that contain it.
/// Without one it lists the sections.
///
/// Example: lunarray explain map.epsilon
#[derive(Debug, Args)]
pub(super) struct ExplainArgs {
    /// Keys, sections, or parts of names.
    #[arg(value_name = "KEY")]
    keys: Vec<String>,
    /// Print one JSON object per line: key, default (as TOML), about.
    #[arg(long)]
    json: bool,
}

pub(super) fn explain(args: &ExplainArgs) -> CommandResult {
    let all = key_descriptions();
    let mut shown: Vec<&KeyDescription> = Vec::new();
    if args.keys.is_empty() {
        shown.extend(
            all.iter().filter(|described| described.default.is_none() && is_section(&all, &described.key)),
        );
    }
    for key in &args.keys {
        let found = matches_of(&all, key);
        if found.is_empty() {
            let expected = "expected a key such as map.epsilon, a section such as map, or a part of a name";
            return Err(format!("{}: no such key; {expected}", echo(key)).into());
        }
        shown.extend(found);
    }
    for described in shown {
        if args.json {
            print_json_line(described)?;
        } else {
            let KeyDescription { key, default, about } = described;
            let head = match default {
                Some(default) => format!("{key} = {default}"),
                None if is_section(&all, key) => format!("[{key}]"),
                None => format!("{key} (none)"),
            };
            print_text(if about.is_empty() { head } else { format!("{head}\n    {about}") }.as_str())?;
        }
    }
    Ok(Completion::Done)
}

fn is_section(all: &[KeyDescription], key: &str) -> bool {
    let inside = format!("{key}.");
    all.iter().any(|described| described.key.starts_with(&inside))
}

/// The key itself; else the keys of the section; else those whose names contain it.
fn matches_of<'a>(all: &'a [KeyDescription], wanted: &str) -> Vec<&'a KeyDescription> {
    let inside = format!("{wanted}.");
    let of_section: Vec<_> = all.iter().filter(|d| d.key == wanted || d.key.starts_with(&inside)).collect();
    if !of_section.is_empty() || wanted.is_empty() {
        return of_section;
    }
    all.iter().filter(|described| described.key.contains(wanted)).collect()
}

/// Print a pipeline file that comes with the program, to start from.
///
/// The reference has every key with its default, unit and meaning; a pipeline file needs only the keys that it changes. The
/// quicklook is what `lunarray run` runs without a file.
///
/// Example: lunarray config --print quicklook > my.toml
#[derive(Debug, Args)]
pub(super) struct ConfigArgs {
    /// The file to print.
    #[arg(long, value_enum, default_value = "reference")]
    print: Printed,
    /// Print all its settings as one JSON object.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Printed {
    /// What `lunarray run` runs without a file.
    Quicklook,
    /// Every key with its default.
    Reference,
}

pub(super) fn config(args: &ConfigArgs) -> CommandResult {
    let text = match args.print {
        Printed::Quicklook => QUICKLOOK,
        Printed::Reference => REFERENCE,
    };
    if args.json {
        print_json_line(&toml::from_str::<toml::Table>(text)?)?;
    } else {
        print_text(text.trim_end())?;
    }
    Ok(Completion::Done)
}
