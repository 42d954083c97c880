//! The registry of this user's runs: finds those that are alive, and removes what dead runs left in shared memory.
//!
//! Every run has a directory of its own below `/tmp/caraware-<user id>/` (or `CARAWARE_RUNTIME_DIR`): a marker that names its
//! owner and its run directory, a lock that its supervisor holds, and iceoryx2's files. Files in `/dev/shm` carry the
//! directory's name in their prefix. Only a directory with a valid marker is ever removed: [`base`] may be any directory
//! of the user.

use std::{
    fs::{DirBuilder, File, OpenOptions, Permissions},
    io::{Read as _, Write as _},
    os::unix::fs::{DirBuilderExt as _, MetadataExt as _, OpenOptionsExt as _, PermissionsExt as _},
    path::{Path, PathBuf},
};

use ipc_schema::{
    SCHEMA_VERSION,
    reserve::SHARED_MEMORY,
    run::{RunFile, SharedMemory},
    services,
};
use rustix::fs::{FlockOperation, OFlags, flock};
use serde::{Deserialize, Serialize};

use crate::failure::Exit;

const LOCK: &str = "lock";
/// File that marks a directory as one that caraware created.
const MARKER: &str = "caraware-run.json";
/// Value of [`RunMarker::program`].
const PROGRAM: &str = "caraware";
/// Largest valid marker, bytes.
const MARKER_BYTES: u64 = 16 << 10;
/// What the name of a directory begins with until it is complete.
const UNNAMED: char = '.';
/// Hexadecimal digits of a directory's name.
const NAME_DIGITS: usize = 8;

/// File in a [`base`] that a run created: such a directory is removed with its last run. A directory of the user has none.
const BASE_MARKER: &str = ".created-by-caraware";

/// Environment variable that moves [`base`].
const RUNTIME_DIR: &str = "CARAWARE_RUNTIME_DIR";
/// Longest [`base`]: iceoryx2's sockets lie below it, and Unix allows their paths 107 bytes.
const BASE_BYTES: usize = 40;

/// The marker, which a run writes into its directory before the directory gets its final name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct RunMarker {
    /// [`PROGRAM`].
    program: String,
    /// User that owns the run.
    user_id: u32,
    /// [`SCHEMA_VERSION`] of the program that wrote it.
    schema_version: u32,
    /// Where the run writes its results.
    run_dir: PathBuf,
}

impl RunMarker {
    fn new(run_dir: &Path) -> Self {
        Self {
            program: PROGRAM.into(),
            user_id: user_id(),
            schema_version: SCHEMA_VERSION,
            run_dir: run_dir.into(),
        }
    }

    /// The marker of a directory that this program wrote for this user; `None` for every other directory. Links are not followed.
    fn of(directory: &Path) -> Option<Self> {
        Self::of_named(directory, directory.file_name()?.to_str()?)
    }

    /// As [`Self::of`], of a directory that would be called `name` if it were complete.
    fn of_named(directory: &Path, name: &str) -> Option<Self> {
        let is_name = name.len() == NAME_DIGITS && name.bytes().all(|byte| byte.is_ascii_hexdigit());
        let data = directory.symlink_metadata().ok()?;
        if !is_name || !data.is_dir() || data.uid() != user_id() {
            return None;
        }
        // Without NONBLOCK a FIFO in the marker's place would never open.
        let file = OpenOptions::new()
            .read(true)
            .custom_flags((OFlags::NOFOLLOW | OFlags::NONBLOCK).bits().cast_signed())
            .open(directory.join(MARKER))
            .ok()?;
        let data = file.metadata().ok()?;
        if !data.is_file() || data.uid() != user_id() {
            return None;
        }
        let mut text = String::new();
        file.take(MARKER_BYTES).read_to_string(&mut text).ok()?;
        let marker: Self = serde_json::from_str(&text).ok()?;
        (marker.program == PROGRAM && marker.user_id == user_id()).then_some(marker)
    }

    fn write(&self, directory: &Path) -> std::io::Result<()> {
        OpenOptions::new()
            .create_new(true)
            .write(true)
            .mode(0o600)
            .open(directory.join(MARKER))?
            .write_all(&serde_json::to_vec(self)?)
    }
}

