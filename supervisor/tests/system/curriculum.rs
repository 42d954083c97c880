//! A curriculum whose gates the learner passes: it gives the same bytes for the same seed, with killed trainers, and from its log.

use std::{
    process::Child,
    time::{Duration, Instant},
};

use crate::common::{CURRICULUM, Workplace, lines_of, of_channel};
use ipc_schema::{
    block,
    observation::{ObservationLayout, VALID},
    ports::BoardReader,
    process::Process,
    run::RunFile,
    services::{self, Channel, RunNode},
};
use recorder::file::{reader::RecordingReader, writer::LineTopic};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// Settings in addition to [`CURRICULUM`]: no evaluations in between.
const MORE: [&str; 3] = [
    "episode.evaluation_interval=0",
    "trainer.checkpoint_interval=2",
    "run.window_ticks=16",
];

fn arguments<'a>(mode: &'a str, name: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    [&unnamed(mode, more)[..], &["--name", name]].concat()
}

fn unnamed<'a>(mode: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let settings = CURRICULUM
        .iter()
        .chain(&MORE)
        .chain(more)
        .flat_map(|setting| ["--set", setting]);
    [mode, "paper"].into_iter().chain(settings).collect()
}

fn decisions(workplace: &Workplace, name: &str) -> Vec<[u64; 3]> {
    let text = std::fs::read_to_string(workplace.path().join("runs").join(name).join("curriculum.jsonl")).unwrap();
    let number = |line: &Value, key: &str| line[key].as_u64().unwrap();
    let lines = text.lines().map(|line| serde_json::from_str(line).unwrap());
    lines
        .map(|line: Value| ["stage", "lesson", "tick"].map(|key| number(&line, key)))
        .collect()
}

/// A run under way, and the board of its trainer.
fn trainer_of(workplace: &Workplace, name: &str, child: &mut Child) -> (RunNode, BoardReader) {
    let file = workplace.path().join("runs").join(name).join("run.json");
    loop {
        assert!(child.try_wait().unwrap().is_none(), "the run is over");
        if let Ok(run) = RunFile::read(&file)
            && let Ok(node) = services::node(&run.shared_memory)
            && let Ok(board) = BoardReader::open(&node, &run, 0, Process::Trainer)
        {
            break (node, board);
        }
        std::thread::park_timeout(Duration::from_millis(5));
    }
}

/// Kills the trainer once it has consumed `tick` ticks as incarnation `incarnation`.
fn kill_trainer(board: &BoardReader, incarnation: u32, tick: u64) {
    let deadline = Instant::now() + Duration::from_secs(120);
    loop {
        let progress = board.progress();
        if progress.incarnation == incarnation && progress.attached == 1 && progress.consumed_ticks >= tick {
            return kill_process(Pid::from_raw(board.health().pid).unwrap(), Signal::KILL).unwrap();
        }
        assert!(
            Instant::now() < deadline,
            "trainer {incarnation} never got to tick {tick}"
        );
        std::thread::park_timeout(Duration::from_millis(1));
    }
}

