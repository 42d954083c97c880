//! Whole runs with real SUMO traffic, real processes and real shared memory.

use std::{
    collections::BTreeSet,
    io::{BufRead as _, BufReader},
    path::{Path, PathBuf},
    process::{Child, Stdio},
    time::{Duration, Instant},
};

use caraware::install::Install;

use crate::common::{Workplace, assert_documented, command_lines, free_port, sumo_program, text, tool};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// Settings of a run of a few thousand steps.
const SMALL: [&str; 18] = [
    "--set",
    "traffic.cavs=6",
    "--set",
    "traffic.others=3",
    "--set",
    "traffic.pedestrians=3",
    "--set",
    "episode.ticks=150",
    "--set",
    "episode.training_episodes=4",
    "--set",
    "episode.evaluation_interval=2",
    "--set",
    "episode.evaluation_ticks=40",
    "--set",
    "trainer.horizon=900",
    "--set",
    "trainer.batch_size=300",
];

/// A command with the small settings.
fn small<'a>(mode: &'a str, name: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    [&[mode, "town", "--name", name], SMALL.as_slice(), more].concat()
}

const QUIET: [&str; 2] = ["--set", "fanout.enabled=false"];
/// Small networks, one evaluation at the end and no plots, for runs in which what is learnt does not matter.
const LIGHT: [&str; 6] = [
    "--set",
    "trainer.plots=false",
    "--set",
    "trainer.hidden=[32, 32]",
    "--set",
    "episode.final_evaluations=1",
];

/// No checkpoint but the last.
const RARE: [&str; 2] = ["--set", "trainer.checkpoint_interval=1000000"];

#[test]
fn a_run_trains_reports_and_leaves_nothing_behind() {
    let workplace = Workplace::new();
    let listen = format!("fanout.listen=tcp/127.0.0.1:{}", free_port());
    let output = workplace.succeed(&small("train", "one", &["--set", &listen]));
    let report = workplace.report("one");
    for key in [
        "env_steps",
        "wall_s",
        "env_steps_per_s",
        "raw_gnss_mean_error_m",
        "ppo_mean_error_m",
        "policy_std",
        "vehicles",
        "observation_hash",
        "lost_ticks",
        "duplicated_ticks",
        "drops",
        "restarts",
    ] {
        assert!(!report[key].is_null(), "{key} is missing: {report:#}");
    }
    assert_eq!(report["vehicles"], 6);
    assert_eq!(
        (&report["lost_ticks"], &report["duplicated_ticks"], &report["restarts"]),
        (&0.into(), &0.into(), &0.into())
    );
    let steps = report["env_steps"].as_u64().unwrap();
    assert!(
        (3000..=3600).contains(&steps),
        "6 vehicles, 4 episodes of 150 ticks: {steps} steps"
    );
    assert_eq!(report["ticks"], 4 * 150 + 40 + 4 * 40);
    let raw = report["raw_gnss_mean_error_m"].as_f64().unwrap();
    // σ = 5.57 m on each axis: the mean distance is σ √(π/2) = 6.98 m; 960 samples give a standard error of 0.12 m.
    assert!((raw - 6.98).abs() < 0.5, "raw GNSS mean error {raw} m");
    let run = workplace.path().join("runs/one");
    for file in [
        "config.toml",
        "run.json",
        "logs/trainer.log",
        "logs/traffic-bridge.log",
        "plots/error.png",
        "plots/sigma.png",
        "map/town.net.xml",
        "checkpoints/latest",
    ] {
        assert!(run.join(file).is_file(), "{file} is missing");
    }
    let events = std::fs::read_dir(run.join("tensorboard"))
        .unwrap()
        .flatten()
        .filter(|entry| entry.metadata().unwrap().len() > 0)
        .count();
    assert!(events > 0, "no TensorBoard events");
    assert_documented(&run);
    assert!(
        text(&output).contains("mean error on 4 unseen seeds (± 95 %): policy"),
        "{}",
        text(&output)
    );
    workplace.assert_nothing_left();
}

