//! Comments, pages and messages call a process by its name: words for people stay below a limit.

use std::path::{Path, PathBuf};

/// Words that stand for people, or make a process speak.
const WORDS: [&str; 9] = [
    "who",
    "whom",
    "whoever",
    "nobody",
    "somebody",
    "anybody",
    "everybody",
    "told",
    "tells",
];

/// Most of these words in a thousand.
const LIMIT_PER_THOUSAND: f64 = 0.3;

/// Directories without text of the project.
const SKIPPED: [&str; 3] = ["target", "runs", "node_modules"];

/// This file quotes the words.
const QUOTES: &str = "supervisor/tests/tree/words.rs";

/// The form of a file, which decides what is text in it.
#[derive(Debug, Clone, Copy, PartialEq)]
enum FileForm {
    /// Comments and string literals.
    Rust,
    /// Comments after `#` and string literals: Python and TOML.
    Script,
    /// Everything.
    Page,
}

impl FileForm {
    fn of(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()? {
            "rs" => Some(Self::Rust),
            "py" | "pyi" | "toml" => Some(Self::Script),
            "md" => Some(Self::Page),
            _ => None,
        }
    }
}

/// Every file with text, below a directory. Hidden directories hold environments and tools.
fn files(directory: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(directory).unwrap().flatten() {
        let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
        if name.starts_with('.') || SKIPPED.contains(&name.as_str()) || path.is_symlink() {
            continue;
        }
        if path.is_dir() {
            files(&path, found);
        } else if FileForm::of(&path).is_some() {
            found.push(path);
        }
    }
}

/// Length of the comment or string literal that `rest` begins with, if it begins with one. `before` is the byte before it.
fn text_len(rest: &str, before: u8, form: FileForm) -> Option<usize> {
    let until = |open: usize, close: &str| {
        rest[open..]
            .find(close)
            .map_or(rest.len(), |at| open + at + close.len())
    };
    match form {
        FileForm::Page => return Some(rest.len()),
        FileForm::Rust if rest.starts_with("//") => return Some(until(2, "\n")),
        FileForm::Rust if rest.starts_with("/*") => return Some(until(2, "*/")),
        FileForm::Rust if rest.starts_with('r') && !before.is_ascii_alphanumeric() && before != b'_' => {
            let hashes = rest[1..].bytes().take_while(|byte| *byte == b'#').count();
            let open = 1 + hashes + 1;
            let is_raw = rest[1 + hashes..].starts_with('"');
            return is_raw.then(|| until(open, &format!("\"{}", "#".repeat(hashes))));
        }
        FileForm::Script if rest.starts_with('#') => return Some(until(1, "\n")),
        FileForm::Script => {
            for quotes in ["\"\"\"", "'''"] {
                if rest.starts_with(quotes) {
                    return Some(until(3, quotes));
                }
            }
        }
        FileForm::Rust => {}
    }
    let quote = *rest.as_bytes().first()?;
    let is_string = quote == b'"' || quote == b'\'' && form == FileForm::Script;
    is_string.then(|| quoted_len(rest.as_bytes(), quote))
}

/// Length of a string literal with escapes.
fn quoted_len(bytes: &[u8], quote: u8) -> usize {
    let mut at = 1;
    while at < bytes.len() && bytes[at] != quote {
        at += if bytes[at] == b'\\' { 2 } else { 1 };
    }
    (at + 1).min(bytes.len())
}

/// Length of a character literal of Rust such as `'"'`, which holds no text.
fn character_len(rest: &str) -> Option<usize> {
    let inner = rest.strip_prefix('\'')?;
    let first = inner.chars().next()?;
    let len = if first == '\\' { 2 } else { first.len_utf8() };
    (inner.as_bytes().get(len) == Some(&b'\'')).then_some(len + 2)
}

/// Every text of a file, with the line on which it begins.
fn texts(text: &str, form: FileForm) -> Vec<(usize, &str)> {
    let mut found = Vec::new();
    let (mut at, mut line, mut before) = (0, 1, b' ');
    while at < text.len() {
        let rest = &text[at..];
        let (len, is_text) = match text_len(rest, before, form) {
            Some(len) => (len.min(rest.len()), true),
            None if form == FileForm::Rust => (character_len(rest).unwrap_or(1), false),
            None => (1, false),
        };
        // A length inside a character ends after it.
        let len = (len..=rest.len()).find(|len| rest.is_char_boundary(*len)).unwrap();
        if is_text {
            found.push((line, &rest[..len]));
        }
        line += rest[..len].matches('\n').count();
        before = rest.as_bytes()[len - 1];
        at += len;
    }
    found
}

/// Number of words in a text, and the line offset of each word of the list.
fn count(text: &str) -> (usize, Vec<(usize, &str)>) {
    let (mut words, mut found) = (0, Vec::new());
    for (offset, line) in text.lines().enumerate() {
        for word in line.split(|letter: char| !letter.is_alphabetic()) {
            words += usize::from(!word.is_empty());
            if WORDS.iter().any(|listed| word.eq_ignore_ascii_case(listed)) {
                found.push((offset, word));
            }
        }
    }
    (words, found)
}

#[test]
fn processes_have_names_in_comments_pages_and_messages() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let mut paths = Vec::new();
    files(root, &mut paths);
    paths.sort();
    let (mut words, mut places) = (0, Vec::new());
    for path in &paths {
        let name = path.strip_prefix(root).unwrap().display().to_string();
        if name == QUOTES {
            continue;
        }
        let text = std::fs::read_to_string(path).unwrap();
        for (line, part) in texts(&text, FileForm::of(path).unwrap()) {
            let (more, found) = count(part);
            words += more;
            places.extend(
                found
                    .iter()
                    .map(|(offset, word)| format!("{name}:{}: {word}", line + offset)),
            );
        }
    }
    assert!(words > 100_000, "only {words} words in {} files", paths.len());
    let per_thousand = 1000.0 * places.len() as f64 / words as f64;
    println!(
        "{} of {words} words: {per_thousand:.2} in a thousand\n{}",
        places.len(),
        places.join("\n")
    );
    assert!(
        per_thousand <= LIMIT_PER_THOUSAND,
        "{per_thousand:.2} words for people in a thousand, at most {LIMIT_PER_THOUSAND}: call each process by its name\n{}",
        places.join("\n")
    );
}

#[test]
fn comments_and_strings_are_distinguished_from_code() {
    let rust = "fn who() { // told\n    let q = '\"'; let s = \"say \\\" who\"; /* x */ r#\"raw \"who\"\"#; }\n";
    let found: Vec<_> = texts(rust, FileForm::Rust).into_iter().collect();
    assert_eq!(
        found,
        [
            (1, "// told\n"),
            (2, "\"say \\\" who\""),
            (2, "/* x */"),
            (2, "r#\"raw \"who\"\"#")
        ]
    );
    let script = "who = 'it''s' # nobody\nx = \"\"\"a\nwho\"\"\"\n";
    let found: Vec<_> = texts(script, FileForm::Script).into_iter().collect();
    assert_eq!(
        found,
        [(1, "'it'"), (1, "'s'"), (1, "# nobody\n"), (2, "\"\"\"a\nwho\"\"\"")]
    );
    assert_eq!(count("Who whole,\nwhoever").1, [(0, "Who"), (1, "whoever")]);
}
