//! Suites in a configuration: ready-made ones by name, and the sensors of every suite completed by the values of their sections.

use ipc_schema::config::KEYS_OF_A_KIND;
use serde_json::{Map, Value};

use super::{
    ConfigError, LayeredSettings,
    keys::SUITE_SENSORS,
    layer::{self, LocatedValue, SettingsLayer},
    rules::conflict_at,
    span::SourceSpan,
};

/// Ready-made suites: name and text.
pub const READY_MADE_SUITES: [(&str, &str); 3] = [
    ("kitti", include_str!("../../../configs/suites/kitti.toml")),
    ("nuscenes", include_str!("../../../configs/suites/nuscenes.toml")),
    ("paper", include_str!("../../../configs/suites/paper.toml")),
];

/// A ready-made suite as a configuration names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReadyMadeSuite {
    /// Its name.
    pub name: &'static str,
    /// Its text, TOML.
    pub text: &'static str,
    /// Slots whose vehicles carry it; `None` = all.
    pub first: Option<u32>,
}

/// Names of all ready-made suites, for messages.
#[must_use]
pub fn names() -> String {
    READY_MADE_SUITES.map(|(name, _)| name).join(", ")
}

/// The suite that `"NAME"` or `"NAME:SLOTS"` names.
///
/// # Errors
/// There is no such suite, or the number of slots is none.
pub fn ready_made(text: &str) -> Result<ReadyMadeSuite, String> {
    let (name, first) = match text.split_once(':') {
        None => (text, None),
        Some((name, slots)) => {
            let first = slots
                .parse()
                .map_err(|_| format!("\"{slots}\" is no number of slots"))?;
            (name, Some(first))
        }
    };
    let mut known = READY_MADE_SUITES.iter();
    let found = known.find(|(known, _)| *known == name);
    let (name, text) = *found.ok_or_else(|| format!("\"{name}\" is no ready-made suite"))?;
    Ok(ReadyMadeSuite { name, text, first })
}

/// The one suite that `suite = "NAME"` stands for.
pub(super) fn named(text: &str, place: &SourceSpan) -> SettingsLayer {
    let setting = LocatedValue {
        value: text.into(),
        place: place.clone(),
        entries: Vec::new(),
    };
    SettingsLayer::from([("suite.preset", setting)])
}

/// Puts suites and carriers beside the road into a configuration: `root` holds all sections.
///
/// # Errors
/// The period of a sensor is not a whole number of ticks, or is given twice.
pub(super) fn complete(settings: &LayeredSettings, root: &mut Map<String, Value>) -> Result<(), ConfigError> {
    if let Some(roadsides) = settings.setting("roadside") {
        root.insert("roadside".into(), roadsides.value.clone());
    }
    let Some(suites) = settings.setting("suite") else {
        return Ok(());
    };
    let completed = suites.entries.iter().map(|entry| suite(entry, root));
    let completed: Vec<Value> = completed.collect::<Result<_, _>>()?;
    root.insert("suite".into(), completed.into());
    Ok(())
}

fn suite(entry: &SettingsLayer, root: &Map<String, Value>) -> Result<Value, ConfigError> {
    let sensors_of = |entry: &SettingsLayer| match entry.get(SUITE_SENSORS) {
        Some(setting) => setting.entries.clone(),
        None => Vec::new(),
    };
    let (mut suite, mut sensors) = (Map::new(), Vec::new());
    suite.insert("name".into(), "".into());
    // A ready-made one, then what the entry says itself.
    if let Some(preset) = entry.get("suite.preset").and_then(|setting| setting.value.as_str())
        && let Ok(ready) = ready_made(preset)
    {
        let read = layer::parse(&format!("suite {}", ready.name), ready.text)?;
        let made = read.get("suite").map_or(&[][..], |suites| &suites.entries);
        sensors.extend(made.iter().flat_map(sensors_of));
        suite.insert("name".into(), ready.name.into());
        if let Some(first) = ready.first {
            suite.insert("first".into(), first.into());
        }
    }
    for key in ["name", "classes", "types", "ids", "share", "first"] {
        if let Some(setting) = entry.get(format!("suite.{key}").as_str()) {
            suite.insert(key.into(), setting.value.clone());
        }
    }
    sensors.extend(sensors_of(entry));
    let sensors = sensors.iter().map(|sensor| completed_sensor(sensor, root));
    let sensors: Vec<Value> = sensors.collect::<Result<_, _>>()?;
    suite.insert("sensor".into(), sensors.into());
    Ok(suite.into())
}

