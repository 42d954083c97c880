//! The source tree compared with its own rules: words, names, dependencies, documentation.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

mod documentation;
mod layering;
mod type_names;
mod words;
