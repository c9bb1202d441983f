//! `lunarray completions` and `lunarray man`: shell completions and manual pages.

use std::path::PathBuf;

use clap::{Args, Command};
use clap_complete::Shell;

use super::output::{CommandError, CommandResult, Completion, cannot_write, print_json_line, print_text};
use crate::files::write_atomically;

/// Name of the program.
const NAME: &str = "lunarray";

/// Print a script that completes commands and options in a shell.
///
/// Bash: lunarray completions bash > ~/.local/share/bash-completion/completions/lunarray. Zsh: write it to a file _lunarray in a
/// folder of $fpath. Fish: write it to ~/.config/fish/completions/lunarray.fish.
///
/// Example: lunarray completions bash
#[derive(Debug, Args)]
pub(super) struct CompletionsArgs {
    /// Shell.
    shell: Shell,
    /// Print one JSON object: shell, script.
    #[arg(long)]
    json: bool,
}

pub(super) fn completions(args: &CompletionsArgs, mut command: Command) -> CommandResult {
    let mut text = Vec::new();
    clap_complete::generate(args.shell, &mut command, NAME, &mut text);
    let script = String::from_utf8_lossy(&text);
    let script = script.trim_end();
    if args.json {
        print_json_line(&serde_json::json!({ "shell": args.shell.to_string(), "script": script }))?;
    } else {
        print_text(script)?;
    }
    Ok(Completion::Done)
}

/// Write manual pages, one per command.
///
/// `man -l FOLDER/lunarray.1` shows the first of them; packages put them into section 1 of the manual.
///
/// Example: lunarray man --out man1/
#[derive(Debug, Args)]
pub(super) struct ManArgs {
    /// Folder for the pages, which is created if necessary.
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,
    /// Print one JSON object: files.
    #[arg(long)]
    json: bool,
}

pub(super) fn man(args: &ManArgs, mut command: Command) -> CommandResult {
    command.build();
    let parts = command.get_subcommands().filter(|part| part.get_name() != "help");
    let pages: Vec<_> = std::iter::once(&command).chain(parts).map(page).collect::<Result<_, _>>()?;
    let mut files = Vec::new();
    for (name, text) in pages {
        let path = args.out.join(name);
        write_atomically(&path, &text).map_err(cannot_write(&path))?;
        files.push(path);
    }
    if args.json {
        print_json_line(&serde_json::json!({ "files": files }))?;
    } else {
        print_text(&format!("{} pages are in {}", files.len(), args.out.display()))?;
    }
    Ok(Completion::Done)
}

/// The name of a page's file, and its text.
fn page(command: &Command) -> Result<(String, Vec<u8>), CommandError> {
    let mut text = Vec::new();
    clap_mangen::Man::new(command.clone()).render(&mut text)?;
    // The display name includes the program, as in lunarray-run.
    Ok((format!("{}.1", command.get_display_name().unwrap_or(NAME)), text))
}
