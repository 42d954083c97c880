use super::*;
use ipc_schema::{config::HeroTurns, sensor::SensorKind};

fn config_of(text: &str) -> Result<Config, ConfigError> {
    layer::parse("my.toml", text).and_then(|layer| {
        let mut settings = LayeredSettings::defaults()?;
        settings.0.extend(layer);
        settings.validate()
    })
}

fn error_of(text: &str) -> (String, String) {
    let error = config_of(text).unwrap_err();
    let help = miette::Diagnostic::help(&error)
        .map(|help| help.to_string())
        .unwrap_or_default();
    (error.to_string(), help)
}

/// A line of 100 000 letters is not printed: what is around the part that is wrong says as much.
#[test]
fn the_error_in_a_long_line_shows_what_is_around_its_part() {
    let long = "é".repeat(50_000);
    for (text, part) in [
        (
            format!("curriculum.log = \"{long}\"\ntraffic.cavs = -1\n"),
            "traffic.cavs = -1",
        ),
        (format!("map.place = {{ a = \"{long}\", b = 1 }}\n"), "map.place"),
        (
            format!("fanout = {{ users = \"{long}\", world_hz = -1 }}\n"),
            "world_hz = -1",
        ),
        (format!("traffic.cavs = \"{long}\"\n"), "traffic.cavs"),
    ] {
        let error = config_of(&text).unwrap_err();
        let mut shown = String::new();
        let handler = miette::GraphicalReportHandler::new_themed(miette::GraphicalTheme::unicode_nocolor());
        handler.with_width(100).render_report(&mut shown, &error).unwrap();
        assert!(shown.contains(part), "{shown}");
        assert!(shown.len() < 3000, "{} bytes for {part}", shown.len());
    }
}

#[test]
fn the_default_preset_is_valid_and_complete() {
    let config = LayeredSettings::defaults().unwrap().validate().unwrap();
    assert_eq!(config.observation.fields.len(), 9);
    let missing: Vec<_> = keys::KEYS
        .iter()
        .filter(|key| !key.optional && LayeredSettings::defaults().unwrap().setting(key.path).is_none())
        .collect();
    assert!(missing.is_empty(), "{missing:?}");
}

#[test]
fn every_preset_is_valid() {
    for (name, _) in PRESETS {
        LayeredSettings::defaults()
            .unwrap()
            .with_preset(name)
            .unwrap()
            .unwrap()
            .validate()
            .unwrap();
    }
}

#[test]
fn the_resolved_configuration_can_be_given_back() {
    let config = LayeredSettings::defaults().unwrap().validate().unwrap();
    let layer = layer::parse("again", &to_toml(&config).unwrap()).unwrap();
    assert_eq!(LayeredSettings(layer).validate().unwrap(), config);
}

#[test]
fn an_unknown_key_is_refused_with_file_line_and_the_nearest_key() {
    let (message, help) = error_of("[run]\nseed = 3\n\n[gnss]\nnoise_deg = 1e-5\n");
    assert_eq!(message, "my.toml:5: unknown key `gnss.noise_deg`");
    assert_eq!(help, "did you mean `gnss.noise_std_deg`? All keys: configs/README.md");
}

/// A file that begins from a preset.
fn file_of(text: &str, preset: Option<&str>) -> Result<Config, ConfigError> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("my.toml");
    std::fs::write(&path, text).unwrap();
    LayeredSettings::defaults()?.with_file(&path, preset)?.validate()
}

#[test]
fn a_file_begins_from_the_preset_that_it_names() {
    let driving = LayeredSettings::defaults().unwrap().with_named_preset("driving");
    let mut expected = driving.unwrap().validate().unwrap();
    assert_eq!(file_of("preset = \"driving\"\n", None).unwrap(), expected);
    // The option has precedence, and the file's own settings before both.
    expected.traffic.heroes = 4;
    for (text, preset) in [
        ("preset = 'driving'\n[traffic]\nheroes = 4\n", None),
        ("preset = \"lap\"\n[traffic]\nheroes = 4\n", Some("driving")),
        ("traffic.heroes = 4\n", Some("driving")),
    ] {
        assert_eq!(file_of(text, preset).unwrap(), expected, "{text}");
    }
    assert_eq!(
        file_of("", None).unwrap(),
        LayeredSettings::defaults().unwrap().validate().unwrap()
    );
}

#[test]
fn a_preset_that_is_none_is_refused_with_its_line_and_the_names_of_all() {
    let refusal = |error: &ConfigError| (error.to_string(), miette::Diagnostic::help(error).unwrap().to_string());
    for value in ["\"drivign\"", "3"] {
        let (message, help) = refusal(&file_of(&format!("# mine\npreset = {value}\n"), None).unwrap_err());
        assert!(
            message.ends_with(&format!("my.toml:2: there is no preset {value}")),
            "{message}"
        );
        assert!(help.starts_with("presets: town, paper, driving"), "{help}");
    }
    let (message, help) = refusal(&file_of("", Some("drivign")).unwrap_err());
    assert_eq!(message, "--preset drivign: there is no such preset");
    assert!(help.starts_with("presets: town, paper, driving"), "{help}");
    // Below a section the key is that section's, and `--set` is no file.
    let (message, help) = refusal(&file_of("[traffic]\ncavs = 4\npreset = \"driving\"\n", None).unwrap_err());
    assert!(
        message.ends_with("my.toml:3: unknown key `traffic.preset`"),
        "{message}"
    );
    assert!(help.contains("above the first section"), "{help}");
    let (_, help) = refusal(&layer::parse_assignment("preset=driving").unwrap_err());
    assert!(help.contains("--preset NAME"), "{help}");
}

#[test]
fn a_renamed_key_is_refused_with_its_new_name() {
    let (message, help) = error_of("[[curriculum.steps]]\ncavs = 1\n");
    assert_eq!(
        message,
        "my.toml:1: `curriculum.steps` is renamed to `curriculum.stages`"
    );
    assert!(help.starts_with("write `curriculum.stages`"), "{help}");
}

