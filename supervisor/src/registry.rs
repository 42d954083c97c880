//! Which runs are alive on this machine, and what dead ones left in shared memory.
//!
//! Every run has a directory of its own below `/tmp/caraware-<user id>/` (or `CARAWARE_RUNTIME_DIR`): a lock that its supervisor
//! holds, the path of its run directory, and iceoryx2's files. Files in `/dev/shm` carry the directory's name in their prefix.

use std::{
    fs::{DirBuilder, File, OpenOptions},
    io::{Read as _, Write as _},
    os::unix::fs::DirBuilderExt as _,
    path::{Path, PathBuf},
};

use ipc_schema::run::{RunFile, SharedMemory};
use rustix::fs::{FlockOperation, flock};

use crate::failure::Exit;

/// Where iceoryx2 puts shared memory.
pub const SHARED_MEMORY: &str = "/dev/shm";
const LOCK: &str = "lock";
const RUN_DIR: &str = "run_dir";

/// Environment variable that moves [`base`].
const RUNTIME_DIR: &str = "CARAWARE_RUNTIME_DIR";
/// Longest [`base`]: iceoryx2's sockets lie below it, and Unix allows their paths 107 bytes.
const BASE_BYTES: usize = 40;

/// The directory of all runs of this user. Not in `TMPDIR`, which may be long and differ between terminals.
#[must_use]
pub fn base() -> PathBuf {
    std::env::var_os(RUNTIME_DIR).map_or_else(
        || format!("/tmp/caraware-{}", rustix::process::getuid().as_raw()).into(),
        PathBuf::from,
    )
}

/// Creates [`base`] for this user alone.
fn create_base() -> Result<PathBuf, Exit> {
    use std::os::unix::fs::MetadataExt as _;
    let base = base();
    let help = format!("set {RUNTIME_DIR} to a short path of your own, up to {BASE_BYTES} bytes");
    if base.as_os_str().len() > BASE_BYTES || !base.is_absolute() {
        return Err(Exit::config(
            format!("{RUNTIME_DIR} = {} is too long or not absolute", base.display()),
            help,
        ));
    }
    DirBuilder::new()
        .recursive(true)
        .mode(0o700)
        .create(&base)
        .map_err(|error| Exit::io("create", &base, &error))?;
    let owner = base
        .metadata()
        .map_err(|error| Exit::io("look at", &base, &error))?
        .uid();
    if owner != rustix::process::getuid().as_raw() {
        return Err(Exit::run(format!("{} belongs to another user", base.display()), help));
    }
    Ok(base)
}

/// A claimed corner of shared memory; released and emptied when dropped.
#[derive(Debug)]
pub struct Claim {
    directory: PathBuf,
    /// Held as long as the run lives.
    _lock: File,
    /// Random identity of the run.
    pub run_id: u64,
    /// For the run file.
    pub memory: SharedMemory,
}

