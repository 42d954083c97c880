//! A process that hangs is named, and replaced if the configuration says so; one that waits in order is not.

use std::{
    path::Path,
    process::{Child, Stdio},
    sync::OnceLock,
    time::{Duration, Instant},
};

use crate::common::{Spectator, Workplace, free_port, text, until};
use ipc_schema::process::Process;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// Six vehicles, 1 000 ticks with an evaluation in the middle, a checkpoint for every update. Small networks, and no estimates that only
/// viewers see.
const SMALL: [&str; 16] = [
    "traffic.cavs=6",
    "traffic.others=3",
    "traffic.pedestrians=3",
    "episode.ticks=150",
    "episode.training_episodes=6",
    "episode.evaluation_interval=3",
    "episode.evaluation_ticks=50",
    "episode.final_evaluations=1",
    "trainer.horizon=300",
    "trainer.plots=false",
    "trainer.batch_size=150",
    "trainer.hidden=[32, 32]",
    "trainer.estimates=never",
    "trainer.checkpoint_interval=1",
    "trainer.matmul_precision=float32",
    "fanout.enabled=false",
];
/// A pace that leaves time to stop processes: 10 s for the run.
const PACED: &str = "run.real_time_factor=10";

fn arguments<'a>(name: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let settings = SMALL.iter().chain(more).flat_map(|setting| ["--set", setting]);
    ["train", "town", "--name", name].into_iter().chain(settings).collect()
}

/// A run in the background.
struct Run {
    child: Child,
    said: std::path::PathBuf,
    run_dir: std::path::PathBuf,
    boards: Spectator,
}

impl Run {
    fn start(workplace: &Workplace, name: &str, more: &[&str]) -> Self {
        let said = workplace.path().join("said");
        let log = std::fs::File::create(&said).unwrap();
        let mut command = workplace.command(&arguments(name, more));
        let mut child = command.stdout(Stdio::null()).stderr(log).spawn().unwrap();
        let run_dir = workplace.path().join("runs").join(name);
        let boards = Spectator::join(&run_dir.join("run.json"), &mut child);
        Self {
            child,
            said,
            run_dir,
            boards,
        }
    }

    fn until_said(&mut self, words: &str) {
        let said = self.said.clone();
        until(&mut self.child, words, || {
            std::fs::read_to_string(&said).unwrap().contains(words).then_some(())
        });
    }

    /// Waits until the trainer has consumed `more` ticks.
    fn until_consumed(&mut self, more: u64) {
        let board = self.boards.board(Process::Trainer);
        let consumed = || Some(board.progress()).filter(|progress| progress.attached == 1);
        let first = until(&mut self.child, "a trainer", consumed).consumed_ticks;
        until(&mut self.child, "ticks", || {
            consumed()
                .filter(|progress| progress.consumed_ticks >= first + more)
                .map(drop)
        });
    }

    fn pid_of(&self, process: Process) -> Option<Pid> {
        pid_in(&self.run_dir, process)
    }

    fn end(mut self) -> String {
        drop(self.boards);
        let status = self.child.wait().unwrap();
        let said = std::fs::read_to_string(&self.said).unwrap();
        assert!(status.success(), "{status}\n{said}");
        said
    }
}

/// The process of the run in `run_dir`, by its command line.
fn pid_in(run_dir: &Path, process: Process) -> Option<Pid> {
    let run_file = run_dir.join("run.json").to_string_lossy().into_owned();
    let mut entries = std::fs::read_dir("/proc").unwrap().flatten();
    entries.find_map(|entry| {
        let line = std::fs::read(entry.path().join("cmdline")).ok()?;
        let line = String::from_utf8_lossy(&line).into_owned();
        let program = match process {
            Process::Trainer => line.contains("\0caraware.train\0"),
            process => Path::new(line.split('\0').next()?).ends_with(process.name()),
        };
        let pid: i32 = entry.file_name().to_str()?.parse().ok()?;
        (program && line.contains(&run_file))
            .then(|| Pid::from_raw(pid))
            .flatten()
    })
}

/// Bytes of what was learnt.
fn parameters(workplace: &Workplace, name: &str) -> Vec<u8> {
    let checkpoints = workplace.path().join("runs").join(name).join("checkpoints");
    let newest = std::fs::read_to_string(checkpoints.join("latest")).unwrap();
    let files = ["parameters", "optimiser", "random"].map(|name| format!("{name}.safetensors"));
    let read = |file: &String| std::fs::read(checkpoints.join(newest.trim()).join(file)).unwrap();
    files.iter().flat_map(read).collect()
}

/// Report and parameters of the undisturbed run, which is made once.
fn whole(workplace: &Workplace) -> &'static (Value, Vec<u8>) {
    static WHOLE: OnceLock<(Value, Vec<u8>)> = OnceLock::new();
    WHOLE.get_or_init(|| {
        workplace.succeed(&arguments("whole", &[]));
        (workplace.report("whole"), parameters(workplace, "whole"))
    })
}

