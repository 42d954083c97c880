//! The files that a simulation reads: which they are, whether they exist, and which of them SUMO refuses.

use std::path::{Path, PathBuf};

use quick_xml::{
    Reader, XmlVersion,
    events::{BytesStart, Event},
};

use super::error::SumoError;

/// Files longer than this are not searched for the origin of an error.
const SEARCHED_BYTES: u64 = 64 << 20;

/// SUMO's step when a configuration does not name one, seconds.
const DEFAULT_STEP_S: f64 = 1.0;
/// SUMO's seed when a configuration does not name one.
const DEFAULT_SEED: u64 = 23423;

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
    // SUMO replaces ${…} by environment variables: SUMO itself checks such a path.
    if path.is_file() || path.to_string_lossy().contains("${") {
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

/// The parts of a `.sumocfg` that the bridge needs before SUMO reads it.
#[derive(Debug, Clone, PartialEq)]
pub struct ScenarioFile {
    /// Its files.
    pub files: InputFiles,
    /// Its step, seconds.
    pub step_s: f64,
    /// Its seed.
    pub seed: u64,
}

impl ScenarioFile {
    /// Reads `sumocfg`.
    ///
    /// # Errors
    /// Missing, unreadable or malformed, or step or seed are no numbers.
    pub fn read(sumocfg: &Path) -> Result<Self, SumoError> {
        let folder = sumocfg.parent().unwrap_or(Path::new(""));
        let mut scenario = Self {
            files: InputFiles {
                main: sumocfg.into(),
                others: Vec::new(),
            },
            step_s: DEFAULT_STEP_S,
            seed: DEFAULT_SEED,
        };
        let mut wrong = None;
        for_each_element(sumocfg, |element| {
            let Some(value) = attribute(element, "value") else {
                return;
            };
            match element.name().as_ref() {
                "net-file" | "net" | "route-files" | "routes" | "additional-files" | "additional" => {
                    let files = value.split([',', ' ']).filter(|name| !name.is_empty());
                    scenario.files.others.extend(files.map(|name| folder.join(name)));
                }
                "step-length" => match value.trim().parse() {
                    Ok(step_s) => scenario.step_s = step_s,
                    Err(_) => wrong = Some(("step-length", value)),
                },
                "seed" => match value.trim().parse() {
                    Ok(seed) => scenario.seed = seed,
                    Err(_) => wrong = Some(("seed", value)),
                },
                _ => {}
            }
        })?;
        match wrong {
            None => Ok(scenario),
            Some((what, value)) => Err(SumoError::NoNumber {
                path: sumocfg.into(),
                what: what.into(),
                value,
            }),
        }
    }
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
    fn a_configuration_names_its_files_and_its_step() {
        let folder = tempfile::tempdir().unwrap();
        let text = "<configuration><input><net-file value=\"a.net.xml\"/><route-files value=\"b.xml, c.xml\"/></input>\
                    <time><step-length value=\"0.5\"/></time></configuration>";
        let scenario = ScenarioFile::read(&write(folder.path(), "x.sumocfg", text)).unwrap();
        assert_eq!((scenario.step_s, scenario.seed), (0.5, 23423));
        let names: Vec<_> = scenario
            .files
            .others
            .iter()
            .map(|f| f.file_name().unwrap().to_owned())
            .collect();
        assert_eq!(names, ["a.net.xml", "b.xml", "c.xml"]);
        assert!(matches!(scenario.files.check(), Err(SumoError::Missing { .. })));
    }

    #[test]
    fn a_configuration_cut_in_the_middle_is_malformed() {
        let folder = tempfile::tempdir().unwrap();
        let path = write(folder.path(), "x.sumocfg", "<configuration><input></configuration>");
        assert!(matches!(ScenarioFile::read(&path), Err(SumoError::Malformed { .. })));
    }

    #[test]
    fn a_step_that_is_no_number_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let text = "<configuration><time><step-length value=\"short\"/></time></configuration>";
        let error = ScenarioFile::read(&write(folder.path(), "x.sumocfg", text)).unwrap_err();
        assert!(
            error
                .to_string()
                .ends_with("x.sumocfg: step-length \"short\" is no number"),
            "{error}"
        );
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
