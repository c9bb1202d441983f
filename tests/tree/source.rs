//! What a source file imports, re-exports and defines, read from its text.

use std::collections::BTreeMap;

/// Segments below the crate: `["sky", "fits"]` for `crate::sky::fits`.
pub type ModulePath = Vec<String>;

/// What the rules need to know of a file.
pub struct File {
    pub path: String,
    /// Paths that it names in the module where they stand.
    pub references: Vec<(ModulePath, Vec<String>)>,
    /// Names that it re-exports, and of what.
    pub exports: BTreeMap<String, (ModulePath, Vec<String>)>,
}

/// The file's module, what is in it, and the modules that it declares for tests alone.
pub fn parse(path: &str, text: &str) -> (ModulePath, File, Vec<ModulePath>) {
    // The members of the workspace are one tree.
    let place = ["core/", "app/"].iter().find_map(|member| path.strip_prefix(member)).unwrap_or(path);
    let mut module: ModulePath = place.trim_end_matches(".rs").split('/').map(str::to_owned).collect();
    if matches!(module.last().unwrap().as_str(), "mod" | "lib") {
        module.pop();
    }
    let (tokens, tests) = without_tests(&tokens(text));
    let tests = tests.into_iter().map(|name| [module.clone(), vec![name]].concat()).collect();
    let mut file = File { path: path.to_owned(), references: vec![], exports: BTreeMap::new() };
    // The module in which a token stands, with the depths at which inner modules end.
    let (mut base, mut ends, mut depth) = (module.clone(), vec![], 0);
    let mut k = 0;
    while k < tokens.len() {
        let next = |n: usize| tokens.get(k + n).map_or("", String::as_str);
        match tokens[k].as_str() {
            "{" => depth += 1,
            "}" => {
                depth -= 1;
                if ends.last() == Some(&depth) {
                    ends.pop();
                    base.pop();
                }
            }
            "mod" if next(2) == "{" => {
                base.push(next(1).to_owned());
                ends.push(depth);
            }
            "use" if next(1) != "<" => {
                let public = visibility(&tokens, k).is_some();
                let mut leaves = Vec::new();
                k = use_tree(&tokens, k + 1, &[], &mut leaves);
                for (path, name) in leaves {
                    match public {
                        true => drop(file.exports.insert(name, (base.clone(), path))),
                        false => file.references.push((base.clone(), path)),
                    }
                }
                continue;
            }
            first if is_name(first) && next(1) == "::" && !(k > 0 && tokens[k - 1] == "::") => {
                let mut path = vec![first.to_owned()];
                while tokens.get(k + 1).is_some_and(|t| t == "::")
                    && tokens.get(k + 2).is_some_and(|t| is_name(t))
                {
                    path.push(tokens[k + 2].clone());
                    k += 2;
                }
                file.references.push((base.clone(), path));
            }
            _ => {}
        }
        k += 1;
    }
    (module, file, tests)
}

/// The scope in `pub(scope)` before token `k`; empty for `pub` alone, none without it.
fn visibility(tokens: &[String], k: usize) -> Option<&str> {
    let before = |n: usize| k.checked_sub(n).map_or("", |at| tokens[at].as_str());
    match before(1) {
        "pub" => Some(""),
        ")" => {
            let open = tokens[..k].iter().rposition(|token| token == "(")?;
            (open > 0 && tokens[open - 1] == "pub").then(|| tokens[open + 1].as_str())
        }
        "unsafe" => visibility(tokens, k - 1),
        _ => None,
    }
}

/// Adds the paths of the tree that begins at token `k`, and the name that each gets; the token behind it.
fn use_tree(
    tokens: &[String],
    mut k: usize,
    above: &[String],
    leaves: &mut Vec<(Vec<String>, String)>,
) -> usize {
    let mut path = above.to_vec();
    let mut name = None;
    while k < tokens.len() {
        match tokens[k].as_str() {
            "{" => {
                while tokens[k] != "}" {
                    k += 1;
                    if tokens[k] != "}" {
                        k = use_tree(tokens, k, &path, leaves);
                    }
                }
                return k + 1;
            }
            "," | "}" | ";" => break,
            "as" => {
                name = Some(tokens[k + 1].clone());
                k += 1;
            }
            "self" if !path.is_empty() => {}
            "::" if path.is_empty() => path.push("::".to_owned()), // Of another crate.
            "::" => {}
            part => path.push(part.to_owned()),
        }
        k += 1;
    }
    if let Some(last) = path.last().cloned() {
        leaves.push((path, name.unwrap_or(last)));
    }
    k
}

