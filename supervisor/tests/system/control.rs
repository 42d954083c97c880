//! Commands to a live run: each takes effect at a tick and is logged, and the log makes the same run again.

use std::{
    io::{BufRead as _, BufReader, Write as _},
    os::unix::net::UnixStream,
    process::{Child, Output, Stdio},
};

use crate::common::{Workplace, text};
use ipc_schema::{
    board::State,
    control::{Command, Refusal, RefusalKind, Reply},
    ports::BoardReader,
    process::Process,
    run::RunFile,
    services::{self, RunNode},
};

/// Two episodes of 300 ticks, six seconds of wall clock at this pace: time for a few commands.
const SMALL: [&str; 11] = [
    "traffic.cavs=6",
    "traffic.others=3",
    "traffic.pedestrians=2",
    "episode.ticks=300",
    "episode.training_episodes=2",
    "episode.evaluation_interval=0",
    "episode.final_evaluations=1",
    "episode.evaluation_ticks=100",
    "fanout.enabled=false",
    "run.window_ticks=3",
    "blackout.policy=nan",
];

fn arguments<'a>(mode: &'a str, name: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let settings = SMALL.iter().flat_map(|setting| ["--set", setting]);
    [mode, "town", "--name", name]
        .into_iter()
        .chain(settings)
        .chain(more.iter().copied())
        .collect()
}

/// A paused run.
struct Run<'a> {
    workplace: &'a Workplace,
    name: &'a str,
    child: Child,
    board: BoardReader,
    file: RunFile,
    _node: RunNode,
}

impl<'a> Run<'a> {
    /// Starts a run at twenty times real time and pauses it as soon as it takes commands.
    fn start(workplace: &'a Workplace, mode: &'a str, name: &'a str, more: &[&'a str]) -> Self {
        let paced = ["--set", "run.real_time_factor=20"];
        let more: Vec<&str> = paced.iter().chain(more).copied().collect();
        let mut child = workplace
            .command(&arguments(mode, name, &more))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let run_file = workplace.path().join("runs").join(name).join("run.json");
        let (node, file, board) = crate::common::until(&mut child, "a board", || {
            let file = RunFile::read(&run_file).ok()?;
            let node = services::node(&file.shared_memory).ok()?;
            let board = BoardReader::open(&node, &file, 0, Process::TrafficBridge).ok()?;
            (board.health().ticks > 0).then_some((node, file, board))
        });
        let run = Self {
            workplace,
            name,
            child,
            board,
            file,
            _node: node,
        };
        run.done(&["pause"]);
        run
    }

    fn ask(&self, command: &[&str]) -> Output {
        let head = ["control", "--run", self.name];
        self.workplace
            .run(&head.iter().chain(command).copied().collect::<Vec<_>>())
    }

    /// The tick at which a command takes effect.
    fn done(&self, command: &[&str]) -> u64 {
        let output = self.ask(command);
        assert!(output.status.success(), "{command:?}: {}", text(&output));
        let text = text(&output);
        let tick = text.split("tick ").nth(1).and_then(|rest| rest.split(':').next());
        tick.and_then(|tick| tick.parse().ok())
            .unwrap_or_else(|| panic!("{text}"))
    }

    fn refused(&self, command: &[&str], reason: &str) {
        let output = self.ask(command);
        assert!(!output.status.success(), "{command:?}: {}", text(&output));
        assert!(text(&output).contains(reason), "{command:?}: {}", text(&output));
    }

    fn ticks(&self) -> u64 {
        self.board.health().ticks
    }

    fn until_ticks(&mut self, ticks: u64) {
        let board = &self.board;
        crate::common::until(&mut self.child, "ticks", || {
            (board.health().ticks >= ticks).then_some(())
        });
    }

    /// Lets the run end, and returns the hash of all its observations.
    fn finish(self) -> String {
        self.done(&["resume"]);
        let Self {
            workplace,
            name,
            child,
            board,
            _node,
            ..
        } = self;
        drop((board, _node));
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success(), "{}", text(&output));
        hash(workplace, name)
    }
}

