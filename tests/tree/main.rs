//! The tree is the data's path: reads `src/` as text and fails where an import goes against it.
//!
//! Two rules, each with its own message on how to mend what offends:
//! a folder imports only folders before it in [`ORDER`], and the ground nothing of the spacecraft; neither files nor the parts of a folder
//! (its files, and folders as wholes) import each other in a circle.
//!
//! [`lengths`] has the longest a function may be, [`messages`] what errors may show, [`public`] how many items the library shows, [`book`] what links may lead to.
//!
//! An import is a `use` or a path in the code. It is followed through `pub use` to the file that defines the item, so
//! that a re-export neither hides an import nor makes one. Code under `#[cfg(test)]` is free.
#![allow(clippy::unwrap_used, clippy::panic)] // A test fails by panicking.

mod book;
mod lengths;
mod messages;
mod public;
mod rules;
mod source;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use source::{File, ModulePath, parse};

/// Folders (and files) of `src/core/` and then of `src/app/`, each after all that it may use.
const ORDER: [&str; 24] = [
    "units",
    "numerics",
    "files",
    "ranks",
    "frames",
    "runtime",
    "sky",
    "array",
    "response",
    "daughters",
    "mother",
    "downlink",
    "calibration",
    "imaging",
    "ground",
    "products",
    "pipeline",
    "prelude",
    "figures",
    "serve",
    "bench",
    "cli",
    "tab",
    "main",
];
const SPACECRAFT: [&str; 2] = ["daughters", "mother"];
const GROUND: [&str; 5] = ["downlink", "calibration", "imaging", "ground", "products"];

#[test]
fn the_tree_is_the_path_of_the_data() {
    let mut sources = Vec::new();
    read_folder(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/src")), "", &mut sources);
    let tree = Tree::new(&sources);
    // Without these the rules would hold of nothing.
    assert!(tree.files.len() > 150, "only {} files", tree.files.len());
    assert!(tree.imports().values().map(BTreeSet::len).sum::<usize>() > 500, "hardly any import was found");
    let offences = tree.offences();
    assert!(offences.is_empty(), "{} offences\n{}", offences.len(), offences.join("\n"));
}

fn read_folder(folder: &Path, below: &str, sources: &mut Vec<(String, String)>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = format!("{below}{}", path.file_name().unwrap().to_str().unwrap());
        if path.is_dir() {
            read_folder(&path, &format!("{name}/"), sources);
        } else if name.ends_with(".rs") {
            sources.push((name, std::fs::read_to_string(&path).unwrap()));
        }
    }
}

struct Tree {
    files: BTreeMap<ModulePath, File>,
}

impl Tree {
    /// Of files by their paths below `src/`, and their text.
    fn new(sources: &[(String, String)]) -> Self {
        let parsed: Vec<_> = sources.iter().map(|(path, text)| parse(path, text)).collect();
        let of_tests: BTreeSet<ModulePath> = parsed.iter().flat_map(|(_, _, tests)| tests.clone()).collect();
        let is_test = |module: &[String]| (0..=module.len()).any(|n| of_tests.contains(&module[..n]));
        let kept = parsed.into_iter().filter(|(module, ..)| !is_test(module));
        Self { files: kept.map(|(module, file, _)| (module, file)).collect() }
    }

    fn offences(&self) -> Vec<String> {
        [self.against_order(), self.circles()].concat()
    }

    fn against_order(&self) -> Vec<String> {
        let mut found = BTreeSet::new();
        let place = |folder: &String| ORDER.iter().position(|name| name == folder);
        for (module, file) in self.files.iter().filter(|(module, _)| !module.is_empty()) {
            let Some(here) = place(&module[0]) else {
                found.insert(format!(
                    "src/{}: `{}` has no place in the data's path; give it one in tests/tree/main.rs",
                    file.path, module[0]
                ));
                continue;
            };
            let re_exported = file.exports.values();
            for (base, path) in file.references.iter().chain(re_exported) {
                let Some(target) = self.resolve(base, path).filter(|target| !target.is_empty()) else {
                    continue;
                };
                let (from, to) = (&module[0], &target[0]);
                if place(to).is_some_and(|there| there > here) {
                    found.insert(format!(
                        "src/{} imports `{}`, but `{to}` comes after `{from}` in the data's path.\n    \
                         Move what both need to `{from}` or before it, or let the caller pass it in.",
                        file.path,
                        path.join("::")
                    ));
                } else if GROUND.contains(&from.as_str()) && SPACECRAFT.contains(&to.as_str()) {
                    found.insert(format!(
                        "src/{} imports `{}`, but the ground knows the spacecraft by bytes alone.\n    \
                         Move what both need before `daughters` (to `frames`, `array` or `response`).",
                        file.path,
                        path.join("::")
                    ));
                }
            }
        }
        found.into_iter().collect()
    }