#[test]
fn a_replaced_key_suggests_the_new_one() {
    let (_, help) = error_of("imu.gravity_mps2 = 9.81\n");
    assert_eq!(help, "did you mean `imu.convention`? All keys: configs/README.md");
}

#[test]
fn an_unknown_table_is_an_unknown_key() {
    let (message, _) = error_of("[odometer]\nchannels = 3\n");
    assert_eq!(message, "my.toml:1: unknown key `odometer`");
}

#[test]
fn a_value_out_of_range_names_range_and_unit() {
    let (message, help) = error_of("[gnss]\nnoise_std_deg = -1\n");
    assert_eq!(message, "my.toml:2: `gnss.noise_std_deg` cannot be -1");
    assert!(help.starts_with("allowed: 2 × 0 … 1, or one for all in deg."), "{help}");
}

#[test]
fn text_where_a_number_belongs_and_not_a_number_are_refused() {
    assert_eq!(
        error_of("run.tick_s = \"0.1s\"\n").0,
        "my.toml:1: `run.tick_s` cannot be \"0.1s\""
    );
    assert_eq!(
        error_of("run.tick_s = nan\n").0,
        "my.toml:1: `run.tick_s` cannot be nan"
    );
    assert_eq!(
        error_of("run.tick_s = inf\n").0,
        "my.toml:1: `run.tick_s` cannot be inf"
    );
}

#[test]
fn rates_that_do_not_divide_name_both_numbers() {
    let (message, help) = error_of("[gnss]\nperiod_s = 0.25\n");
    assert_eq!(
        message,
        "my.toml:2: `gnss.period_s` = 0.25 s is not a whole number of ticks of `run.tick_s` = 0.1 s"
    );
    assert_eq!(help, "choose a multiple of 0.1 s, or another `run.tick_s`");
}

#[test]
fn a_fast_imu_divides_the_tick_and_takes_whole_sub_steps() {
    for period_s in ["0.25", "0.03", "0.04", "0.005"] {
        let (message, help) = error_of(&format!("imu.period_s = {period_s}\n"));
        assert!(
            message.starts_with(&format!("my.toml:1: `imu.period_s` = {period_s} s is neither")),
            "{message}"
        );
        assert!(help.starts_with("choose 0.1 s"), "{help}");
    }
    for period_s in ["0.01", "0.02", "0.05", "0.1", "0.3"] {
        assert!(config_of(&format!("imu.period_s = {period_s}\n")).is_ok(), "{period_s}");
    }
}

#[test]
fn one_number_stands_for_all_axes_and_a_list_must_be_whole() {
    let axes = |text: &str| config_of(text).unwrap().gnss.noise_std_m;
    assert_eq!(axes("gnss.noise_std_m = 2\n"), [2.0; 3]);
    assert_eq!(axes("gnss.noise_std_m = [1, 2.5, 3]\n"), [1.0, 2.5, 3.0]);
    for text in [
        "gnss.noise_std_m = [1, 2]",
        "gnss.noise_std_m = [1, 2, -3]",
        "gnss.noise_std_m = []",
    ] {
        assert_eq!(
            error_of(text).1,
            "allowed: 3 × 0 … 10000, or one for all in m. Standard deviation east, north and up, in addition to `gnss.noise_std_deg`."
        );
    }
    for text in [
        "gnss.blackout_gap_s = [10, 5]",
        "gnss.blackout_gap_s = [-1, 5]",
        "imu.blackout_length_s = [1]",
    ] {
        assert!(
            error_of(text)
                .1
                .starts_with("allowed: [shortest, longest] in 0 … 1000000 in s.")
        );
    }
}

#[test]
fn an_impossible_lidar_is_refused_with_key_value_and_range() {
    for (text, message, help) in [
        (
            "lidar.points_per_second = 1000000000",
            "`lidar.points_per_second` cannot be 1000000000",
            "allowed: 1 … 20000000 in 1/s",
        ),
        (
            "lidar.range_noise_std_m = -0.1",
            "`lidar.range_noise_std_m` cannot be -0.1",
            "allowed: 0 … 100 in m",
        ),
        (
            "lidar.horizontal_fov_deg = 0",
            "`lidar.horizontal_fov_deg` cannot be 0",
            "allowed: 0.1 … 360 in deg",
        ),
        (
            "lidar.upper_fov_deg = -40",
            "`lidar.upper_fov_deg` = -40 is not above `lidar.lower_fov_deg` = -30",
            "give the highest",
        ),
        (
            "lidar.rotation_hz = 7",
            "`lidar.rotation_hz` = 7: a rotation must be",
            "choose a multiple or a whole part of 10 Hz",
        ),
        (
            "lidar.points_per_second = 100000",
            "makes 312.500 firings of 32 channels in a tick of 0.1 s",
            "choose a multiple of 320 such as 100160",
        ),
        (
            "lidar.pattern = \"vlp17\"",
            "`lidar.pattern` cannot be \"vlp17\"",
            "allowed: \"uniform\", \"vlp16\"",
        ),
        (
            "lidar.pattern = \"table\"",
            "\"table\" needs `lidar.ray_table`",
            "name a CSV file",
        ),
        (
            "lidar.min_range_m = 100",
            "leaves nothing below `lidar.range_m` = 100",
            "lower the one",
        ),
    ] {
        let (said, helped) = error_of(&format!("lidar.vehicles = 1\n{text}\n"));
        assert!(said.starts_with("my.toml:2: ") && said.contains(message), "{said}");
        assert!(helped.starts_with(help), "{helped}");
    }
    assert!(
        error_of("observation.fields = [\"object_1_x\"]\n")
            .0
            .contains("the sensor `lidar` measures")
    );
}

