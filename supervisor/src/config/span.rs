//! The place of a value in a text of settings, for messages that show the line.

use std::{borrow::Cow, ops::Range, sync::Arc};

use miette::{MietteError, MietteSpanContents, NamedSource, SourceCode, SpanContents};

/// Longest line that a message shows whole, bytes.
const WHOLE_LINE: usize = 200;
/// Bytes of a longer line that are shown: before its part, and from there on.
const AROUND: (usize, usize) = (60, 120);

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

    /// The part as written; of a long one its beginning.
    #[must_use]
    pub fn text(&self) -> Cow<'_, str> {
        let text = |part: Range<usize>| self.source.inner().get(part).unwrap_or_default();
        let shown = self.label();
        if shown.end < self.span.end {
            Cow::Owned(format!("{}…", text(shown)))
        } else {
            Cow::Borrowed(text(shown))
        }
    }

    /// What is underlined: of a long part its beginning.
    #[must_use]
    pub fn label(&self) -> Range<usize> {
        self.span.start..self.span.end.min(self.char_boundary(self.span.start + AROUND.1))
    }

    /// `at`, or the next byte after it with which a character begins.
    fn char_boundary(&self, at: usize) -> usize {
        let text = self.source.inner();
        (at..text.len())
            .find(|at| text.is_char_boundary(*at))
            .unwrap_or(text.len())
    }
}

/// The lines around the part; of a line that is too long to be read, what is around the part alone.
impl SourceCode for SourceSpan {
    fn read_span<'a>(
        &'a self,
        span: &miette::SourceSpan,
        lines_before: usize,
        lines_after: usize,
    ) -> Result<Box<dyn SpanContents<'a> + 'a>, MietteError> {
        let lines = self.source.read_span(span, lines_before, lines_after)?;
        if lines
            .data()
            .split(|byte| *byte == b'\n')
            .all(|line| line.len() <= WHOLE_LINE)
        {
            return Ok(lines);
        }
        let text = self.source.inner();
        let (before, after) = text.split_at(self.char_boundary(span.offset()));
        let first = before.rfind('\n').map_or(0, |end| end + 1);
        let last = after.find('\n').map_or(text.len(), |length| before.len() + length);
        let begin = self.char_boundary(span.offset().saturating_sub(AROUND.0).max(first));
        let end = self.char_boundary((span.offset() + AROUND.1).min(last));
        let contents = MietteSpanContents::new_named(
            self.source.name().to_owned(),
            text.get(begin..end).unwrap_or_default().as_bytes(),
            (begin, end - begin).into(),
            before.matches('\n').count(),
            begin - first,
            1,
        );
        Ok(Box::new(contents.with_language("toml")))
    }
}
