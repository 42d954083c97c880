use super::*;

fn error_of(text: &str) -> (String, String) {
    let error = layer::parse("my.toml", text)
        .and_then(|layer| {
            let mut settings = Settings::defaults()?;
            settings.0.extend(layer);
            settings.validate()
        })
        .unwrap_err();
    let help = miette::Diagnostic::help(&error)
        .map(|help| help.to_string())
        .unwrap_or_default();
    (error.to_string(), help)
}

#[test]
fn the_default_preset_is_valid_and_complete() {
    let config = Settings::defaults().unwrap().validate().unwrap();
    assert_eq!(config.observation.fields.len(), 9);
    let missing: Vec<_> = keys::KEYS
        .iter()
        .filter(|key| !key.optional && Settings::defaults().unwrap().setting(key.path).is_none())
        .collect();
    assert!(missing.is_empty(), "{missing:?}");
}

#[test]
fn every_preset_is_valid() {
    for (name, _) in PRESETS {
        Settings::defaults()
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
    let config = Settings::defaults().unwrap().validate().unwrap();
    let layer = layer::parse("again", &to_toml(&config)).unwrap();
    assert_eq!(Settings(layer).validate().unwrap(), config);
}

#[test]
fn an_unknown_key_names_file_line_and_what_was_meant() {
    let (message, help) = error_of("[run]\nseed = 3\n\n[gnss]\nnoise_deg = 1e-5\n");
    assert_eq!(message, "my.toml:5: unknown key `gnss.noise_deg`");
    assert_eq!(help, "did you mean `gnss.noise_std_deg`? All keys: configs/README.md");
}

#[test]
fn an_unknown_table_is_an_unknown_key() {
    let (message, _) = error_of("[radar]\nchannels = 3\n");
    assert_eq!(message, "my.toml:1: unknown key `radar`");
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
    let (message, help) = error_of("[imu]\nperiod_s = 0.25\n");
    assert_eq!(
        message,
        "my.toml:2: `imu.period_s` = 0.25 s is not a whole number of ticks of `run.tick_s` = 0.1 s"
    );
    assert_eq!(help, "choose a multiple of 0.1 s, or another `run.tick_s`");
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
fn assignments_take_numbers_words_and_lists() {
    let settings = Settings::defaults()
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
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/configs/README.md");
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
        let defaults = Settings::defaults().unwrap();
        let mut text = String::from(INTRODUCTION);
        let mut table = "";
        for key in keys::KEYS {
            let (name, _) = key.path.split_once('.').unwrap();
            if name != table {
                text.push_str(&format!(
                    "\n## `[{name}]`\n\n| key | default | allowed | unit | meaning |\n|---|---|---|---|---|\n"
                ));
                table = name;
            }
            let default = defaults.setting(key.path).map_or("none".into(), |setting| {
                setting.place.source.inner()[setting.place.span.clone()].to_owned()
            });
            let leaf = key.path.split_once('.').unwrap().1;
            text.push_str(&format!(
                "| `{leaf}` | `{default}` | {} | {} | {} |\n",
                key.range(),
                key.unit,
                key.meaning
            ));
        }
        text
    }

    const INTRODUCTION: &str = "\
# Configuration

`caraware train`, `caraware simulate` take a CONFIG: the name of a preset, your own `.toml`, or a `.sumocfg`. A `.toml` needs only the
keys that differ from the default preset [`town`](town.toml); `--set key=value` (repeatable) comes last. The resolved configuration
of every run is written to its run directory as `config.toml` and can be given back as CONFIG.

Units are SI with angles in radians, except where a key's name says degrees. An unknown key, a wrong type or a value out of range is
refused with the file, the line and the allowed values.
";
}

/// The default preset as JSON, for tests and benchmarks of the other crates; written with `CARAWARE_BLESS=1`.
#[test]
fn the_resolved_default_preset_for_tests_is_true() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/ipc-schema/tests/town.json");
    let expected = serde_json::to_string_pretty(&Settings::defaults().unwrap().validate().unwrap()).unwrap() + "\n";
    if std::env::var_os("CARAWARE_BLESS").is_some() {
        std::fs::write(path, &expected).unwrap();
    }
    assert!(
        std::fs::read_to_string(path).unwrap() == expected,
        "{path} is not what CARAWARE_BLESS=1 would write"
    );
}

#[test]
fn an_obstacle_that_cannot_be_placed_is_named_with_what_can() {
    let (message, help) = error_of("[scene]\nobstacles = [\"cone 10 20\", \"cnoe 1 2\"]\n");
    assert!(
        message.contains("`scene.obstacles`: \"cnoe 1 2\" names no known prop"),
        "{message}"
    );
    assert!(help.contains("props: cone, bollard"), "{help}");
    let (message, _) = error_of("[scene]\nobstacles = [\"cone 10\"]\n");
    assert!(message.contains("\"cone 10\" is not \"name x y\""), "{message}");
}

#[test]
fn heroes_and_the_driving_task_go_together() {
    let cases = [
        (
            "traffic.heroes = 1",
            "`traffic.heroes` = 1 without anybody who drives them",
            "task.kind = \"driving\"",
        ),
        (
            "traffic.hero_ids = [\"a\"]",
            "`traffic.hero_ids` names heroes without anybody",
            "task.kind = \"driving\"",
        ),
        (
            "traffic.cavs = 0",
            "`traffic.cavs` = 0: nobody is to be localised",
            "one connected vehicle",
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
            "task.kind = \"driving\"\ntraffic.heroes = 1",
            "`trainer.module` = \"caraware.train\" learns to localise",
            "caraware.examples.pure_pursuit",
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