#[test]
fn a_batch_larger_than_the_horizon_is_refused() {
    assert!(
        error_of("trainer.horizon = 100\n")
            .0
            .contains("`trainer.batch_size` = 1024 is more than `trainer.horizon` = 100")
    );
}

#[test]
fn networks_and_activations_are_known_by_name() {
    for unknown in ["lstm", ":Wide", "networks:", "my networks:Wide", "networks:Wide:er"] {
        let (_, help) = error_of(&format!("trainer.network = \"{unknown}\"\n"));
        assert!(
            help.contains("\"mlp\", \"gru\", \"cnn\", \"package.module:Class\""),
            "{unknown}: {help}"
        );
    }
    assert!(layer::parse_assignment("trainer.network=my.networks:Wide").is_ok());
    assert!(
        error_of("trainer.activation = \"gelu\"\n")
            .1
            .contains("\"relu\", \"tanh\"")
    );
}

#[test]
fn a_word_on_the_command_line_is_a_word() {
    for assignment in ["blackout.policy=nan", "blackout.policy=\"nan\"", "trainer.module=nan"] {
        assert!(layer::parse_assignment(assignment).is_ok(), "{assignment}");
    }
    assert!(layer::parse_assignment("gnss.period_s=nan").is_err());
}

#[test]
fn assignments_take_numbers_words_and_lists() {
    let settings = LayeredSettings::defaults()
        .unwrap()
        .with_assignments(&[
            "run.seed=7".into(),
            "trainer.reward=exponential".into(),
            "trainer.hidden=[64, 64]".into(),
            "observation.fields=caraware".into(),
        ])
        .unwrap();
    let config = settings.validate().unwrap();
    assert_eq!(
        (
            config.run.seed,
            config.trainer.hidden.as_slice(),
            config.observation.fields.len()
        ),
        (7, [64, 64].as_slice(), 11)
    );
    assert_eq!(
        layer::parse_assignment("run.seed").unwrap_err().to_string(),
        "--set run.seed: not of the form key=value"
    );
    assert_eq!(
        layer::parse_assignment("run.sead=1").unwrap_err().to_string(),
        "--set:1: unknown key `run.sead`"
    );
}

/// `CARAWARE_BLESS=1 cargo test -p caraware` rewrites the reference after a deliberate change.
#[test]
fn the_reference_of_keys_is_true() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/README.md");
    let expected = reference::markdown();
    if std::env::var_os("CARAWARE_BLESS").is_some() {
        std::fs::write(path, &expected).unwrap();
    }
    assert!(
        std::fs::read_to_string(path).unwrap() == expected,
        "{path} is not what CARAWARE_BLESS=1 would write"
    );
}

mod reference {
    use super::*;

    pub fn markdown() -> String {
        let defaults = LayeredSettings::defaults().unwrap();
        let mut text = String::from(INTRODUCTION);
        let mut table = "";
        for key in keys::KEYS {
            let (name, leaf) = key.path.split_once('.').unwrap_or((key.path, ""));
            if name != table {
                let heading = if leaf.is_empty() {
                    format!("[[{name}]]")
                } else {
                    format!("[{name}]")
                };
                text.push_str(&format!(
                    "\n## `{heading}`\n\n| key | default | allowed | unit | meaning |\n|---|---|---|---|---|\n"
                ));
                table = name;
            }
            let default = defaults.setting(key.path).map_or("none".into(), |setting| {
                setting.place.source.inner()[setting.place.span.clone()].to_owned()
            });
            let shown = if leaf.is_empty() { name } else { leaf };
            text.push_str(&format!(
                "| `{shown}` | `{default}` | {} | {} | {} |\n",
                key.range(),
                key.unit,
                key.meaning
            ));
            if let keys::ValueKind::Tables(entries) | keys::ValueKind::Suites(entries) = key.kind {
                add_entries(shown, entries, &mut text);
            }
        }
        text
    }

    fn add_entries(list: &str, entries: &[keys::ConfigKey], text: &mut String) {
        for entry in entries {
            let optional = if entry.optional { "none" } else { "" };
            let name = format!("{list}.{}", entry.leaf());
            text.push_str(&format!(
                "| `{name}` | `{optional}` | {} | {} | {} |\n",
                entry.range(),
                entry.unit,
                entry.meaning
            ));
            if let keys::ValueKind::Tables(entries) = entry.kind {
                add_entries(&name, entries, text);
            }
        }
    }

    const INTRODUCTION: &str = "\
# Configuration

`caraware train`, `caraware simulate` and `caraware play` take a CONFIG: the name of a preset, your
own `.toml`, or a `.sumocfg`. A `.toml` needs only the keys that differ from the default preset
[`town`](town.toml), or from the preset that it names above its first section:

```toml
preset = \"driving\"

[traffic]
heroes = 4
```

`--preset NAME` does the same on the command line, for a `.sumocfg` too, which has its own road
users: the maps, stages and heroes of the preset do not hold for it. `--set key=value` (repeatable)
comes last. Every run writes its resolved configuration to `config.toml` in its run directory, which
is a valid CONFIG too.

Units are SI with angles in radians, except where a key's name says degrees. An unknown key, a wrong
type or a value out of range is refused with the file, the line and the allowed values.
";
}

/// The default preset as JSON, for tests and benchmarks of the other crates; written with `CARAWARE_BLESS=1`.
#[test]
fn the_resolved_default_preset_for_tests_is_true() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../ipc-schema/tests/town.json");
    let expected =
        serde_json::to_string_pretty(&LayeredSettings::defaults().unwrap().validate().unwrap()).unwrap() + "\n";
    if std::env::var_os("CARAWARE_BLESS").is_some() {
        std::fs::write(path, &expected).unwrap();
    }
    assert!(
        std::fs::read_to_string(path).unwrap() == expected,
        "{path} is not what CARAWARE_BLESS=1 would write"
    );
}

