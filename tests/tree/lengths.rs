//! No function is longer than a screen or two, of whose body the lines that hold code are counted, and no file longer than ten.

use std::path::Path;

use super::source::code_alone;

/// Most lines of code in the body of a function.
const LINES_MAX: usize = 80;

/// Most lines of a file.
const FILE_LINES_MAX: usize = 600;

/// What is counted.
const FOLDERS: [&str; 5] = ["src", "python/src", "tests", "benches", "examples"];

/// Functions of a file: name, line where each begins, and lines of code between the braces of its body.
fn functions(text: &str) -> Vec<(String, usize, usize)> {
    let code = code_alone(text);
    let word = |c: char| c.is_alphanumeric() || c == '_';
    let mut found = Vec::new();
    for (at, _) in code.match_indices("fn ") {
        let name: String = code[at + 3..].chars().take_while(|c| word(*c)).collect();
        if code[..at].ends_with(word) || name.is_empty() {
            continue;
        }
        let Some(body) = body(&code[at..]) else { continue };
        let lines = body.lines().filter(|line| !line.trim().is_empty()).count();
        found.push((name, 1 + code[..at].matches('\n').count(), lines));
    }
    found
}

/// What is between the braces of the function that `code` begins with; a declaration has none.
fn body(code: &str) -> Option<&str> {
    let (mut depth, mut start) = (0, None);
    for (at, sign) in code.char_indices() {
        match sign {
            ';' if depth == 0 => return None,
            '{' if depth == 0 => (depth, start) = (1, Some(at + 1)),
            '(' | '[' | '{' => depth += 1,
            ')' | ']' => depth -= 1,
            '}' => {
                depth -= 1;
                if depth == 0 {
                    return Some(&code[start?..at]);
                }
            }
            _ => {}
        }
    }
    None
}

#[test]
fn no_function_and_no_file_is_long() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (mut long, mut count) = (Vec::new(), 0);
    for folder in FOLDERS {
        let mut sources = Vec::new();
        super::read_folder(&root.join(folder), "", &mut sources);
        for (path, text) in sources {
            let lines = text.lines().count();
            if lines > FILE_LINES_MAX {
                long.push(format!("{folder}/{path} has {lines} lines: expected at most {FILE_LINES_MAX}"));
            }
            let functions = functions(&text);
            count += functions.len();
            let too_long = functions.into_iter().filter(|(_, _, lines)| *lines > LINES_MAX);
            long.extend(too_long.map(|(name, line, lines)| {
                format!("{folder}/{path}:{line}: {name} has {lines} lines: expected at most {LINES_MAX}")
            }));
        }
    }
    // Without functions the rule would hold of nothing.
    assert!(count > 5_000, "only {count} functions were found");
    assert!(long.is_empty(), "divide into parts with names\n{}", long.join("\n"));
}

#[test]
fn lines_of_code_are_counted() {
    let text = "/// fn a() {\nfn one(b: [u8; 2]) -> u8 {\n    // Why.\n\n    let c = \"}\n    {\";\n    1\n}\ntrait T {\n    fn none(&self);\n    \
                fn two(&self) { /* } */ self.none() }\n}\nfn three() {\n    [b'\"', b'\\''];\n}\nfn four() {}\n";
    let of = |name: &str, line, lines| (name.to_owned(), line, lines);
    assert_eq!(functions(text), [of("one", 2, 3), of("two", 11, 1), of("three", 13, 1), of("four", 16, 0)]);
}