fn user_id() -> u32 {
    rustix::process::getuid().as_raw()
}

/// True if the user chose [`base`]: such a directory is neither removed nor changed.
fn is_chosen() -> bool {
    std::env::var_os(RUNTIME_DIR).is_some()
}

/// The directory of all runs of this user. Not in `TMPDIR`, which may be long and differ between terminals.
#[must_use]
pub fn base() -> PathBuf {
    std::env::var_os(RUNTIME_DIR).map_or_else(|| format!("/tmp/caraware-{}", user_id()).into(), PathBuf::from)
}

/// Why runs cannot lie in this directory. zenoh listens on a socket below it, and takes `?` and `#` for the end of its path.
fn fault_of_base(base: &Path) -> Option<&'static str> {
    match base.to_str() {
        _ if base.as_os_str().len() > BASE_BYTES => Some("is too long"),
        _ if !base.is_absolute() => Some("is not absolute"),
        None => Some("is not UTF-8"),
        Some(text) if text.contains(['?', '#']) => Some("contains `?` or `#`"),
        Some(_) => None,
    }
}

/// Creates [`base`] for this user alone.
fn create_base() -> Result<PathBuf, Exit> {
    let base = base();
    let help = format!("set {RUNTIME_DIR} to a short path of your own, up to {BASE_BYTES} bytes");
    if let Some(fault) = fault_of_base(&base) {
        return Err(Exit::config(
            format!("{RUNTIME_DIR} = {} {fault}", base.display()),
            help,
        ));
    }
    make_base(&base).map_err(|error| Exit::io("create", &base, &error))?;
    // The user's own directory may be a link; the default one must not be.
    let metadata = if is_chosen() {
        base.metadata()
    } else {
        base.symlink_metadata()
    };
    let data = metadata.map_err(|error| Exit::io("look at", &base, &error))?;
    if data.uid() != user_id() {
        return Err(Exit::run(format!("{} belongs to another user", base.display()), help));
    }
    if !data.is_dir() {
        return Err(Exit::run(format!("{} is not a directory", base.display()), help));
    }
    if !is_chosen() && data.mode() & 0o077 != 0 {
        std::fs::set_permissions(&base, Permissions::from_mode(0o700))
            .map_err(|error| Exit::io("close to other users", &base, &error))?;
    }
    Ok(base)
}

/// Creates the directory if it does not exist, and marks it as created by a run.
fn make_base(base: &Path) -> std::io::Result<()> {
    if base.is_dir() {
        return Ok(());
    }
    DirBuilder::new().recursive(true).mode(0o700).create(base)?;
    mark_base(base)
}

fn mark_base(base: &Path) -> std::io::Result<()> {
    OpenOptions::new()
        .create(true)
        .truncate(false)
        .write(true)
        .mode(0o600)
        .open(base.join(BASE_MARKER))
        .map(drop)
}

/// Removes [`base`] after its last run, if a run created it.
fn remove_base(base: &Path) -> std::io::Result<()> {
    let marker = base.join(BASE_MARKER);
    let mut entries = std::fs::read_dir(base)?.flatten();
    if !entries.all(|entry| entry.path() == marker) || !marker.is_file() {
        return Ok(());
    }
    std::fs::remove_file(&marker)?;
    // Another run may have started meanwhile: then the directory is not empty, and is marked again.
    std::fs::remove_dir(base).or_else(|_| mark_base(base))
}

/// Removes [`base`] if a run created it and none is left there. A failure is only logged: the next run tries again.
pub fn forget_base(base: &Path) {
    if let Err(error) = remove_base(base) {
        tracing::debug!(%error, "cannot remove the runtime directory");
    }
}

/// A run's own part of shared memory. Dropping it removes its files.
#[derive(Debug)]
pub struct RunClaim {
    directory: PathBuf,
    /// Held as long as the run lives.
    _lock: File,
    /// Random identity of the run.
    pub run_id: u64,
    /// Where the run's services are; the run file holds it.
    pub memory: SharedMemory,
}