#[test]
fn a_stage_of_a_curriculum_is_checked_value_by_value() {
    let config = config_of(
        "[[curriculum.stages]]\ncavs = 1\nrestart = false\nuntil_std = 0.5\n[[curriculum.stages]]\ncavs = 8\n",
    )
    .unwrap();
    let steps = config.curriculum.stages;
    assert_eq!(
        (steps.len(), steps[0].restart, steps[1].restart, steps[1].cavs),
        (2, false, true, Some(8))
    );
    assert_eq!((steps[0].until_std, steps[1].noise), (Some(0.5), 1.0));
    let (message, help) = error_of("[[curriculum.stages]]\ncavs = 1\nuntil_sigma = 0.5\n");
    assert_eq!(message, "my.toml:3: unknown key `curriculum.stages.until_sigma`");
    assert!(help.contains("`curriculum.stages.until_std`"), "{help}");
    let (message, _) = error_of("[curriculum]\nstages = [{ cavs = 0 }]\n");
    assert_eq!(
        message,
        "my.toml:2: stage 1 of `curriculum.stages` has no connected vehicle for the localisation task"
    );
    let (message, _) = error_of("[[curriculum.stages]]\nspeed_limit_factor = 3.0\n");
    assert_eq!(
        message,
        "my.toml:2: `curriculum.stages.speed_limit_factor` cannot be 3.0"
    );
    let (message, _) = error_of("[[curriculum.stages]]\nheroes = 3\n");
    assert_eq!(
        message,
        "my.toml:2: stage 1 of `curriculum.stages` sets heroes, which need the driving task"
    );
    let (message, help) = error_of("traffic.max_road_users = 60\n[[curriculum.stages]]\ncavs = 100\n");
    assert!(
        message.contains("stage 1 of `curriculum.stages` asks for 120 road users"),
        "{message}"
    );
    assert_eq!(help, "set traffic.max_road_users to 120 or more");
}

/// What a stage leaves out is as in the configuration.
#[test]
fn a_stage_of_the_driving_task_sets_what_heroes_learn_to_drive_through() {
    let driving = "task.kind = \"driving\"\ntraffic.cavs = 0\ntraffic.heroes = 2\ntrainer.network = \"mlp\"\ntrainer.actions_per_observation = 1\n";
    let with = |lines: &str| format!("{driving}{lines}");
    let stages = "[[curriculum.stages]]\nothers = 0\nspeed_limit_factor = 0.5\n[[curriculum.stages]]\nheroes = 5\nhero_turns = \"left\"\ntraffic_lights = false\n";
    let config = config_of(&with(stages)).unwrap();
    assert!(config.trainer_decides_lessons());
    assert_eq!(config.heroes(), 5, "there is room for the most heroes of a stage");
    let of_stage = |number: usize| {
        let traffic = config.in_stage(number).traffic;
        (
            (traffic.cavs, traffic.others, traffic.pedestrians, traffic.heroes),
            (traffic.hero_turns, traffic.traffic_lights, traffic.speed_limit_factor),
        )
    };
    assert_eq!(of_stage(0), ((0, 8, 12, 2), (HeroTurns::Any, true, 1.0)));
    assert_eq!(of_stage(1), ((0, 0, 12, 2), (HeroTurns::Any, true, 0.5)));
    assert_eq!(of_stage(2), ((0, 8, 12, 5), (HeroTurns::Left, false, 1.0)));

    let (message, _) = error_of(&with("[[curriculum.stages]]\nheroes = 0\n"));
    assert_eq!(
        message,
        "my.toml:7: stage 1 of `curriculum.stages` has no hero to teach"
    );
    let along = "traffic.hero_route = [\"a\"]\n[[curriculum.stages]]\nhero_turns = \"left\"\n";
    let (message, _) = error_of(&with(along));
    assert!(message.contains("`traffic.hero_route` gives one"), "{message}");
    let (message, _) = error_of(&with("traffic.hero_route = [\"a\"]\ntraffic.hero_turns = \"left\"\n"));
    assert!(message.contains("`traffic.hero_route` gives one"), "{message}");
}

/// The mirror of a hero that SUMO drives may be behind SUMO as any other. One that takes actions is where its own model is.
#[test]
fn a_view_of_the_road_ahead_is_for_heroes_that_sumo_drives() {
    let watched = "task.kind = \"driving\"\ntraffic.heroes = 1\nvehicle.preview_s = 1.5\ntrainer.module = \"caraware.driving.trips\"\n";
    assert!(config_of(&format!("{watched}task.driver = \"sumo\"\n")).is_ok());
    let (message, help) = error_of(watched);
    assert!(
        message.contains("puts the traffic around a hero into the past"),
        "{message}"
    );
    assert!(help.contains("task.driver = \"sumo\""), "{help}");
}

#[test]
fn sumo_is_not_asked_for_advice_where_it_drives() {
    let advised = "trainer.module = \"caraware.driving.dagger\"\ntask.kind = \"driving\"\ntraffic.heroes = 1\nobservation.fields = \"advised-driver\"\n";
    assert!(config_of(advised).is_ok_and(|config| config.advises_heroes()));
    let driven = "task.driver = \"sumo\"\n";
    let (message, help) = error_of(&format!("{advised}{driven}"));
    assert!(
        message.contains("`advised_accel` is what SUMO's driver would do"),
        "{message}"
    );
    assert!(help.contains("observation.fields = \"driver\""), "{help}");
}

/// A decision of one trainer is not that of the others, and lessons end at other ticks in each environment.
#[test]
fn several_environments_count_the_lessons_of_a_stage() {
    let envs = "run.envs = 2\n";
    let config = config_of(&format!("{envs}[[curriculum.stages]]\ncavs = 1\nuntil_lessons = 3\n")).unwrap();
    assert!(!config.trainer_decides_lessons());
    for (setting, key, value) in [
        (envs, "until_std", "0.5"),
        (envs, "until_metric", "\"error_m\"\nuntil_value = 6.0"),
        (envs, "restart", "false"),
        ("trainer.ranks = 2\n", "until_std", "0.5"),
        ("trainer.module = \"mine\"\n", "until_std", "0.5"),
    ] {
        let (message, help) = error_of(&format!("{setting}[[curriculum.stages]]\ncavs = 1\n{key} = {value}\n"));
        let expected = format!("my.toml:4: stage 1 of `curriculum.stages`: `{key}` needs one trainer that decides");
        assert!(message.starts_with(&expected), "{message}");
        assert!(help.contains("\"caraware.train\""), "{help}");
    }
}

