//! Whole runs that run out of shared memory, of disk space or of file handles: a clear error or a wait, never a signal or a hang.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

mod common;

use std::{
    fs::File,
    os::{fd::AsRawFd as _, unix::process::ExitStatusExt as _},
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
};

use common::{Workplace, text, until, with_mounts};
use rustix::{
    fs::statvfs,
    process::{Pid, Signal, kill_process},
};

/// A short training run of six vehicles, without viewers.
const SHORT: [&str; 11] = [
    "traffic.cavs=6",
    "traffic.others=3",
    "traffic.pedestrians=3",
    "episode.ticks=150",
    "episode.training_episodes=4",
    "episode.evaluation_interval=2",
    "episode.evaluation_ticks=40",
    "trainer.checkpoint_interval=1",
    "trainer.horizon=900",
    "trainer.batch_size=300",
    "fanout.enabled=false",
];

fn train<'a>(name: &'a str, settings: &[&'a str]) -> Vec<&'a str> {
    let set = SHORT.iter().chain(settings).flat_map(|setting| ["--set", *setting]);
    ["train", "town", "--name", name].into_iter().chain(set).collect()
}

/// Process id of the process whose command line has both words.
fn pid_of(words: [&str; 2]) -> Option<Pid> {
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    let pids = processes.filter_map(|entry| entry.file_name().to_string_lossy().parse::<i32>().ok());
    pids.filter_map(Pid::from_raw).find(|pid| {
        let line = std::fs::read(format!("/proc/{}/cmdline", pid.as_raw_nonzero())).unwrap_or_default();
        let line = String::from_utf8_lossy(&line).replace('\0', " ");
        words.iter().all(|word| line.contains(word)) && !line.contains("unshare")
    })
}

/// Fills the file system of `directory`, as another program's file does, and returns that file.
fn fill(directory: &Path) -> PathBuf {
    let path = directory.join("other");
    let file = File::create(&path).unwrap();
    let block = vec![1_u8; 1 << 16];
    let mut size = block.len();
    // What is left is too little for a block: smaller ones follow.
    while size > 0 {
        if std::io::Write::write_all(&mut &file, &block[..size]).is_err() {
            size /= 2;
        }
    }
    path
}

fn assert_ended_clearly(output: &Output, what: &str) {
    assert_eq!(output.status.signal(), None, "{what}: {}", text(output));
    assert!(
        output.status.success() || !text(output).contains("panicked"),
        "{what}: {}",
        text(output)
    );
}

#[test]
fn little_shared_memory_is_an_error_that_names_what_is_needed() {
    let workplace = Workplace::new();
    for mib in [1, 16, 64] {
        let name = format!("of-{mib}");
        let mount = format!("mount -t tmpfs -o size={mib}m none /dev/shm");
        let Some(mut command) = with_mounts(&workplace.command(&train(&name, &[])), &mount) else {
            return;
        };
        let output = command.output().unwrap();
        assert_ended_clearly(&output, &name);
        let said = text(&output);
        match mib {
            64 => assert!(output.status.success(), "{said}"),
            mib => {
                assert_eq!(output.status.code(), Some(3), "{said}");
                assert!(
                    said.contains(&format!("/dev/shm has {mib} MiB free, but this run needs")),
                    "{said}"
                );
                assert!(said.contains("--shm-size"), "{said}");
            }
        }
    }
    workplace.assert_nothing_left();
}

#[test]
fn a_run_keeps_the_memory_that_it_reserved_when_others_fill_the_rest() {
    let workplace = Workplace::new();
    let hash = |name: &str| workplace.report(name)["observation_hash"].clone();
    workplace.succeed(&train("alone", &[]));
    // Another program fills the memory as soon as the run has been prepared: no process has started.
    let disturb = "mount -t tmpfs -o size=80m none /dev/shm && \
        { (until [ -s /dev/shm/*reserve ]; do :; done; cat /dev/zero > /dev/shm/other; touch filled) > /dev/null 2>&1 & }";
    let command = workplace.command(&train("beside", &[]));
    let Some(mut command) = with_mounts(&command, disturb) else {
        return;
    };
    let mut run = command.stderr(Stdio::piped()).spawn().unwrap();
    // The trainer is killed while the memory is full: its successor gets what it had.
    let checkpoint = workplace.path().join("runs/beside/checkpoints/latest");
    until(&mut run, "checkpoint", || checkpoint.exists().then_some(()));
    assert!(workplace.path().join("filled").exists());
    let trainer = pid_of(["caraware.train", &workplace.path().to_string_lossy()]);
    let killed = trainer.is_some_and(|pid| kill_process(pid, Signal::KILL).is_ok());
    let output = run.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    assert_eq!(hash("alone"), hash("beside"));
    assert!(!killed || workplace.report("beside")["lost_ticks"] == 0);
    workplace.assert_nothing_left();
}

#[test]
fn a_full_disk_is_waited_for() {
    let workplace = Workplace::new();
    let hash = |name: &str| workplace.report(name)["observation_hash"].clone();
    let longer = ["episode.training_episodes=10"];
    workplace.succeed(&train("alone", &longer));
    let reference = hash("alone");
    let small = workplace.path().join("small");
    std::fs::create_dir(&small).unwrap();
    let arguments = [&train("full", &longer)[..], &["--runs", "small"]].concat();
    let mount = format!("mount -t tmpfs -o size=48m none {}", small.display());
    let Some(mut command) = with_mounts(&workplace.command(&arguments), &mount) else {
        return;
    };
    let said = workplace.path().join("said");
    command.stderr(File::create(&said).unwrap()).stdout(Stdio::null());
    let mut run = command.spawn().unwrap();
    // The run's mounts are seen through its process, and through an open directory also after its end.
    let inside = PathBuf::from(format!("/proc/{}/root{}", run.id(), small.display()));
    until(&mut run, "checkpoint", || {
        inside.join("full/checkpoints/latest").exists().then_some(())
    });
    let held = File::open(&inside).unwrap();
    let inside = PathBuf::from(format!("/proc/self/fd/{}", held.as_raw_fd()));
    let other = fill(&inside);
    // Whichever process is the first to need space waits for it.
    until(&mut run, "notice", || {
        std::fs::read_to_string(&said)
            .unwrap()
            .contains("is full")
            .then_some(())
    });
    assert!(
        statvfs(&inside).unwrap().f_bavail * 4096 < 64 << 10,
        "the disk is not full"
    );
    std::fs::remove_file(other).unwrap();
    assert!(
        run.wait().unwrap().success(),
        "{}",
        std::fs::read_to_string(&said).unwrap()
    );
    let logs = std::fs::read_dir(inside.join("full/logs")).unwrap().flatten();
    let logs: String = logs
        .filter_map(|entry| std::fs::read_to_string(entry.path()).ok())
        .collect();
    let said = std::fs::read_to_string(&said).unwrap();
    assert!(said.contains("has space again"), "{said}");
    assert!(logs.contains("there is space again"), "{logs}");
    let report: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(inside.join("full/report.json")).unwrap()).unwrap();
    assert_eq!(
        (&report["result"], &report["observation_hash"]),
        (&"completed".into(), &reference)
    );
    assert_eq!((&report["lost_ticks"], &report["restarts"]), (&0.into(), &0.into()));
    assert!(report["disk_full"].as_u64().unwrap() >= 1, "{report:#}");
}

