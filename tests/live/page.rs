//! The page in a browser, which `tests/python/page.py` drives.

use std::path::{Path, PathBuf};

use super::common::python;
use super::*;

/// Where pictures of the page go: `LUNARRAY_ARTEFACTS`, or cargo's folder for tests.
fn pictures() -> PathBuf {
    let folder = std::env::var_os("LUNARRAY_ARTEFACTS");
    folder.map_or_else(|| Path::new(env!("CARGO_TARGET_TMPDIR")).join("page"), PathBuf::from)
}

/// Debian's `chromium` and `chromium-driver` have to be here.
fn require_browser() {
    let path = std::env::var_os("PATH").unwrap_or_default();
    for name in ["chromium", "chromedriver"] {
        let is_here = std::env::split_paths(&path).any(|folder| folder.join(name).is_file());
        assert!(is_here, "no {name} here; Debian has it in the packages chromium and chromium-driver");
    }
}

/// Runs a script of `tests/python` with the command and these arguments, and prints what it says.
fn drive(python: &Path, script: &str, args: &[&str]) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python").join(script);
    let lunarray = assert_cmd::cargo::cargo_bin("lunarray");
    let output = Process::new(python).arg(script).arg(lunarray).args(args).output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    println!("{said}");
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON and chromium"]
fn a_browser_shows_what_the_interface_and_the_files_say() {
    let python = python();
    require_browser();
    let place = Place::new();
    let file = place.downlink("packets");
    let pictures = pictures();
    drive(&python, "page.py", &[place.pipeline(), &file, &place.path(""), pictures.to_str().unwrap()]);
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON and chromium"]
fn a_browser_shows_what_a_ground_waits_for_and_its_stations() {
    let python = python();
    require_browser();
    let place = Place::new();
    let file = place.downlink("packets");
    let pictures = pictures();
    drive(&python, "page_ground.py", &[place.pipeline(), &file, &place.path(""), pictures.to_str().unwrap()]);
}

/// A mission of 1.3 years, of which every tenth window is kept, in half a minute; LUNARRAY_PAGE_S and LUNARRAY_PAGE_WINDOWS say
/// otherwise, 600 and 2 for a long look.
#[test]
#[ignore = "needs LUNARRAY_PYTHON and chromium"]
fn a_page_that_stays_open_takes_no_more_memory() {
    let python = python();
    require_browser();
    let place = Place::new();
    let of = |name: &str, default: &str| std::env::var(name).unwrap_or_else(|_| default.to_owned());
    let windows = format!("spacecraft.every_nth_window={}", of("LUNARRAY_PAGE_WINDOWS", "10"));
    let thinned = ["--set", &windows, "--set", "spacecraft.every_nth_integration=16"];
    let file = place.workplace.simulate("year.ccsds", &thinned);
    let seconds = of("LUNARRAY_PAGE_S", "30");
    drive(&python, "page_memory.py", &[place.pipeline(), &file, &place.path(""), &seconds]);
}

/// `.ci/tab` makes the tab's program.
#[test]
#[ignore = "needs LUNARRAY_PYTHON, LUNARRAY_TAB and chromium"]
fn a_browser_tab_makes_the_map_of_the_program() {
    let python = python();
    require_browser();
    let book = std::env::var("LUNARRAY_TAB").expect("LUNARRAY_TAB names the site with tab/lunarray_tab.wasm");
    let place = Place::new();
    drive(&python, "tab.py", &[&book, &place.path(""), pictures().to_str().unwrap()]);
}