#[test]
fn the_learner_passes_the_gates_and_the_same_seed_gives_the_same_bytes() {
    let workplace = Workplace::new();
    workplace.succeed(&arguments("train", "whole", &[]));
    let report = workplace.report("whole");
    let passed = report["trainer"]["curriculum"]["passed"].as_array().unwrap().clone();
    assert_eq!(passed.len(), 3, "{report:#}");
    for (gate, limit) in passed.iter().zip([0.66, 0.63, 0.6]) {
        assert!(gate["policy_std"].as_f64().unwrap() <= limit, "{gate}");
    }
    let taken = decisions(&workplace, "whole");
    assert_eq!(taken.iter().map(|[stage, ..]| *stage).collect::<Vec<_>>(), [0, 1, 2, 3]);
    // A stage begins with the tick after the one at which the gate before it opened.
    for (gate, [_, lesson, tick]) in passed.iter().zip(&taken[1..]) {
        assert_eq!(gate["tick"].as_u64().unwrap() + 1, *tick);
        assert_eq!(gate["lessons"].as_u64().unwrap(), *lesson);
    }
    let last = taken[3];
    assert_eq!(
        report["ticks"],
        last[2] + 80,
        "nothing but the evaluation follows the last gate"
    );
    // Lessons of one vehicle are 450 and 350 ticks, those of five 100.
    let lessons = |from: usize| taken[from + 1][1] - taken[from][1];
    assert_eq!(last[2], 450 * lessons(0) + 350 * lessons(1) + 100 * lessons(2));

    // Kills before the first checkpoint, in each stage, and while other processes wait for the decision about the last lesson.
    let mut command = workplace.command(&arguments("train", "killed", &["run.window_ticks=5"]));
    let mut child = command.spawn().unwrap();
    let run = trainer_of(&workplace, "killed", &mut child);
    let ticks = [200, taken[1][2] - 1, taken[2][2] + 120, last[2] - 1];
    for (incarnation, tick) in (0..).zip(ticks) {
        kill_trainer(&run.1, incarnation, tick);
    }
    drop(run);
    assert!(child.wait().unwrap().success());
    let killed = workplace.report("killed");
    assert_eq!(killed["observation_hash"], report["observation_hash"]);
    assert_eq!((&killed["lost_ticks"], &killed["restarts"]), (&0.into(), &4.into()));
    assert_eq!(decisions(&workplace, "killed"), taken);
    assert_eq!(killed["trainer"]["curriculum"], report["trainer"]["curriculum"]);

    // The training part is made again without a learner.
    let log = workplace.path().join("runs/whole/curriculum.jsonl");
    let log = format!("curriculum.log={}", log.display());
    workplace.succeed(&arguments("simulate", "again", &[&log]));
    assert_eq!(
        workplace.report("again")["observation_hash"],
        report["observation_hash"]
    );
    workplace.assert_nothing_left();
}

#[test]
fn a_gate_that_is_never_passed_ends_with_the_training_episodes() {
    let workplace = Workplace::new();
    let steps = "curriculum.stages=[{cavs=2,until_lessons=1},{cavs=3,until_std=0.001}]";
    let settings = [steps, "episode.training_episodes=3", "episode.ticks=120"];
    let train = arguments("train", "stuck", &settings);
    workplace.succeed(&[&train[..], &["--record"]].concat());
    let report = workplace.report("stuck");
    let curriculum = &report["trainer"]["curriculum"];
    assert_eq!(
        (&curriculum["lessons"], curriculum["passed"].as_array().unwrap().len()),
        (&3.into(), 1)
    );
    assert_eq!(report["ticks"], 3 * 120 + 80);

    // The recording has the decisions as the run's log has them.
    let run = workplace.path().join("runs/stuck");
    let log = std::fs::read_to_string(run.join("curriculum.jsonl")).unwrap();
    let recording = RecordingReader::open(&run.join("recording.mcap")).unwrap();
    assert_eq!(decisions(&workplace, "stuck").len(), 2, "{log}");
    assert_eq!(
        lines_of(&recording, LineTopic::Curriculum),
        log.lines().collect::<Vec<_>>()
    );
}

/// Stages over the town and a grid of 300 m: in order, at random, and gradually at random.
const MAPS: [&str; 5] = [
    "curriculum.maps=[\"town\",\"city/city.sumocfg\"]",
    "curriculum.stages=[{cavs=2,until_lessons=4,maps=[\"town\",\"city\"]},\
     {cavs=3,until_lessons=6,maps=[\"town\",\"city\"],map_choice=\"random\",noise=2.0},\
     {cavs=2,until_lessons=8,maps=[\"city\",\"town\"],map_choice=\"gradually_random\"}]",
    "episode.ticks=60",
    // The sky view depends on the buildings of each map.
    "gnss.sky_view=true",
    "traffic.others=0",
];

fn with_city() -> Workplace {
    let workplace = Workplace::new();
    let size = ["--vehicles", "20", "--junctions", "4", "--block-m", "300"];
    workplace.succeed(&[&["generate", "city"][..], &size].concat());
    workplace
}

/// Lessons by map that follow from a run's configuration and the stages of its lessons.
fn lessons_by_map(workplace: &Workplace, name: &str, steps: &[usize]) -> [u64; 2] {
    let run = RunFile::read(&workplace.path().join("runs").join(name).join("run.json")).unwrap();
    let mut plan = run.curriculum_plan().unwrap();
    let mut lessons = [0; 2];
    for stage in steps {
        lessons[plan.enter(*stage).unwrap().map] += 1;
    }
    lessons
}

