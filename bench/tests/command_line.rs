//! The command line of `caraware-bench`, which `caraware bench` forwards.

#![allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]

use std::{
    ffi::OsStr,
    fs,
    os::unix::ffi::OsStrExt as _,
    path::Path,
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use rustix::process::{Pid, Signal, kill_process};

fn answer(arguments: &[&str]) -> (Option<i32>, String) {
    let program = env!("CARGO_BIN_EXE_caraware-bench");
    let output = Command::new(program).args(arguments).output().unwrap();
    let text = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8(text).unwrap())
}

#[test]
fn the_help_shows_the_command_and_every_part() {
    let (code, text) = answer(&["--help"]);
    assert_eq!(code, Some(0), "{text}");
    assert!(text.contains("Usage: caraware bench [OPTIONS] <PART>"), "{text}");
    for part in [
        "lidar",
        "envs",
        "fanout",
        "ipc",
        "trainer",
        "overhead",
        "scale",
        "peers",
        "heroes",
        "record",
        "watch",
        "v2x",
        "endurance",
        "soak",
        "all",
    ] {
        assert!(text.contains(&format!("- {part}:")), "{part}: {text}");
    }
}

#[test]
fn an_unknown_part_is_refused_as_wrong_usage() {
    let (code, text) = answer(&["soup"]);
    assert_eq!(code, Some(2), "{text}");
    assert!(text.contains("possible values: lidar"), "{text}");
}

/// A recorder comes and goes beside live runs, and every pair of stretches gives a ratio.
#[test]
fn a_recorder_that_watches_is_measured_beside_equal_runs() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let (code, text) = answer(&["watch", "--quick", "--json", file.path().to_str().unwrap()]);
    assert_eq!(code, Some(0), "{text}");
    let report: serde_json::Value = serde_json::from_reader(file).unwrap();
    for what in ["wall time", "processor time", "processor time of `traffic-bridge`"] {
        for beside in ["watched", "beside a process that counts", "alone beside alone"] {
            let figure = |part: &str| {
                report["figures"][format!("{what} of a tick, {beside}, {part}")]
                    .as_f64()
                    .unwrap()
            };
            let [low, median, high] = ["low", "median", "high"].map(figure);
            assert!(0.0 < low && low <= median && median <= high, "{what}, {beside}: {text}");
        }
    }
    assert!(report["figures"]["MB/s of messages"].as_f64().unwrap() > 0.0, "{text}");
}

/// Heroes drive, and every process of a tick uses processor time.
#[test]
fn heroes_that_a_policy_drives_are_measured() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let (code, text) = answer(&["heroes", "--quick", "--json", file.path().to_str().unwrap()]);
    assert_eq!(code, Some(0), "{text}");
    let report: serde_json::Value = serde_json::from_reader(file).unwrap();
    let figure = |what: &str| report["figures"][what].as_f64().unwrap();
    for policy in ["learnt", "untrained"] {
        assert!(figure(&format!("{policy}, 16 heroes, agent-steps/s")) > 0.0, "{text}");
        assert!(
            figure(&format!("{policy}, 16 heroes, sim-core, CPU µs/tick")) > 0.0,
            "{text}"
        );
    }
}

/// More radios and collective perception make more of the others known, and cost the channel more.
#[test]
fn the_curves_of_messages_go_the_way_they_must() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let (code, text) = answer(&["v2x", "--quick", "--json", file.path().to_str().unwrap()]);
    assert_eq!(code, Some(0), "{text}");
    let report: serde_json::Value = serde_json::from_reader(file).unwrap();
    let figure = |case: &str, what: &str| report["figures"][format!("{case}: {what}")].as_f64().unwrap();
    let cases = [
        "CAM, 50 % with a radio",
        "CAM, 100 % with a radio",
        "CAM and CPM, 100 % with a radio",
    ];
    for what in ["channel busy ratio", "awareness within 100 m"] {
        let values = cases.map(|case| figure(case, what));
        assert!(0.0 < values[0] && values[0] < values[1], "{what}: {values:?}");
        assert!(values[1] < values[2] && values[2] <= 1.0, "{what}: {values:?}");
    }
    assert!(figure(cases[2], "error after fusion, m") < figure(cases[1], "error after fusion, m"));
}