#[test]
fn a_gate_names_a_metric_of_the_task_and_the_value_that_it_must_reach() {
    let with = |lines: &str| {
        format!("[[curriculum.stages]]\ncavs = 1\nuntil_std = 0.5\n[[curriculum.stages]]\ncavs = 8\n{lines}\n")
    };
    let config = config_of(&with("until_metric = \"error_m\"\nuntil_value = 6")).unwrap();
    let stage = &config.curriculum.stages[1];
    assert_eq!(stage.until_metric.unwrap().spec().name, "error_m");
    assert_eq!(stage.until_value, Some(6.0));

    let (message, help) = error_of(&with("until_metric = \"error_km\""));
    assert_eq!(
        message,
        "my.toml:6: `curriculum.stages.until_metric` cannot be \"error_km\""
    );
    assert!(
        help.starts_with(
            "allowed: \"error_m\", \"progress_mps\", \"route_offset_m\", \"lateral_error_m\", \"wrong_lane_percent\", \"awareness_percent\", \"message_kbitps\". "
        ),
        "{help}"
    );
    let (message, help) = error_of(&with("until_value = 6.0\nuntil_metric = \"progress_mps\""));
    assert_eq!(
        message,
        "my.toml:7: stage 2 of `curriculum.stages`: `until_metric` = \"progress_mps\" is no metric of the localisation task"
    );
    assert_eq!(help, "its metrics are \"error_m\"");
    let (message, help) = error_of(&with("until_metric = \"error_m\""));
    assert_eq!(
        message,
        "my.toml:6: stage 2 of `curriculum.stages`: `until_metric` is set without `until_value`"
    );
    assert_eq!(help, "give the value that ends the stage, in m");
    let (message, help) = error_of(&with("until_value = 6.0"));
    assert_eq!(
        message,
        "my.toml:6: stage 2 of `curriculum.stages`: `until_value` is set without `until_metric`"
    );
    assert_eq!(help, "name the metric: \"error_m\"");
    let (message, help) = error_of(&with("until_error_m = 6.0"));
    assert_eq!(
        message,
        "my.toml:6: `curriculum.stages.until_error_m` is renamed to `curriculum.stages.until_metric`"
    );
    assert!(
        help.contains("until_metric = \"error_m\" with until_value = 6.0"),
        "{help}"
    );
}

#[test]
fn maps_of_a_curriculum_are_names_that_the_run_has() {
    let steps = "[[curriculum.stages]]\ncavs = 1\n[[curriculum.stages]]\ncavs = 2\nmaps = [\"b\", \"town\"]\nmap_choice = \"random\"\n";
    let curriculum = config_of(&format!("[curriculum]\nmaps = [\"town\", \"nets/b.net.xml\"]\n{steps}"))
        .unwrap()
        .curriculum;
    assert_eq!(curriculum.map_names(), ["town", "b"]);
    let maps: Vec<_> = curriculum.stages.iter().map(|step| curriculum.maps_of(step)).collect();
    assert_eq!(maps, [vec![0], vec![1, 0]]);

    let (message, help) = error_of(&format!("[curriculum]\nmaps = [\"town\", \"c.sumocfg\"]\n{steps}"));
    assert!(message.contains("my.toml:"), "{message}");
    assert!(
        message.contains("stage 2 of `curriculum.stages` uses the map \"b\", which the run does not have"),
        "{message}"
    );
    assert!(help.contains("its maps are \"town\", \"c\""), "{help}");
    let (message, help) = error_of(steps);
    assert!(
        message.contains("uses the map \"b\"") && help.contains("\"town\""),
        "{message} {help}"
    );

    let (message, help) = error_of("[curriculum]\nmaps = [\"town\", \"avenue\"]\n");
    assert!(
        message.contains("my.toml:2: `curriculum.maps` has several maps, but there are no stages"),
        "{message}"
    );
    assert!(help.contains("[[curriculum.stages]]"), "{help}");
    let alone = config_of("[curriculum]\nmaps = [\"nets/b.net.xml\"]\n").unwrap();
    assert_eq!(alone.curriculum.map_names(), ["b"]);
    let one = "[[curriculum.stages]]\ncavs = 1\n";
    let (message, help) = error_of(&format!("[curriculum]\nmaps = [\"town\", \"Town02\"]\n{one}"));
    assert!(
        message.contains("\"Town02\" is no map") && help.contains(".net.xml"),
        "{message} {help}"
    );
    let (message, _) = error_of(&format!(
        "[curriculum]\nmaps = [\"a/x.net.xml\", \"b/x.sumocfg\"]\n{one}"
    ));
    assert!(message.contains("two maps of the name \"x\""), "{message}");

    let (message, help) = error_of("[[curriculum.stages]]\ncavs = 1\nmap_choice = \"random\"\n");
    assert!(
        message.contains("stage 1 of `curriculum.stages` draws its maps, but names 0"),
        "{message}"
    );
    assert!(help.contains("two or more"), "{help}");
    let (message, _) = error_of("[[curriculum.stages]]\ncavs = 1\nmap_choice = \"gradual\"\n");
    assert!(
        message.contains("`curriculum.stages.map_choice` cannot be \"gradual\""),
        "{message}"
    );
}

