//! One source of settings: a preset, a file, or one `--set`. Every value is checked by its key and keeps the place where it was set.

use std::{collections::BTreeMap, sync::Arc};

use ipc_schema::{
    field::{Field, FieldPreset},
    metric::PolicyMetric,
};
use miette::NamedSource;
use serde_json::Value;
use toml::{
    Spanned,
    de::{DeTable, DeValue},
};

use super::{
    error::ConfigError,
    keys::{self, ConfigKey, ValueKind},
    span::{NamedText, SourceSpan},
    suites,
    text_form::TextForm,
};

/// A checked value and where it was set.
#[derive(Debug, Clone)]
pub struct LocatedValue {
    /// The value as the run file will hold it.
    pub value: Value,
    /// Where it was set.
    pub place: SourceSpan,
    /// The settings of each entry, if the value is a list of tables.
    pub entries: Vec<SettingsLayer>,
}

/// The key of a user's file that names the preset that the file begins from. It stands above the first section.
pub const PRESET_KEY: &str = "preset";

/// The preset that a file begins from.
#[derive(Debug, Clone)]
pub struct PresetChoice {
    /// Its name as written; `None` if the value is no text.
    pub name: Option<String>,
    /// Where it is named.
    pub place: SourceSpan,
}

/// Settings by dotted path.
pub type SettingsLayer = BTreeMap<&'static str, LocatedValue>;

/// Reads a whole TOML text.
///
/// # Errors
/// The text is not TOML, a key is unknown, or a value has a wrong type or is out of range. Each error has its line.
pub fn parse(name: &str, text: &str) -> Result<SettingsLayer, ConfigError> {
    let (source, table) = table_of(name, text)?;
    let mut layer = SettingsLayer::new();
    add_table("", &table, &source, &mut layer)?;
    Ok(layer)
}

/// Reads a user's file: its settings, and the preset that it begins from, if it names one with [`PRESET_KEY`].
///
/// # Errors
/// As [`parse`]. Whether there is such a preset is not checked here.
pub fn parse_file(name: &str, text: &str) -> Result<(Option<PresetChoice>, SettingsLayer), ConfigError> {
    let (source, mut table) = table_of(name, text)?;
    let preset = table.remove(PRESET_KEY).map(|value| PresetChoice {
        name: value.get_ref().as_str().map(ToOwned::to_owned),
        place: SourceSpan {
            source: source.clone(),
            span: value.span(),
        },
    });
    let mut layer = SettingsLayer::new();
    add_table("", &table, &source, &mut layer)?;
    Ok((preset, layer))
}

fn table_of<'a>(name: &str, text: &'a str) -> Result<(NamedText, DeTable<'a>), ConfigError> {
    let source: NamedText = Arc::new(NamedSource::new(name, text.to_owned()).with_language("toml"));
    let table = DeTable::parse(text).map_err(|error| ConfigError::Syntax {
        message: error.message().to_owned(),
        place: SourceSpan {
            source: source.clone(),
            span: error.span().unwrap_or(0..0),
        },
    })?;
    Ok((source, table.into_inner()))
}

/// Reads one `key=value` of the command line; a bare word counts as text.
///
/// # Errors
/// As [`parse`], or the assignment has no `=`.
pub fn parse_assignment(assignment: &str) -> Result<SettingsLayer, ConfigError> {
    let Some((key, value)) = assignment.split_once('=') else {
        return Err(ConfigError::Assignment {
            assignment: assignment.to_owned(),
        });
    };
    let (key, value) = (key.trim(), value.trim());
    let plain = format!("{key} = {value}");
    // A key that takes a word takes every word as text, also "nan" and "true", which mean something else in TOML.
    let takes_a_word = keys::find(key).is_some_and(|key| {
        matches!(
            key.kind,
            ValueKind::Choice(_) | ValueKind::Text | ValueKind::TextOf(_) | ValueKind::Suites(_)
        )
    });
    let is_quoted = value.starts_with(['"', '\'']);
    let text = if DeTable::parse(&plain).is_ok() && (is_quoted || !takes_a_word) {
        plain
    } else {
        format!("{key} = {}", Value::from(value))
    };
    parse("--set", &text)
}