#[test]
fn the_same_seed_gives_the_same_bytes_whatever_runs_beside() {
    let workplace = Workplace::new();
    let hash = |name: &str| workplace.report(name)["observation_hash"].as_str().unwrap().to_owned();
    workplace.succeed(&small("train", "a", &[&QUIET[..], &LIGHT].concat()));
    // Everything that must not matter differs: a fan-out beside the run, a narrow window, a shorter horizon, other networks.
    let listen = format!("fanout.listen=tcp/127.0.0.1:{}", free_port());
    let beside = [
        "--set",
        &listen,
        "--set",
        "run.window_ticks=2",
        "--set",
        "trainer.horizon=400",
        "--set",
        "episode.final_evaluations=1",
    ];
    workplace.succeed(&small("train", "b", &beside));
    workplace.succeed(&small("simulate", "d", &QUIET));
    // Traffic and sensors draw from the seed, so a run without a learner shows the difference.
    workplace.succeed(&small(
        "simulate",
        "c",
        &[&QUIET[..], &["--set", "run.seed=2"]].concat(),
    ));
    assert_eq!(
        hash("a"),
        hash("b"),
        "same seed, another window, horizon and network, and a fan-out"
    );
    assert_ne!(
        hash("a"),
        hash("d"),
        "without evaluations in between these are other episodes"
    );
    assert_ne!(hash("d"), hash("c"), "another seed");
    assert_eq!(hash("a").len(), 64);
}

/// A run in the background, killed when dropped.
struct Background(Child);

impl Background {
    fn start(workplace: &Workplace, arguments: &[&str]) -> Self {
        let mut command = workplace.command(arguments);
        Self(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap())
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_raw(self.0.id().try_into().unwrap()).unwrap(), signal).unwrap();
    }

    fn said(&mut self) -> String {
        let out = self.0.stderr.take().unwrap();
        BufReader::new(out)
            .lines()
            .map_while(Result::ok)
            .collect::<Vec<_>>()
            .join("\n")
    }
}

impl Drop for Background {
    fn drop(&mut self) {
        if self.0.try_wait().unwrap().is_none() {
            self.0.kill().unwrap();
            self.0.wait().unwrap();
        }
    }
}

/// Calls `ask` until it returns a value.
fn eventually<T>(what: &str, mut ask: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + Duration::from_mins(2);
    while Instant::now() < deadline {
        if let Some(answer) = ask() {
            return answer;
        }
        std::thread::park_timeout(Duration::from_millis(50));
    }
    panic!("{what}: not within two minutes");
}

/// Rows of `caraware ps` (process, state, pid) once every process is running.
fn process_table(workplace: &Workplace) -> Vec<(String, String, u32)> {
    eventually("all processes running", || {
        let output = workplace.run(&["ps"]);
        let rows: Vec<(String, String, u32)> = String::from_utf8_lossy(&output.stdout)
            .lines()
            .skip(1)
            .take_while(|line| !line.is_empty())
            .map(|line| line.split_whitespace().map(str::to_owned).collect::<Vec<_>>())
            .map(|words| (words[1].clone(), words[2].clone(), words[3].parse().unwrap()))
            .collect();
        let running = rows.len() == 6 && rows.iter().all(|(_, state, _)| state == "running");
        running.then_some(rows)
    })
}

#[test]
fn the_processes_are_separate_and_stop_ends_them_in_order() {
    let workplace = Workplace::new();
    let listen = format!("fanout.listen=tcp/127.0.0.1:{}", free_port());
    let mut run = Background::start(
        &workplace,
        &small(
            "train",
            "long",
            &["--set", &listen, "--set", "episode.training_episodes=100000"],
        ),
    );
    let rows = process_table(&workplace);
    let pids: BTreeSet<u32> = rows.iter().map(|(_, _, pid)| *pid).collect();
    assert_eq!(pids.len(), 6, "{rows:?}");
    for (process, _, pid) in &rows {
        let command = std::fs::read_to_string(format!("/proc/{pid}/cmdline"))
            .unwrap()
            .replace('\0', " ");
        let expected = match process.as_str() {
            "supervisor" => "caraware train",
            "trainer" => "-m caraware.train",
            name => name,
        };
        assert!(command.contains(expected), "{process}: {command}");
    }
    let pace = eventually("vehicles on the road", || {
        let output = workplace.run(&["ps"]);
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        let line = said.lines().find(|line| line.contains("environment 0"))?.to_owned();
        (!line.contains(" 0.0 × real time")).then_some(line)
    });
    for part in [" of 12 road users sensing", "arrived", "steps/s"] {
        assert!(pace.contains(part), "{part}: {pace}");
    }
    let output = workplace.run(&["stop"]);
    assert!(output.status.success(), "{}", text(&output));
    assert_eq!(run.0.wait().unwrap().code(), Some(130));
    let report = workplace.report("long");
    assert_eq!(report["result"], "interrupted");
    assert!(
        workplace.path().join("runs/long/checkpoints/latest").is_file(),
        "no checkpoint"
    );
    workplace.assert_nothing_left();
}

