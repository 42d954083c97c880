//! Names of a scenario's outputs. SUMO writes all of a run into one directory, so two outputs of one name in two folders need two names.

use std::{
    collections::BTreeMap,
    path::{Component, Path, PathBuf},
};

use super::input_check::NO_FILE;

/// An output that an element of an additional file names: what names it, and the file that it would be without a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ElementOutput {
    /// File and element, for messages.
    pub named_by: String,
    /// The file.
    pub file: PathBuf,
}

/// An output that the `.sumocfg` names.
#[derive(Debug)]
struct OptionOutput {
    option: String,
    value: String,
    line: usize,
    file: PathBuf,
}

/// All outputs of a scenario.
#[derive(Debug, Default)]
pub(super) struct OutputNames {
    options: Vec<OptionOutput>,
    elements: Vec<ElementOutput>,
}

impl OutputNames {
    /// Adds the outputs of an option of the `.sumocfg`, which lies in `directory`.
    pub(super) fn add_option(&mut self, option: &str, value: &str, line: usize, directory: &Path) {
        // States are numbered files, several options of logs may share one.
        if NO_FILE.contains(&value.trim()) || option.starts_with("save-state") || option.contains("log") {
            return;
        }
        self.options.push(OptionOutput {
            option: option.to_owned(),
            value: value.to_owned(),
            line,
            file: plain_path(&directory.join(value)),
        });
    }

    /// Adds the outputs of additional files.
    pub(super) fn add_elements(&mut self, elements: Vec<ElementOutput>) {
        self.elements.extend(elements);
    }

    /// The options whose outputs get another name: each with the name, which SUMO's option takes in place of the scenario's.
    ///
    /// # Errors
    /// Two elements of additional files name outputs alike, which only their files can change: the message.
    pub(super) fn renamed(self) -> Result<Vec<(String, String)>, String> {
        let mut taken: BTreeMap<String, (PathBuf, String)> = BTreeMap::new();
        for ElementOutput { named_by, file } in self.elements {
            let first = taken
                .entry(name_of(&file))
                .or_insert_with(|| (file.clone(), named_by.clone()));
            if first.0 != file {
                let (first, by) = (first.0.display(), &first.1);
                return Err(format!(
                    "two outputs have the same name in two folders: {first} ({by}) and {} ({named_by})",
                    file.display()
                ));
            }
        }
        let mut renamed = Vec::new();
        for output in self.options {
            let name = name_of(&output.file);
            let is_free = |name: &str| taken.get(name).is_none_or(|(file, _)| *file == output.file);
            if is_free(&name) {
                taken.insert(name, (output.file, output.option));
                continue;
            }
            let folder = output.file.parent().map(name_of).unwrap_or_default();
            let mut other = format!("{folder}_{name}");
            if !is_free(&other) {
                other = format!("{}_{name}", output.option);
            }
            if !is_free(&other) {
                return Err(format!(
                    "line {}: {} = \"{}\" has the name of another output in another folder",
                    output.line, output.option, output.value
                ));
            }
            renamed.push((output.option.clone(), other.clone()));
            taken.insert(other, (output.file, output.option));
        }
        Ok(renamed)
    }
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The path without `.` and `..`: two texts for one file become equal.
pub(super) fn plain_path(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for part in path.components() {
        match part {
            Component::CurDir => {}
            Component::ParentDir if plain.file_name().is_some() => {
                plain.pop();
            }
            part => plain.push(part),
        }
    }
    plain
}

#[cfg(test)]
mod tests {
    use super::*;

    fn renamed(options: &[(&str, &str)], elements: &[&str]) -> Result<Vec<(String, String)>, String> {
        let mut names = OutputNames::default();
        for (option, value) in options {
            names.add_option(option, value, 3, Path::new("/s"));
        }
        let element = |file: &&str| ElementOutput {
            named_by: "a.add.xml: <e1Detector>".into(),
            file: plain_path(Path::new(file)),
        };
        names.add_elements(elements.iter().map(element).collect());
        names.renamed()
    }

    #[test]
    fn outputs_of_one_name_in_two_folders_get_two_names() {
        let pair = |option: &str, name: &str| (option.to_owned(), name.to_owned());
        assert_eq!(
            renamed(&[("tripinfo", "a/x.xml"), ("fcd-output", "b/y.xml")], &["/s/a/x.xml"]),
            Ok(vec![])
        );
        assert_eq!(
            renamed(
                &[
                    ("tripinfo", "a/x.xml"),
                    ("fcd-output", "b/x.xml"),
                    ("summary", "b/../c/x.xml")
                ],
                &[]
            ),
            Ok(vec![pair("fcd-output", "b_x.xml"), pair("summary", "c_x.xml")])
        );
        assert_eq!(
            renamed(&[("tripinfo", "x.xml")], &["/s/d/x.xml"]),
            Ok(vec![pair("tripinfo", "s_x.xml")])
        );
        // Many detectors of one file share it.
        assert_eq!(renamed(&[], &["/s/d/x.xml", "/s/e/../d/x.xml"]), Ok(vec![]));
        let said = renamed(&[], &["/s/d/x.xml", "/s/e/x.xml"]).unwrap_err();
        assert!(
            said.contains("/s/d/x.xml (a.add.xml: <e1Detector>) and /s/e/x.xml"),
            "{said}"
        );
    }
}
