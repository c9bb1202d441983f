//! The public interface: what `cargo doc` shows stays so little that it reads like a manual.
//!
//! Counted are types, traits, functions and constants of documented modules, re-exported or defined there, and the methods and
//! constants of these types and traits; not fields, variants, implementations of traits, and what is `#[doc(hidden)]`. Sources are
//! read line by line, as rustfmt leaves them.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Most items that the documentation may have.
const ITEMS_MAX: usize = 300;

const SRC: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/src");

/// What a module shows.
#[derive(Default)]
struct Shown {
    items: BTreeSet<String>,
    modules: Vec<String>,
}

/// The name behind a declaration such as `pub struct `, if the line is one at this indentation.
fn declared<'a>(line: &'a str, indent: &str, kinds: &[&str]) -> Option<&'a str> {
    let rest = line.strip_prefix(indent)?.strip_prefix("pub ")?;
    let rest = rest.strip_prefix("const fn ").map_or(rest, |name| &rest[rest.len() - name.len() - 3..]);
    let kind = kinds.iter().find(|kind| rest.starts_with(&format!("{kind} ")))?;
    let name = &rest[kind.len() + 1..];
    Some(&name[..name.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(name.len())])
}

/// Whether an attribute above line `k` hides it.
fn is_hidden(lines: &[&str], k: usize) -> bool {
    let above = lines[..k].iter().rev().map(|line| line.trim());
    above
        .take_while(|line| line.starts_with("#[") || line.starts_with("///"))
        .any(|line| line == "#[doc(hidden)]")
}

fn shown(text: &str) -> Shown {
    let lines: Vec<&str> = text.lines().collect();
    let mut found = Shown::default();
    for (k, line) in lines.iter().enumerate().filter(|(k, _)| !is_hidden(&lines, *k)) {
        if let Some(name) = declared(line, "", &["mod"]).filter(|_| line.ends_with(';')) {
            found.modules.push(name.to_owned());
        } else if let Some(name) =
            declared(line, "", &["struct", "enum", "trait", "type", "fn", "const", "static", "union"])
        {
            found.items.insert(name.to_owned());
        } else if line.starts_with("pub use ") {
            let whole = lines[k..].join(" ");
            let whole = whole.split(';').next().unwrap_or_default();
            let names = whole.rsplit("::").next().unwrap_or_default();
            let names = whole.split_once('{').map_or(names, |(_, names)| names);
            for name in names.split([',', '{', '}']).map(str::trim).filter(|name| !name.is_empty()) {
                found.items.insert(name.rsplit(' ').next().unwrap_or(name).to_owned());
            }
        }
    }
    found
}

/// The text of a module's file.
fn text_of(module: &Path) -> String {
    let files = [module.with_extension("rs"), module.join("mod.rs")];
    let file =
        files.iter().find(|file| file.exists()).unwrap_or_else(|| panic!("no file of {}", module.display()));
    std::fs::read_to_string(file).unwrap()
}

/// The type of an inherent implementation, or the trait that begins at a line.
fn block_of(line: &str) -> Option<String> {
    if let Some(name) = declared(line, "", &["trait"]) {
        return Some(name.to_owned());
    }
    let rest = line.strip_prefix("impl")?.split(" where ").next()?;
    if rest.contains(" for ") {
        return None;
    }
    // Behind the parameters, if there are any.
    let mut depth = 0;
    let start = rest.find(|c| {
        depth += i32::from(c == '<') - i32::from(c == '>');
        c == ' ' && depth == 0
    })?;
    let name = rest[start + 1..].split(['<', ' ', '{']).next()?;
    Some(name.to_owned())
}