#[test]
fn a_key_with_positions_is_refused_with_several_maps() {
    let maps = "[curriculum]\nmaps = [\"town\", \"b.net.xml\"]\n[[curriculum.stages]]\ncavs = 1\n";
    for (key, setting) in [
        ("scene.obstacles", "[scene]\nobstacles = [\"cone 10 20\"]\n"),
        ("scene.meshes", "[scene]\nmeshes = [\"a.obj 1 2\"]\n"),
        (
            "region.polygon_m",
            "[region]\npolygon_m = [\"0 0\", \"9 0\", \"9 9\"]\n",
        ),
        ("region.radius_m", "[region]\nradius_m = 50.0\n"),
    ] {
        let (message, _) = error_of(&format!("{setting}{maps}"));
        assert!(
            message.contains(&format!(
                "my.toml:2: `{key}` holds positions on one map, but `curriculum.maps` has 2"
            )),
            "{message}"
        );
        assert!(config_of(&format!("{setting}{}", maps.replace(", \"b.net.xml\"", ""))).is_ok());
    }
}

#[test]
fn a_stage_changes_population_noise_and_blackouts_and_nothing_else() {
    let text = "[blackout]\nenabled = true\n[[curriculum.stages]]\ncavs = 3\nnoise = 2.0\nblackout = 0.0\n[[curriculum.stages]]\ncavs = 5\n";
    let config = config_of(text).unwrap();
    let (base, first, second) = (config.in_stage(0), config.in_stage(1), config.in_stage(2));
    assert_eq!(base, config);
    assert_eq!((first.traffic.cavs, second.traffic.cavs), (3, 5));
    assert_eq!(
        (first.gnss.noise_std_deg, second.gnss.noise_std_deg),
        ([1e-4; 2], [5e-5; 2])
    );
    assert_eq!(
        (first.imu.accel_noise_std_mps2, first.gnss.blackout_length_s),
        ([0.002; 3], [0.0; 2])
    );
    assert_eq!(second.gnss.blackout_length_s, [5.0, 10.0]);
    assert_eq!((first.trainer, first.run), (config.trainer, config.run));
}

#[test]
fn the_error_on_a_wrong_text_names_its_line_and_the_allowed_form() {
    for (key, good, bad, fault, allowed) in [
        (
            "scene.obstacles",
            "cone 10 20",
            "cnoe 1 2",
            "names no known prop (\"cnoe\")",
            "props: cone, bollard",
        ),
        (
            "scene.obstacles",
            "cone 1 2 90",
            "cone 10",
            "is not \"name x y\"",
            "\"name x y heading\"",
        ),
        (
            "scene.meshes",
            "a.obj 1 2",
            "a.obj 1 two",
            "is not \"file.obj x y\"",
            "\"file.obj x y heading\"",
        ),
        (
            "region.polygon_m",
            "0 0",
            "1 zero",
            "is no corner",
            "list of \"x y\" such as \"120 45.5\"",
        ),
        (
            "vehicle.class_models",
            "bus=dynamic",
            "bus=rigid_body",
            "is no vehicle class",
            "passenger, private",
        ),
        (
            "lidar.interest_props",
            "cone",
            "unicorn",
            "names no known prop",
            "list of props: cone",
        ),
        ("curriculum.maps", "town", "Town02", "is no map", ".net.xml"),
    ] {
        let (message, help) = error_of(&format!("{key} = [\n  \"{good}\",\n  \"{bad}\",\n]\n"));
        assert!(
            message.starts_with(&format!("my.toml:3: `{key}`: \"{bad}\" {fault}")),
            "{message}"
        );
        assert!(
            help.starts_with("allowed: list of ") && help.contains(allowed),
            "{help}"
        );
    }
    for (key, bad, allowed) in [
        (
            "fanout.listen",
            "quic/127.0.0.1:7447",
            "\"tcp/HOST:PORT\", \"tls/HOST:PORT\"",
        ),
        ("fanout.listen", "tcp/127.0.0.1", "\"tcp/127.0.0.1:7447\""),
        ("trainer.network", "lstm", "\"package.module:Class\""),
    ] {
        let (message, help) = error_of(&format!("{key} = \"{bad}\"\n"));
        assert!(
            message.starts_with(&format!("my.toml:1: `{key}`: \"{bad}\" is n")),
            "{message}"
        );
        assert!(help.starts_with("allowed: ") && help.contains(allowed), "{help}");
    }
    assert_eq!(
        error_of("scene.obstacles = [1]\n").0,
        "my.toml:1: `scene.obstacles` cannot be [1]"
    );
    assert_eq!(
        error_of("fanout.listen = 1\n").0,
        "my.toml:1: `fanout.listen` cannot be 1"
    );
}

/// A word that the table of keys offers and the type does not know would be a defect of the program, not of the configuration.
#[test]
fn every_choice_of_a_key_is_a_value_of_its_type() {
    for key in keys::KEYS {
        let keys::ValueKind::Choice(words) = key.kind else {
            continue;
        };
        for word in words {
            match config_of(&format!("{} = \"{word}\"\n", key.path)) {
                Ok(_) | Err(ConfigError::Conflict { .. }) => {}
                Err(error) => panic!("{} = {word}: {error}", key.path),
            }
        }
    }
}

