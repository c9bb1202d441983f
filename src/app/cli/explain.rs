//! `lunarray explain` and `lunarray config`: explanations of settings, and files to start from.

use clap::{Args, ValueEnum};

use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::pipeline::{KeyDescription, QUICKLOOK, Shown, condition_text, key_descriptions, reference};
use crate::units::echo;

/// Explain keys of pipeline files: their defaults, units and meaning.
///
/// Takes keys (map.epsilon), sections (map), or a word (epsilon): it finds all keys whose names contain it, or else all whose
/// explanation does. Without one it lists the sections.
///
/// Example: lunarray explain map.epsilon
#[derive(Debug, Args)]
pub(super) struct ExplainArgs {
    /// Keys, sections, or parts of names.
    #[arg(value_name = "KEY")]
    keys: Vec<String>,
    /// Print one JSON object per line: key, default (as TOML), about, only_with (when it has an effect), everyday.
    #[arg(long)]
    json: bool,
    /// Print the page docs/keys.md: the everyday keys as a table of Markdown.
    #[arg(long, conflicts_with_all = ["json", "keys"])]
    markdown: bool,
}

pub(super) fn explain(args: &ExplainArgs) -> CommandResult {
    let all = key_descriptions();
    if args.markdown {
        print_text(page_of(&all).trim_end())?;
        return Ok(Completion::Done);
    }
    let mut shown: Vec<&KeyDescription> = Vec::new();
    if args.keys.is_empty() {
        shown.extend(
            all.iter().filter(|described| described.default.is_none() && is_section(&all, &described.key)),
        );
    }
    for key in &args.keys {
        let found = matches_of(&all, key);
        if found.is_empty() {
            let expected = "expected a key such as map.epsilon, a section such as map, or a part of a name or an explanation";
            return Err(format!("{}: no such key; {expected}", echo(key)).into());
        }
        shown.extend(found);
    }
    for described in shown {
        if args.json {
            print_json_line(described)?;
        } else {
            let KeyDescription { key, default, about, only_with, .. } = described;
            let head = match default {
                Some(default) => format!("{key} = {default}"),
                None if is_section(&all, key) => format!("[{key}]"),
                None => format!("{key} (none)"),
            };
            let only = match only_with.is_empty() {
                true => String::new(),
                false => {
                    let conditions: Vec<String> = only_with.iter().map(|only| condition_text(only)).collect();
                    format!("\n    It has an effect only {}.", conditions.join(", and "))
                }
            };
            print_text(&format!("{head}\n    {about}{only}"))?;
        }
    }
    Ok(Completion::Done)
}

fn is_section(all: &[KeyDescription], key: &str) -> bool {
    let inside = format!("{key}.");
    all.iter().any(|described| described.key.starts_with(&inside))
}

/// The page `docs/keys.md`: a table of the everyday keys, and the reference with all keys, which mdBook includes.
fn page_of(all: &[KeyDescription]) -> String {
    let mut page = "# All keys\n\n\
        A pipeline file names only the keys that it changes. Units stand at the end of names. `lunarray explain KEY` explains keys, \
        sections, or all keys with\na word in them. Written by `lunarray explain --markdown`.\n\n\
        ## For every day\n\n| key | |\n|---|---|\n"
        .to_owned();
    for described in all.iter().filter(|described| described.everyday && !is_section(all, &described.key)) {
        let KeyDescription { key, default, about, only_with, .. } = described;
        let default = default.as_ref().map_or_else(String::new, |text| format!(" = {text}"));
        // The last condition is that of the key; the others are of its sections.
        let condition =
            only_with.last().map_or_else(String::new, |only| format!(" Only {}.", condition_text(only)));
        page.push_str(&format!("| `{key}{default}` | {}{condition} |\n", in_a_cell(about)));
    }
    page.push_str(
        "\n## All, with those for experts\n\n\
        The file `pipelines/reference.toml`, also printed by `lunarray config --print reference`:\n\n\
        ```toml\n{{#include ../pipelines/reference.toml}}\n```\n",
    );
    page
}

/// Escapes a text for a table cell of Markdown.
fn in_a_cell(text: &str) -> String {
    text.replace('|', "\\|").replace('<', "&lt;")
}

/// Finds keys: the key or section itself, or else keys whose names contain the word, or else keys whose explanations do.
fn matches_of<'a>(all: &'a [KeyDescription], wanted: &str) -> Vec<&'a KeyDescription> {
    let inside = format!("{wanted}.");
    let exact: Vec<_> = all.iter().filter(|d| d.key == wanted || d.key.starts_with(&inside)).collect();
    if !exact.is_empty() || wanted.is_empty() {
        return exact;
    }
    let named: Vec<_> = all.iter().filter(|described| described.key.contains(wanted)).collect();
    if !named.is_empty() {
        return named;
    }
    let word = wanted.to_lowercase();
    all.iter().filter(|described| described.about.to_lowercase().contains(&word)).collect()
}

/// The JSON schema of `summary.json`, which tests check.
const SUMMARY_SCHEMA: &str = include_str!("summary.schema.json");

/// Print a pipeline file that comes with the program, to start from, or the schema of what it writes.
///
/// Without options it prints the everyday keys with their defaults and meanings; --all adds those for experts. A pipeline file
/// needs only the keys that it changes.
///
/// Example: lunarray config --print quicklook > my.toml
#[derive(Debug, Args)]
pub(super) struct ConfigArgs {
    /// Print a file instead of the everyday keys.
    #[arg(long, value_enum)]
    print: Option<PrintedConfig>,
    /// Print all keys.
    #[arg(long, conflicts_with_all = ["print", "schema"])]
    all: bool,
    /// Print a JSON schema instead.
    #[arg(long, value_enum, conflicts_with = "print")]
    schema: Option<Schema>,
    /// Print all its settings as one JSON object.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum PrintedConfig {
    /// What `lunarray run` runs without a file.
    Quicklook,
    /// Every key with its default: those for experts as comments.
    Reference,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Schema {
    /// Of summary.json, and of what run and replay print with --json.
    Summary,
}

pub(super) fn config(args: &ConfigArgs) -> CommandResult {
    if let Some(Schema::Summary) = args.schema {
        print_text(SUMMARY_SCHEMA.trim_end())?;
        return Ok(Completion::Done);
    }
    let text = match args.print {
        Some(PrintedConfig::Quicklook) => QUICKLOOK.to_owned(),
        Some(PrintedConfig::Reference) => reference(Shown::Folded),
        None => reference(if args.all { Shown::All } else { Shown::Everyday }),
    };
    if args.json {
        print_json_line(&toml::from_str::<toml::Table>(&text)?)?;
    } else {
        print_text(text.trim_end())?;
    }
    Ok(Completion::Done)
}