fn hash(workplace: &Workplace, name: &str) -> String {
    workplace.report(name)["observation_hash"].as_str().unwrap().to_owned()
}

fn log(workplace: &Workplace, name: &str) -> Option<String> {
    std::fs::read_to_string(workplace.path().join("runs").join(name).join("commands.jsonl")).ok()
}

/// A run from a log carries out every logged command at its tick. With another pace and window it makes the same log and the same bytes.
#[test]
fn a_run_with_commands_is_made_again_from_its_log() {
    let workplace = Workplace::new();
    workplace.succeed(&arguments("simulate", "undisturbed", &[]));
    assert_eq!(log(&workplace, "undisturbed"), None);

    let mut run = Run::start(&workplace, "simulate", "steered", &[]);
    let tick = run.ticks();
    run.done(&["step", "40"]);
    run.until_ticks(tick + 40);
    let tick = run.done(&["sensor", "cav.0", "gnss", "off"]);
    assert_eq!(tick, run.ticks(), "the next tick of a paused run");
    run.done(&["sensor", "all", "imu", "off"]);
    run.done(&["destination", "cav.1", "ring_west_2"]);
    run.done(&["step", "20"]);
    run.until_ticks(tick + 20);
    run.done(&["sensor", "cav.2", "imu", "on"]);
    run.done(&["start", "cav.3", "ring_north_1"]);
    run.done(&["start", "other.0", "-ring_east_2"]);
    let reset = run.done(&["reset"]);
    run.done(&["step", "30"]);
    run.until_ticks(reset + 30);
    run.done(&["destination", "other.1", "ring_south_1"]);
    let steered = run.finish();

    assert_ne!(steered, hash(&workplace, "undisturbed"));
    let ticks = workplace.report("steered")["ticks"].as_u64().unwrap();
    assert_eq!(
        ticks,
        reset + 1 + 2 * 300,
        "the reset episode is made again from its beginning"
    );

    let written = log(&workplace, "steered").unwrap();
    assert_eq!(written.lines().count(), 8, "{written}");
    let file = workplace.write("commands.jsonl", &written);
    let actions = ["--commands", file.to_str().unwrap(), "--set", "run.window_ticks=8"];
    workplace.succeed(&arguments("simulate", "again", &actions));
    assert_eq!(hash(&workplace, "again"), steered);
    assert_eq!(log(&workplace, "again").unwrap(), written);

    // The log of another run is refused.
    let other = written.replacen("cav.3", "cav.77", 1);
    let file = workplace.write("other.jsonl", &other);
    let output = workplace.run(&arguments(
        "simulate",
        "astray",
        &["--commands", file.to_str().unwrap()],
    ));
    assert_eq!(output.status.code(), Some(2), "{}", text(&output));
    assert!(text(&output).contains("does not fit this run"), "{}", text(&output));
    workplace.assert_nothing_left();
}

/// Sensors of the surroundings follow commands too, and the log makes the same bytes again.
#[test]
fn ultrasonic_sensors_are_switched_off_and_the_run_is_made_again() {
    let workplace = Workplace::new();
    let settings = [
        "--set",
        "ultrasonic.vehicles=6",
        "--set",
        "observation.fields=ultrasonic",
    ];
    workplace.succeed(&arguments("simulate", "heard", &settings));
    let run = Run::start(&workplace, "simulate", "muted", &settings);
    run.done(&["sensor", "all", "ultrasonic", "off"]);
    let muted = run.finish();
    assert_ne!(muted, hash(&workplace, "heard"));

    let file = workplace.write("commands.jsonl", &log(&workplace, "muted").unwrap());
    let again = [&settings[..], &["--commands", file.to_str().unwrap()]].concat();
    workplace.succeed(&arguments("simulate", "again", &again));
    assert_eq!(hash(&workplace, "again"), muted);
    workplace.assert_nothing_left();
}