/// `command` in a shell that first runs `before`.
fn in_shell(command: &Command, before: &str) -> Command {
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!("{before} && exec \"$@\""), "sh"]);
    shell.arg(command.get_program()).args(command.get_args());
    shell.current_dir(command.get_current_dir().unwrap());
    shell.envs(command.get_envs().filter_map(|(key, value)| Some((key, value?))));
    shell
}

#[test]
fn too_few_file_handles_are_an_error_that_names_the_limit() {
    let workplace = Workplace::new();
    for limit in [12, 24, 48, 64, 96, 128, 192, 256] {
        let command = workplace.command(&train("handles", &[]));
        let output = in_shell(&command, &format!("ulimit -n {limit}")).output().unwrap();
        let said = text(&output);
        assert_eq!(output.status.code(), Some(3), "{limit}: {said}");
        assert!(
            said.contains(&format!("a process may open {limit} files")),
            "{limit}: {said}"
        );
        assert!(said.contains("`ulimit -n 320`"), "{limit}: {said}");
    }
    assert!(!workplace.path().join("runs").exists());
    // What is asked for is enough, and a limit that the user may raise is raised.
    for (name, before) in [("hard", "ulimit -n 320"), ("soft", "ulimit -S -n 64")] {
        let output = in_shell(&workplace.command(&train(name, &[])), before)
            .output()
            .unwrap();
        assert!(output.status.success(), "{before}: {}", text(&output));
    }
    workplace.assert_nothing_left();
}