/// A run is in the registry before its shared memory is there, and a little longer.
#[test]
fn ps_succeeds_while_a_run_starts_and_while_it_ends() {
    let workplace = Workplace::new();
    let mut run = Background::start(
        &workplace,
        &small(
            "simulate",
            "short",
            &[&QUIET[..], &["--set", "run.real_time_factor=8"]].concat(),
        ),
    );
    let mut asked = 0;
    while run.0.try_wait().unwrap().is_none() {
        // Two at a time: they measure for half a second, and one that finds no run, or no shared memory, ends at once.
        let ask = || {
            let mut table = workplace.command(&["ps"]);
            table.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
        };
        for table in [ask(), ask()] {
            let output = table.wait_with_output().unwrap();
            assert!(output.status.success(), "{}", text(&output));
            assert!(output.stderr.is_empty(), "{}", text(&output));
            asked += 1;
        }
    }
    assert!(run.0.wait().unwrap().success());
    assert!(asked >= 4, "{asked}");
    workplace.assert_nothing_left();
}

#[test]
fn after_sigkill_of_the_supervisor_everything_ends_and_the_next_run_starts() {
    let workplace = Workplace::new();
    let run = Background::start(
        &workplace,
        &small(
            "train",
            "killed",
            &[&QUIET[..], &["--set", "episode.training_episodes=100000"]].concat(),
        ),
    );
    eventually("a running trainer", || {
        let output = workplace.run(&["ps"]);
        String::from_utf8_lossy(&output.stdout)
            .lines()
            .any(|line| line.contains("trainer") && line.contains("running"))
            .then_some(())
    });
    run.signal(Signal::KILL);
    let here = workplace.path().to_string_lossy().into_owned();
    eventually("the children end with the supervisor", || {
        (!command_lines().iter().any(|line| line.contains(&here))).then_some(())
    });
    workplace.succeed(&small("train", "next", &[&QUIET[..], &LIGHT].concat()));
    assert_eq!(workplace.report("next")["result"], "completed");
    workplace.assert_nothing_left();
}

/// A simulator process that crashes again and again before anything new is sensed is the program's fault: the run gives up, with a
/// checkpoint and a report.
#[test]
fn a_simulator_that_always_crashes_ends_the_run_with_its_name_a_checkpoint_and_a_report() {
    let workplace = Workplace::new();
    let endless = ["--set", "episode.training_episodes=100000"];
    let mut run = Background::start(
        &workplace,
        &small("train", "hit", &[&QUIET[..], &LIGHT, &endless, &RARE].concat()),
    );
    let updates = workplace.path().join("runs/hit/learning.jsonl");
    eventually("an update", || {
        std::fs::metadata(&updates).ok().filter(|file| file.len() > 0)
    });
    // The only checkpoint is that of a learner that was asked to commit.
    assert!(!workplace.path().join("runs/hit/checkpoints/latest").exists());
    let here = workplace.path().join("runs/hit").to_string_lossy().into_owned();
    let status = eventually("the end of the run", || {
        for entry in std::fs::read_dir("/proc").unwrap().flatten() {
            let line = std::fs::read(entry.path().join("cmdline")).unwrap_or_default();
            let line = String::from_utf8_lossy(&line).into_owned();
            let pid = entry.file_name().to_str().and_then(|name| name.parse().ok());
            if line.contains("sim-core\0")
                && line.contains(&here)
                && let Some(pid) = pid.and_then(Pid::from_raw)
            {
                let _ = kill_process(pid, Signal::SEGV);
            }
        }
        run.0.try_wait().unwrap()
    });
    assert_eq!(status.code(), Some(1));
    let said = run.said();
    assert!(said.contains("sim-core ended with signal: 11"), "{said}");
    assert!(said.contains("crashed again and again"), "{said}");
    let report = workplace.report("hit");
    assert_eq!(report["result"], "failed");
    let message = report["failure"]["message"].as_str().unwrap();
    assert!(message.contains("sim-core ended with signal: 11"), "{message}");
    assert!(report["env_steps"].as_u64().unwrap() > 0, "{report:#}");
    let newest = Path::new(report["checkpoint"].as_str().unwrap());
    assert!(newest.join("manifest.json").is_file(), "{}", newest.display());
    workplace.assert_nothing_left();
}

