//! A run whose fan-out and viewers are killed while it continues.

use std::{
    io::{BufRead as _, BufReader},
    path::Path,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use crate::common::{Spectator, Workplace, free_port, until};
use ipc_schema::{board::State, process::Process};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

const KILLS: u64 = 6;

fn settings(fanout: &str) -> Vec<String> {
    let settings = [
        "traffic.cavs=6",
        "traffic.others=3",
        "traffic.pedestrians=3",
        "episode.ticks=600",
        "episode.training_episodes=1",
        fanout,
    ];
    settings
        .iter()
        .flat_map(|setting| ["--set".to_owned(), (*setting).to_owned()])
        .collect()
}

fn simulate(name: &str, settings: &[String]) -> Vec<String> {
    let head = ["simulate", "town", "--name", name].map(str::to_owned);
    [head.as_slice(), settings].concat()
}

/// A viewer of environment `env` that counts.
fn watch(run: &str, env: u32, port: u16, seconds: u64, log: &Path) -> Child {
    let program = caraware::install::programs().unwrap().join("fanout-watch");
    Command::new(program)
        .args([&format!("tcp/127.0.0.1:{port}"), run, "--seconds", &seconds.to_string()])
        .args(["--env", &env.to_string(), "--log"])
        .arg(log)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap()
}

/// A viewer that is killed.
struct Victim(Child);

impl Victim {
    fn kill(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

impl Drop for Victim {
    fn drop(&mut self) {
        self.kill();
    }
}

fn count(mut viewer: Child) -> Value {
    let lines = BufReader::new(viewer.stdout.take().unwrap()).lines();
    let last = lines.map_while(Result::ok).last().unwrap();
    assert!(viewer.wait().unwrap().success());
    serde_json::from_str(&last).unwrap()
}

/// The fan-out is restarted every time and its viewers connect again. The run makes the same bytes as a run without viewers.
#[test]
fn kills_of_fan_out_and_viewer_do_not_change_the_run() {
    let workplace = Workplace::new();
    let alone = simulate("alone", &settings("fanout.enabled=false"));
    workplace.succeed(&alone.iter().map(String::as_str).collect::<Vec<_>>());
    let port = free_port();
    let mut arguments = simulate("watched", &settings(&format!("fanout.listen=tcp/127.0.0.1:{port}")));
    arguments.extend(["--set".into(), "run.real_time_factor=3".into()]);
    let mut command = workplace.command(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    let mut run = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let spectator = Spectator::join(&workplace.path().join("runs/watched/run.json"), &mut run);
    let board = spectator.board(Process::Fanout);
    let works = |incarnation: u64| {
        let there = board.progress().attached == 1 && u64::from(board.progress().incarnation) == incarnation;
        (there && board.health().state == State::Running as u32).then_some(board.health().pid)
    };
    until(&mut run, "a first fan-out", || works(0));
    let logs = ["viewer", "victim"].map(|name| workplace.path().join(name));
    let viewer = watch("watched", 0, port, 15, &logs[0]);
    let mut victim = Victim(watch("watched", 0, port, 60, &logs[1]));
    // Both viewers have received a frame, so frames after a kill reach viewers that were connected before it.
    until(&mut run, "frames", || {
        logs.iter()
            .all(|log| log.metadata().is_ok_and(|log| log.len() > 0))
            .then_some(())
    });
    for kill in 0..KILLS {
        let pid = until(&mut run, "a fan-out", || works(kill));
        let moment = Instant::now();
        while moment.elapsed() < Duration::from_millis(kill * 137 % 400) {
            std::thread::park_timeout(Duration::from_millis(5));
        }
        kill_process(Pid::from_raw(pid).unwrap(), Signal::KILL).unwrap();
        if kill == KILLS / 2 {
            victim.kill();
        }
    }
    until(&mut run, "the last fan-out", || works(KILLS));
    let frames = || std::fs::read_to_string(&logs[0]).unwrap().lines().count();
    let before_the_last = frames();
    let seen = count(viewer);
    assert!(run.wait().unwrap().success());
    // The last fan-out sends ten frames a second: ten more frames cannot all have been under way before.
    assert!(frames() >= before_the_last + 10, "{before_the_last} of {seen:#}");
    assert_eq!(seen["world"]["refused"], 0, "{seen:#}");
    let (alone, watched) = (workplace.report("alone"), workplace.report("watched"));
    assert_eq!(watched["observation_hash"], alone["observation_hash"]);
    assert_eq!(watched["ticks"], alone["ticks"]);
    assert_eq!(watched["restarts"], KILLS);
    workplace.assert_nothing_left();
}

/// One endpoint shows every environment under its own number, and viewers do not change the observations.
#[test]
fn every_environment_of_a_run_is_shown() {
    let workplace = Workplace::new();
    let both = |name: &str, fanout: &str| {
        let mut arguments = simulate(name, &settings(fanout));
        arguments.extend(["--envs".into(), "2".into()]);
        arguments
    };
    let alone = both("alone", "fanout.enabled=false");
    workplace.succeed(&alone.iter().map(String::as_str).collect::<Vec<_>>());
    let port = free_port();
    let mut arguments = both("watched", &format!("fanout.listen=tcp/127.0.0.1:{port}"));
    arguments.extend(["--set".into(), "run.real_time_factor=6".into()]);
    let mut command = workplace.command(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    let mut run = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let spectator = Spectator::join(&workplace.path().join("runs/watched/run.json"), &mut run);
    let board = spectator.board(Process::Fanout);
    until(&mut run, "a trainer", || (board.progress().attached == 1).then_some(()));
    let viewers = [0, 1].map(|env| {
        let log = workplace.path().join(format!("viewer-{env}"));
        watch("watched", env, port, 8, &log)
    });
    let seen = viewers.map(count);
    assert!(run.wait().unwrap().success());
    for seen in &seen {
        for topic in ["status", "vehicles", "world", "observation"] {
            assert!(seen[topic]["received"].as_u64().unwrap() > 3, "{topic}: {seen:#}");
            assert_eq!(seen[topic]["refused"], 0, "{topic}: {seen:#}");
        }
    }
    let (alone, watched) = (workplace.report("alone"), workplace.report("watched"));
    for env in [0, 1] {
        let hash = |report: &Value| report["environments"][env]["observation_hash"].clone();
        assert!(hash(&alone).is_string());
        assert_eq!(hash(&watched), hash(&alone));
    }
    workplace.assert_nothing_left();
}
