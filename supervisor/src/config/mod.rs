//! Merges presets, files and `--set` into one validated configuration.

pub mod error;
pub mod keys;
pub mod layer;
pub mod rules;
pub mod span;
pub mod suites;
pub mod text_form;

use std::path::Path;

use ipc_schema::config::Config;
use serde_json::{Map, Value};

use crate::scenario::input_check::require_regular;
pub use error::ConfigError;
use layer::{LocatedValue, PresetChoice, SettingsLayer};

/// Embedded presets by name; the first is the default and holds every key that must have a value.
pub const PRESETS: [(&str, &str); 8] = [
    ("town", include_str!("../../../configs/town.toml")),
    ("paper", include_str!("../../../configs/paper.toml")),
    ("driving", include_str!("../../../configs/driving.toml")),
    ("lap", include_str!("../../../configs/lap.toml")),
    ("fusion", include_str!("../../../configs/fusion.toml")),
    ("camera", include_str!("../../../configs/camera.toml")),
    ("cooperation", include_str!("../../../configs/cooperation.toml")),
    ("messages", include_str!("../../../configs/messages.toml")),
];

/// Merged settings, each remembering where it was set.
#[derive(Debug, Clone)]
pub struct LayeredSettings(SettingsLayer);

impl LayeredSettings {
    /// The default preset.
    ///
    /// # Errors
    /// Never with the committed preset (a test reads it).
    pub fn defaults() -> Result<Self, ConfigError> {
        let (name, text) = PRESETS[0];
        layer::parse(&format!("preset {name}"), text).map(Self)
    }

    /// The settings whose configuration is `config`.
    ///
    /// # Errors
    /// Never with a validated configuration.
    pub fn of(config: &Config) -> Result<Self, ConfigError> {
        layer::parse("the run's configuration", &to_toml(config)?).map(Self)
    }

    /// Adds a preset by name; `None` if there is no such preset.
    pub fn with_preset(mut self, name: &str) -> Option<Result<Self, ConfigError>> {
        let (name, text) = PRESETS.iter().find(|(known, _)| *known == name)?;
        Some(layer::parse(&format!("preset {name}"), text).map(|layer| {
            self.0.extend(layer);
            self
        }))
    }

    /// Adds a user's TOML file, and before it the preset `preset`, or the one that the file names.
    ///
    /// # Errors
    /// The file is unreadable, there is no such preset, or as [`layer::parse`].
    pub fn with_file(self, path: &Path, preset: Option<&str>) -> Result<Self, ConfigError> {
        let name = path.display().to_string();
        let unreadable = |reason: String| ConfigError::File {
            path: name.clone(),
            message: format!("cannot be read: {reason}"),
            help: format!("give a .toml, a .sumocfg, or one of the presets: {}", preset_names()),
        };
        require_regular(path).map_err(unreadable)?;
        let text = std::fs::read_to_string(path).map_err(|error| unreadable(error.to_string()))?;
        let (named, layer) = layer::parse_file(&name, &text)?;
        let mut settings = match (preset, named) {
            (Some(preset), _) => self.with_named_preset(preset)?,
            (None, Some(named)) => self.with_choice(&named)?,
            (None, None) => self,
        };
        settings.0.extend(layer);
        Ok(settings)
    }

    /// Adds the preset `--preset`.
    ///
    /// # Errors
    /// There is no such preset.
    pub fn with_named_preset(self, name: &str) -> Result<Self, ConfigError> {
        self.with_preset(name).ok_or_else(|| ConfigError::File {
            path: format!("--preset {name}"),
            message: "there is no such preset".into(),
            help: format!("presets: {}", preset_names()),
        })?
    }

    fn with_choice(self, choice: &PresetChoice) -> Result<Self, ConfigError> {
        let name = choice.name.as_deref().unwrap_or_default();
        self.with_preset(name).ok_or_else(|| ConfigError::Conflict {
            message: format!("there is no preset {}", choice.place.text()),
            help: format!("presets: {}", preset_names()),
            place: choice.place.clone(),
        })?
    }

    /// Adds `--set` assignments, in order.
    ///
    /// # Errors
    /// As [`layer::parse_assignment`].
    pub fn with_assignments(mut self, assignments: &[String]) -> Result<Self, ConfigError> {
        for assignment in assignments {
            self.0.extend(layer::parse_assignment(assignment)?);
        }
        Ok(self)
    }