/// Simulated time does not depend on the clock: pauses and steps change nothing, and a learner that waits meanwhile loses nothing.
#[test]
fn pauses_and_steps_leave_no_trace() {
    let workplace = Workplace::new();
    let learner = [
        "--set",
        "trainer.horizon=400",
        "--set",
        "trainer.batch_size=200",
        "--set",
        "trainer.hidden=[32, 32]",
    ];
    workplace.succeed(&arguments("train", "undisturbed", &learner));
    let mut run = Run::start(&workplace, "train", "paused", &learner);
    let paused_at = run.ticks();
    for _ in 0..3 {
        let before = run.ticks();
        run.done(&["step", "7"]);
        run.until_ticks(before + 7);
    }
    assert_eq!(run.ticks(), paused_at + 21);
    assert_eq!(run.finish(), hash(&workplace, "undisturbed"));
    assert_eq!(log(&workplace, "paused"), None);
    let (paused, undisturbed) = (workplace.report("paused"), workplace.report("undisturbed"));
    assert_eq!(
        paused["policy_std"], undisturbed["policy_std"],
        "the same policy was learnt"
    );
    assert_eq!(
        (&paused["lost_ticks"], &paused["ticks"]),
        (&undisturbed["lost_ticks"], &undisturbed["ticks"])
    );
    workplace.assert_nothing_left();
}

/// Every wrong request is refused with its reason, and the run continues undisturbed.
#[test]
fn wrong_requests_are_refused_with_their_reasons_and_the_run_continues() {
    let workplace = Workplace::new();
    workplace.succeed(&arguments("simulate", "undisturbed", &[]));
    let run = Run::start(&workplace, "simulate", "pestered", &[]);
    run.refused(&["sensor", "cav.999", "gnss", "off"], "is not on the road now");
    run.refused(&["sensor", "other.0", "gnss", "off"], "carries no sensors");
    run.refused(&["sensor", "all", "lidar", "off"], "carries the sensor `lidar`");
    run.refused(
        &["sensor", "cav.0", "ultrasonic", "off"],
        "carries the sensor `ultrasonic`",
    );
    run.refused(
        &["start", "unknown", "ring_west_2"],
        "is not a vehicle of the population",
    );
    run.refused(&["destination", "cav.0", "no_such_edge"], "is not an edge");
    run.refused(&["step", "0"], "a step has 1 to");
    run.refused(
        &["start", &"x".repeat(500), "ring_west_2"],
        "the id of a vehicle has 1 to 128 bytes",
    );

    let socket = run.file.control_socket();
    let request = |bytes: &[u8]| -> String {
        let mut stream = UnixStream::connect(&socket).unwrap();
        let _ = stream.write_all(bytes);
        let _ = stream.write_all(b"\n");
        let mut line = String::new();
        let _ = BufReader::new(stream).read_line(&mut line);
        line
    };
    for garbage in [&b""[..], b"{}", b"\xff\xfe\x00", b"[[[[[[", &vec![b'x'; 300_000]] {
        assert_eq!(request(garbage), "", "a malformed request gets no answer");
    }
    let refusal = |control: &str| -> Refusal {
        let line = request(
            serde_json::json!({ "control": { "request": control } })
                .to_string()
                .as_bytes(),
        );
        match serde_json::from_str(&line).unwrap() {
            Reply::Refused(refusal) => refusal,
            Reply::Done(done) => panic!("{done:?}"),
        }
    };
    assert_eq!(refusal("no json").kind, RefusalKind::Malformed);
    let pause = Command::Pause {}.to_json().unwrap();
    assert_eq!(
        refusal(&pause.replace("schema_version\":", "schema_version\":9")).kind,
        RefusalKind::Schema
    );
    // A connection without a request delays other requests by at most two seconds.
    let silent = UnixStream::connect(&socket).unwrap();
    run.done(&["pause"]);
    drop(silent);

    assert_eq!(State::from_u32(run.board.health().state), State::Running);
    assert_eq!(run.finish(), hash(&workplace, "undisturbed"));
    assert_eq!(log(&workplace, "pestered"), None);
    workplace.assert_nothing_left();
}