/// Every kind of disturbance happens: the runs must end as the undisturbed ones.
#[test]
fn disturbed_runs_end_as_if_nothing_had_happened() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let (code, text) = answer(&[
        "endurance",
        "--quick",
        "--seed",
        "3",
        "--json",
        file.path().to_str().unwrap(),
    ]);
    assert_eq!(code, Some(0), "{text}");
    let report: serde_json::Value = serde_json::from_reader(file).unwrap();
    let figures = report["figures"].as_object().unwrap();
    for (case, own) in [("town", Some("v2x")), ("grid", Some("recorder")), ("learners", None)] {
        let runs = figures[&format!("{case}: runs completed")].as_f64().unwrap();
        assert!(runs >= 1.0, "{text}");
        let hung = figures
            .keys()
            .filter(|what| what.starts_with(&format!("{case}: ")) && what.ends_with(" hung"));
        assert_eq!(hung.count(), 1, "{text}");
        let processes = [
            "traffic-bridge",
            "sim-core",
            "sensor-daemon",
            "trainer",
            "fanout",
            "supervisor",
        ];
        for process in processes.into_iter().chain(own) {
            let killed = figures.get(&format!("{case}: {process} killed"));
            assert_eq!(killed, Some(&1.0.into()), "{process}: {text}");
        }
        let may_mount = !report["text"].as_str().unwrap().contains("may not mount");
        let filled = figures.get(&format!("{case}: disk filled")).cloned();
        assert_eq!(filled, may_mount.then(|| 1.0.into()), "{text}");
    }
}

/// Command lines of processes that name `directory`, and end with one of these programs.
fn processes_in(directory: &Path, programs: &[&str]) -> Vec<String> {
    let entries = fs::read_dir("/proc").unwrap().flatten();
    let lines = entries.filter_map(|entry| fs::read(entry.path().join("cmdline")).ok());
    let named = |line: &Vec<u8>| {
        let program = line.split(|byte| *byte == 0).next().unwrap_or_default();
        let program = Path::new(OsStr::from_bytes(program)).file_name();
        let is_one = programs.is_empty() || program.is_some_and(|name| programs.iter().any(|wanted| name == *wanted));
        is_one
            && line
                .windows(directory.as_os_str().len())
                .any(|part| part == directory.as_os_str().as_bytes())
    };
    lines
        .filter(named)
        .map(|line| String::from_utf8_lossy(&line).into_owned())
        .collect()
}

/// Bare SUMO and whole runs end with the measurement that has started them, and its files are removed.
#[test]
fn a_measurement_that_is_stopped_leaves_nothing_behind() {
    let cases = [
        ("sumo", Signal::TERM, 143),
        ("traffic-bridge", Signal::INT, 130),
        ("traffic-bridge", Signal::HUP, 129),
    ];
    for (running, signal, code) in cases {
        let temporary = tempfile::tempdir().unwrap();
        let mut bench = Command::new(env!("CARGO_BIN_EXE_caraware-bench"))
            .args(["overhead", "--quick"])
            .env("TMPDIR", temporary.path())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let begun = Instant::now();
        while processes_in(temporary.path(), &[running]).is_empty() {
            assert!(bench.try_wait().unwrap().is_none() && begun.elapsed() < Duration::from_secs(120));
            std::thread::park_timeout(Duration::from_millis(5));
        }
        kill_process(Pid::from_child(&bench), signal).unwrap();
        assert_eq!(bench.wait().unwrap().code(), Some(code));
        let left = processes_in(temporary.path(), &[]);
        assert!(left.is_empty(), "{signal:?}: {left:?}");
        let files: Vec<_> = fs::read_dir(temporary.path()).unwrap().flatten().collect();
        assert!(files.is_empty(), "{signal:?}: {files:?}");
    }
}
