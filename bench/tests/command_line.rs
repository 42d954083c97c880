//! The command line of `caraware-bench`, which `caraware bench` forwards.

#![allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]

use std::process::Command;

fn answer(arguments: &[&str]) -> (Option<i32>, String) {
    let program = env!("CARGO_BIN_EXE_caraware-bench");
    let output = Command::new(program).args(arguments).output().unwrap();
    let text = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8(text).unwrap())
}

#[test]
fn the_help_shows_the_command_and_every_part() {
    let (code, text) = answer(&["--help"]);
    assert_eq!(code, Some(0), "{text}");
    assert!(text.contains("Usage: caraware bench [OPTIONS] <PART>"), "{text}");
    for part in [
        "lidar", "envs", "fanout", "ipc", "trainer", "overhead", "scale", "peers", "all",
    ] {
        assert!(text.contains(&format!("- {part}:")), "{part}: {text}");
    }
}

#[test]
fn an_unknown_part_is_refused_as_wrong_usage() {
    let (code, text) = answer(&["soup"]);
    assert_eq!(code, Some(2), "{text}");
    assert!(text.contains("possible values: lidar"), "{text}");
}
