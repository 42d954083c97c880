//! The errors of a configuration, each with the place where it was made and the fix.

use miette::{Diagnostic, LabeledSpan, Severity, SourceCode};

use super::{
    keys::{self, ConfigKey},
    layer::PRESET_KEY,
    span::SourceSpan,
};

/// A configuration that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// Not TOML.
    #[error("{}: not valid TOML: {message}", place.line())]
    Syntax {
        /// What the parser says.
        message: String,
        /// Where.
        place: SourceSpan,
    },
    /// No such key.
    #[error("{}: unknown key `{path}`", place.line())]
    UnknownKey {
        /// The key as written.
        path: String,
        /// What was probably meant.
        nearest: Option<&'static str>,
        /// Where.
        place: SourceSpan,
    },
    /// A key by its former name.
    #[error("{}: `{path}` is renamed to `{renamed_to}`", place.line())]
    RenamedKey {
        /// The key as written.
        path: String,
        /// Its name now.
        renamed_to: &'static str,
        /// Where.
        place: SourceSpan,
    },
    /// Wrong type or out of range.
    #[error("{}: `{}` cannot be {}", place.line(), key.path, place.text())]
    Value {
        /// The key.
        key: &'static ConfigKey,
        /// Where.
        place: SourceSpan,
    },
    /// A text does not have the form of its key.
    #[error("{}: `{}`: {reason}", place.line(), key.path)]
    Text {
        /// The key.
        key: &'static ConfigKey,
        /// The text and its fault.
        reason: String,
        /// Where.
        place: SourceSpan,
    },
    /// Two values contradict each other.
    #[error("{}: {message}", place.line())]
    Conflict {
        /// Both keys with their values.
        message: String,
        /// What to change.
        help: String,
        /// Where one of them was set.
        place: SourceSpan,
    },
    /// `--set` without `=`.
    #[error("--set {assignment}: not of the form key=value")]
    Assignment {
        /// As given.
        assignment: String,
    },
    /// A file of the user cannot be used.
    #[error("{path}: {message}")]
    File {
        /// The file.
        path: String,
        /// What is wrong.
        message: String,
        /// What to do.
        help: String,
    },
}

impl ConfigError {
    fn place(&self) -> Option<&SourceSpan> {
        match self {
            Self::Syntax { place, .. }
            | Self::UnknownKey { place, .. }
            | Self::RenamedKey { place, .. }
            | Self::Value { place, .. }
            | Self::Text { place, .. }
            | Self::Conflict { place, .. } => Some(place),
            Self::Assignment { .. } | Self::File { .. } => None,
        }
    }

    fn advice(&self) -> String {
        match self {
            Self::Syntax { .. } => "see https://toml.io for the format".into(),
            Self::UnknownKey { path, .. } if path == PRESET_KEY => {
                "a .toml may name its preset above its first section; on the command line give --preset NAME".into()
            }
            Self::UnknownKey { path, .. } if path.ends_with(".preset") => {
                "`preset` stands above the first section of a file, where TOML has the keys without one".into()
            }
            Self::UnknownKey {
                nearest: Some(nearest), ..
            } => format!("did you mean `{nearest}`? All keys: configs/README.md"),
            Self::UnknownKey { nearest: None, .. } => "all keys are listed in configs/README.md".into(),
            Self::RenamedKey { renamed_to, .. } => {
                let meaning = keys::find(renamed_to).map_or("", |key| key.meaning);
                format!("write `{renamed_to}`. {meaning} All keys: configs/README.md")
            }
            Self::Value { key, .. } | Self::Text { key, .. } => {
                let unit = if key.unit.is_empty() {
                    String::new()
                } else {
                    format!(" in {}", key.unit)
                };
                format!("allowed: {}{unit}. {}", key.range(), key.meaning)
            }
            Self::Conflict { help, .. } | Self::File { help, .. } => help.clone(),
            Self::Assignment { .. } => "for example: --set run.seed=7".into(),
        }
    }
}

impl Diagnostic for ConfigError {
    fn severity(&self) -> Option<Severity> {
        Some(Severity::Error)
    }

    fn help<'a>(&'a self) -> Option<Box<dyn std::fmt::Display + 'a>> {
        Some(Box::new(self.advice()))
    }

    fn source_code(&self) -> Option<&dyn SourceCode> {
        self.place().map(|place| place as &dyn SourceCode)
    }

    fn labels(&self) -> Option<Box<dyn Iterator<Item = LabeledSpan> + '_>> {
        let place = self.place()?;
        Some(Box::new(std::iter::once(LabeledSpan::underline(place.label()))))
    }
}