#[test]
fn one_map_alone_is_that_of_the_whole_run() {
    let workplace = with_city();
    let alone = [
        "curriculum.maps=[\"city/city.sumocfg\"]",
        "episode.ticks=40",
        "episode.training_episodes=1",
        "traffic.pedestrians=0",
    ];
    workplace.succeed(&arguments("simulate", "alone", &alone));
    let run = RunFile::read(&workplace.path().join("runs/alone/run.json")).unwrap();
    assert!(
        run.scene_files.net_file.ends_with("city/city.net.xml"),
        "{:?}",
        run.scene_files
    );
    assert!(workplace.report("alone")["vehicle_steps"].as_u64() > Some(100));
}

#[test]
fn lessons_are_on_the_maps_of_their_stages_and_the_same_seed_gives_the_same_bytes() {
    let workplace = with_city();
    workplace.succeed(&arguments("train", "maps", &MAPS));
    let report = workplace.report("maps");
    let maps = &report["traffic"]["maps"];
    let steps: Vec<usize> = [(0, 4), (1, 6), (2, 8)]
        .into_iter()
        .flat_map(|(stage, count)| vec![stage; count])
        .collect();
    let expected = lessons_by_map(&workplace, "maps", &steps);
    assert!(expected.iter().all(|lessons| *lessons > 2), "{expected:?}");
    for (map, (name, lessons)) in ["town", "city"].into_iter().zip(expected).enumerate() {
        let usage = serde_json::json!({"name": name, "lessons": lessons, "ticks": 60 * lessons});
        assert_eq!(maps[map], usage);
    }

    // Kills before the first checkpoint, and at borders between maps.
    let paced = [&MAPS[..], &["run.real_time_factor=30"]].concat();
    let mut child = workplace
        .command(&arguments("train", "killed", &paced))
        .spawn()
        .unwrap();
    let run = trainer_of(&workplace, "killed", &mut child);
    for (incarnation, tick) in (0..).zip([60, 300, 750]) {
        kill_trainer(&run.1, incarnation, tick);
    }
    drop(run);
    assert!(child.wait().unwrap().success());
    let killed = workplace.report("killed");
    assert_eq!(killed["observation_hash"], report["observation_hash"]);
    assert_eq!((&killed["lost_ticks"], &killed["restarts"]), (&0.into(), &3.into()));
    assert_eq!(&killed["traffic"]["maps"], maps);

    let log = workplace.path().join("runs/maps/curriculum.jsonl");
    let log = format!("curriculum.log={}", log.display());
    workplace.succeed(&arguments("simulate", "again", &[&MAPS[..], &[&log]].concat()));
    let again = workplace.report("again");
    assert_eq!(again["observation_hash"], report["observation_hash"]);
    assert_eq!(&again["traffic"]["maps"], maps);
    // Another seed draws other maps.
    workplace.succeed(&arguments("simulate", "other", &[&MAPS[..], &["run.seed=99"]].concat()));
    assert_ne!(lessons_by_map(&workplace, "other", &steps), [0, 18]);
    assert_ne!(
        workplace.report("other")["observation_hash"],
        report["observation_hash"]
    );
    workplace.assert_nothing_left();
}

/// Two environments count their lessons, each on maps of its own.
const DRIVEN: [&str; 14] = [
    "curriculum.maps=[\"town\",\"city/city.sumocfg\"]",
    "curriculum.stages=[{others=0,pedestrians=0,speed_limit_factor=0.5,until_lessons=1},\
     {heroes=6,hero_turns=\"left\",traffic_lights=false,maps=[\"town\",\"city\"],map_choice=\"random\"}]",
    "run.envs=2",
    "traffic.heroes=4",
    "episode.ticks=60",
    "episode.training_episodes=5",
    "episode.evaluation_interval=0",
    "episode.evaluation_ticks=40",
    "trainer.value_updates=2",
    "trainer.horizon=512",
    "trainer.batch_size=256",
    "trainer.matmul_precision=float32",
    "trainer.checkpoint_interval=1",
    "fanout.enabled=false",
];