impl RunClaim {
    /// Claims a new part of shared memory for the run in `run_dir`.
    ///
    /// The directory gets its final name once it is complete and locked, so that no other run mistakes it for a dead run's.
    ///
    /// # Errors
    /// The runtime directory is not writable.
    pub fn new(run_dir: &Path) -> Result<Self, Exit> {
        let run_id = random_u64()?;
        let name = format!("{:08x}", run_id >> 32);
        let base = create_base()?;
        let directory = base.join(&name);
        let unnamed = base.join(format!("{UNNAMED}{name}"));
        let named = make_unnamed(&unnamed, run_dir).and_then(|lock| {
            std::fs::rename(&unnamed, &directory).map_err(|error| Exit::io("create", &directory, &error))?;
            Ok(lock)
        });
        let lock = named.inspect_err(|_| {
            // It is not there if it could not be created.
            let _ = std::fs::remove_dir_all(&unnamed);
            forget_base(&base);
        })?;
        let memory = SharedMemory {
            root: directory.clone(),
            prefix: prefix(&name),
        };
        Ok(Self {
            directory,
            _lock: lock,
            run_id,
            memory,
        })
    }
}

impl Drop for RunClaim {
    fn drop(&mut self) {
        remove(&self.directory);
        // A client that was attaching to a run while that run died may have created a file after the sweep at the start.
        sweep();
        forget_base(&base());
    }
}

/// Creates the directory of the run in `run_dir` under its first name, with its lock and its marker, in this order. Returns the lock.
fn make_unnamed(unnamed: &Path, run_dir: &Path) -> Result<File, Exit> {
    DirBuilder::new()
        .mode(0o700)
        .create(unnamed)
        .map_err(|error| Exit::io("create", unnamed, &error))?;
    let path = unnamed.join(LOCK);
    let lock = OpenOptions::new()
        .create_new(true)
        .write(true)
        .mode(0o600)
        .open(&path)
        .map_err(|error| Exit::io("create", &path, &error))?;
    flock(&lock, FlockOperation::NonBlockingLockExclusive).map_err(|error| Exit::io("lock", &path, &error.into()))?;
    RunMarker::new(run_dir)
        .write(unnamed)
        .map_err(|error| Exit::io("write", &unnamed.join(MARKER), &error))?;
    Ok(lock)
}

pub(crate) fn random_u64() -> Result<u64, Exit> {
    let path = Path::new("/dev/urandom");
    let mut bytes = [0_u8; 8];
    File::open(path)
        .and_then(|mut file| file.read_exact(&mut bytes))
        .map_err(|error| Exit::io("read", path, &error))?;
    Ok(u64::from_le_bytes(bytes))
}

fn prefix(name: &str) -> String {
    format!("caraware_{name}_")
}

/// True if the runtime directory of a run still has its marker.
#[must_use]
pub fn is_marked(directory: &Path) -> bool {
    directory.join(MARKER).is_file()
}

/// A run found in the registry.
#[derive(Debug)]
pub struct RegistryEntry {
    directory: PathBuf,
    /// True while its supervisor lives.
    pub alive: bool,
    /// Its run file, if readable.
    pub run: Option<RunFile>,
}

/// Paths directly below [`base`], in a stable order.
fn paths() -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> = std::fs::read_dir(base())
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path())
        .collect();
    paths.sort();
    paths
}

/// All runs of this user, dead or alive, in a stable order.
#[must_use]
pub fn entries() -> Vec<RegistryEntry> {
    paths().into_iter().filter_map(RegistryEntry::read).collect()
}

/// Paths in [`base`] that are neither runs of this user nor its own mark. They are never changed.
#[must_use]
pub fn foreign_paths() -> Vec<PathBuf> {
    let own = base().join(BASE_MARKER);
    paths()
        .into_iter()
        .filter(|path| *path != own && RunMarker::of(path).is_none())
        .collect()
}