#[test]
fn what_acts_needs_a_task_and_a_task_needs_what_acts() {
    let cases = [
        (
            "traffic.heroes = 1",
            "`traffic.heroes` = 1 needs the driving task",
            "task.kind = \"driving\"",
        ),
        (
            "traffic.hero_ids = [\"a\"]",
            "`traffic.hero_ids` names heroes, which need the driving task",
            "task.kind = \"driving\"",
        ),
        (
            "traffic.cavs = 0",
            "`traffic.cavs` = 0: the localisation task needs a connected vehicle",
            "set traffic.cavs to 1 or more",
        ),
        (
            "observation.fields = \"driving\"",
            "\"route_x_5\", which only a hero has",
            "leave the field out",
        ),
        (
            "task.kind = \"driving\"",
            "`task.kind` = \"driving\" without a hero",
            "traffic.heroes = 1",
        ),
        (
            "task.kind = \"driving\"\ntraffic.heroes = 1\ntraffic.step_s = 0.5",
            "`traffic.step_s` = 0.5 s is not `run.tick_s` = 0.1 s",
            "set both to the same time",
        ),
        (
            "task.kind = \"driving\"\ntraffic.heroes = 1\ntrainer.network = \"gru\"",
            "`trainer.network` = \"gru\" does not draw actions tick by tick",
            "set trainer.network = \"mlp\"",
        ),
        (
            "task.kind = \"driving\"\ntraffic.heroes = 1\ntrainer.actions_per_observation = 2",
            "`trainer.actions_per_observation` = 2: the world takes one action at a time",
            "set trainer.actions_per_observation = 1",
        ),
        (
            "v2x.share = 1.0\nv2x.inclusion = \"policy\"",
            "`v2x.inclusion` = \"policy\" needs a trainer that chooses",
            "task.kind = \"messages\"",
        ),
        (
            "task.kind = \"messages\"",
            "`task.kind` = \"messages\", but no road user has a radio",
            "set v2x.share above 0",
        ),
        (
            "task.kind = \"messages\"\nv2x.share = 0.5",
            "but vehicles perceive nothing that they could tell of",
            "set v2x.perception_range_m",
        ),
        (
            "task.kind = \"messages\"\nv2x.share = 0.5\nv2x.perception_range_m = 60.0\ntrainer.network = \"gru\"",
            "`trainer.network` = \"gru\" does not draw actions tick by tick",
            "set trainer.network = \"mlp\"",
        ),
    ];
    for (text, expected, cure) in cases {
        let (message, help) = error_of(text);
        assert!(
            message.contains(expected) && help.contains(cure),
            "{text}: {message}; {help}"
        );
    }
}

#[test]
fn heroes_count_as_road_users() {
    let (message, _) =
        error_of("task.kind = \"driving\"\ntraffic.heroes = 1\ntrainer.module = \"mine\"\ntraffic.max_road_users = 52");
    assert!(message.contains("less than the 53 road users"), "{message}");
}

const TWO_CAMERAS: &str = "[[suite]]\nname = \"pair\"\nclasses = [\"bus\"]\nshare = 0.5\n\
    [[suite.sensor]]\nkind = \"camera\"\nname = \"left\"\nwidth = 42\nperiod_ticks = 3\n\
    [[suite.sensor]]\nkind = \"camera\"\nname = \"right\"\nmount = [1, 2, 3, 0, 0, 0.5]\nperiod_s = 0.2\n";

#[test]
fn a_sensor_of_a_suite_is_its_section_with_exceptions() {
    let config = config_of(&format!("camera.height = 99\n{TWO_CAMERAS}")).unwrap();
    let suite = &config.suites[0];
    assert_eq!(
        (suite.name.as_str(), suite.share, suite.classes.as_slice()),
        ("pair", 0.5, ["bus".to_owned()].as_slice())
    );
    let periods: Vec<u32> = suite.sensors.iter().map(|sensor| sensor.period_ticks).collect();
    assert_eq!(periods, [3, 2]);
    let units = config.sensor_units(SensorKind::Camera);
    let [left, right] = [0, 1].map(|place: usize| config.with_unit(&units[place]).camera);
    assert_eq!(
        (left.width, left.height, left.mount, left.period_s),
        (42, 99, config.camera.mount, 0.3)
    );
    assert_eq!(
        (right.width, right.height, right.mount),
        (config.camera.width, 99, [1.0, 2.0, 3.0, 0.0, 0.0, 0.5])
    );
    // What a run writes is a configuration.
    let again = layer::parse("again", &to_toml(&config).unwrap()).unwrap();
    assert_eq!(LayeredSettings(again).validate().unwrap(), config);
}

#[test]
fn ready_made_suites_are_known_by_name() {
    for (name, _) in suites::READY_MADE_SUITES {
        let settings = LayeredSettings::defaults().unwrap();
        let config = settings
            .with_assignments(&[format!("suite={name}:3")])
            .unwrap()
            .validate()
            .unwrap();
        assert_eq!(
            (config.suites[0].name.as_str(), config.suites[0].first),
            (name, Some(3))
        );
        let again = layer::parse("again", &to_toml(&config).unwrap()).unwrap();
        assert_eq!(LayeredSettings(again).validate().unwrap(), config);
    }
    let nuscenes = config_of("suite = \"nuscenes\"\n").unwrap();
    let of_kind =
        [SensorKind::Lidar, SensorKind::Camera, SensorKind::Radar].map(|kind| nuscenes.sensor_units(kind).len());
    assert_eq!(of_kind, [1, 6, 5]);
    let mine = "[[suite]]\npreset = \"kitti\"\nname = \"mine\"\n[[suite.sensor]]\nkind = \"radar\"\nname = \"front\"\n";
    let mine = config_of(mine).unwrap();
    assert_eq!(
        (mine.suites[0].name.as_str(), mine.suites[0].sensors.len()),
        ("mine", 8)
    );
    let (message, help) = error_of("suite = \"kity\"\n");
    assert_eq!(message, "my.toml:1: `suite`: \"kity\" is no ready-made suite");
    assert!(help.contains("kitti, nuscenes, paper"), "{help}");
    assert!(
        error_of("suite = \"kitti:few\"\n")
            .0
            .contains("\"few\" is no number of slots")
    );
}

