//! A small disk for the runs, so that it can be filled: a tmpfs in a mount namespace of this program's own.

use std::{
    env,
    ffi::OsString,
    os::unix::process::CommandExt as _,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use caraware::failure::Exit;

/// Set once this program has been started again in its namespace.
const STARTED: &str = "CARAWARE_ENDURANCE_NAMESPACE";
/// What the report says if there is no such disk.
pub const NO_DISK: &str = "The disk was not filled: this user may not mount anything.";
/// A run of either case takes some 20 MiB.
const SIZE: &str = "size=128m";

/// The disk. Dropping it unmounts it.
#[derive(Debug)]
pub struct SmallDisk {
    path: PathBuf,
}

impl SmallDisk {
    /// Mounts a small disk at `directory`, which no other program sees; `None` if this user may not. The first call starts this program
    /// again in a namespace, with the same process id.
    ///
    /// # Errors
    /// The program cannot be started again.
    pub fn mount(directory: &Path) -> Result<Option<Self>, Exit> {
        if env::var_os(STARTED).is_some() {
            let mounted = silent("mount", &["-t", "tmpfs", "-o", SIZE, "none"], directory);
            return Ok(mounted.then(|| Self {
                path: directory.to_owned(),
            }));
        }
        let user = match rustix::process::getuid().is_root() {
            true => None,
            false => Some("--map-root-user"),
        };
        let options: Vec<&str> = user.into_iter().chain(["--mount"]).collect();
        let probe = [&options[..], &["mount", "-t", "tmpfs", "none"]].concat();
        if !silent("unshare", &probe, directory) {
            return Ok(None);
        }
        let program = env::current_exe().map_err(|error| Exit::io("find", Path::new("this program"), &error))?;
        let arguments: Vec<OsString> = env::args_os().skip(1).collect();
        let error = Command::new("unshare")
            .args(options)
            .arg(&program)
            .args(arguments)
            .env(STARTED, "1")
            .exec();
        Err(Exit::io("start", &program, &error))
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // It ends with the namespace in any case.
        silent("umount", &["--lazy"], &self.path);
    }
}

/// True if the command succeeds.
fn silent(program: &str, arguments: &[&str], directory: &Path) -> bool {
    let mut command = Command::new(program);
    command.args(arguments).arg(directory);
    let status = command
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status();
    status.is_ok_and(|status| status.success())
}
