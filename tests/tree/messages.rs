//! No message of an error shows a struct as Rust writes it.

/// Types that `{:?}` shows as quoted text.
const QUOTED: [&str; 4] = ["String", "&'static str", "PathBuf", "std::path::PathBuf"];

#[test]
fn errors_show_no_struct_of_rust() {
    let mut sources = Vec::new();
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/src");
    super::read_folder(std::path::Path::new(folder), "", &mut sources);
    let all: Vec<String> = sources
        .iter()
        .flat_map(|(name, text)| shown(text).into_iter().map(move |found| format!("{name}: {found}")))
        .collect();
    assert!(all.is_empty(), "write it in words, as `{{}}` of a type with Display: {}", all.join(", "));
    let attributes = sources.iter().map(|(_, text)| text.matches("#[error(").count()).sum::<usize>();
    // Without these the rule would hold of nothing.
    assert!(attributes > 200, "only {attributes} messages were found");
}

/// What messages show with `{:?}` that is not quoted text.
fn shown(text: &str) -> Vec<String> {
    // Each part has a message and the fields of its variant.
    let of_part = |part: &str| -> Vec<String> {
        let (message, fields) = part.split_once(")]\n").unwrap_or((part, ""));
        let names = message.split('{').filter_map(|rest| rest.split_once('}')?.0.strip_suffix(":?"));
        let is_quoted = |name: &&str| {
            let kind = fields.split_once(&format!("{name}: ")).map(|(_, rest)| rest);
            kind.is_some_and(|kind| QUOTED.iter().any(|quoted| kind.starts_with(&format!("{quoted},"))))
        };
        names.filter(|name| !is_quoted(name)).map(|name| format!("{{{name}:?}}")).collect()
    };
    text.split("#[error(").skip(1).flat_map(of_part).collect()
}

#[test]
fn a_struct_in_a_message_is_found() {
    let message =
        |shown: &str, field: &str| format!("#[error(\"found {shown}\")]\nA {{\n    {field},\n}},\n");
    assert_eq!(shown("#[error(\"none: {0:?}\")]\nNone(Counts),\n"), ["{0:?}"]);
    assert_eq!(shown(&message("{counts:?}", "counts: Counts")), ["{counts:?}"]);
    for (text, field) in [("{name:?}", "name: String"), ("{counts}", "counts: Counts")] {
        assert!(shown(&message(text, field)).is_empty(), "{text}");
    }
}