/// Methods and constants of types and traits, with the names of these.
fn methods(text: &str) -> Vec<(String, String)> {
    let lines: Vec<&str> = text.lines().collect();
    let (mut within, mut is_trait, mut found) = (None, false, Vec::new());
    for (k, line) in lines.iter().enumerate() {
        if let Some(name) = block_of(line) {
            (within, is_trait) = (Some(name), line.starts_with("pub trait"));
        } else if *line == "}" {
            within = None;
        }
        let Some(name) = &within else { continue };
        let of_trait = line.strip_prefix("    fn ").filter(|_| is_trait);
        let of_trait = of_trait.map(|rest| rest.split(['(', '<']).next().unwrap_or(rest));
        let method = declared(line, "    ", &["fn", "const"]).or(of_trait);
        if let Some(method) = method.filter(|_| !is_hidden(&lines, k)) {
            found.push((name.clone(), method.to_owned()));
        }
    }
    found
}

fn files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

/// Items of the documentation by module, without the re-exports of `prelude`.
fn items() -> BTreeSet<(String, String)> {
    let mut found = BTreeSet::new();
    // What the library shows are modules of the workspace's members.
    let rooms = shown(&std::fs::read_to_string(Path::new(SRC).join("lib.rs")).unwrap()).items;
    let mut open: Vec<_> = rooms
        .iter()
        .filter(|room| *room != "prelude")
        .flat_map(|room| ["core", "app"].map(|member| Path::new(SRC).join(member).join(room)))
        .filter(|module| module.exists())
        .map(|module| (module.clone(), text_of(&module)))
        .collect();
    while let Some((module, text)) = open.pop() {
        let Shown { items, modules } = shown(&text);
        let name = module.strip_prefix(SRC).unwrap().display().to_string();
        found.extend(items.into_iter().map(|item| (name.clone(), item)));
        for inner in modules.iter().filter(|inner| *inner != "prelude") {
            open.push((module.join(inner), text_of(&module.join(inner))));
        }
    }
    found
}

#[test]
fn the_documentation_is_a_manual() {
    let items = items();
    assert!(items.len() > 100, "{items:?}");
    let mut sources = Vec::new();
    files(Path::new(SRC), &mut sources);
    let names: BTreeSet<&String> = items.iter().map(|(_, item)| item).collect();
    let methods: BTreeSet<(String, String)> = sources
        .iter()
        .flat_map(|path| methods(&std::fs::read_to_string(path).unwrap()))
        .filter(|(name, _)| names.contains(name))
        .collect();
    assert!(methods.len() > 50, "{methods:?}");
    let count = items.len() + methods.len();
    let listed: Vec<String> =
        items.iter().chain(&methods).map(|(place, name)| format!("{place}::{name}")).collect();
    assert!(
        count <= ITEMS_MAX,
        "{count} documented items ({} and {} methods): expected at most {ITEMS_MAX}; hide what no program outside needs by \
         #[doc(hidden)], or make it pub(crate)\n{}",
        items.len(),
        methods.len(),
        listed.join("\n")
    );
}

#[test]
fn what_is_hidden_does_not_count() {
    let text = "pub mod a;\n#[doc(hidden)]\npub mod b;\nmod c;\n/// Of c.\npub use c::{One, Two as Three};\n#[doc(hidden)]\n\
                pub use c::{\n    Four,\n};\npub use c::Five;\n/// Six.\n#[derive(Debug)]\npub struct Six<T>(T);\npub const fn seven() {}\n\
                pub(crate) fn eight() {}\npub use c::{\n    Nine, Ten,\n};\n";
    let found = shown(text);
    assert_eq!(found.modules, ["a"]);
    assert_eq!(
        found.items.into_iter().collect::<Vec<_>>(),
        ["Five", "Nine", "One", "Six", "Ten", "Three", "seven"]
    );
    let text = "impl<T: Into<u8>> Six<T> {\n    pub fn a(&self) {}\n    /// B.\n    #[doc(hidden)]\n    pub const fn b() {}\n    fn c() {}\n    \
                pub const D: u8 = 1;\n}\nimpl Drop for Six<u8> {\n    fn drop(&mut self) {}\n}\npub trait Named {\n    fn name(&self);\n}\n";
    let of = |name: &str, method: &str| (name.to_owned(), method.to_owned());
    assert_eq!(methods(text), [of("Six", "a"), of("Six", "D"), of("Named", "name")]);
}