/// Heroes on a map are judged by its roads, and a death changes nothing.
#[test]
fn heroes_learn_stage_by_stage_in_several_environments() {
    let workplace = with_city();
    let driver = concat!(
        "task.begin_from=",
        env!("CARGO_MANIFEST_DIR"),
        "/../maps/town/driver.safetensors"
    );
    let settings = DRIVEN.iter().chain([&driver]).flat_map(|setting| ["--set", setting]);
    let train = |name| -> Vec<&str> {
        let named = ["train", "driving", "--name", name].into_iter();
        named.chain(settings.clone()).collect()
    };
    workplace.succeed(&train("whole"));
    let report = workplace.report("whole");
    for environment in report["environments"].as_array().unwrap() {
        let heroes = &environment["dynamics"]["heroes"];
        // The first stage and the evaluation have four, each other lesson six. On another map's roads all would be beside them.
        let [episodes, off_road] = ["episodes", "off_road"].map(|name| heroes[name].as_u64().unwrap());
        assert!(episodes >= 4 + 4 * 6 + 4 && 4 * off_road < episodes, "{heroes}");
    }
    assert_eq!(report["ticks"], 2 * (5 * 60 + 40));
    let stages = decisions(&workplace, "whole");
    assert_eq!(stages, [[0, 0, 0], [1, 1, 60]]);
    assert_eq!(decisions(&workplace, "whole/env-1"), stages);
    let maps = &report["traffic"]["maps"];
    let lessons = |map: usize| maps[map]["lessons"].as_u64().unwrap();
    assert_eq!(lessons(0) + lessons(1), 5, "{maps}");
    let of_each = [0, 1].map(|index| lessons_of_environment(&workplace, "whole", index));
    assert_eq!([lessons(0), lessons(1)], of_each[0]);
    assert!(of_each.iter().all(|[town, _]| *town > 0), "{of_each:?}");
    assert!(of_each.iter().any(|[_, city]| *city > 0), "{of_each:?}");

    let mut child = workplace.command(&train("killed")).spawn().unwrap();
    let run = trainer_of(&workplace, "killed", &mut child);
    kill_trainer(&run.1, 0, 130);
    drop(run);
    assert!(child.wait().unwrap().success());
    let killed = workplace.report("killed");
    assert_eq!((&killed["lost_ticks"], &killed["restarts"]), (&0.into(), &1.into()));
    for index in 0..2 {
        let hash = |report: &Value| report["environments"][index]["observation_hash"].clone();
        assert_eq!(hash(&killed), hash(&report), "environment {index}");
    }
    workplace.assert_nothing_left();
}

/// Lessons by map of an environment, by configuration and seed.
fn lessons_of_environment(workplace: &Workplace, name: &str, index: u32) -> [u64; 2] {
    let run = RunFile::read(&workplace.path().join("runs").join(name).join("run.json")).unwrap();
    let mut plan = run.environment(index).curriculum_plan().unwrap();
    let mut lessons = [0; 2];
    for stage in [0, 1, 1, 1, 1] {
        lessons[plan.enter(stage).unwrap().map] += 1;
    }
    lessons
}

/// True if a position is on a street of the generated grid: lines 300 m apart.
fn is_on_the_grid([x_m, y_m]: [f32; 2]) -> bool {
    let off_m = |place_m: f32| (place_m - 300.0 * (place_m / 300.0).round()).abs();
    off_m(x_m).min(off_m(y_m)) < 12.0
}

#[test]
fn vehicles_are_on_the_map_that_their_tick_says() {
    let workplace = with_city();
    let turns = [
        "curriculum.stages=[{cavs=12,maps=[\"town\",\"city\"]}]",
        "episode.training_episodes=30",
    ];
    let settings = [&MAPS[..], &turns].concat();
    let recording = workplace.record("turns", &unnamed("simulate", &settings), &[Channel::Observation]);
    // Rows by map, and how many of them are on the grid.
    let (mut ticks, mut rows) = (0, [[0_u32; 2]; 2]);
    for message in of_channel(&recording, Channel::Observation) {
        ticks += 1;
        let header = &message.header;
        let layout = ObservationLayout::of(header);
        let truth: &[[f32; 4]] = block::view(message.payload(), layout.truth).unwrap();
        let flags: &[u32] = block::view(message.payload(), layout.flags).unwrap();
        for ([x_m, y_m, ..], _) in truth.iter().zip(flags).filter(|(_, flags)| **flags & VALID != 0) {
            rows[usize::from(header.map)][0] += 1;
            rows[usize::from(header.map)][1] += u32::from(is_on_the_grid([*x_m, *y_m]));
            assert!(
                header.map == 1 || *x_m < 260.0 && *y_m < 260.0,
                "{x_m} {y_m} is not in the town"
            );
        }
    }
    assert_eq!(ticks, 30 * 60 + 80, "the lessons and the evaluation");
    let [[town, by_chance], [city, on_grid]] = rows;
    assert!(town > 500 && city > 500, "{rows:?}");
    assert_eq!(city, on_grid);
    assert!(by_chance < town / 2, "{rows:?}");
    workplace.assert_nothing_left();
}
