//! A live run and another user of the machine: that user can neither attach to the run nor command it.

use std::{
    fs::Permissions,
    os::unix::fs::{FileTypeExt as _, MetadataExt as _, PermissionsExt as _},
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
};

use crate::common::{Spectator, Workplace, text};
use ipc_schema::run::RunFile;

/// Runs a command as a user without any rights.
fn as_stranger(arguments: &[&str], workplace: &Workplace) -> Output {
    Command::new("setpriv")
        .args(["--reuid=65534", "--regid=65534", "--clear-groups"])
        .args(arguments)
        .current_dir("/")
        .env("CARAWARE_RUNTIME_DIR", workplace.path().join("run"))
        .env("NO_COLOR", "1")
        .output()
        .unwrap()
}

/// Every path below a directory, with the directory itself.
fn paths(directory: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(directory).unwrap().flatten();
    let below = entries.flat_map(|entry| match entry.file_type().unwrap().is_dir() {
        true => paths(&entry.path()),
        false => vec![entry.path()],
    });
    std::iter::once(directory.to_owned()).chain(below).collect()
}

#[test]
fn another_user_can_neither_attach_to_a_run_nor_command_it() {
    let workplace = Workplace::new();
    if !rustix::process::getuid().is_root() {
        // Only root can act as another user.
        return;
    }
    // Nothing but the run's own permissions protects it: the directories above are open, and so is the user's setting for new files.
    for open in [workplace.path().to_owned(), workplace.path().join("run")] {
        std::fs::set_permissions(open, Permissions::from_mode(0o777)).unwrap();
    }
    let program = workplace.path().join("caraware");
    std::fs::copy(env!("CARGO_BIN_EXE_caraware"), &program).unwrap();
    let endless = ["--set", "episode.training_episodes=100000"];
    let command = workplace.command(&[&["simulate", "town", "--name", "mine"], &endless[..]].concat());
    let mut shell = Command::new("sh");
    shell.args(["-c", "umask 000 && exec \"$@\"", "sh"]);
    shell
        .arg(command.get_program())
        .args(command.get_args())
        .current_dir(workplace.path());
    shell.envs(command.get_envs().filter_map(|(key, value)| Some((key, value?))));
    let mut run = shell.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let run_file = workplace.path().join("runs/mine/run.json");
    let _spectator = Spectator::join(&run_file, &mut run);
    let memory = RunFile::read(&run_file).unwrap().shared_memory;

    let program = program.to_str().unwrap();
    for (arguments, says) in [
        (vec![program, "ps"], "no run is alive"),
        (vec![program, "stop", "mine"], "no run named `mine` is alive"),
        (
            vec![program, "control", "--run", "mine", "pause"],
            "no run named `mine` is alive",
        ),
        (vec![program, "handover", "mine"], "no run named `mine` is alive"),
    ] {
        let said = text(&as_stranger(&arguments, &workplace));
        assert!(said.contains(says), "{arguments:?}: {said}");
    }
    // Nor with programs that know where everything is.
    let socket = memory.root.join("control");
    let touch = format!(
        "for file in /dev/shm/{}* {}/*; do test -r $file -o -w $file && echo $file; done; ls {}",
        memory.prefix,
        memory.root.display(),
        memory.root.display()
    );
    let found = as_stranger(&["sh", "-c", &touch], &workplace);
    assert_eq!(String::from_utf8_lossy(&found.stdout), "", "{}", text(&found));
    assert!(text(&found).contains("Permission denied"), "{}", text(&found));
    assert!(socket.symlink_metadata().unwrap().file_type().is_socket());
    assert_eq!(socket.metadata().unwrap().mode() & 0o777, 0o600);
    let writable: Vec<PathBuf> = paths(&workplace.path().join("runs"))
        .into_iter()
        .filter(|path| path.symlink_metadata().unwrap().mode() & 0o022 != 0)
        .collect();
    assert!(writable.is_empty(), "other users can write {writable:?}");

    assert!(workplace.run(&["stop", "mine"]).status.success());
    run.wait().unwrap();
    workplace.assert_nothing_left();
}