/// Asserts that the run `stopped` ended as the undisturbed one.
fn assert_same(workplace: &Workplace, restarts: u64) {
    let (whole, learnt) = whole(workplace);
    let disturbed = workplace.report("stopped");
    for key in ["result", "observation_hash", "vehicle_steps", "ticks", "env_steps"] {
        assert_eq!(whole[key], disturbed[key], "{key}");
    }
    for (key, expected) in [("lost_ticks", 0), ("duplicated_ticks", 0), ("restarts", restarts)] {
        assert_eq!(disturbed[key], Value::from(expected), "{key}");
    }
    assert_eq!(parameters(workplace, "stopped"), *learnt);
    workplace.assert_nothing_left();
}

/// Stops each of `processes` in a run with these settings, and asserts that it is named and replaced, and that the run ends as the
/// undisturbed one.
fn assert_replaced(settings: &[&str], processes: &[Process]) {
    let workplace = Workplace::new();
    let replace = ["run.stall_s=5", "run.on_stall=replace"];
    let mut run = Run::start(&workplace, "stopped", &[&replace, settings].concat());
    for process in processes {
        run.until_consumed(100);
        let pid = run.pid_of(*process).unwrap();
        kill_process(pid, Signal::STOP).unwrap();
        run.until_said(&format!(
            "{process} has made no progress for 5 s: a signal or a debugger has stopped it"
        ));
        let gone = format!("/proc/{}", pid.as_raw_nonzero());
        until(&mut run.child, "its end", || (!Path::new(&gone).exists()).then_some(()));
    }
    for process in processes {
        let log = std::fs::read_to_string(run.run_dir.join(format!("logs/{process}.log"))).unwrap();
        let note = format!("caraware: {process} has made no progress for 5 s");
        assert!(log.contains(&note), "{log}");
    }
    let said = run.end();
    // The other processes wait meanwhile, and are not named.
    let named = said.lines().filter(|line| line.contains("; it is killed")).count();
    assert_eq!(named, processes.len(), "{said}");
    assert_same(&workplace, processes.len() as u64);
}

#[test]
fn each_process_that_is_stopped_is_named_and_replaced_and_nothing_changes() {
    let processes = [
        Process::TrafficBridge,
        Process::SimCore,
        Process::SensorDaemon,
        Process::Trainer,
    ];
    assert_replaced(&[PACED], &processes);
}

/// While the fan-out or a recorder that watches is stopped, the run continues: its pace leaves time for both.
#[test]
fn a_stopped_fan_out_recorder_or_v2x_is_named_and_replaced_and_nothing_changes() {
    let listen = format!("fanout.listen=tcp/127.0.0.1:{}", free_port());
    let settings = [
        "run.real_time_factor=5",
        "v2x.share=1.0",
        "record.manner=watching",
        "fanout.enabled=true",
        &listen,
    ];
    let processes = [Process::Fanout, Process::Recorder, Process::V2x];
    assert_replaced(&settings, &processes);
}

/// What is made again is shown as such, and the learner's process stays.
#[test]
fn ticks_that_are_made_again_are_named_in_the_progress_and_the_learner_stays() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "stopped", &[PACED]);
    run.until_consumed(300);
    let [trainer, core, traffic] =
        [Process::Trainer, Process::SimCore, Process::TrafficBridge].map(|process| run.pid_of(process).unwrap());
    kill_process(core, Signal::KILL).unwrap();
    let run_dir = run.run_dir.clone();
    let next = until(&mut run.child, "another traffic-bridge", || {
        let next = pid_in(&run_dir, Process::TrafficBridge)?;
        (next != traffic).then_some(next)
    });
    // It loads its net for longer than this takes: no tick has been made again.
    kill_process(next, Signal::STOP).unwrap();
    run.until_said("[making ticks again]");
    kill_process(next, Signal::CONT).unwrap();
    assert_eq!(run.pid_of(Process::Trainer), Some(trainer));
    let said = run.end();
    assert!(said.contains("the simulation is made again from tick"), "{said}");
    assert_same(&workplace, 1);
}

/// Asks for a handover in the background, and waits until its successor is being started.
fn ask_for_handover(workplace: &Workplace, run: &mut Run) -> Child {
    let mut command = workplace.command(&["handover", "stopped"]);
    let client = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let successor = run.run_dir.join("run.next.json");
    until(&mut run.child, "a successor", || successor.exists().then_some(()));
    client
}

/// A handover excuses no trainer: one that hangs is killed, and its successor continues.
#[test]
fn a_successor_takes_over_from_a_trainer_that_hangs() {
    let workplace = Workplace::new();
    let settings = ["run.stall_s=5", "run.on_stall=replace", PACED];
    let mut run = Run::start(&workplace, "stopped", &settings);
    run.until_consumed(100);
    let client = ask_for_handover(&workplace, &mut run);
    kill_process(run.pid_of(Process::Trainer).unwrap(), Signal::STOP).unwrap();
    run.until_said("trainer has made no progress for 5 s");
    let output = client.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    run.end();
    assert_same(&workplace, 0);
    assert_eq!(
        workplace.report("stopped")["handovers"].as_array().map(Vec::len),
        Some(1)
    );
}