#[test]
fn a_run_whose_traffic_cannot_start_says_so_in_its_report() {
    let workplace = Workplace::new();
    let arguments = ["--grid", "--grid.number", "3", "-o", "n.net.xml"];
    tool(&sumo_program("netgenerate"), &arguments, workplace.path());
    workplace.write(
        "r.rou.xml",
        "<routes><trip id=\"lost\" depart=\"0\" from=\"nowhere\" to=\"elsewhere\"/></routes>",
    );
    let input = "<net-file value=\"n.net.xml\"/><route-files value=\"r.rou.xml\"/>";
    let cfg = format!("<configuration><input>{input}</input></configuration>");
    let cfg = workplace.write("lost.sumocfg", &cfg);
    let more = [
        "--name",
        "lost",
        "--set",
        "fanout.enabled=false",
        "--set",
        "map.origin_latitude_deg=52",
        "--set",
        "map.origin_longitude_deg=10",
    ];
    let output = workplace.run(&[&["simulate", cfg.to_str().unwrap()], &more[..]].concat());
    assert!(!output.status.success(), "{}", text(&output));
    let report = workplace.report("lost");
    assert_eq!(report["result"], "failed");
    let message = report["failure"]["message"].as_str().unwrap();
    assert!(message.contains("nowhere"), "{message}");
    workplace.assert_nothing_left();
}

/// Two runs with one name, started at the same moment in two directories, with the default endpoint.
#[test]
fn two_runs_that_start_together_have_ports_of_their_own_and_are_told_apart() {
    let workplace = Workplace::new();
    let endless = ["--set", "episode.training_episodes=100000", "--runs"];
    let mut runs = ["here", "there"].map(|runs| {
        let arguments = small("simulate", "twin", &[&endless[..], &[runs]].concat());
        Background::start(&workplace, &arguments)
    });
    let endpoints = ["here", "there"].map(|runs| {
        let file = workplace.path().join(runs).join("twin/run.json");
        eventually("a run that makes ticks", || {
            let run_file = std::fs::read_to_string(&file).ok()?;
            let table = text(&workplace.run(&["ps"]));
            let is_whole = table.lines().filter(|line| line.contains("fanout")).count() == 2;
            let run: Value = serde_json::from_str(&run_file).ok()?;
            is_whole.then(|| run["config"]["fanout"]["listen"].as_str().unwrap().to_owned())
        })
    });
    assert_ne!(endpoints[0], endpoints[1]);
    for endpoint in &endpoints {
        let address = endpoint.strip_prefix("tcp/").unwrap();
        eventually("a fan-out that listens", || std::net::TcpStream::connect(address).ok());
    }
    // The name alone fits both. A directory means one of them.
    for command in [
        vec!["stop", "twin"],
        vec!["control", "--run", "twin", "pause"],
        vec!["view", "twin"],
        vec!["handover", "twin"],
    ] {
        let output = workplace.run(&command);
        assert_eq!(output.status.code(), Some(2), "{command:?}: {}", text(&output));
        let said = text(&output);
        assert!(
            said.contains("several runs named `twin` are alive"),
            "{command:?}: {said}"
        );
        assert!(
            said.contains("here/twin") && said.contains("there/twin"),
            "{command:?}: {said}"
        );
    }
    workplace.succeed(&["stop", "there/twin"]);
    assert_eq!(runs[1].0.wait().unwrap().code(), Some(130));
    assert!(runs[0].0.try_wait().unwrap().is_none(), "the other lives");
    workplace.succeed(&["stop", "twin"]);
    assert_eq!(runs[0].0.wait().unwrap().code(), Some(130));
    workplace.assert_nothing_left();
}

