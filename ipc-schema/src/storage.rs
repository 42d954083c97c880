//! Files that a run depends on: written whole, flushed to disk and renamed. A full disk is waited for.

use std::{
    fmt::Debug,
    fs::File,
    io::{Error, ErrorKind, Result, Seek as _, SeekFrom, Write as _},
    path::{Path, PathBuf},
    sync::{
        Arc, OnceLock,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use rustix::{
    fs::{CWD, RenameFlags, renameat_with, statvfs},
    io::Errno,
};

/// Time between two attempts on a full disk.
const RETRY: Duration = Duration::from_millis(100);

/// Free space with which the small files of a node, a service or a port can be written, bytes.
const SMALL_FILES_BYTES: u64 = 64 << 10;

/// Where iceoryx2 writes the small files of this process's nodes, services and ports.
static IPC_FILES: OnceLock<PathBuf> = OnceLock::new();
/// Set when the process is asked to stop.
static STOP: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Ends a wait for space that has no limit once `stop` is set.
pub fn stop_waiting_at(stop: &Arc<AtomicBool>) {
    STOP.get_or_init(|| Arc::clone(stop));
}

fn is_stopped() -> bool {
    STOP.get().is_some_and(|stop| stop.load(Ordering::Relaxed))
}

/// True if the disk, or the user's share of it, is full.
#[must_use]
pub fn is_full(error: &Error) -> bool {
    matches!(error.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded)
}

/// The result of `write`, which is called again while the disk is full: until there is space, or the process is asked to stop.
///
/// # Errors
/// `write` fails for another reason, or the process is asked to stop.
pub fn when_there_is_space<T>(path: &Path, write: impl FnMut() -> Result<T>) -> Result<T> {
    wait_for_space(path, Duration::MAX, write)
}

/// As [`when_there_is_space`], for at most `limit`.
///
/// # Errors
/// As [`when_there_is_space`], or there is no space in time.
pub fn wait_for_space<T>(path: &Path, limit: Duration, mut write: impl FnMut() -> Result<T>) -> Result<T> {
    let begin = Instant::now();
    let mut has_waited = false;
    loop {
        match write() {
            Err(error) if is_full(&error) && begin.elapsed() < limit && !(limit == Duration::MAX && is_stopped()) => {
                if !has_waited {
                    tracing::warn!("the disk is full: {} waits until there is space", path.display());
                }
                has_waited = true;
                std::thread::park_timeout(RETRY);
            }
            result => {
                if has_waited && result.is_ok() {
                    tracing::warn!("there is space again: {} is written", path.display());
                }
                return result;
            }
        }
    }
}

/// From now on [`retry_on_full_disk`] looks at the disk of `root`, iceoryx2's directory. All runs of a user have theirs on one disk.
pub(crate) fn ipc_files_are_in(root: &Path) {
    IPC_FILES.get_or_init(|| root.to_owned());
}

/// The result of `attempt`, which creates or opens something of iceoryx2 and is called again while the disk of iceoryx2's files is full:
/// iceoryx2 refuses then without saying why. What does not exist is not waited for.
pub(crate) fn retry_on_full_disk<T, E: Debug>(
    mut attempt: impl FnMut() -> std::result::Result<T, E>,
) -> std::result::Result<T, E> {
    let has_space = || {
        let free = |root: &PathBuf| statvfs(root).map_or(u64::MAX, |stat| stat.f_bavail.saturating_mul(stat.f_frsize));
        IPC_FILES.get().is_none_or(|root| free(root) >= SMALL_FILES_BYTES)
    };
    let mut has_waited = false;
    loop {
        let had_space = has_space();
        let result = attempt();
        let is_for_space = |error: &E| format!("{error:?}") != "DoesNotExist" && !(had_space && has_space());
        if !result.as_ref().is_err_and(is_for_space) || is_stopped() {
            if has_waited && result.is_ok() {
                tracing::warn!("there is space again: shared memory is opened");
            }
            return result;
        }
        if !has_waited {
            tracing::warn!("the disk is full: shared memory is opened once there is space");
        }
        has_waited = true;
        std::thread::park_timeout(RETRY);
    }
}

/// iceoryx2's reason for refusing something. It names none where the process, or the machine, can open no further file, so whether one
/// can is tried.
pub(crate) fn reason_of(reason: &dyn Debug) -> String {
    with_cause(format!("{reason:?}"), File::open("/dev/null").err())
}

fn with_cause(reason: String, unopened: Option<Error>) -> String {
    let is_of_handles = |error: &Error| matches!(Errno::from_io_error(error), Some(Errno::MFILE | Errno::NFILE));
    match unopened.filter(is_of_handles) {
        Some(error) => format!("{reason}: {error}"),
        None => reason,
    }
}

/// Writes a file that has its old content or the new one at any moment, also after a loss of power.
///
/// # Errors
/// Not writable, or the disk is full.
pub fn write_whole(path: &Path, content: impl AsRef<[u8]>) -> Result<()> {
    let (Some(directory), Some(name)) = (path.parent(), path.file_name()) else {
        return Err(ErrorKind::InvalidInput.into());
    };
    let partial = directory.join(format!(".{}.partial", name.to_string_lossy()));
    let written = File::create(&partial).and_then(|mut file| {
        file.write_all(content.as_ref())?;
        file.sync_all()
    });
    if let Err(error) = written.and_then(|()| std::fs::rename(&partial, path)) {
        // What was written of it takes space that is missing.
        std::fs::remove_file(&partial).or_else(|removal| match removal.kind() {
            ErrorKind::NotFound => Ok(()),
            _ => Err(removal),
        })?;
        return Err(error);
    }
    File::open(directory)?.sync_all()
}

/// Adds a line at the end of a log, whole and flushed to disk. Waits while the disk is full.
///
/// # Errors
/// Not writable, or the process is asked to stop while the disk is full.
pub fn append_line(file: &mut File, path: &Path, line: &str) -> Result<()> {
    let (end, line) = (file.metadata()?.len(), format!("{line}\n"));
    when_there_is_space(path, || {
        let written = file.write_all(line.as_bytes()).and_then(|()| file.sync_data());
        if written.is_err() {
            file.set_len(end)?;
            file.seek(SeekFrom::Start(end))?;
        }
        written
    })
}

/// Gives two paths each other's names, from one moment to the next.
///
/// # Errors
/// One of them does not exist, or the file system cannot do it even in three steps.
pub fn exchange(one: &Path, other: &Path) -> Result<()> {
    match renameat_with(CWD, one, CWD, other, RenameFlags::EXCHANGE) {
        // Some file systems (overlays, networks) have no such operation.
        Err(Errno::INVAL | Errno::NOSYS | Errno::NOTSUP) => {
            let aside = one.with_extension("aside.partial");
            std::fs::rename(other, &aside)?;
            std::fs::rename(one, other)?;
            std::fs::rename(&aside, one)
        }
        result => Ok(result?),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_names_missing_file_handles_and_nothing_else() {
        let of = |errno: Errno| with_cause("InternalFailure".into(), Some(errno.into()));
        assert_eq!(of(Errno::MFILE), "InternalFailure: Too many open files (os error 24)");
        assert_eq!(
            of(Errno::NFILE),
            "InternalFailure: Too many open files in system (os error 23)"
        );
        assert_eq!(of(Errno::NOENT), "InternalFailure");
        assert_eq!(reason_of(&"DoesNotExist"), "\"DoesNotExist\"");
    }

    #[test]
    fn a_file_is_replaced_whole_and_leaves_nothing_beside() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("run.json");
        for content in ["old", "the new one"] {
            write_whole(&path, content).unwrap();
            assert_eq!(std::fs::read_to_string(&path).unwrap(), content);
        }
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 1);
        assert!(write_whole(&directory.path().join("missing/file"), "").is_err());
    }

    #[test]
    fn directories_are_exchanged() {
        let directory = tempfile::tempdir().unwrap();
        let [one, other] = ["one", "other"].map(|name| directory.path().join(name));
        for path in [&one, &other] {
            std::fs::create_dir(path).unwrap();
            std::fs::write(path.join("name"), path.as_os_str().as_encoded_bytes()).unwrap();
        }
        exchange(&one, &other).unwrap();
        assert_eq!(
            std::fs::read(one.join("name")).unwrap(),
            other.as_os_str().as_encoded_bytes()
        );
        assert!(exchange(&one, &directory.path().join("missing")).is_err());
    }

    #[test]
    fn a_write_is_repeated_only_while_the_disk_is_full() {
        let mut attempts = 0;
        let mut write = |successes_after: u32| {
            attempts += 1;
            match attempts > successes_after {
                true => Ok(attempts),
                false => Err(Error::from(ErrorKind::StorageFull)),
            }
        };
        assert_eq!(when_there_is_space(Path::new("file"), || write(2)).unwrap(), 3);
        let denied = when_there_is_space(Path::new("file"), || Err::<(), _>(ErrorKind::PermissionDenied.into()));
        assert_eq!(denied.unwrap_err().kind(), ErrorKind::PermissionDenied);
        let full = wait_for_space(Path::new("file"), Duration::ZERO, || {
            Err::<(), _>(ErrorKind::StorageFull.into())
        });
        assert!(is_full(&full.unwrap_err()));
    }
}
