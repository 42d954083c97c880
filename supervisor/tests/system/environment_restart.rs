//! A killed simulator process: its environment is made again, and the run ends as if nothing had happened.

use std::{
    path::PathBuf,
    process::{Child, Stdio},
    time::Duration,
};

use crate::common::{CURRICULUM, SMALL, Spectator, Workplace, sumo_program, text, tool, until};
use ipc_schema::process::Process;
use rustix::process::{Pid, Signal, kill_process};

const SIMULATORS: [&str; 4] = ["traffic-bridge", "sim-core", "sensor-daemon", "v2x"];

fn arguments<'a>(head: &[&'a str], settings: &[&'a str], more: &[&'a str]) -> Vec<&'a str> {
    let settings = settings.iter().chain(more).flat_map(|setting| ["--set", setting]);
    head.iter().copied().chain(settings).collect()
}

/// Process ids of the simulator processes of a run, whose command lines name its run file.
fn simulators(workplace: &Workplace, name: &str) -> Vec<Pid> {
    let here = workplace.path().join("runs").join(name).to_string_lossy().into_owned();
    let entries = std::fs::read_dir("/proc").unwrap().flatten();
    let pids = entries.filter_map(|entry| {
        let line = std::fs::read(entry.path().join("cmdline")).ok()?;
        let line = String::from_utf8_lossy(&line).into_owned();
        let is_simulator = SIMULATORS
            .iter()
            .any(|process| line.split('\0').next().is_some_and(|p| p.ends_with(process)));
        let pid: i32 = entry.file_name().to_str()?.parse().ok()?;
        (is_simulator && line.contains(&here))
            .then(|| Pid::from_raw(pid))
            .flatten()
    });
    pids.collect()
}

/// Kills a simulator process again and again, at moments that have no order, while the run lives. Returns how many were killed.
fn kill_while(workplace: &Workplace, name: &str, run: &mut Child, most: usize) -> usize {
    let (mut killed, mut random) = (0, 12_345_u64);
    while killed < most {
        random = random
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        std::thread::park_timeout(Duration::from_millis(300 + (random >> 33) % 1_500));
        if run.try_wait().unwrap().is_some() {
            break;
        }
        let pids = simulators(workplace, name);
        if let Some(pid) = pids.get((random >> 40) as usize % pids.len().max(1)) {
            // A process that is asked to end ends by itself, with success.
            let signal = match random >> 50 & 1 {
                0 => Signal::KILL,
                _ => Signal::TERM,
            };
            killed += usize::from(kill_process(*pid, signal).is_ok());
        }
    }
    killed
}

fn killed_run(workplace: &Workplace, arguments: &[&str], name: &str, most: usize) {
    let log = std::fs::File::create(workplace.path().join("said")).unwrap();
    let command = workplace.command(arguments).stdout(Stdio::null()).stderr(log).spawn();
    let mut run = command.unwrap();
    let killed = kill_while(workplace, name, &mut run, most);
    let status = run.wait().unwrap();
    let said = std::fs::read_to_string(workplace.path().join("said")).unwrap();
    assert!(status.success(), "{status}\n{said}");
    assert!(killed >= 2, "only {killed} were killed");
    assert!(said.contains("the simulation is made again from tick"), "{said}");
}

/// Bytes of what was learnt.
fn parameters(workplace: &Workplace, name: &str) -> Vec<u8> {
    let checkpoints: PathBuf = workplace.path().join("runs").join(name).join("checkpoints");
    let newest = std::fs::read_to_string(checkpoints.join("latest")).unwrap();
    let files = ["parameters", "optimiser", "random"].map(|name| format!("{name}.safetensors"));
    let read = |file: &String| std::fs::read(checkpoints.join(newest.trim()).join(file)).unwrap();
    files.iter().flat_map(read).collect()
}

/// What the two runs of the same settings have in common although one was disturbed.
fn assert_same(workplace: &Workplace, names: [&str; 2]) {
    let [whole, killed] = names.map(|name| workplace.report(name));
    for report in [&whole, &killed] {
        assert_eq!(report["result"], "completed");
    }
    assert_eq!(
        (&killed["lost_ticks"], &killed["duplicated_ticks"]),
        (&0.into(), &0.into()),
        "{killed:#}"
    );
    for key in [
        "observation_hash",
        "vehicle_steps",
        "ticks",
        "environments",
        "dynamics",
        "env_steps",
    ] {
        assert_eq!(without_own(&whole[key]), without_own(&killed[key]), "{key}");
    }
    assert_eq!(
        (&killed["lost_ticks"], &killed["duplicated_ticks"]),
        (&0.into(), &0.into())
    );
    workplace.assert_nothing_left();
}

/// What two runs of the same settings need not have in common: watchers may miss other messages, processes have used other times and
/// memory, and what was sent again differs.
const OF_ONE_RUN: [&str; 4] = ["drops", "process", "redelivered_ticks", "journal_mib"];

/// A report without what is of one run alone.
fn without_own(value: &serde_json::Value) -> serde_json::Value {
    match value {
        serde_json::Value::Object(map) => {
            let kept = map.iter().filter(|(key, _)| !OF_ONE_RUN.contains(&key.as_str()));
            kept.map(|(key, value)| (key.clone(), without_own(value))).collect()
        }
        serde_json::Value::Array(values) => values.iter().map(without_own).collect(),
        value => value.clone(),
    }
}