/// Adds the values of a table and of its inner tables to the layer.
fn add_table(
    prefix: &str,
    table: &DeTable<'_>,
    source: &NamedText,
    layer: &mut SettingsLayer,
) -> Result<(), ConfigError> {
    for (name, value) in table {
        let path = if prefix.is_empty() {
            name.get_ref().to_string()
        } else {
            format!("{prefix}.{}", name.get_ref())
        };
        if let DeValue::Table(inner) = value.get_ref()
            && keys::KEYS.iter().any(|key| key.path.starts_with(&format!("{path}.")))
        {
            add_table(&path, inner, source, layer)?;
            continue;
        }
        let of_section = if prefix == keys::SUITE_SENSORS {
            let kind = table.iter().find(|(key, _)| key.get_ref() == "kind");
            let kind = kind.and_then(|(_, kind)| kind.get_ref().as_str());
            kind.and_then(|kind| keys::of_section(kind, name.get_ref()))
        } else {
            None
        };
        let Some(key) = of_section.or_else(|| keys::find(&path)) else {
            let place = SourceSpan {
                source: source.clone(),
                span: name.span(),
            };
            return Err(match keys::renamed_to(&path) {
                Some(renamed_to) => ConfigError::RenamedKey {
                    path,
                    renamed_to,
                    place,
                },
                None => ConfigError::UnknownKey {
                    nearest: keys::nearest(&path),
                    path,
                    place,
                },
            });
        };
        let place = SourceSpan {
            source: source.clone(),
            span: value.span(),
        };
        check_form(key, value, source)?;
        let refused = || ConfigError::Value {
            key,
            place: place.clone(),
        };
        let (value, entries) = match key.kind {
            ValueKind::Tables(keys) => {
                let entries = tables(key, keys, value, source)?.ok_or_else(refused)?;
                (list_of(&entries), entries)
            }
            ValueKind::Suites(keys) => {
                let entries = match value.get_ref().as_str() {
                    Some(name) => vec![suites::named(name, &place)],
                    None => tables(key, keys, value, source)?.ok_or_else(refused)?,
                };
                (list_of(&entries), entries)
            }
            _ => (check(key, value).ok_or_else(refused)?, Vec::new()),
        };
        layer.insert(key.path, LocatedValue { value, place, entries });
    }
    Ok(())
}

/// Reads a list of tables and checks each value of an entry by its own key; `None` if the value is not such a list.
fn tables(
    key: &'static ConfigKey,
    keys: &[ConfigKey],
    value: &Spanned<DeValue<'_>>,
    source: &NamedText,
) -> Result<Option<Vec<SettingsLayer>>, ConfigError> {
    let Some(items) = value.get_ref().as_array() else {
        return Ok(None);
    };
    let mut entries = Vec::new();
    for item in items {
        let DeValue::Table(table) = item.get_ref() else {
            return Ok(None);
        };
        let mut layer = SettingsLayer::new();
        add_table(key.path, table, source, &mut layer)?;
        if let Some(missing) = keys.iter().find(|key| !key.optional && !layer.contains_key(key.path)) {
            return Err(ConfigError::Conflict {
                message: format!(
                    "entry {} of `{}` has no `{}`",
                    entries.len() + 1,
                    key.path,
                    missing.leaf()
                ),
                help: format!("give `{}`. {}", missing.leaf(), missing.meaning),
                place: SourceSpan {
                    source: source.clone(),
                    span: item.span(),
                },
            });
        }
        entries.push(layer);
    }
    Ok(Some(entries))
}

/// A list of tables as the run file will hold it.
fn list_of(entries: &[SettingsLayer]) -> Value {
    // A sensor of a suite has keys of its section.
    let leaf = |path: &'static str| path.rsplit('.').next().unwrap_or(path).to_owned();
    let table = |layer: &SettingsLayer| {
        let values = layer.iter().map(|(path, setting)| (leaf(path), setting.value.clone()));
        Value::Object(values.collect())
    };
    entries.iter().map(table).collect()
}

