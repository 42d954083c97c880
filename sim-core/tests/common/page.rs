//! Tables of `docs/vehicle-model.md` that a test writes and keeps true.
#![allow(clippy::unwrap_used, reason = "test code may assert by unwrapping")]

use std::sync::Mutex;

const PAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/vehicle-model.md");
/// Tests of one binary run side by side, and each writes the whole page.
static WRITING: Mutex<()> = Mutex::new(());

/// Compares the text between `<!-- name -->` and `<!-- end of name -->` with `table`; with `CARAWARE_BLESS=1` writes it there.
pub fn shows(name: &str, table: &str) {
    let _writing = WRITING.lock().unwrap();
    let page = std::fs::read_to_string(PAGE).unwrap();
    let marks = [format!("<!-- {name} -->\n"), format!("<!-- end of {name} -->")];
    let (before, rest) = page.split_once(&marks[0]).unwrap();
    let (_, after) = rest.split_once(&marks[1]).unwrap();
    let wanted = format!("{before}{}{table}{}{after}", marks[0], marks[1]);
    if std::env::var_os("CARAWARE_BLESS").is_some() {
        std::fs::write(PAGE, wanted).unwrap();
    } else {
        assert!(page == wanted, "bring {PAGE} up to date with CARAWARE_BLESS=1");
    }
}