/// The tokens outside `#[cfg(test)]`, and the names of the files declared under it.
fn without_tests(tokens: &[String]) -> (Vec<String>, Vec<String>) {
    let (mut kept, mut tests, mut k) = (Vec::new(), Vec::new(), 0);
    while k < tokens.len() {
        if tokens[k..].starts_with(&["#", "[", "cfg", "(", "test", ")", "]"].map(str::to_owned)) {
            let start = k + 7;
            k = end_of_item(tokens, start);
            if let Some(at) = (start..k).find(|at| tokens[*at] == "mod")
                && tokens[at + 2] == ";"
            {
                tests.push(tokens[at + 1].clone());
            }
        } else {
            kept.push(tokens[k].clone());
            k += 1;
        }
    }
    (kept, tests)
}

/// The token behind the item that starts at token `k`.
fn end_of_item(tokens: &[String], mut k: usize) -> usize {
    let mut depth = 0_usize;
    while k < tokens.len() {
        match tokens[k].as_str() {
            ";" if depth == 0 => return k + 1,
            "}" if depth == 1 => return k + 1,
            ")" | "]" | "}" if depth == 0 => return k,
            "(" | "[" | "{" => depth += 1,
            ")" | "]" | "}" => depth -= 1,
            _ => {}
        }
        k += 1;
    }
    k
}

fn is_name(token: &str) -> bool {
    token.starts_with(|c: char| c.is_alphabetic() || c == '_')
}

/// Names, `::` and single signs; comments are left out, literals of text are empty.
fn tokens(text: &str) -> Vec<String> {
    let mut tokens = Vec::new();
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let name = rest.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(rest.len());
        let taken = if rest.starts_with("//") {
            rest.find('\n').unwrap_or(rest.len())
        } else if rest.starts_with("/*") {
            block_comment(rest)
        } else if let Some(length) = text_literal(rest) {
            tokens.push("\"\"".to_owned());
            length
        } else if name > 0 {
            tokens.push(rest[..name].to_owned());
            name
        } else if rest.starts_with("::") {
            tokens.push("::".to_owned());
            2
        } else {
            if !first.is_whitespace() {
                tokens.push(first.to_string());
            }
            first.len_utf8()
        };
        rest = &rest[taken..];
    }
    tokens
}

/// A text without comments and without what is between quotes, line for line.
pub fn code_alone(text: &str) -> String {
    let (mut code, mut rest) = (String::with_capacity(text.len()), text);
    let mut in_name = false;
    while let Some(first) = rest.chars().next() {
        let is_literal = !in_name && text_literal(rest).is_some();
        let taken = if rest.starts_with("//") {
            rest.find('\n').unwrap_or(rest.len())
        } else if rest.starts_with("/*") {
            block_comment(rest)
        } else if is_literal {
            code.push_str("\"\"");
            text_literal(rest).unwrap_or(1)
        } else {
            first.len_utf8()
        };
        in_name = first.is_alphanumeric() || first == '_';
        match taken == first.len_utf8() && !is_literal {
            true => code.push(first),
            false => code.extend(rest[..taken].chars().filter(|c| *c == '\n')),
        }
        rest = &rest[taken..];
    }
    code
}

/// The length of a comment that may hold others.
fn block_comment(text: &str) -> usize {
    let (mut depth, mut at) = (0, 0);
    while at < text.len() {
        let (step, change) = match text.as_bytes()[at..] {
            [b'/', b'*', ..] => (2, 1),
            [b'*', b'/', ..] => (2, -1),
            _ => (1, 0),
        };
        at += step;
        depth += change;
        if depth == 0 {
            break;
        }
    }
    at
}

/// The length of the string or character that `text` begins with, if it does.
fn text_literal(text: &str) -> Option<usize> {
    let bytes = text.as_bytes();
    let prefix = ["br", "cr", "b", "c", "r"].into_iter().find(|p| {
        let behind = text.strip_prefix(p).unwrap_or_default();
        behind.trim_start_matches('#').starts_with('"') && (p.ends_with('r') || behind.starts_with('"'))
    });
    let start = prefix.map_or(usize::from(text.starts_with("b'")), str::len);
    if prefix.is_some_and(|p| p.ends_with('r')) {
        let signs = text[start..].find('"')?;
        let end = format!("\"{}", "#".repeat(signs));
        let inside = start + signs + 1;
        return Some(inside + text[inside..].find(&end)? + end.len());
    }
    let quote = bytes[start];
    let is_char = quote == b'\'' && {
        let mut inside = text[start + 1..].chars();
        inside.next() == Some('\\') || inside.next() == Some('\'')
    };
    if quote != b'"' && !is_char {
        return None;
    }
    let mut at = start + 1;
    while at < bytes.len() && bytes[at] != quote {
        at += if bytes[at] == b'\\' { 2 } else { 1 };
    }
    Some(at + 1)
}
