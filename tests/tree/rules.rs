//! The rules themselves: each offends where it should, and nowhere else.

use super::Tree;

/// Offences in files given by path and text.
fn offences(files: &[(&str, &str)]) -> Vec<String> {
    let sources: Vec<_> = files.iter().map(|(path, text)| ((*path).to_owned(), (*text).to_owned())).collect();
    Tree::new(&sources).offences()
}

#[track_caller]
fn assert_one(files: &[(&str, &str)], words: &[&str]) {
    let found = offences(files);
    assert_eq!(found.len(), 1, "{found:#?}");
    for word in words {
        assert!(found[0].contains(word), "no {word:?} in: {}", found[0]);
    }
}

#[track_caller]
fn assert_none(files: &[(&str, &str)]) {
    assert_eq!(offences(files), [""; 0]);
}

#[test]
fn an_import_of_a_later_folder_offends() {
    let solve = ("solve/mod.rs", "pub fn solve() {}");
    assert_one(
        &[solve, ("sky/mod.rs", "use crate::solve::solve;")],
        &["src/sky/mod.rs imports `crate::solve::solve`", "`solve` comes after `sky`", "Move what both need"],
    );
    assert_one(&[solve, ("sky/mod.rs", "fn f() { crate::solve::solve() }")], &["src/sky/mod.rs"]);
    assert_one(&[solve, ("sky/fits.rs", "fn f() { super::super::solve::solve() }")], &["src/sky/fits.rs"]);
    assert_one(&[solve, ("sky/mod.rs", "pub use crate::solve::{self as s};")], &["src/sky/mod.rs"]);
    assert_one(&[solve, ("sky/mod.rs", "use crate::{units::Hz, solve::{solve}};")], &["src/sky/mod.rs"]);
    assert_none(&[("sky/mod.rs", ""), ("solve/mod.rs", "use crate::sky::SkyMap;")]);
}

#[test]
fn the_ground_knows_nothing_of_the_spacecraft() {
    let mother = ("mother/mod.rs", "pub struct Store;");
    let store = "use crate::mother::Store;";
    assert_one(&[mother, ("calibration/mod.rs", store)], &["src/calibration/mod.rs", "by bytes alone"]);
    assert_one(&[mother, ("downlink/mod.rs", store)], &["src/downlink/mod.rs", "by bytes alone"]);
    assert_none(&[mother, ("pipeline/mod.rs", store), ("cli/mod.rs", store), ("bench/mod.rs", store)]);
}

#[test]
fn a_folder_without_a_place_offends() {
    assert_one(&[("attic/mod.rs", "")], &["`attic` has no place"]);
}

#[test]
fn an_import_is_followed_to_where_the_item_is_defined() {
    // A re-export leads on: `a` imports `c`, not the folder, and so is in no circle with it.
    let through = |a| {
        vec![
            ("sky/mod.rs", "mod a; mod b; mod c; pub use c::{C as Name}; use a::A; use b::B;"),
            ("sky/a.rs", a),
            ("sky/b.rs", "use super::a::A;"),
            ("sky/c.rs", "pub struct C;"),
        ]
    };
    assert_none(&through("use super::Name;"));
    assert_one(
        &through("use super::Name; fn f() { super::own() }"),
        &["3 files", "src/sky/a.rs imports src/sky/mod.rs"],
    );
    // And hides nothing.
    assert_one(
        &[
            ("lib.rs", "pub use solve::solve;"),
            ("solve/mod.rs", "pub fn solve() {}"),
            ("sky/mod.rs", "use crate::solve;"),
        ],
        &["src/sky/mod.rs"],
    );
}

#[test]
fn a_circle_of_three_offends_and_one_of_two_does_not() {
    let a = ("sky/a.rs", "use super::b::B;");
    let b = ("sky/b.rs", "use super::c::C;");
    let words = ["3 files", "src/sky/c.rs imports src/sky/a.rs", "Cut it"];
    assert_one(&[a, b, ("sky/c.rs", "fn f(a: &super::a::A) {}")], &words);
    assert_none(&[a, b, ("sky/c.rs", "use super::b::B;")]);
}

#[test]
fn a_type_that_stands_twice_offends() {
    let one = ("sky/mod.rs", "pub struct Plan;");
    assert_one(
        &[one, ("array/mod.rs", "pub(crate) enum Plan {}")],
        &["`Plan`", "sky/mod.rs", "array/mod.rs", "Rename"],
    );
    assert_one(&[one, ("array/mod.rs", "mod inner { pub trait Plan {} }")], &["`Plan`"]);
    assert_one(&[one, ("array/mod.rs", "pub type Plan = u8;")], &["`Plan`"]);
    assert_none(&[
        one,
        ("array/mod.rs", "struct Plan; pub(super) struct Plan; impl T for U { type Plan = u8; }"),
    ]);
}

#[test]
fn tests_are_free() {
    let solve = ("solve/mod.rs", "pub struct Plan;");
    for text in [
        "#[cfg(test)]\nmod tests { use crate::solve::Plan; fn f() { [()]; } pub struct Plan; }",
        "#[cfg(test)] use crate::solve::{Plan};",
        "#[cfg(test)] #[allow(dead_code)] fn f(a: [u8; 2]) { crate::solve::solve() }",
    ] {
        assert_none(&[solve, ("sky/mod.rs", text)]);
        assert_one(
            &[solve, ("sky/mod.rs", &format!("{text} fn g() {{ crate::solve::g() }}"))],
            &["crate::solve::g"],
        );
    }
    let parts =
        [("sky/tests/mod.rs", "mod a; pub struct Plan;"), ("sky/tests/a.rs", "use crate::solve::Plan;")];
    assert_none(&[solve, ("sky/mod.rs", "#[cfg(test)]\nmod tests;"), parts[0], parts[1]]);
    assert_eq!(offences(&[solve, ("sky/mod.rs", "mod tests;"), parts[0], parts[1]]).len(), 2);
}

#[test]
fn comments_and_text_are_no_code() {
    for text in [
        "// use crate::solve::a;\n/// [`crate::solve::a`]\n",
        "/* /* */ use crate::solve::a; */",
        r##"const A: &str = "\" crate::solve::a"; const B: &str = r#"" crate::solve::a"#; const C: u8 = b'"';"##,
        "const D: [char; 3] = ['\"', '\\'', '\\u{7d}']; fn f<'a>(a: &'a str) {} const E: &[u8] = b\"crate::solve::a\";",
    ] {
        let solve = ("solve/mod.rs", "");
        assert_none(&[solve, ("sky/mod.rs", text)]);
        let then = format!("{text} use crate::solve::b;");
        assert_one(&[solve, ("sky/mod.rs", &then)], &["crate::solve::b"]);
    }
}
