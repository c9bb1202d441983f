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
    let products = ("products/mod.rs", "pub fn products() {}");
    assert_one(
        &[products, ("sky/mod.rs", "use crate::products::products;")],
        &[
            "src/sky/mod.rs imports `crate::products::products`",
            "`products` comes after `sky`",
            "Move what both need",
        ],
    );
    assert_one(&[products, ("sky/mod.rs", "fn f() { crate::products::products() }")], &["src/sky/mod.rs"]);
    assert_one(
        &[products, ("sky/fits.rs", "fn f() { super::super::products::products() }")],
        &["src/sky/fits.rs"],
    );
    assert_one(&[products, ("sky/mod.rs", "pub use crate::products::{self as s};")], &["src/sky/mod.rs"]);
    assert_one(
        &[products, ("sky/mod.rs", "use crate::{units::Hz, products::{products}};")],
        &["src/sky/mod.rs"],
    );
    assert_none(&[("sky/mod.rs", ""), ("products/mod.rs", "use crate::sky::SkyMap;")]);
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
            ("lib.rs", "pub use products::products;"),
            ("products/mod.rs", "pub fn products() {}"),
            ("sky/mod.rs", "use crate::products;"),
        ],
        &["src/sky/mod.rs"],
    );
}

#[test]
fn a_circle_offends_of_three_files_and_of_two() {
    let a = ("sky/a.rs", "use super::b::B;");
    let b = ("sky/b.rs", "use super::c::C;");
    let words = ["3 files", "src/sky/c.rs imports src/sky/a.rs", "Cut it"];
    assert_one(&[a, b, ("sky/c.rs", "fn f(a: &super::a::A) {}")], &words);
    assert_one(&[a, b, ("sky/c.rs", "use super::b::B;")], &["2 files", "src/sky/c.rs imports src/sky/b.rs"]);
    assert_none(&[a, b, ("sky/c.rs", "pub struct C;")]);
}

#[test]
fn a_circle_of_a_folder_and_a_file_beside_it_offends() {
    // No two files import each other; the folder `b`, as a whole, and `a` do, and so do the folders `b` and `c`.
    let above = ("sky/a.rs", "use super::b::low::Low;");
    let low = ("sky/b/low.rs", "pub struct Low;");
    let high = |text| ("sky/b/high.rs", text);
    assert_one(
        &[above, low, high("use crate::sky::a::A;")],
        &[
            "2 parts of a folder",
            "src/sky/a.rs imports src/sky/b/low.rs",
            "src/sky/b/high.rs imports src/sky/a.rs",
        ],
    );
    assert_none(&[above, low, high("use super::low::Low;")]);
    let other = [("sky/c/one.rs", "use crate::sky::b::low::Low;"), ("sky/c/two.rs", "")];
    assert_one(
        &[other[0], other[1], low, high("use crate::sky::c::two::Two;")],
        &["2 parts of a folder", "src/sky/b/high.rs imports src/sky/c/two.rs"],
    );
    // Circles of folders in folders are told once.
    let deep = |text| ("sky/d/b/high.rs", text);
    assert_one(
        &[
            ("sky/d/a.rs", "use super::b::low::Low;"),
            ("sky/d/b/low.rs", ""),
            deep("use crate::sky::d::a::A;"),
        ],
        &["2 parts of a folder"],
    );
    // A folder's own file is no part of it: it may use its parts and they what it defines, as long as files are in no circle.
    assert_none(&[("sky/mod.rs", "pub struct Map;"), ("sky/a.rs", "use super::Map;")]);
}

#[test]
fn tests_are_free() {
    let products = ("products/mod.rs", "pub struct Plan;");
    for text in [
        "#[cfg(test)]\nmod tests { use crate::products::Plan; fn f() { [()]; } pub struct Plan; }",
        "#[cfg(test)] use crate::products::{Plan};",
        "#[cfg(test)] #[allow(dead_code)] fn f(a: [u8; 2]) { crate::products::products() }",
    ] {
        assert_none(&[products, ("sky/mod.rs", text)]);
        assert_one(
            &[products, ("sky/mod.rs", &format!("{text} fn g() {{ crate::products::g() }}"))],
            &["crate::products::g"],
        );
    }
    let parts =
        [("sky/tests/mod.rs", "mod a; pub struct Plan;"), ("sky/tests/a.rs", "use crate::products::Plan;")];
    assert_none(&[products, ("sky/mod.rs", "#[cfg(test)]\nmod tests;"), parts[0], parts[1]]);
    assert_eq!(offences(&[products, ("sky/mod.rs", "mod tests;"), parts[0], parts[1]]).len(), 1);
}

#[test]
fn comments_and_text_are_no_code() {
    for text in [
        "// use crate::products::a;\n/// [`crate::products::a`]\n",
        "/* /* */ use crate::products::a; */",
        r##"const A: &str = "\" crate::products::a"; const B: &str = r#"" crate::products::a"#; const C: u8 = b'"';"##,
        "const D: [char; 3] = ['\"', '\\'', '\\u{7d}']; fn f<'a>(a: &'a str) {} const E: &[u8] = b\"crate::products::a\";",
    ] {
        let products = ("products/mod.rs", "");
        assert_none(&[products, ("sky/mod.rs", text)]);
        let then = format!("{text} use crate::products::b;");
        assert_one(&[products, ("sky/mod.rs", &then)], &["crate::products::b"]);
    }
}
