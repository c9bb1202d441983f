//! Tests that the command lines in the documentation are valid.

use std::path::{Path, PathBuf};

use clap::Parser;

use super::Cli;

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

fn pages(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            pages(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "md") {
            found.push(path);
        }
    }
}

/// Replaces the shell variables of a command line by 3, which is valid as a number, a frequency and a name.
fn without_variables(command: &str) -> String {
    let mut parts = command.split('$');
    let mut found = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let end = part.strip_prefix('{').and_then(|_| Some(part.find('}')? + 1));
        let name = part.find(|c: char| !c.is_alphanumeric() && c != '_');
        found.push('3');
        found.push_str(&part[end.or(name).unwrap_or(part.len())..]);
    }
    found
}

/// Words of a command line without quotes, up to the first pipe, redirection or comment.
fn words(command: &str) -> Vec<String> {
    let command = without_variables(command);
    let mut words = vec![String::new()];
    let (mut quote, mut before) = (None, ' ');
    for c in command.chars() {
        let is_quote = matches!(c, '\'' | '"');
        match quote {
            Some(open) if c == open => quote = None,
            None if is_quote => quote = Some(c),
            None if matches!(c, '|' | ';' | '&' | '<' | '>') || (c == '#' && before == ' ') => {
                // `2> file` is a redirection.
                if c == '>' && before == '2' {
                    words.pop();
                }
                break;
            }
            None if c.is_whitespace() => words.push(String::new()),
            _ => words.last_mut().unwrap().push(c),
        }
        before = c;
    }
    words.retain(|word| !word.is_empty());
    words
}

/// Command lines of a page: lines of code blocks, and code spans that name a file.
fn commands(page: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut is_block = false;
    for line in page.replace("\\\n", " ").lines() {
        if line.starts_with("```") {
            is_block = !is_block;
        } else if is_block || line.starts_with("    ") {
            let line = line.replace("cargo run --release --", "lunarray");
            // The command may follow `mpirun -n 4` or `until`.
            let is_command =
                ["lunarray ", "mpirun ", "until "].iter().any(|word| line.trim().starts_with(word));
            let start = line.find("lunarray ").filter(|_| is_command);
            found.extend(start.map(|start| line[start..].to_owned()));
        } else {
            let code = line.split('`').skip(1).step_by(2);
            let is_complete =
                |code: &&str| !code.contains(['[', '|']) && !code.contains("...") && code.contains('.');
            let commands = code.filter(|code| code.starts_with("lunarray ")).filter(is_complete);
            found.extend(commands.map(str::to_owned));
        }
    }
    found
}

#[test]
fn every_documented_command_is_valid() {
    let mut files = vec![Path::new(ROOT).join("README.md"), Path::new(ROOT).join("CONTRIBUTING.md")];
    pages(&Path::new(ROOT).join("docs"), &mut files);
    let keys = std::fs::read_to_string(Path::new(ROOT).join("pipelines/reference.toml")).unwrap();
    let (mut problems, mut count) = (Vec::new(), 0);
    for file in files {
        for command in commands(&std::fs::read_to_string(&file).unwrap()) {
            let words = words(&command);
            count += 1;
            if let Err(error) = Cli::try_parse_from(&words) {
                let is_help = !error.use_stderr();
                if !is_help {
                    problems.push(format!("{}: {command}\n{error}", file.display()));
                }
            }
            for set in words.windows(2).filter(|pair| pair[0] == "--set") {
                let key = set[1].split('=').next().unwrap_or_default();
                let last = key.rsplit('.').next().unwrap_or_default();
                if key != "KEY" && !keys.contains(last) {
                    problems.push(format!(
                        "{}: {command}\nno key {key} in pipelines/reference.toml",
                        file.display()
                    ));
                }
            }
        }
    }
    assert!(problems.is_empty(), "{}", problems.join("\n"));
    // The test must not pass because no command was found.
    assert!(count > 40, "{count}");
}

#[test]
fn commands_are_found_in_pages() {
    let page = "`lunarray run x.toml` and `lunarray gaps`\n```sh\nlunarray top --once 8080 > x # why\nls\n```\n    mpirun -n 4 lunarray run \\\n  --mpi\n";
    let found: Vec<Vec<String>> = commands(page).iter().map(|command| words(command)).collect();
    assert_eq!(
        found,
        [
            vec!["lunarray", "run", "x.toml"],
            vec!["lunarray", "top", "--once", "8080"],
            vec!["lunarray", "run", "--mpi"],
        ]
    );
    assert_eq!(words("lunarray run --set 'a=[1, 2]' 2> y &"), ["lunarray", "run", "--set", "a=[1, 2]"]);
    assert_eq!(
        words("lunarray sky --freq-hz ${mhz}e6 -o x-$mhz.fits"),
        ["lunarray", "sky", "--freq-hz", "3e6", "-o", "x-3.fits"]
    );
}
