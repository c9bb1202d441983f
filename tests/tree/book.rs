//! The book in `docs/`: every page is in its table of contents, and every link leads somewhere.
//!
//! Links of a page may lead to files of the book and to headings in them; nothing else of the repository is on the site. The README is read
//! in the repository, and may link to all of it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// Pages below a folder, by their paths in it.
fn pages(folder: &Path, inside: &Path, found: &mut BTreeMap<PathBuf, String>) {
    for entry in std::fs::read_dir(folder.join(inside)).unwrap() {
        let name = inside.join(entry.unwrap().file_name());
        let path = folder.join(&name);
        if path.is_dir() {
            pages(folder, &name, found);
        } else if path.extension().is_some_and(|extension| extension == "md") {
            found.insert(name, std::fs::read_to_string(path).unwrap());
        }
    }
}

/// Lines of a page that are text, with code between backticks taken out.
fn text(page: &str) -> impl Iterator<Item = String> {
    let mut is_code = false;
    page.lines().filter_map(move |line| {
        if line.trim_start().starts_with("```") {
            is_code = !is_code;
            return None;
        }
        (!is_code).then(|| line.split('`').step_by(2).collect::<Vec<_>>().join("`"))
    })
}

/// Targets of links and pictures, `[text](target)`.
fn links(page: &str) -> Vec<String> {
    let all: Vec<String> = text(page).collect();
    let parts = all.join("\n");
    parts.split("](").skip(1).filter_map(|rest| Some(rest.split_once(')')?.0.to_owned())).collect()
}

/// The names by which headings can be linked to, as mdBook and code hosts make them.
fn anchors(page: &str) -> BTreeSet<String> {
    let mut is_code = false;
    let mut found = BTreeSet::new();
    for line in page.lines() {
        is_code ^= line.trim_start().starts_with("```");
        let title = line.trim_start_matches('#');
        if is_code || title.len() == line.len() || !title.starts_with(' ') {
            continue;
        }
        let kept = |c: char| match c {
            ' ' => Some('-'),
            c if c.is_alphanumeric() || c == '-' || c == '_' => Some(c.to_ascii_lowercase()),
            _ => None,
        };
        let name: String = title.trim().chars().filter_map(kept).collect();
        let again = (1..).map(|k| format!("{name}-{k}")).find(|next| !found.contains(next));
        found.insert(if found.contains(&name) { again.unwrap() } else { name });
    }
    found
}

/// A path without `.` and `..`; `None` if it leads out.
fn within(path: &Path) -> Option<PathBuf> {
    let mut found = PathBuf::new();
    for part in path.components() {
        match part {
            Component::Normal(name) => found.push(name),
            Component::CurDir => {}
            Component::ParentDir => {
                if !found.pop() {
                    return None;
                }
            }
            _ => return None,
        }
    }
    Some(found)
}

/// What is wrong with the links of a page in a folder.
fn broken(folder: &Path, name: &Path, page: &str) -> Vec<String> {
    let mut problems = Vec::new();
    for link in links(page) {
        if link.starts_with("https://") || link.starts_with("http://") {
            continue;
        }
        let (path, anchor) = link.split_once('#').map_or((link.as_str(), None), |(p, a)| (p, Some(a)));
        let target = match path {
            "" => Some(name.to_owned()),
            path => within(&name.parent().unwrap().join(path)),
        };
        let is_own = target.as_deref() == Some(name);
        let place = target.map(|target| folder.join(target)).filter(|place| is_own || place.exists());
        let Some(place) = place else {
            problems.push(format!("{}: {link} leads to no file of {}", name.display(), folder.display()));
            continue;
        };
        let Some(anchor) = anchor else { continue };
        let there =
            if is_own { page.to_owned() } else { std::fs::read_to_string(&place).unwrap_or_default() };
        if !anchors(&there).contains(anchor) {
            problems.push(format!("{}: {link}: no such heading", name.display()));
        }
    }
    problems
}

#[test]
fn every_page_is_in_the_book_and_every_link_leads_somewhere() {
    let docs = Path::new(ROOT).join("docs");
    let mut found = BTreeMap::new();
    pages(&docs, Path::new(""), &mut found);
    let contents = &found[Path::new("SUMMARY.md")];
    let listed: Vec<PathBuf> = links(contents).into_iter().map(PathBuf::from).collect();
    let once: BTreeSet<&PathBuf> = listed.iter().collect();
    assert_eq!(once.len(), listed.len(), "a page stands twice in SUMMARY.md");
    let pages: BTreeSet<&PathBuf> = found.keys().filter(|path| *path != Path::new("SUMMARY.md")).collect();
    assert_eq!(once, pages, "SUMMARY.md and the pages in docs/");
    assert!(pages.len() > 12);

    // One screen: the rest stands on the site.
    let readme_bytes = std::fs::read(Path::new(ROOT).join("README.md")).unwrap().len();
    assert!(readme_bytes <= 6_000, "README.md has {readme_bytes} bytes, expected at most 6,000");

    let mut problems: Vec<String> = found.iter().flat_map(|(name, page)| broken(&docs, name, page)).collect();
    let readme = std::fs::read_to_string(Path::new(ROOT).join("README.md")).unwrap();
    problems.extend(broken(Path::new(ROOT), Path::new("README.md"), &readme));
    assert!(problems.is_empty(), "{}", problems.join("\n"));
    // Without links the rule would hold of nothing.
    assert!(found.values().map(|page| links(page).len()).sum::<usize>() > 50);

    // Pictures that nobody looks at.
    let shown: BTreeSet<PathBuf> = found
        .iter()
        .flat_map(|(name, page)| {
            links(page).into_iter().filter_map(|link| within(&name.parent().unwrap().join(link)))
        })
        .chain(links(&readme).into_iter().filter_map(|link| Some(link.strip_prefix("docs/")?.into())))
        .collect();
    for entry in std::fs::read_dir(&docs).unwrap() {
        let name = PathBuf::from(entry.unwrap().file_name());
        let is_picture = name.extension().is_some_and(|extension| extension == "png");
        assert!(!is_picture || shown.contains(&name), "docs/{}: no page shows it", name.display());
    }
}

#[test]
fn broken_links_are_found() {
    let folder = Path::new(ROOT).join("docs");
    let check = |page: &str| broken(&folder, Path::new("tutorials/x.md"), page);
    assert!(
        check("[a](../python.md#errors-and-ctrl-c) [b](https://example.org/x) `[c](nothing.md)`").is_empty()
    );
    assert!(check("```sh\n[c](nothing.md)\n```\n# A `b` c!\n[d](#a-b-c)").is_empty());
    for page in ["[a](nothing.md)", "[a](../python.md#nothing)", "[a](../../README.md)", "[a](#nothing)"] {
        assert_eq!(check(page).len(), 1, "{page}");
    }
}
