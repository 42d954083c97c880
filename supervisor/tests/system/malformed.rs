//! Files damaged at random: each is read or refused with a message that names it, without a panic, and a sample of them by the whole program.

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use crate::common::{Workplace, sumo_program, text, tool};
use caraware::{
    config::LayeredSettings,
    failure::Exit,
    scenario::{self, ScenarioReading},
};
use ipc_schema::{failure::FailureKind, run::RunFile};

/// Longest time that the program may take to refuse a file.
const LIMIT: Duration = Duration::from_mins(1);

/// Random numbers, a function of seed and count.
struct Damage {
    seed: u64,
    count: u64,
}

impl Damage {
    fn new(seed: u64) -> Self {
        Self { seed, count: 0 }
    }

    fn below(&mut self, end: usize) -> usize {
        self.count += 1;
        let mut bits = (self.seed << 32 | self.count).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        bits = (bits ^ bits >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ bits >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        usize::try_from((bits ^ bits >> 31) >> 8).unwrap() % end.max(1)
    }

    /// `original` with one to three faults.
    fn damaged(&mut self, original: &[u8]) -> Vec<u8> {
        const PIECES: [&[u8]; 12] = [
            b"\"",
            b"<",
            b"&",
            b"\0",
            b"\xff",
            b"nan",
            b"-1e999",
            b"99999999999999999999",
            b"]]>",
            b"[",
            b"{",
            b"\n",
        ];
        let mut bytes = original.to_vec();
        for _ in 0..=self.below(3) {
            let at = self.below(bytes.len());
            match self.below(6) {
                0 => bytes.truncate(at),
                1 if !bytes.is_empty() => bytes[at] ^= 1 << self.below(8),
                2 => bytes
                    .splice(at..at, PIECES[self.below(PIECES.len())].iter().copied())
                    .for_each(drop),
                // A line is repeated, or lost.
                3 | 4 => {
                    let mut lines: Vec<&[u8]> = bytes.split_inclusive(|byte| *byte == b'\n').collect();
                    let (line, repeated) = (self.below(lines.len()), self.below(2) == 0);
                    match repeated && !lines.is_empty() {
                        true => lines.insert(line, lines[line]),
                        false => drop((!lines.is_empty()).then(|| lines.remove(line))),
                    }
                    bytes = lines.concat();
                }
                _ => {
                    let end = (at + self.below(40)).min(bytes.len());
                    bytes.drain(at.min(end)..end);
                }
            }
        }
        bytes
    }
}

/// Asserts that a refusal is one of wrong input, and that it names the file.
fn assert_names(exit: &Exit, path: &Path) {
    let (message, help) = exit.summary();
    let name = path.file_name().unwrap().to_string_lossy().into_owned();
    let is_config = match exit {
        Exit::Config(_) => true,
        Exit::Failure(failure) => failure.kind == FailureKind::Config,
        Exit::Interrupted => false,
    };
    assert!(is_config && help.is_some(), "{name}: {message}");
    assert!(
        message.contains(&name) || message.contains('`') || message.contains("a.net.xml"),
        "{name}: {message}"
    );
}

/// Writes `count` damaged copies of `original` as `path`, and gives each to `check`.
fn each_damaged(original: &[u8], path: &Path, count: u64, mut check: impl FnMut()) {
    for seed in 0..count {
        std::fs::write(path, Damage::new(seed).damaged(original)).unwrap();
        let begun = Instant::now();
        check();
        assert!(begun.elapsed() < LIMIT, "seed {seed}");
    }
    std::fs::write(path, original).unwrap();
}

/// A grid with routes, a detector and a `.sumocfg`.
fn scenario_files(directory: &Path) -> [PathBuf; 4] {
    let grid = ["--grid", "--grid.number", "3", "-o", "a.net.xml"];
    tool(&sumo_program("netgenerate"), &grid, directory);
    let write = |name: &str, text: &str| {
        let path = directory.join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    [
        directory.join("a.net.xml"),
        write(
            "a.rou.xml",
            "<routes>\n  <vType id=\"car\" maxSpeed=\"14\"/>\n  <vehicle id=\"v\" type=\"car\" depart=\"0\"><route edges=\"A0A1\"/></vehicle>\n</routes>\n",
        ),
        write(
            "a.add.xml",
            "<additional>\n  <e1Detector id=\"d\" lane=\"A0A1_0\" pos=\"1\" period=\"5\" file=\"out.xml\"/>\n</additional>\n",
        ),
        write(
            "a.sumocfg",
            "<configuration>\n  <input>\n    <net-file value=\"a.net.xml\"/>\n    <route-files value=\"a.rou.xml\"/>\n    \
             <additional-files value=\"a.add.xml\"/>\n  </input>\n  <time>\n    <end value=\"10\"/>\n    <step-length value=\"0.1\"/>\n  </time>\n</configuration>\n",
        ),
    ]
}

#[test]
fn damaged_nets_routes_and_scenarios_are_read_or_refused() {
    let directory = tempfile::tempdir().unwrap();
    let files = scenario_files(directory.path());
    let (mut read, mut refused) = (0, 0);
    for path in &files {
        let original = std::fs::read(path).unwrap();
        each_damaged(&original, path, 75, || {
            let scenario = scenario::read(&files[3], ScenarioReading::Checked);
            match scenario.and_then(|scenario| scenario::map_info(&scenario.net_file, Some((52.0, 10.0)))) {
                Ok(_) => read += 1,
                Err(exit) => {
                    refused += 1;
                    assert_names(&exit, path);
                }
            }
        });
    }
    assert!(read > 20 && refused > 60, "{read} read, {refused} refused");
}

#[test]
fn damaged_configurations_are_read_or_refused() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("my.toml");
    let (mut read, mut refused) = (0, 0);
    for preset in ["town", "paper", "fusion"] {
        let original = std::fs::read(Path::new("../configs").join(preset).with_extension("toml")).unwrap();
        each_damaged(&original, &path, 60, || {
            let settings = LayeredSettings::defaults().unwrap().with_file(&path, None);
            match settings.and_then(|settings| settings.validate()) {
                Ok(_) => read += 1,
                Err(error) => {
                    refused += 1;
                    assert_names(&error.into(), &path);
                }
            }
        });
    }
    assert!(read > 20 && refused > 60, "{read} read, {refused} refused");
}

/// The run file is that of a real run, and each damaged copy is read by a process of a run.
#[test]
fn damaged_run_files_are_read_or_refused() {
    let workplace = Workplace::new();
    let short = [
        "episode.training_episodes=1",
        "episode.ticks=20",
        "fanout.enabled=false",
    ];
    let short: Vec<&str> = short.into_iter().flat_map(|setting| ["--set", setting]).collect();
    workplace.succeed(&[&["simulate", "town", "--name", "a"], &short[..]].concat());
    let original = std::fs::read(workplace.path().join("runs/a/run.json")).unwrap();
    let path = workplace.path().join("run.json");
    let (mut read, mut refused) = (0, 0);
    each_damaged(&original, &path, 200, || match RunFile::read(&path) {
        Ok(_) => read += 1,
        Err(error) => {
            refused += 1;
            assert!(error.to_string().contains("run.json"), "{error}");
        }
    });
    assert!(refused > 80, "{read} read, {refused} refused");
}

/// Damaged copies of each file that the whole program reads in these tests; `make model` sets more.
fn sample() -> u64 {
    std::env::var("CARAWARE_DAMAGED_COPIES").map_or(3, |count| count.parse().unwrap())
}

/// Asserts that the whole program reads the damaged file at `path` or refuses it: by itself, in time, with the exit code `refusal` and a
/// message with advice. It leaves nothing behind.
fn assert_survives(workplace: &Workplace, arguments: &[&str], path: &Path, seed: u64, refusal: &[i32]) {
    let begun = Instant::now();
    let output = workplace.run(arguments);
    let (said, name) = (text(&output), path.display());
    let code = output
        .status
        .code()
        .unwrap_or_else(|| panic!("{name}, seed {seed}: {}: {said}", output.status));
    assert!(
        code == 0 || refusal.contains(&code),
        "{name}, seed {seed}: {code}: {said}"
    );
    assert!(!said.contains("panicked"), "{name}, seed {seed}: {said}");
    assert!(code == 0 || said.contains("help:"), "{name}, seed {seed}: {said}");
    assert!(begun.elapsed() < LIMIT, "{name}, seed {seed}: {said}");
    workplace.assert_nothing_left();
}

/// What the checks let pass goes to SUMO, which may refuse it once the run has begun.
#[test]
fn the_whole_program_survives_damaged_scenarios() {
    let workplace = Workplace::new();
    let files = scenario_files(workplace.path());
    let settings = [
        "map.origin_latitude_deg=52",
        "map.origin_longitude_deg=10",
        "fanout.enabled=false",
    ];
    let settings: Vec<&str> = settings.into_iter().flat_map(|setting| ["--set", setting]).collect();
    let arguments = [&["simulate", "a.sumocfg", "--quiet"], &settings[..]].concat();
    for path in &files {
        let original = std::fs::read(path).unwrap();
        for seed in 1000..1000 + sample() {
            std::fs::write(path, Damage::new(seed).damaged(&original)).unwrap();
            assert_survives(&workplace, &arguments, path, seed, &[1, 2]);
        }
        std::fs::write(path, original).unwrap();
    }
}

/// The files of a run that was stopped: each is what a resumption or a replay begins with.
#[test]
fn the_whole_program_survives_damaged_run_files_checkpoints_and_recordings() {
    let workplace = Workplace::new();
    let settings = [
        "traffic.cavs=3",
        "traffic.others=0",
        "traffic.pedestrians=0",
        "episode.ticks=60",
        "episode.training_episodes=2",
        "episode.evaluation_interval=0",
        "episode.final_evaluations=1",
        "episode.evaluation_ticks=20",
        "trainer.horizon=90",
        "trainer.batch_size=90",
        "trainer.hidden=[8]",
        "trainer.plots=false",
        "trainer.checkpoints_kept=1",
        "record.manner=lossless",
        "fanout.enabled=false",
    ];
    let settings: Vec<&str> = settings.into_iter().flat_map(|setting| ["--set", setting]).collect();
    workplace.succeed(&[&["train", "town", "--name", "whole", "--quiet"], &settings[..]].concat());
    let run = workplace.path().join("runs/whole");
    let newest = std::fs::read_to_string(run.join("checkpoints/latest")).unwrap();
    let checkpoint = run.join("checkpoints").join(newest.trim());
    let checkpoint = std::fs::read_dir(checkpoint)
        .unwrap()
        .flatten()
        .map(|entry| entry.path());
    let resume = &["train", "--resume", "whole", "--name", "next", "--quiet"][..];
    let replay = &["replay", "whole", "--learn", "--name", "next", "--quiet"][..];
    let files = checkpoint
        .chain([run.join("checkpoints/latest"), run.join("run.json")])
        .map(|path| (path, resume))
        .chain([(run.join("recording.mcap"), replay)]);
    let mut refused = 0;
    for (path, arguments) in files {
        let original = std::fs::read(&path).unwrap();
        for seed in 2000..2000 + sample() {
            std::fs::write(&path, Damage::new(seed).damaged(&original)).unwrap();
            assert_survives(&workplace, arguments, &path, seed, &[1, 2]);
            let next = workplace.path().join("runs/next");
            match next.exists() {
                true => std::fs::remove_dir_all(next).unwrap(),
                false => refused += 1,
            }
        }
        std::fs::write(path, original).unwrap();
    }
    assert!(refused > 0, "no damaged file was refused before a run was made");
}