/// A sensor with the values of its section, except those that it has itself.
fn completed_sensor(sensor: &SettingsLayer, root: &Map<String, Value>) -> Result<Value, ConfigError> {
    let own = |key: &str| sensor.get(key).map(|setting| &setting.value);
    let kind = own("suite.sensor.kind").and_then(Value::as_str).unwrap_or_default();
    let section = root.get(kind).and_then(Value::as_object);
    let mut completed = section.cloned().unwrap_or_default();
    let looks = !matches!(kind, "gnss" | "imu");
    completed.retain(|key, _| match looks {
        true => !KEYS_OF_A_KIND.contains(&key.as_str()),
        false => key == "mount",
    });
    for (path, setting) in sensor {
        if let Some((table, key)) = path.split_once('.')
            && table == kind
        {
            completed.insert(key.to_owned(), setting.value.clone());
        }
    }
    for key in ["kind", "name"] {
        let value = own(&format!("suite.sensor.{key}")).cloned().unwrap_or_default();
        completed.insert(key.into(), value);
    }
    let tick_s = root
        .get("run")
        .and_then(|run| run.get("tick_s"))
        .and_then(Value::as_f64);
    set_period(sensor, kind, tick_s.unwrap_or(1.0), &mut completed)?;
    Ok(completed.into())
}

/// Sets the number of ticks between two samples, and the period in seconds that agrees with it.
fn set_period(
    sensor: &SettingsLayer,
    kind: &str,
    tick_s: f64,
    completed: &mut Map<String, Value>,
) -> Result<(), ConfigError> {
    let ticks = sensor.get("suite.sensor.period_ticks");
    let seconds = sensor.get(format!("{kind}.period_s").as_str());
    if matches!(kind, "gnss" | "imu") && ticks.is_some() {
        return Err(conflict_at(
            ticks,
            format!("a sensor of a suite of kind \"{kind}\" has no `period_ticks`"),
            format!("set `{kind}.period_s`, which all vehicles share"),
        ));
    }
    let period_s = completed.get("period_s").and_then(Value::as_f64);
    let whole = |period_s: f64| {
        let ratio = (period_s / tick_s).round();
        (ratio >= 1.0 && (period_s / tick_s - ratio).abs() < 1e-6 * ratio).then_some(ratio)
    };
    #[expect(clippy::cast_precision_loss, reason = "at most a million")]
    let given = ticks
        .and_then(|setting| setting.value.as_u64())
        .map(|ticks| ticks as f64);
    let ticks_of_period = match (given, period_s) {
        (Some(given), Some(period_s)) if seconds.is_some() => {
            if whole(period_s) != Some(given) {
                return Err(conflict_at(
                    seconds,
                    format!(
                        "`period_s` = {period_s} s and `period_ticks` = {given} of a sensor of a suite are two periods"
                    ),
                    format!("leave one of them out; {given} ticks are {} s", given * tick_s),
                ));
            }
            given
        }
        (Some(given), _) => given,
        (None, Some(period_s)) => match whole(period_s) {
            Some(ticks) => ticks,
            None => {
                return Err(conflict_at(
                    seconds.or_else(|| sensor.get("suite.sensor.kind")),
                    format!(
                        "`{kind}.period_s` = {period_s} s of a sensor of a suite is not a whole number of ticks of `run.tick_s` = {tick_s} s"
                    ),
                    format!("choose a multiple of {tick_s} s, or give `period_ticks`"),
                ));
            }
        },
        (None, None) => 1.0,
    };
    if matches!(kind, "gnss" | "imu") {
        return Ok(());
    }
    if completed.contains_key("period_s") && given.is_some() && seconds.is_none() {
        let period_s = (ticks_of_period * tick_s * 1e9).round() / 1e9;
        completed.insert("period_s".into(), period_s.into());
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a whole number of ticks, at least 1"
    )]
    let ticks = ticks_of_period as u64;
    completed.insert("period_ticks".into(), ticks.into());
    Ok(())
}