impl Claim {
    /// Claims a fresh corner for the run in `run_dir`.
    ///
    /// # Errors
    /// The temporary directory is not writable.
    pub fn new(run_dir: &Path) -> Result<Self, Exit> {
        let run_id = random_u64()?;
        let name = format!("{:08x}", run_id >> 32);
        let directory = create_base()?.join(&name);
        DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(&directory)
            .map_err(|error| Exit::io("create", &directory, &error))?;
        let path = directory.join(LOCK);
        let lock = OpenOptions::new()
            .create(true)
            .truncate(false)
            .write(true)
            .open(&path)
            .map_err(|error| Exit::io("create", &path, &error))?;
        flock(&lock, FlockOperation::NonBlockingLockExclusive)
            .map_err(|error| Exit::io("lock", &path, &error.into()))?;
        let path = directory.join(RUN_DIR);
        File::create(&path)
            .and_then(|mut file| file.write_all(run_dir.as_os_str().as_encoded_bytes()))
            .map_err(|error| Exit::io("write", &path, &error))?;
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

impl Drop for Claim {
    fn drop(&mut self) {
        remove(&self.directory);
        // The last run leaves nothing; with another one alive the directory is not empty, and stays.
        if let Err(error) = std::fs::remove_dir(base()) {
            tracing::debug!(%error, "the registry stays");
        }
    }
}

fn random_u64() -> Result<u64, Exit> {
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

/// A run found in the registry.
#[derive(Debug)]
pub struct Entry {
    directory: PathBuf,
    /// True while its supervisor lives.
    pub alive: bool,
    /// Its run file, if readable.
    pub run: Option<RunFile>,
}

/// All runs of this user, dead or alive, in a stable order.
#[must_use]
pub fn entries() -> Vec<Entry> {
    let mut directories: Vec<PathBuf> = std::fs::read_dir(base())
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path())
        .collect();
    directories.sort();
    directories.into_iter().map(Entry::read).collect()
}

impl Entry {
    fn read(directory: PathBuf) -> Self {
        let alive = File::open(directory.join(LOCK))
            .is_ok_and(|lock| flock(&lock, FlockOperation::NonBlockingLockShared).is_err());
        let run = std::fs::read_to_string(directory.join(RUN_DIR))
            .ok()
            .and_then(|run_dir| RunFile::read(&Path::new(&run_dir).join("run.json")).ok());
        Self { directory, alive, run }
    }

    /// Bytes the run holds in shared memory.
    #[must_use]
    pub fn shared_memory_bytes(&self) -> u64 {
        shared_files(&self.directory)
            .iter()
            .filter_map(|path| path.metadata().ok())
            .map(|data| allocated_bytes(&data))
            .sum()
    }

    /// Removes what a dead run left; a live one is left alone.
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

/// Removes a run's shared memory, then its directory with the lock. Failures are only reported: the next start tries again.
fn remove(directory: &Path) {
    for path in shared_files(directory) {
        if let Err(error) = std::fs::remove_file(&path) {
            tracing::warn!(%error, path = %path.display(), "cannot remove shared memory");
        }
    }
    if let Err(error) = std::fs::remove_dir_all(directory) {
        tracing::warn!(%error, path = %directory.display(), "cannot remove the run's directory");
    }
}

/// Removes what dead runs left. Returns how many there were.
pub fn sweep() -> usize {
    let dead: Vec<Entry> = entries().into_iter().filter(|entry| !entry.alive).collect();
    dead.iter().for_each(Entry::clean);
    dead.len()
}

/// True if the supervisor of the run in `run_dir` lives.
#[must_use]
pub fn is_alive(run_dir: &Path) -> bool {
    let is_there = |entry: &Entry| entry.alive && entry.run.as_ref().is_some_and(|run| run.run_dir == run_dir);
    entries().iter().any(is_there)
}

/// The live run called `name`, or the only one if `name` is `None`.
///
/// # Errors
/// None, or several to choose from.
pub fn find(name: Option<&str>) -> Result<RunFile, Exit> {
    let mut runs: Vec<RunFile> = entries()
        .into_iter()
        .filter(|entry| entry.alive)
        .filter_map(|entry| entry.run)
        .collect();
    let names = runs.iter().map(|run| run.name.clone()).collect::<Vec<_>>().join(", ");
    if let Some(name) = name {
        runs.retain(|run| run.name == name);
    }
    match (runs.len(), name) {
        (1, _) => runs.pop().ok_or_else(|| Exit::run("no run", "")),
        (0, Some(name)) => Err(Exit::config(
            format!("no run named `{name}` is alive"),
            format!("alive: {}", if names.is_empty() { "none" } else { &names }),
        )),
        (0, None) => Err(Exit::config("no run is alive", "start one with `caraware train`")),
        _ => Err(Exit::config(
            "several runs are alive",
            format!("name one of them: {names}"),
        )),
    }
}