    /// Replaces a preset's value by that of a scenario, unless the user set the key.
    pub fn suggest(&mut self, path: &'static str, value: Value, source: &str) {
        if let Some(setting) = self.0.get_mut(path)
            && setting.place.source.name().starts_with("preset ")
        {
            let text = format!("{path} = {value}");
            let span = text.len() - value.to_string().len()..text.len();
            let place = span::SourceSpan {
                // An error shows this line, which no file has.
                source: std::sync::Arc::new(miette::NamedSource::new(format!("suggested by {source}"), text)),
                span,
            };
            *setting = LocatedValue {
                value,
                place,
                entries: Vec::new(),
            };
        }
    }

    /// True if the user set this key, in a file or by `--set`.
    #[must_use]
    pub fn is_set_by_user(&self, path: &str) -> bool {
        self.0
            .get(path)
            .is_some_and(|setting| !setting.place.source.name().starts_with("preset "))
    }

    /// True if the flag `path` is set.
    #[must_use]
    pub fn has_flag(&self, path: &str) -> bool {
        self.setting(path)
            .is_some_and(|setting| setting.value == Value::Bool(true))
    }

    /// The number that the key `path` has, if it is set.
    #[must_use]
    pub fn number(&self, path: &str) -> Option<f64> {
        self.setting(path).and_then(|setting| setting.value.as_f64())
    }

    /// The value of the key `path`; null if it is unset.
    #[must_use]
    pub fn value(&self, path: &str) -> Value {
        self.setting(path).map_or(Value::Null, |setting| setting.value.clone())
    }

    /// The text that the key `path` has, if it is set.
    #[must_use]
    pub fn text(&self, path: &str) -> Option<&str> {
        self.setting(path).and_then(|setting| setting.value.as_str())
    }

    /// True if the key `path` has this text.
    #[must_use]
    pub fn has_text(&self, path: &str, text: &str) -> bool {
        self.setting(path).is_some_and(|setting| setting.value == text)
    }

    fn setting(&self, path: &str) -> Option<&LocatedValue> {
        self.0.get(path)
    }

    /// The validated configuration.
    ///
    /// # Errors
    /// Two values contradict each other, or a rule between keys is broken.
    pub fn validate(&self) -> Result<Config, ConfigError> {
        let mut root = Map::new();
        for key in keys::KEYS {
            let value = self
                .setting(key.path)
                .map_or(Value::Null, |setting| setting.value.clone());
            let Some((table, name)) = key.path.split_once('.') else {
                continue;
            };
            let table = root.entry(table).or_insert_with(|| Value::Object(Map::new()));
            if let Value::Object(table) = table {
                table.insert(name.to_owned(), value);
            }
        }
        suites::complete(self, &mut root)?;
        let config: Config = serde_json::from_value(Value::Object(root)).map_err(|error| ConfigError::File {
            path: "configuration".into(),
            message: error.to_string(),
            help: "the key table and the configuration types differ: this is a defect of caraware, please report it"
                .into(),
        })?;
        rules::check(self, &config)?;
        Ok(config)
    }
}

/// Names of all presets, for messages.
#[must_use]
pub fn preset_names() -> String {
    PRESETS.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
}

/// The configuration as TOML, which can be used as CONFIG.
///
/// # Errors
/// A path in it is not UTF-8.
pub fn to_toml(config: &Config) -> Result<String, ConfigError> {
    toml::to_string_pretty(config).map_err(|error| unwritable(&error))
}

/// BLAKE3 of the configuration's canonical JSON, hexadecimal.
///
/// # Errors
/// As [`to_toml`].
pub fn hash(config: &Config) -> Result<String, ConfigError> {
    let text = serde_json::to_string(config).map_err(|error| unwritable(&error))?;
    Ok(blake3::hash(text.as_bytes()).to_hex().to_string())
}

fn unwritable(error: &dyn std::fmt::Display) -> ConfigError {
    ConfigError::File {
        path: "configuration".into(),
        message: format!("cannot be written: {error}"),
        help: "start caraware in a directory whose path is UTF-8".into(),
    }
}

#[cfg(test)]
mod tests;
