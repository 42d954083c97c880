//! The mark of a run directory that is being prepared, from its creation until it has a run file.
//!
//! The name of the mark holds the process id of the supervisor. `caraware train --restart` removes what a killed supervisor prepared,
//! and nothing that another program made under the same name.

use std::{
    fs::OpenOptions,
    io::{Error, ErrorKind, Result},
    path::{Path, PathBuf},
};

fn mark(directory: &Path, supervisor_pid: i32) -> PathBuf {
    directory.join(format!(".preparing-{supervisor_pid}"))
}

fn own_pid() -> i32 {
    i32::try_from(std::process::id()).unwrap_or(0)
}

/// Creates `directory`, which must not exist, with the mark of this process.
///
/// # Errors
/// The directory exists or cannot be written.
pub fn create_marked(directory: &Path) -> Result<()> {
    std::fs::create_dir(directory)?;
    let marked = OpenOptions::new()
        .create_new(true)
        .write(true)
        .open(mark(directory, own_pid()))
        .map(drop);
    // Without its mark the directory would keep its name from the next run.
    marked.or_else(|error| std::fs::remove_dir(directory).and(Err(error)))
}

/// Removes the mark of this process, if `directory` has it: from now on its run file names the supervisor.
///
/// # Errors
/// The directory cannot be written.
pub fn remove_mark(directory: &Path) -> Result<()> {
    match std::fs::remove_file(mark(directory, own_pid())) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        removed => removed,
    }
}

/// True if this supervisor prepares `directory`, or prepared it until it ended.
#[must_use]
pub fn is_prepared_by(directory: &Path, supervisor_pid: i32) -> bool {
    mark(directory, supervisor_pid).is_file()
}

/// Removes `directory` if the ended supervisor prepared it, or if it is empty.
///
/// # Errors
/// Another program made the directory, which stays as it is, or the directory cannot be written.
pub fn remove_prepared(directory: &Path, supervisor_pid: i32) -> Result<()> {
    if is_prepared_by(directory, supervisor_pid) {
        return std::fs::remove_dir_all(directory);
    }
    match std::fs::remove_dir(directory) {
        Err(error) if error.kind() == ErrorKind::DirectoryNotEmpty => {
            Err(Error::new(error.kind(), "another program made it"))
        }
        removed => removed,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ANOTHER_PID: i32 = -1;

    #[test]
    fn only_what_the_ended_supervisor_prepared_is_removed() {
        let runs = tempfile::tempdir().unwrap();
        let directory = runs.path().join("town");
        create_marked(&directory).unwrap();
        std::fs::create_dir(directory.join("map")).unwrap();
        std::fs::write(directory.join("map/town.net.xml"), "<net/>").unwrap();
        let again = create_marked(&directory).unwrap_err();
        assert_eq!(again.kind(), ErrorKind::AlreadyExists);
        let refused = remove_prepared(&directory, ANOTHER_PID).unwrap_err();
        assert_eq!(refused.to_string(), "another program made it");
        assert!(directory.join("map/town.net.xml").is_file());
        remove_prepared(&directory, own_pid()).unwrap();
        assert!(!directory.exists());
    }

    #[test]
    fn a_file_of_another_program_survives() {
        let runs = tempfile::tempdir().unwrap();
        let file = runs.path().join("town/config.toml");
        std::fs::create_dir(runs.path().join("town")).unwrap();
        std::fs::write(&file, "foreign").unwrap();
        assert!(remove_prepared(&runs.path().join("town"), own_pid()).is_err());
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "foreign");
    }

    #[test]
    fn a_directory_with_a_run_file_has_no_mark() {
        let runs = tempfile::tempdir().unwrap();
        let directory = runs.path().join("town");
        create_marked(&directory).unwrap();
        std::fs::write(directory.join("run.json"), "{}").unwrap();
        remove_mark(&directory).unwrap();
        remove_mark(&directory).unwrap();
        assert!(remove_prepared(&directory, own_pid()).is_err());
        assert!(directory.join("run.json").is_file());
    }

    #[test]
    fn an_empty_directory_holds_nothing_to_keep() {
        let runs = tempfile::tempdir().unwrap();
        let directory = runs.path().join("town");
        std::fs::create_dir(&directory).unwrap();
        remove_prepared(&directory, own_pid()).unwrap();
        assert!(!directory.exists());
    }
}