#[test]
fn a_run_takes_a_free_port_if_the_default_one_is_in_use() {
    let workplace = Workplace::new();
    // Another program, or another run on this machine, listens there.
    let _taken = std::net::TcpListener::bind("127.0.0.1:7447");
    let output = workplace.succeed(&small("simulate", "second", &["--set", "episode.ticks=30"]));
    assert!(
        text(&output).contains("viewers connect to tcp/127.0.0.1:"),
        "{}",
        text(&output)
    );
    let file = std::fs::read_to_string(workplace.path().join("runs/second/run.json")).unwrap();
    let run: Value = serde_json::from_str(&file).unwrap();
    assert_ne!(run["config"]["fanout"]["listen"], "tcp/127.0.0.1:7447");
    workplace.assert_nothing_left();
}

/// The end of a terminal: SIGHUP, and no place left to write to.
#[test]
fn a_closed_terminal_ends_the_run_with_a_checkpoint_and_a_report() {
    let workplace = Workplace::new();
    let endless = ["--set", "episode.training_episodes=100000"];
    let mut run = Background::start(
        &workplace,
        &small("train", "hung", &[&QUIET[..], &LIGHT, &endless, &RARE].concat()),
    );
    let latest = workplace.path().join("runs/hung/checkpoints/latest");
    let updates = workplace.path().join("runs/hung/learning.jsonl");
    eventually("an update", || {
        std::fs::metadata(&updates).ok().filter(|file| file.len() > 0)
    });
    assert!(!latest.exists());
    drop((run.0.stdout.take(), run.0.stderr.take()));
    run.signal(Signal::HUP);
    assert_eq!(run.0.wait().unwrap().code(), Some(130));
    assert_eq!(workplace.report("hung")["result"], "interrupted");
    assert!(latest.is_file(), "a checkpoint that was asked for");
    workplace.assert_nothing_left();
}

#[test]
fn the_runtime_directory_of_a_killed_run_can_be_removed() {
    let workplace = Workplace::new();
    let made = workplace.path().join("made");
    let command = |arguments: &[&str]| {
        let mut command = workplace.command(arguments);
        command
            .env("CARAWARE_RUNTIME_DIR", &made)
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        command
    };
    let endless = ["--set", "episode.training_episodes=100000"];
    let simulate = small("simulate", "killed", &[&QUIET[..], &endless].concat());
    let mut run = command(&simulate).spawn().unwrap();
    let log = workplace.path().join("runs/killed/logs/sensor-daemon.log");
    eventually("a process of the run", || log.exists().then_some(()));
    run.kill().unwrap();
    run.wait().unwrap();
    let here = workplace.path().to_string_lossy().into_owned();
    eventually("the children end with the supervisor", || {
        (!command_lines().iter().any(|line| line.contains(&here))).then_some(())
    });
    assert!(made.is_dir());
    assert!(command(&["doctor", "--clean"]).status().unwrap().success());
    assert!(!made.exists());
}

/// Libraries of C and C++, which the project's own programs link too.
const BASE: [&str; 9] = [
    "ld-linux-x86-64.so.2",
    "libc.so.6",
    "libdl.so.2",
    "libgcc_s.so.1",
    "libm.so.6",
    "libpthread.so.0",
    "libresolv.so.2",
    "librt.so.1",
    "libstdc++.so.6",
];

#[test]
fn doctor_looks_for_every_library_that_sumo_takes_from_the_system() {
    let sumo_home = Install::find().unwrap().sumo_home;
    let wheel = sumo_home.parent().unwrap().join("eclipse_sumo.libs");
    let files = |directory: &Path| -> Vec<PathBuf> {
        let entries = std::fs::read_dir(directory).unwrap();
        entries.map(|entry| entry.unwrap().path()).collect()
    };
    let mut brought = files(&sumo_home.join("lib64"));
    brought.extend(files(&wheel));
    let own: BTreeSet<String> = brought.iter().map(|path| file_name(path)).collect();
    let programs = ["netconvert", "netgenerate", "polyconvert"].map(sumo_program);
    let mut needed = BTreeSet::new();
    for file in brought.iter().chain(&programs) {
        let listing = std::process::Command::new("readelf")
            .arg("-d")
            .arg(file)
            .output()
            .unwrap();
        let listing = String::from_utf8_lossy(&listing.stdout).into_owned();
        let names = listing.lines().filter(|line| line.contains("(NEEDED)"));
        needed.extend(names.filter_map(|line| Some(line.split_once('[')?.1.trim_end_matches(']').to_owned())));
    }
    assert!(needed.contains("libc.so.6"), "{needed:?}");
    let workplace = Workplace::new();
    let said = text(&workplace.command(&["doctor"]).output().unwrap());
    for name in &needed {
        let is_known = own.contains(name) || BASE.contains(&name.as_str());
        assert!(
            is_known || said.contains(&format!("library for SUMO: {name}")),
            "{name}\n{said}"
        );
    }
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap().to_string_lossy().into_owned()
}