/// Checks every text of a key whose texts have a form.
fn check_form(key: &'static ConfigKey, value: &Spanned<DeValue<'_>>, source: &NamedText) -> Result<(), ConfigError> {
    let form = match key.kind {
        ValueKind::TextOf(form) | ValueKind::TextsOf(form) => form,
        ValueKind::Suites(_) if value.get_ref().is_str() => TextForm::Suite,
        _ => return Ok(()),
    };
    let items = match value.get_ref() {
        DeValue::Array(items) => items.iter().collect(),
        _ => vec![value],
    };
    for item in items {
        if let Some(text) = item.get_ref().as_str()
            && let Err(reason) = form.check(text)
        {
            let place = SourceSpan {
                source: source.clone(),
                span: item.span(),
            };
            return Err(ConfigError::Text { key, reason, place });
        }
    }
    Ok(())
}

/// The value if `key` allows it.
fn check(key: &ConfigKey, value: &Spanned<DeValue<'_>>) -> Option<Value> {
    let value = value.get_ref();
    match key.kind {
        ValueKind::Float { min, max } => {
            let number = float(value)?;
            (min..=max).contains(&number).then(|| Value::from(number))
        }
        ValueKind::Integer { min, max } => integer(value, min, max).map(Value::from),
        ValueKind::Flag => value.as_bool().map(Value::from),
        ValueKind::Choice(words) => value.as_str().filter(|word| words.contains(word)).map(Value::from),
        ValueKind::Text | ValueKind::TextOf(_) => value.as_str().map(Value::from),
        ValueKind::Fields => fields(value),
        ValueKind::Metric => value
            .as_str()
            .filter(|name| PolicyMetric::by_name(name).is_some())
            .map(Value::from),
        ValueKind::Texts | ValueKind::TextsOf(_) => texts(value),
        ValueKind::Floats { count, min, max } => floats(value, count, min, max).map(Value::from),
        ValueKind::Span { min, max } => floats(value, 2, min, max)
            .filter(|span| span[0] <= span[1])
            .map(Value::from),
        ValueKind::Integers { min, max } => {
            let list: Option<Vec<Value>> = value
                .as_array()?
                .iter()
                .map(|item| integer(item.get_ref(), min, max).map(Value::from))
                .collect();
            list.filter(|list| !list.is_empty()).map(Value::from)
        }
        // `tables` checks these.
        ValueKind::Tables(_) | ValueKind::Suites(_) => None,
    }
}

fn float(value: &DeValue<'_>) -> Option<f64> {
    match value {
        DeValue::Float(number) => number.as_str().parse().ok(),
        #[expect(
            clippy::cast_precision_loss,
            reason = "a whole number given for a real one; ranges are far below 2^53"
        )]
        DeValue::Integer(_) => integer(value, i64::MIN, i64::MAX).map(|whole| whole as f64),
        _ => None,
    }
}

/// `count` numbers, or one that stands for all.
fn floats(value: &DeValue<'_>, count: usize, min: f64, max: f64) -> Option<Vec<f64>> {
    let list: Vec<f64> = match value.as_array() {
        Some(list) => list.iter().map(|item| float(item.get_ref())).collect::<Option<_>>()?,
        None => vec![float(value)?; count],
    };
    (list.len() == count && list.iter().all(|number| (min..=max).contains(number))).then_some(list)
}

fn integer(value: &DeValue<'_>, min: i64, max: i64) -> Option<i64> {
    let whole = value.as_integer()?;
    let number = i64::from_str_radix(whole.as_str(), whole.radix()).ok()?;
    (min..=max).contains(&number).then_some(number)
}

fn texts(value: &DeValue<'_>) -> Option<Value> {
    let list: Option<Vec<&str>> = value.as_array()?.iter().map(|item| item.get_ref().as_str()).collect();
    list.map(Value::from)
}

fn fields(value: &DeValue<'_>) -> Option<Value> {
    if let Some(preset) = value.as_str() {
        let names: Vec<&str> = FieldPreset::by_name(preset)?
            .fields()
            .into_iter()
            .map(Field::name)
            .collect();
        return Some(Value::from(names));
    }
    let names: Option<Vec<&str>> = value.as_array()?.iter().map(|item| item.get_ref().as_str()).collect();
    let names = names?;
    let known = !names.is_empty() && names.iter().all(|name| Field::by_name(name).is_some());
    known.then(|| Value::from(names))
}