/// Where a trainer that hangs is only reported, the handover ends with the reason.
#[test]
fn a_handover_from_a_trainer_that_hangs_is_refused_with_the_reason() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "stopped", &["run.stall_s=5", PACED]);
    run.until_consumed(100);
    let client = ask_for_handover(&workplace, &mut run);
    let trainer = run.pid_of(Process::Trainer).unwrap();
    kill_process(trainer, Signal::STOP).unwrap();
    let output = client.wait_with_output().unwrap();
    let said = text(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("the old trainer has made no progress for"), "{said}");
    assert!(said.contains("run.on_stall"), "{said}");
    kill_process(trainer, Signal::CONT).unwrap();
    run.end();
    // It has been asked to leave, and does so once it can: a trainer with the same settings takes its place.
    assert_same(&workplace, 1);
}

#[test]
fn a_stall_is_reported_and_a_pause_or_a_stopped_supervisor_is_none() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "stopped", &["run.stall_s=4", PACED]);
    run.until_consumed(100);
    // A stopped process is named by `ps`, beside those that wait for it, until it continues.
    let core = run.pid_of(Process::SimCore).unwrap();
    kill_process(core, Signal::STOP).unwrap();
    run.until_said("sim-core has made no progress for 4 s");
    // The others note every look, and what they look for; between two looks they show nothing for a moment.
    until(&mut run.child, "a table of what waits for what", || {
        let table = text(&workplace.succeed(&["ps", "stopped"]));
        let row = |process: &str| {
            table
                .lines()
                .find(|line| line.split_whitespace().nth(1) == Some(process))
                .unwrap()
                .trim()
                .to_owned()
        };
        let [core, sensing, trainer] = ["sim-core", "sensor-daemon", "trainer"].map(row);
        assert!(core.contains(" stalled "), "{table}");
        assert!(!sensing.contains("stalled") && !trainer.contains("stalled"), "{table}");
        (sensing.ends_with(" sim-core") && trainer.ends_with(" sensor-daemon")).then_some(())
    });
    kill_process(core, Signal::CONT).unwrap();
    run.until_said("sim-core continues");

    // In a pause every process waits in order.
    workplace.succeed(&["control", "pause"]);
    wait_beyond_the_limit();
    workplace.succeed(&["control", "resume"]);
    run.until_consumed(100);

    // While the supervisor is stopped, too, no time counts.
    let supervisor = Pid::from_child(&run.child);
    for pid in [core, supervisor] {
        kill_process(pid, Signal::STOP).unwrap();
    }
    wait_beyond_the_limit();
    for pid in [supervisor, core] {
        kill_process(pid, Signal::CONT).unwrap();
    }
    let said = run.end();
    assert_eq!(
        said.matches(": a signal or a debugger has stopped it").count(),
        1,
        "{said}"
    );
    assert!(!said.contains("it is killed"), "{said}");
    assert_same(&workplace, 0);
}

/// The start has a deadline: a process that is not ready in time is named and killed, and the run ends with a report.
#[test]
fn a_process_that_is_not_ready_in_time_ends_the_run() {
    let workplace = Workplace::new();
    let module = "import time\n\ntime.sleep(1e6)\n";
    std::fs::write(workplace.path().join("sleeper.py"), module).unwrap();
    let python = std::env::var("PYTHONPATH").unwrap_or_default();
    let mut command = workplace.command(&arguments("late", &["trainer.module=sleeper", "run.ready_s=15"]));
    command.env("PYTHONPATH", format!("{}:{python}", workplace.path().display()));
    let output = command.output().unwrap();
    let said = text(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("trainer was not ready within 15 s"), "{said}");
    assert!(
        said.contains("logs/trainer.log") && said.contains("run.ready_s"),
        "{said}"
    );
    let report = workplace.report("late");
    assert_eq!(report["result"], "failed", "{report:#}");
    assert!(report["failure"].to_string().contains("not ready"), "{report:#}");
    workplace.assert_nothing_left();
}

/// The shutdown has a deadline: a process that does not end when it is asked to is named and killed.
#[test]
fn a_process_that_does_not_end_in_time_is_named_and_killed() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "held", &[PACED]);
    run.until_consumed(50);
    let trainer = run.pid_of(Process::Trainer).unwrap();
    kill_process(trainer, Signal::STOP).unwrap();
    kill_process(Pid::from_child(&run.child), Signal::TERM).unwrap();
    run.until_said("trainer has not ended within 30 s: it is killed");
    drop(run.boards);
    assert_eq!(run.child.wait().unwrap().code(), Some(130));
    assert_eq!(workplace.report("held")["result"], "interrupted");
    workplace.assert_nothing_left();
}

/// Lets more time pass than a stall takes: what must not happen has then had its time.
fn wait_beyond_the_limit() {
    let end = Instant::now() + Duration::from_secs(6);
    while Instant::now() < end {
        std::thread::park_timeout(end - Instant::now());
    }
}
