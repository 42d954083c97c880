//! The files that a simulation reads: whether they exist, and which of them SUMO refuses. The supervisor has read the `.sumocfg`.

use std::path::{Path, PathBuf};

use quick_xml::{
    Reader, XmlVersion,
    events::{BytesStart, Event},
};

use super::error::SumoError;

/// Files longer than this are not searched for the origin of an error.
const SEARCHED_BYTES: u64 = 64 << 20;

/// The files of one simulation.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct InputFiles {
    /// The file that stands for the whole in messages: the net, or the `.sumocfg`.
    pub main: PathBuf,
    /// All files that the main file names.
    pub others: Vec<PathBuf>,
}

impl InputFiles {
    /// Checks that every file exists.
    ///
    /// # Errors
    /// [`SumoError::Missing`] for the first that does not.
    pub fn check(&self) -> Result<(), SumoError> {
        require(&self.main, None)?;
        self.others.iter().try_for_each(|file| require(file, Some(&self.main)))
    }

    /// File and line of the element that SUMO's `reason` names in quotes, where it can be found; else the main file.
    #[must_use]
    pub fn place_of(&self, reason: &str) -> String {
        let main = self.main.display().to_string();
        if self.others.iter().any(|file| reason.contains(&*file.to_string_lossy())) || reason.contains(&main) {
            return main;
        }
        let names = quoted(reason);
        let found = self
            .others
            .iter()
            .find_map(|file| Some((file, line_with(file, &names)?)));
        found.map_or(main, |(file, line)| format!("{}, line {line}", file.display()))
    }
}

fn require(path: &Path, referenced_by: Option<&PathBuf>) -> Result<(), SumoError> {
    if path.is_file() {
        return Ok(());
    }
    Err(SumoError::Missing {
        path: path.into(),
        referenced_by: referenced_by.cloned(),
    })
}

/// Names in single quotes, in order.
fn quoted(reason: &str) -> Vec<&str> {
    reason
        .split('\'')
        .skip(1)
        .step_by(2)
        .filter(|name| !name.is_empty())
        .collect()
}

/// First line of `file` with the first of `names`, if `file` has them all as whole words.
fn line_with(file: &Path, names: &[&str]) -> Option<usize> {
    let first = names.first()?;
    if std::fs::metadata(file).ok()?.len() > SEARCHED_BYTES {
        return None;
    }
    let text = std::fs::read_to_string(file).ok()?;
    let has = |text: &str, name: &str| text.split(|c: char| " \t\n\r\"'".contains(c)).any(|word| word == name);
    if !names.iter().all(|name| has(&text, name)) {
        return None;
    }
    text.lines().position(|line| has(line, first)).map(|index| index + 1)
}

/// Calls `visit` for every element of an XML file, in order.
///
/// # Errors
/// Missing, unreadable or malformed.
pub fn for_each_element(path: &Path, mut visit: impl FnMut(&BytesStart<'_>)) -> Result<(), SumoError> {
    require(path, None)?;
    let text = std::fs::read_to_string(path).map_err(|source| SumoError::Unreadable {
        path: path.into(),
        source,
    })?;
    let mut reader = Reader::from_str(&text);
    loop {
        match reader.read_event() {
            Ok(Event::Start(element) | Event::Empty(element)) => visit(&element),
            Ok(Event::Eof) => return Ok(()),
            Ok(_) => {}
            Err(error) => {
                return Err(SumoError::Malformed {
                    path: path.into(),
                    reason: error.to_string(),
                });
            }
        }
    }
}

/// The value of an attribute, if it exists and is readable.
#[must_use]
pub fn attribute(element: &BytesStart<'_>, name: &str) -> Option<String> {
    let attribute = element.try_get_attribute(name).ok()??;
    Some(attribute.normalized_value(XmlVersion::Implicit1_0).ok()?.into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(folder: &Path, name: &str, text: &str) -> PathBuf {
        let path = folder.join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    #[test]
    fn a_complaint_is_traced_to_file_and_line() {
        let folder = tempfile::tempdir().unwrap();
        let good = write(
            folder.path(),
            "good.rou.xml",
            "<routes><route id=\"r\" edges=\"a b\"/></routes>",
        );
        let bad = write(
            folder.path(),
            "bad.rou.xml",
            "<routes>\n<route id=\"r\"\n edges=\"a nope\"/></routes>",
        );
        let files = InputFiles {
            main: "x.sumocfg".into(),
            others: vec![good, bad.clone()],
        };
        let place = files.place_of("The edge 'nope' within the route 'r' is not known.");
        assert_eq!(place, format!("{}, line 3", bad.display()));
        assert_eq!(files.place_of("No idea."), "x.sumocfg");
    }
}
