//! Public type names are unique in the workspace, so a search for a name finds one type.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// Words that begin the definition of a type.
const KEYWORDS: [&str; 5] = ["struct", "enum", "trait", "type", "union"];
/// Directories whose code is not part of a program.
const OTHER: [&str; 6] = ["tests", "benches", "examples", "target", "python", "node_modules"];

/// Rust files of all programs below a directory.
fn sources(directory: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(directory).unwrap().flatten() {
        let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
        if entry.file_type().unwrap().is_dir() {
            if !name.starts_with('.') && !OTHER.contains(&name.as_str()) {
                sources(&path, files);
            }
        } else if name.ends_with(".rs") && name != "tests.rs" {
            files.push(path);
        }
    }
}

/// The type that a line defines, if it is visible beyond its module. An associated type has no visibility of its own.
fn public_type(line: &str) -> Option<&str> {
    let rest = line.trim_start().strip_prefix("pub")?;
    let rest = match rest.strip_prefix('(') {
        Some(scope) => scope.split_once(')')?.1,
        None => rest,
    };
    let mut words = rest.strip_prefix(' ')?.split_whitespace();
    let word = words.find(|word| !["unsafe", "auto"].contains(word))?;
    let name = KEYWORDS.contains(&word).then(|| words.next())??;
    // In a macro the name may be a parameter.
    name.split(|letter: char| !letter.is_alphanumeric() && letter != '_')
        .next()
        .filter(|name| !name.is_empty())
}

/// The part of a file before its unit tests, which are at its end.
fn without_tests(text: &str) -> &str {
    let tests = text.find("#[cfg(test)]\nmod tests {");
    tests.map_or(text, |tests| &text[..tests])
}

#[test]
fn two_public_types_never_share_a_name() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let mut files = Vec::new();
    sources(root, &mut files);
    let mut places: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for file in &files {
        let text = std::fs::read_to_string(file).unwrap();
        for (number, line) in (1..).zip(without_tests(&text).lines()) {
            if let Some(name) = public_type(line) {
                let path = file.strip_prefix(root).unwrap().display();
                places
                    .entry(name.to_owned())
                    .or_default()
                    .push(format!("{path}:{number}"));
            }
        }
    }
    assert!(places.len() > 300, "only {} types were found", places.len());
    places.retain(|_, places| places.len() > 1);
    assert!(places.is_empty(), "give each type a name of its own: {places:#?}");
}

#[test]
fn a_definition_is_distinguished_from_other_lines() {
    for (line, name) in [
        ("pub struct Slot {", Some("Slot")),
        ("    pub(crate) enum Way<T> {", Some("Way")),
        ("pub(super) type Bit = u8;", Some("Bit")),
        ("pub unsafe trait Shared: Copy {", Some("Shared")),
        ("pub fn structure() {", None),
        ("struct Private;", None),
        ("public struct Slot", None),
        ("pub use crate::Slot;", None),
    ] {
        assert_eq!(public_type(line), name, "{line}");
    }
}
