//! The place of a value in a text of settings, for messages that show the line.

use std::{ops::Range, sync::Arc};

use miette::NamedSource;

/// A text with its name.
pub type NamedText = Arc<NamedSource<String>>;

/// A part of a text.
#[derive(Debug, Clone)]
pub struct SourceSpan {
    /// The text.
    pub source: NamedText,
    /// Bytes of the part.
    pub span: Range<usize>,
}

impl SourceSpan {
    /// "file:line" of its first byte.
    #[must_use]
    pub fn line(&self) -> String {
        let text = self.source.inner();
        let line = text
            .get(..self.span.start)
            .map_or(1, |before| before.matches('\n').count() + 1);
        format!("{}:{line}", self.source.name())
    }

    /// The part as written.
    #[must_use]
    pub fn text(&self) -> &str {
        self.source.inner().get(self.span.clone()).unwrap_or_default()
    }
}
