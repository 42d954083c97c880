//! The default preset, as the `caraware` command resolves it: for tests, benchmarks and examples.

use ipc_schema::config::Config;

/// The default preset.
#[allow(clippy::unwrap_used, reason = "a test keeps the committed file readable")]
pub fn town() -> Config {
    Config::from_json(include_str!("../../../ipc-schema/tests/town.json")).unwrap()
}