impl RegistryEntry {
    fn read(directory: PathBuf) -> Option<Self> {
        let marker = RunMarker::of(&directory)?;
        let alive = is_locked(&directory);
        let run = RunFile::read(&marker.run_dir.join("run.json")).ok();
        Some(Self { directory, alive, run })
    }

    /// Shared memory that the run holds, bytes.
    #[must_use]
    pub fn shared_memory_bytes(&self) -> u64 {
        shared_files(&self.directory)
            .iter()
            .filter_map(|path| path.metadata().ok())
            .map(|data| allocated_bytes(&data))
            .sum()
    }

    /// Removes the files of a dead run. It does nothing to a live one.
    pub fn clean(&self) {
        if !self.alive {
            remove(&self.directory);
        }
    }
}

fn allocated_bytes(data: &std::fs::Metadata) -> u64 {
    use std::os::unix::fs::MetadataExt as _;
    data.blocks() * 512
}

fn shared_files(directory: &Path) -> Vec<PathBuf> {
    let Some(name) = directory.file_name() else {
        return Vec::new();
    };
    let prefix = prefix(&name.to_string_lossy());
    let files = std::fs::read_dir(SHARED_MEMORY)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path());
    files
        .filter(|path| {
            path.file_name()
                .is_some_and(|file| file.to_string_lossy().starts_with(&prefix))
        })
        .collect()
}

/// Removes a run's shared memory and its directory with the lock. Failures are only logged: the next start tries again.
fn remove(directory: &Path) {
    if let Some(name) = directory.file_name() {
        services::remove_files(&SharedMemory {
            root: directory.to_owned(),
            prefix: prefix(&name.to_string_lossy()),
        });
    }
}

/// True if a process holds the lock of a run's directory.
fn is_locked(directory: &Path) -> bool {
    File::open(directory.join(LOCK)).is_ok_and(|lock| flock(&lock, FlockOperation::NonBlockingLockShared).is_err())
}

/// Removes the directory of a run that was killed before that had its name, which is the last step: it holds nothing yet.
fn remove_unnamed(path: &Path) {
    let name = path.file_name().and_then(|name| name.to_str()?.strip_prefix(UNNAMED));
    if name.is_some_and(|name| RunMarker::of_named(path, name).is_some())
        && !is_locked(path)
        && let Err(error) = std::fs::remove_dir_all(path)
    {
        tracing::debug!(%error, path = %path.display(), "cannot remove");
    }
}

/// Removes the files of all dead runs, and returns the number of these runs.
pub fn sweep() -> usize {
    paths().iter().for_each(|path| remove_unnamed(path));
    let dead: Vec<RegistryEntry> = entries().into_iter().filter(|entry| !entry.alive).collect();
    dead.iter().for_each(RegistryEntry::clean);
    dead.len()
}

/// The run files of all runs that are alive, in a stable order.
fn alive() -> Vec<RunFile> {
    let alive = entries().into_iter().filter(|entry| entry.alive);
    alive.filter_map(|entry| entry.run).collect()
}

/// The runs that are alive on this machine and whose trainers learn together with that of `run`, itself included.
#[must_use]
pub fn ranks_of(run: &RunFile) -> Vec<RunFile> {
    let learns_with = |other: &RunFile| {
        other.config.trainer.ranks == run.config.trainer.ranks
            && other.run_dir.parent() == run.run_dir.parent()
            && launch_of(&other.name) == launch_of(&run.name)
    };
    alive().into_iter().filter(learns_with).collect()
}

/// The name of rank 0's run: `caraware.parallel` calls those of the others NAME-rank1, NAME-rank2 …
fn launch_of(name: &str) -> &str {
    match name.rsplit_once("-rank") {
        Some((launch, rank)) if !rank.is_empty() && rank.bytes().all(|byte| byte.is_ascii_digit()) => launch,
        _ => name,
    }
}

/// True if the supervisor of the run in `run_dir` lives.
#[must_use]
pub fn is_alive(run_dir: &Path) -> bool {
    let is_there = |entry: &RegistryEntry| entry.alive && entry.run.as_ref().is_some_and(|run| run.run_dir == run_dir);
    entries().iter().any(is_there)
}