#[test]
fn killed_simulators_of_two_environments_change_nothing_that_is_observed_or_learnt() {
    let workplace = Workplace::new();
    let [two, radios] = ["run.envs=2", "v2x.share=0.7"];
    workplace.succeed(&arguments(
        &["train", "town", "--name", "whole"],
        &SMALL,
        &[two, radios],
    ));
    let paced = "run.real_time_factor=8";
    let disturbed = arguments(&["train", "town", "--name", "killed"], &SMALL, &[two, radios, paced]);
    killed_run(&workplace, &disturbed, "killed", 8);
    assert_same(&workplace, ["whole", "killed"]);
    let [whole, killed] = ["whole", "killed"].map(|name| workplace.report(name)["v2x"]["neighbours_hash"].clone());
    assert!(whole.is_string() && whole == killed, "{whole} {killed}");
    assert_eq!(parameters(&workplace, "whole"), parameters(&workplace, "killed"));
}

/// Before its first commit a run makes everything again: `sensor-daemon` makes some hundred ticks that it does not send.
#[test]
fn a_sensor_daemon_that_is_killed_again_while_it_is_made_again_changes_nothing() {
    let workplace = Workplace::new();
    let late = "trainer.checkpoint_interval=1000";
    workplace.succeed(&arguments(&["train", "town", "--name", "whole"], &SMALL, &[late]));
    let paced = arguments(
        &["train", "town", "--name", "killed"],
        &SMALL,
        &[late, "run.real_time_factor=10"],
    );
    let log = std::fs::File::create(workplace.path().join("said")).unwrap();
    let command = workplace.command(&paced).stdout(Stdio::null()).stderr(log).spawn();
    let mut run = command.unwrap();
    let spectator = Spectator::join(&workplace.path().join("runs/killed/run.json"), &mut run);
    let (sensing, trainer) = (
        spectator.board(Process::SensorDaemon),
        spectator.board(Process::Trainer),
    );
    let kill = || kill_process(Pid::from_raw(sensing.health().pid).unwrap(), Signal::KILL).unwrap();
    until(&mut run, "ticks", || {
        (trainer.progress().consumed_ticks >= 250).then_some(())
    });
    kill();
    let consumed_ticks = trainer.progress().consumed_ticks;
    for incarnation in 1..=3 {
        until(&mut run, "a tick that is made again", || {
            let is_next = sensing.progress().incarnation == incarnation;
            (is_next && sensing.health().ticks > 0).then_some(())
        });
        let ticks = sensing.health().ticks;
        kill();
        assert!(ticks < consumed_ticks, "{ticks} ticks had been made again");
    }
    drop((sensing, trainer, spectator));
    let status = run.wait().unwrap();
    let said = std::fs::read_to_string(workplace.path().join("said")).unwrap();
    assert!(status.success(), "{status}\n{said}");
    assert_eq!(
        said.matches("the simulation is made again from tick 0").count(),
        4,
        "{said}"
    );
    assert_same(&workplace, ["whole", "killed"]);
    assert_eq!(parameters(&workplace, "whole"), parameters(&workplace, "killed"));
}

#[test]
fn a_curriculum_goes_through_the_same_stages_when_its_simulators_are_killed() {
    let workplace = Workplace::new();
    workplace.succeed(&arguments(&["train", "paper", "--name", "whole"], &CURRICULUM, &[]));
    let disturbed = arguments(
        &["train", "paper", "--name", "killed"],
        &CURRICULUM,
        &["run.real_time_factor=60"],
    );
    killed_run(&workplace, &disturbed, "killed", 8);
    assert_same(&workplace, ["whole", "killed"]);
    assert_eq!(parameters(&workplace, "whole"), parameters(&workplace, "killed"));
    let stages = |name: &str| {
        let log = workplace.path().join("runs").join(name).join("curriculum.jsonl");
        std::fs::read_to_string(log).unwrap()
    };
    assert_eq!(stages("whole"), stages("killed"));
}

#[test]
fn a_scenario_without_a_learner_is_sensed_again_from_its_beginning() {
    let workplace = Workplace::new();
    let grid = ["--grid", "--grid.number", "4", "--seed", "3", "-o", "n.net.xml"];
    tool(&sumo_program("netgenerate"), &grid, workplace.path());
    let home = sumo_program("sumo").parent().unwrap().parent().unwrap().to_path_buf();
    let trips = home.join("tools/randomTrips.py");
    let python = caraware::install::Install::find()
        .unwrap_or_else(|exit| panic!("{exit:?}"))
        .python;
    let arguments_of_trips = [
        trips.to_str().unwrap(),
        "-n",
        "n.net.xml",
        "-r",
        "r.rou.xml",
        "-e",
        "60",
        "-p",
        "0.5",
        "--seed",
        "5",
    ];
    let output = std::process::Command::new(python)
        .args(arguments_of_trips)
        .current_dir(workplace.path())
        .env("SUMO_HOME", &home)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", text(&output));
    let input = "<net-file value=\"n.net.xml\"/><route-files value=\"r.rou.xml\"/>";
    let time = "<time><end value=\"60\"/><step-length value=\"1\"/></time>";
    workplace.write(
        "grid.sumocfg",
        &format!("<configuration><input>{input}</input>{time}</configuration>"),
    );
    let settings = [
        "fanout.enabled=false",
        "collision.detect=true",
        "map.origin_latitude_deg=52",
        "map.origin_longitude_deg=10",
    ];
    workplace.succeed(&arguments(
        &["simulate", "grid.sumocfg", "--name", "whole"],
        &settings,
        &[],
    ));
    let disturbed = arguments(
        &["simulate", "grid.sumocfg", "--name", "killed"],
        &settings,
        &["run.real_time_factor=8"],
    );
    killed_run(&workplace, &disturbed, "killed", 4);
    assert_same(&workplace, ["whole", "killed"]);
    let contacts = |name: &str| {
        let log = workplace.path().join("runs").join(name).join("events/collisions.jsonl");
        std::fs::read_to_string(log).unwrap()
    };
    assert_eq!(contacts("whole"), contacts("killed"));
}