#[test]
fn a_rolling_shutter_reads_within_a_tick_and_beside_no_events() {
    let config = config_of(&format!("{TWO_CAMERAS}readout_s = 0.1\n")).unwrap();
    let units = config.sensor_units(SensorKind::Camera);
    let readouts_s = [0, 1].map(|place: usize| config.with_unit(&units[place]).camera.readout_s);
    assert_eq!(readouts_s, [0.0, 0.1]);
    for (text, message) in [
        (
            "camera.vehicles = 1\ncamera.readout_s = 0.2\n".to_owned(),
            "my.toml:2: `camera` reads its rows within 0.2 s, but a tick, `run.tick_s`, has 0.1 s",
        ),
        (
            "camera.vehicles = 1\ncamera.readout_s = 0.02\ncamera.events = true\n".to_owned(),
            "my.toml:2: `camera` has a rolling shutter and events",
        ),
        (
            "camera.readout_s = -0.1\n".to_owned(),
            "my.toml:1: `camera.readout_s` cannot be -0.1",
        ),
        (
            format!("{TWO_CAMERAS}readout_s = 0.3\n"),
            "camera `right` of the suite `pair` reads its rows within 0.3 s",
        ),
        (
            format!("run.tick_s = 0.05\n{TWO_CAMERAS}readout_s = 0.06\n"),
            "camera `right` of the suite `pair` reads its rows within 0.06 s, but a tick, `run.tick_s`, has 0.05 s",
        ),
    ] {
        let (error, help) = error_of(&text);
        assert!(error.contains(message), "{error}");
        assert!(!help.is_empty(), "{error}");
    }
}

#[test]
fn faults_of_suites_are_named_with_their_lines() {
    let after = |line: &str| error_of(&format!("{TWO_CAMERAS}{line}\n"));
    for (text, message) in [
        ("widht = 3", "my.toml:15: unknown key `suite.sensor.widht`"),
        ("width = 0", "my.toml:15: `camera.width` cannot be 0"),
        ("vehicles = 3", "my.toml:15: unknown key `suite.sensor.vehicles`"),
        (
            "period_ticks = 3",
            "my.toml:14: `period_s` = 0.2 s and `period_ticks` = 3",
        ),
        ("[[suite]]\nname = \"empty\"", "my.toml:"),
        (
            "[[suite]]\npreset = \"kitti\"\nname = \"pair\"",
            "my.toml:17: two suites have the name \"pair\"",
        ),
        (
            "[[suite]]\nname = \"x\"\nclasses = [\"sedan\"]",
            "my.toml:17: `suite.classes`: \"sedan\" is no vehicle class",
        ),
        (
            "[[suite.sensor]]\nkind = \"camera\"\nname = \"left\"",
            "has two sensors with the name \"left\"",
        ),
        (
            "[[suite.sensor]]\nkind = \"sonar\"\nname = \"s\"",
            "my.toml:16: `suite.sensor.kind` cannot be \"sonar\"",
        ),
        (
            "[[suite.sensor]]\nname = \"s\"",
            "entry 3 of `suite.sensor` has no `kind`",
        ),
        (
            "[[suite.sensor]]\nkind = \"imu\"\nname = \"s\"\nperiod_ticks = 2",
            "my.toml:18: a sensor of a suite of kind \"imu\" has no `period_ticks`",
        ),
        (
            "[[suite.sensor]]\nkind = \"radar\"\nname = \"s\"\nperiod_s = 0.25",
            "my.toml:18: `radar.period_s` = 0.25 s of a sensor of a suite is not",
        ),
        (
            "[[suite.sensor]]\nkind = \"lidar\"\nname = \"s\"\nrotation_hz = 7",
            "suite \"pair\", sensor \"s\": `lidar.rotation_hz` = 7: a rotation must be",
        ),
        (
            "[[roadside]]\nname = \"m\"\nsuite = \"mast\"\nx_m = 1\ny_m = 2",
            "my.toml:17: \"m\" carries the suite \"mast\", which",
        ),
        (
            "[[roadside]]\nname = \"m\"\nsuite = \"pair\"\nx_m = 1",
            "my.toml:16: \"m\" beside the road needs exactly one place",
        ),
    ] {
        let (said, help) = after(text);
        assert!(said.contains(message), "{text}: {said}");
        assert!(!help.is_empty(), "{said}");
    }
    assert!(error_of("[suite]\nname = \"a\"\n").0.contains("`suite` cannot be"));
}

#[test]
fn roadside_units_have_names_of_their_own_and_receivers() {
    let unit = |more: &str| format!("[[v2x.roadside]]\nid = \"a\"\nx_m = 1\ny_m = 2\nheight_m = 6\n{more}");
    let with_radios = |more: &str| format!("[v2x]\nshare = 0.5\n{}", unit(more));
    let config = config_of(&with_radios("range_m = 80\nservices = [\"cpm\", \"denm\"]\n")).unwrap();
    let units = config.v2x.roadside;
    assert_eq!(
        (units.len(), units[0].range_m, units[0].heading_deg),
        (1, Some(80.0), None)
    );
    let (message, help) = error_of(&unit(""));
    assert!(
        message.contains("my.toml:1: `v2x.roadside` has 1 units, but no road user has a radio"),
        "{message}"
    );
    assert!(help.contains("v2x.share"), "{help}");
    let (message, _) = error_of(&with_radios(&unit("")));
    assert!(
        message.contains("my.toml:9: unit 2 of `v2x.roadside` has the id \"a\""),
        "{message}"
    );
    let (message, help) = error_of(&with_radios("services = [\"cpm\"]\n"));
    assert!(
        message.contains("my.toml:8: unit 1 of `v2x.roadside`, \"a\", sends CPMs"),
        "{message}"
    );
    assert!(help.contains("range_m"), "{help}");
    let (message, help) = error_of(&with_radios("services = [\"bsm\"]\n"));
    assert!(message.contains("my.toml:8"), "{message}");
    assert!(help.contains("\"cam\", \"cpm\", \"denm\""), "{help}");
    let (message, _) = error_of(&with_radios("heigth = 3\n"));
    assert!(message.contains("unknown key `v2x.roadside.heigth`"), "{message}");
    let (message, _) = error_of("[v2x]\nshare = 1.0\n[[v2x.roadside]]\nid = \"a\"\nx_m = 1\ny_m = 2\n");
    assert!(
        message.contains("entry 1 of `v2x.roadside` has no `height_m`"),
        "{message}"
    );
}