/// The live run called `name`, or the only live run if `name` is `None`. A name may also be the run's directory. Of several runs with a
/// name the one in `runs/` of this directory is meant.
///
/// # Errors
/// No such run is alive, or several are.
pub fn find(name: Option<&str>) -> Result<RunFile, Exit> {
    let mut runs = alive();
    let places: Vec<(&str, &Path)> = runs
        .iter()
        .map(|run| (run.name.as_str(), run.run_dir.as_path()))
        .collect();
    let here = std::env::current_dir().unwrap_or_default();
    let chosen = choose(&places, name, &here)?;
    Ok(runs.swap_remove(chosen))
}

/// Which of the runs, given by name and directory, is meant by `name` in the directory `here`.
fn choose(runs: &[(&str, &Path)], name: Option<&str>, here: &Path) -> Result<usize, Exit> {
    let listed = |(name, directory): &(&str, &Path)| {
        let is_repeated = runs.iter().filter(|(other, _)| other == name).count() > 1;
        if is_repeated {
            directory.display().to_string()
        } else {
            (*name).to_owned()
        }
    };
    let all = || runs.iter().map(listed).collect::<Vec<_>>().join(", ");
    let Some(name) = name else {
        return match runs {
            [_] => Ok(0),
            [] => Err(Exit::config("no run is alive", "start one with `caraware train`")),
            _ => Err(Exit::config(
                "several runs are alive",
                format!("name one of them: {}", all()),
            )),
        };
    };
    let of_name: Vec<usize> = (0..runs.len()).filter(|place| runs[*place].0 == name).collect();
    let within = |directory: PathBuf| {
        let directory = std::fs::canonicalize(&directory).unwrap_or(directory);
        runs.iter().position(|(_, path)| *path == directory)
    };
    match of_name[..] {
        [only] => Ok(only),
        [] => within(here.join(name)).ok_or_else(|| {
            Exit::config(
                format!("no run named `{name}` is alive"),
                format!("alive: {}", if runs.is_empty() { "none".into() } else { all() }),
            )
        }),
        _ => within(here.join("runs").join(name)).ok_or_else(|| {
            Exit::config(
                format!("several runs named `{name}` are alive"),
                format!("give the directory of one of them: {}", all()),
            )
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_meant_by_its_name_by_its_directory_or_by_the_directory_that_one_is_in() {
        let [here, there] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let directory = |base: &tempfile::TempDir, name: &str| {
            let path = base.path().join("runs").join(name);
            std::fs::create_dir_all(&path).unwrap();
            std::fs::canonicalize(path).unwrap()
        };
        let paths = [
            directory(&here, "town-1"),
            directory(&there, "town-1"),
            directory(&there, "other"),
        ];
        let runs: Vec<(&str, &Path)> = ["town-1", "town-1", "other"]
            .into_iter()
            .zip(paths.iter().map(PathBuf::as_path))
            .collect();
        let chosen = |runs: &[(&str, &Path)], name: Option<&str>, at: &Path| choose(runs, name, at).ok();
        assert_eq!(chosen(&runs, Some("other"), here.path()), Some(2));
        assert_eq!(chosen(&runs, Some("town-1"), here.path()), Some(0));
        assert_eq!(chosen(&runs, Some("town-1"), there.path()), Some(1));
        assert_eq!(chosen(&runs, paths[1].to_str(), here.path()), Some(1));
        assert_eq!(chosen(&runs, Some("runs/town-1"), there.path()), Some(1));
        assert_eq!(chosen(&runs[2..], None, here.path()), Some(0));
        let refusal = |name, at: &Path| format!("{:?}", choose(&runs, name, at).unwrap_err());
        assert!(refusal(Some("third"), here.path()).contains("no run named `third`"));
        assert!(refusal(Some("town-1"), Path::new("/")).contains("several runs named `town-1`"));
        assert!(refusal(None, here.path()).contains("several runs are alive"));
    }

    #[test]
    fn a_base_is_a_short_absolute_path_that_an_address_of_zenoh_can_name() {
        let fault = |path: &str| fault_of_base(Path::new(path));
        assert_eq!(fault("/tmp/mine & yours, 2%"), None);
        assert_eq!(fault(&format!("/{}", "a".repeat(BASE_BYTES))), Some("is too long"));
        assert_eq!(fault("mine"), Some("is not absolute"));
        for path in ["/tmp/mine?", "/tmp/#1"] {
            assert_eq!(fault(path), Some("contains `?` or `#`"));
        }
    }

    /// Makes a directory called `name` as a dead run leaves it; `change` alters the marker.
    fn make_dead(base: &Path, name: &str, change: impl FnOnce(&mut RunMarker)) -> PathBuf {
        let directory = base.join(name);
        std::fs::create_dir_all(&directory).unwrap();
        File::create(directory.join(LOCK)).unwrap();
        let mut marker = RunMarker::new(Path::new("/nowhere"));
        change(&mut marker);
        marker.write(&directory).unwrap();
        directory
    }

    #[test]
    fn only_a_directory_with_a_valid_marker_is_a_run() {
        let base = tempfile::tempdir().unwrap();
        let ours = make_dead(base.path(), "0123abcd", |_| {});
        assert_eq!(RunMarker::of(&ours), Some(RunMarker::new(Path::new("/nowhere"))));
        assert!(!RegistryEntry::read(ours).unwrap().alive);
        let foreign = [
            make_dead(base.path(), "0123abc", |_| {}),
            make_dead(base.path(), "my-thesis", |_| {}),
            make_dead(base.path(), "0123abc1", |marker| marker.program = "other".into()),
            make_dead(base.path(), "0123abc2", |marker| marker.user_id += 1),
        ];
        for directory in foreign {
            assert_eq!(RunMarker::of(&directory), None, "{}", directory.display());
        }
    }

    #[test]
    fn a_directory_without_its_name_is_removed_once_its_lock_is_free() {
        let base = tempfile::tempdir().unwrap();
        let unnamed = base.path().join(".0123abcd");
        let lock = make_unnamed(&unnamed, Path::new("/nowhere")).unwrap();
        assert!(RegistryEntry::read(unnamed.clone()).is_none());
        remove_unnamed(&unnamed);
        assert!(unnamed.is_dir());
        drop(lock);
        // A directory of the user that is called alike has no marker.
        let foreign = base.path().join(".0123abce");
        std::fs::create_dir(&foreign).unwrap();
        [&unnamed, &foreign].into_iter().for_each(|path| remove_unnamed(path));
        assert!(!unnamed.exists() && foreign.is_dir());
    }

    #[test]
    fn a_base_is_removed_only_if_a_run_created_it_and_it_is_empty() {
        let parent = tempfile::tempdir().unwrap();
        let (created, chosen) = (parent.path().join("a/created"), parent.path().join("chosen"));
        make_base(&created).unwrap();
        let run = make_dead(&created, "0123abcd", |_| {});
        remove_base(&created).unwrap();
        assert!(run.is_dir() && created.join(BASE_MARKER).is_file());
        std::fs::remove_dir_all(run).unwrap();
        remove_base(&created).unwrap();
        assert!(!created.exists());
        std::fs::create_dir(&chosen).unwrap();
        make_base(&chosen).unwrap();
        remove_base(&chosen).unwrap();
        assert!(chosen.is_dir());
    }

    #[test]
    fn a_link_to_a_run_and_a_damaged_marker_are_no_runs() {
        let base = tempfile::tempdir().unwrap();
        let ours = make_dead(base.path(), "0123abcd", |_| {});
        let link = base.path().join("89abcdef");
        std::os::unix::fs::symlink(&ours, &link).unwrap();
        assert_eq!(RunMarker::of(&link), None);
        let linked = base.path().join("89abcde0");
        std::fs::create_dir(&linked).unwrap();
        std::os::unix::fs::symlink(ours.join(MARKER), linked.join(MARKER)).unwrap();
        assert_eq!(RunMarker::of(&linked), None);
        std::fs::write(ours.join(MARKER), "{\"program\": \"caraware\"").unwrap();
        assert_eq!(RunMarker::of(&ours), None);
    }
}