/// The directory of a run that is being prepared, and the process that prepares it.
fn prepared_directory(workplace: &Workplace) -> (PathBuf, Pid) {
    let files = |directory: &Path| std::fs::read_dir(directory).into_iter().flatten().flatten();
    eventually("a marked directory", || {
        let marks = files(&workplace.path().join("runs")).flat_map(|run| files(&run.path()).collect::<Vec<_>>());
        marks.map(|file| file.path()).find_map(|path| {
            let pid = path.file_name()?.to_str()?.strip_prefix(".preparing-")?.parse().ok()?;
            Some((path.parent()?.to_owned(), Pid::from_raw(pid)?))
        })
    })
}

#[test]
fn a_run_that_is_interrupted_while_it_is_prepared_leaves_nothing() {
    let workplace = Workplace::new();
    for (name, signal) in [("named", Signal::INT), ("ended", Signal::TERM)] {
        let is_interrupted_in_time = |attempt: u32| {
            let name = format!("{name}-{attempt}");
            let mut run = Background::start(&workplace, &small("train", &name, &QUIET));
            let (directory, pid) = prepared_directory(&workplace);
            assert_eq!(pid, Pid::from_child(&run.0));
            run.signal(signal);
            assert_eq!(run.0.wait().unwrap().code(), Some(130));
            // A run that was prepared meanwhile has a report.
            let is_late = directory.join("report.json").exists();
            assert!(is_late || !directory.exists(), "{}", directory.display());
            workplace.assert_nothing_left();
            std::fs::remove_dir_all(workplace.path().join("runs")).unwrap();
            !is_late
        };
        assert!((0..5).any(is_interrupted_in_time), "each run was prepared too fast");
    }
    // One that was killed is made again by its wrapper, also if the user has not named it.
    let unnamed = [&["train", "town", "--restart"][..], &SMALL, &QUIET].concat();
    let mut run = Background::start(&workplace, &unnamed);
    let (directory, pid) = prepared_directory(&workplace);
    kill_process(pid, Signal::KILL).unwrap();
    assert!(run.0.wait().unwrap().success());
    let runs: Vec<_> = std::fs::read_dir(workplace.path().join("runs"))
        .unwrap()
        .flatten()
        .map(|entry| entry.path())
        .collect();
    assert_eq!(runs, [directory]);
    workplace.assert_nothing_left();
}

#[test]
fn a_scenario_of_sumo_is_mirrored_and_sensed() {
    let workplace = Workplace::new();
    let cfg = sumo_program("sumo")
        .parent()
        .unwrap()
        .parent()
        .unwrap()
        .join("tools/game/A10KW.sumocfg");
    let wheel = |directory: &Path| -> BTreeSet<_> {
        std::fs::read_dir(directory)
            .unwrap()
            .flatten()
            .map(|entry| entry.path())
            .collect()
    };
    let game = cfg.parent().unwrap().to_path_buf();
    let before = wheel(&game);
    // The first minute here; the whole 1 800 s are measured by hand (docs/benchmarks.md).
    let mut run = Background::start(
        &workplace,
        &[
            "simulate",
            cfg.to_str().unwrap(),
            "--name",
            "motorway",
            "--set",
            "fanout.enabled=false",
        ],
    );
    eventually("a minute of motorway", || {
        let output = workplace.run(&["ps"]);
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let line = text.lines().find(|line| line.contains("sensor-daemon"))?;
        (line.split_whitespace().nth(4)?.parse::<u64>().ok()? > 600).then_some(())
    });
    run.signal(Signal::INT);
    assert_eq!(run.0.wait().unwrap().code(), Some(130));
    let report: Value = workplace.report("motorway");
    assert!(report["vehicles"].as_u64().unwrap() > 50, "{report:#}");
    assert_eq!(wheel(&game), before, "files were written into the SUMO installation");
    workplace.assert_nothing_left();
}
