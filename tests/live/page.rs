//! The page in a browser, which `tests/python/page.py` drives.

use std::path::{Path, PathBuf};

use super::common::python;
use super::*;

/// Where pictures of the page go: `LUNARRAY_ARTEFACTS`, or cargo's folder for tests.
fn pictures() -> PathBuf {
    let folder = std::env::var_os("LUNARRAY_ARTEFACTS");
    folder.map_or_else(|| Path::new(env!("CARGO_TARGET_TMPDIR")).join("page"), PathBuf::from)
}

/// Whether Debian's `chromium` and `chromium-driver` are here; says so if not.
fn has_browser() -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let missing = ["chromium", "chromedriver"]
        .into_iter()
        .find(|name| !std::env::split_paths(&path).any(|folder| folder.join(name).is_file()));
    if let Some(name) = missing {
        eprintln!("skipped: no {name} here; Debian has it in chromium and chromium-driver");
    }
    missing.is_none()
}

#[test]
fn a_browser_shows_what_the_interface_and_the_files_say() {
    let Some(python) = python().filter(|_| has_browser()) else { return };
    let place = Place::new();
    let file = place.downlink("packets");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/page.py");
    let output = Process::new(python)
        .arg(script)
        .arg(assert_cmd::cargo::cargo_bin("lunarray"))
        .args([place.pipeline(), &file, &place.path("")])
        .arg(pictures())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    println!("{said}");
}