    /// Circles of files, and of the parts of each folder: its files, and its folders as wholes.
    fn circles(&self) -> Vec<String> {
        let imports = self.imports();
        let file = |file: &ModulePath| Some(file.clone());
        let mut found: Vec<String> = circles(&among(&imports, file))
            .iter()
            .map(|circle| self.describe("files", circle, &imports, file))
            .collect();
        let folders: BTreeSet<&[String]> =
            self.files.keys().flat_map(|module| (0..module.len()).map(|n| &module[..n])).collect();
        for folder in folders {
            let part = |file: &ModulePath| {
                (file.len() > folder.len() && file.starts_with(folder))
                    .then(|| file[..=folder.len()].to_vec())
            };
            // Of files alone is told above.
            let is_folder = |part: &ModulePath| {
                self.files.keys().any(|file| file.len() > part.len() && file.starts_with(part))
            };
            let circles = circles(&among(&imports, part));
            let circles = circles.iter().filter(|circle| circle.iter().any(is_folder));
            found.extend(circles.map(|circle| self.describe("parts of a folder", circle, &imports, part)));
        }
        found
    }

    /// What the members of a circle import of one another, file by file.
    fn describe(
        &self,
        what: &str,
        circle: &BTreeSet<ModulePath>,
        imports: &BTreeMap<&ModulePath, BTreeSet<&ModulePath>>,
        part: impl Fn(&ModulePath) -> Option<ModulePath>,
    ) -> String {
        let member = |file: &ModulePath| part(file).filter(|part| circle.contains(part));
        let mut text = format!(
            "{} {what} import each other in a circle.\n    \
             Cut it where one needs least of another: move that item to the other or to a third below both.",
            circle.len()
        );
        for (from, targets) in imports {
            let Some(own) = member(from) else { continue };
            let to = targets.iter().filter(|to| member(to).is_some_and(|other| other != own));
            let to: Vec<_> = to.map(|to| format!("src/{}", self.files[*to].path)).collect();
            if !to.is_empty() {
                text += &format!("\n    src/{} imports {}", self.files[*from].path, to.join(", "));
            }
        }
        text
    }

    /// Which files each file imports; what it merely re-exports is not among them.
    fn imports(&self) -> BTreeMap<&ModulePath, BTreeSet<&ModulePath>> {
        let of = |module, file: &File| {
            let targets = file.references.iter().filter_map(|(base, path)| self.resolve(base, path));
            targets.filter(|target| *target != module).collect()
        };
        self.files.iter().map(|(module, file)| (module, of(module, file))).collect()
    }

    /// The file that defines what `path` names in the module `base`; none if that is another crate or a local name.
    fn resolve(&self, base: &[String], path: &[String]) -> Option<&ModulePath> {
        self.follow(self.absolute(base, path)?, &mut BTreeSet::new())
    }

    fn absolute(&self, base: &[String], path: &[String]) -> Option<ModulePath> {
        let supers = path.iter().take_while(|part| *part == "super").count();
        let child = || [base, &path[..1]].concat();
        match path.first()?.as_str() {
            "crate" => Some(path[1..].to_vec()),
            "self" => Some([base, &path[1..]].concat()),
            "super" => Some([base.get(..base.len().checked_sub(supers)?)?, &path[supers..]].concat()),
            _ if self.files.contains_key(&child()) => Some([base, path].concat()),
            _ => None,
        }
    }

    fn follow(&self, path: ModulePath, seen: &mut BTreeSet<ModulePath>) -> Option<&ModulePath> {
        let length = (0..=path.len()).rev().find(|n| self.files.contains_key(&path[..*n]))?;
        let (module, file) = self.files.get_key_value(&path[..length])?;
        let Some((base, source)) = path.get(length).and_then(|name| file.exports.get(name)) else {
            return Some(module);
        };
        if !seen.insert(path.clone()) {
            return None;
        }
        let mut source = self.absolute(base, source)?;
        source.extend_from_slice(&path[length + 1..]);
        self.follow(source, seen)
    }
}

/// Imports of files as those of the parts that they belong to.
fn among(
    imports: &BTreeMap<&ModulePath, BTreeSet<&ModulePath>>,
    part: impl Fn(&ModulePath) -> Option<ModulePath>,
) -> BTreeMap<ModulePath, BTreeSet<ModulePath>> {
    let mut found = BTreeMap::<ModulePath, BTreeSet<ModulePath>>::new();
    for (from, targets) in imports {
        let Some(from) = part(from) else { continue };
        let targets = targets.iter().filter_map(|to| part(to)).filter(|to| *to != from);
        found.entry(from.clone()).or_default().extend(targets);
    }
    found
}

/// Groups of which each member reaches every other by imports.
fn circles(imports: &BTreeMap<ModulePath, BTreeSet<ModulePath>>) -> BTreeSet<BTreeSet<ModulePath>> {
    let reach: BTreeMap<_, _> = imports.keys().map(|from| (from, reachable(from, imports))).collect();
    reach
        .iter()
        .map(|(from, to)| to.iter().filter(|to| reach[*to].contains(*from)).map(|to| (*to).clone()).collect())
        .filter(|circle: &BTreeSet<_>| circle.len() > 1)
        .collect()
}

fn reachable<'a>(
    from: &'a ModulePath,
    imports: &'a BTreeMap<ModulePath, BTreeSet<ModulePath>>,
) -> BTreeSet<&'a ModulePath> {
    let (mut found, mut open) = (BTreeSet::new(), vec![from]);
    while let Some(part) = open.pop() {
        open.extend(imports[part].iter().filter(|to| found.insert(*to)));
    }
    found
}
