//! Lines on standard output.

use std::{fmt, io::Write as _};

/// Prints a line. A reader that has closed the pipe (`caraware ps | head -1`) has what it wanted: that is no error.
pub fn line(text: fmt::Arguments<'_>) {
    let written = writeln!(std::io::stdout().lock(), "{text}");
    if let Err(error) = written
        && error.kind() != std::io::ErrorKind::BrokenPipe
    {
        tracing::warn!(%error, "cannot print");
    }
}

/// Prints a line as `println!` does, and does not panic where nothing reads it.
#[macro_export]
macro_rules! say {
    ($($part:tt)*) => {
        $crate::output::line(format_args!($($part)*))
    };
}
