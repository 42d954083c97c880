//! `caraware keys`: the table of configuration keys and the presets, as text or as JSON.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;

use crate::{
    config::{
        LayeredSettings, PRESETS,
        keys::{self, ConfigKey, ValueKind},
    },
    display,
    failure::Exit,
};

/// Everything that a form of the configuration needs.
#[derive(Debug, Serialize)]
struct Catalogue {
    presets: Vec<CataloguePreset>,
    keys: Vec<CatalogueKey>,
}

/// A preset: what it is for, and the values that differ from the default preset, by key.
#[derive(Debug, Serialize)]
struct CataloguePreset {
    name: &'static str,
    purpose: String,
    values: BTreeMap<&'static str, Value>,
}

/// A key of the table.
#[derive(Debug, Serialize)]
struct CatalogueKey {
    path: &'static str,
    /// Value of the default preset; null if that leaves the key unset.
    default: Value,
    kind: &'static str,
    /// Least value of a number, or of each number of a list.
    min: Value,
    /// Greatest value.
    max: Value,
    /// Allowed words; empty if the key takes no word of a list.
    choices: Vec<&'static str>,
    unit: &'static str,
    meaning: &'static str,
    /// The allowed values, as `configs/README.md` shows them.
    allowed: String,
    optional: bool,
}

impl CatalogueKey {
    fn of(key: &ConfigKey, defaults: &LayeredSettings) -> Self {
        let (kind, min, max) = match key.kind {
            ValueKind::Float { min, max } => ("float", min.into(), max.into()),
            ValueKind::Integer { min, max } => ("integer", min.into(), max.into()),
            ValueKind::Floats { min, max, .. } => ("floats", min.into(), max.into()),
            ValueKind::Span { min, max } => ("span", min.into(), max.into()),
            ValueKind::Integers { min, max } => ("integers", min.into(), max.into()),
            ValueKind::Flag => ("flag", Value::Null, Value::Null),
            ValueKind::Choice(_) => ("choice", Value::Null, Value::Null),
            ValueKind::Text | ValueKind::TextOf(_) => ("text", Value::Null, Value::Null),
            ValueKind::Texts | ValueKind::TextsOf(_) => ("texts", Value::Null, Value::Null),
            ValueKind::Fields => ("fields", Value::Null, Value::Null),
            ValueKind::Metric => ("metric", Value::Null, Value::Null),
            ValueKind::Tables(_) | ValueKind::Suites(_) => ("tables", Value::Null, Value::Null),
        };
        Self {
            path: key.path,
            default: defaults.value(key.path),
            kind,
            min,
            max,
            choices: match key.kind {
                ValueKind::Choice(words) => words.to_vec(),
                _ => Vec::new(),
            },
            unit: key.unit,
            meaning: key.meaning,
            allowed: key.range(),
            optional: key.optional,
        }
    }
}

/// The table and the presets.
fn catalogue() -> Result<Catalogue, Exit> {
    let defaults = LayeredSettings::defaults()?;
    let keys = keys::KEYS.iter().map(|key| CatalogueKey::of(key, &defaults)).collect();
    let mut presets = Vec::new();
    for (name, text) in PRESETS {
        let Some(settings) = LayeredSettings::defaults()?.with_preset(name) else {
            continue;
        };
        let settings = settings?;
        let changed = keys::KEYS.iter().filter_map(|key| {
            let value = settings.value(key.path);
            (value != defaults.value(key.path)).then_some((key.path, value))
        });
        presets.push(CataloguePreset {
            name,
            purpose: text
                .lines()
                .next()
                .unwrap_or_default()
                .trim_start_matches("# ")
                .to_owned(),
            values: changed.collect(),
        });
    }
    Ok(Catalogue { presets, keys })
}

/// Prints the keys that begin with `prefix`, or all as JSON.
///
/// # Errors
/// No key begins with `prefix`.
pub fn keys(prefix: Option<&str>, json: bool) -> Result<(), Exit> {
    let catalogue = catalogue()?;
    if json {
        let text = serde_json::to_string(&catalogue)
            .map_err(|error| Exit::run(format!("the keys have no form in JSON: {error}"), ""))?;
        display::print(&text);
        return Ok(());
    }
    let prefix = prefix.unwrap_or_default();
    let chosen: Vec<&CatalogueKey> = catalogue
        .keys
        .iter()
        .filter(|key| key.path.starts_with(prefix))
        .collect();
    if chosen.is_empty() {
        return Err(Exit::config(
            format!("no key begins with `{prefix}`"),
            keys::nearest(prefix).map_or("`caraware keys` lists all keys".into(), |key| {
                format!("did you mean `{key}`?")
            }),
        ));
    }
    let presets = catalogue
        .presets
        .iter()
        .map(|preset| preset.name)
        .collect::<Vec<_>>()
        .join(", ");
    display::print(&format!("presets: {presets}"));
    for key in chosen {
        let default = match &key.default {
            Value::Null => "unset".to_owned(),
            value => value.to_string(),
        };
        let unit = match key.unit {
            "" => String::new(),
            unit => format!(" {unit}"),
        };
        display::print(&format!(
            "{} = {default}{unit}\n    {}\n    {}",
            key.path, key.allowed, key.meaning
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_catalogue_has_every_key_with_its_range_and_the_values_of_every_preset() {
        let catalogue = catalogue().unwrap();
        assert_eq!(catalogue.keys.len(), keys::KEYS.len());
        let cavs = catalogue.keys.iter().find(|key| key.path == "traffic.cavs").unwrap();
        assert_eq!(
            (&cavs.default, cavs.kind, &cavs.min, &cavs.max, cavs.unit),
            (
                &Value::from(32),
                "integer",
                &Value::from(0),
                &Value::from(100_000),
                "vehicles"
            )
        );
        let driving = catalogue
            .presets
            .iter()
            .find(|preset| preset.name == "driving")
            .unwrap();
        assert_eq!(driving.values["task.kind"], "driving");
        assert!(driving.purpose.starts_with("The driving task"), "{}", driving.purpose);
        assert!(
            catalogue.presets[0].values.is_empty(),
            "the first preset is the default"
        );
    }
}
