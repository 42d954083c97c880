//! `caraware view` reports mistakes, and a viewer beside a run ends with the run without disturbing it.

use std::net::TcpListener;

use crate::common::{Workplace, text};

fn free_endpoint() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    format!("tcp/{}", listener.local_addr().unwrap())
}

#[test]
fn a_view_of_nothing_is_refused_with_the_fix() {
    let workplace = Workplace::new();
    let endpoint = free_endpoint();
    for (arguments, exit_code, parts) in [
        (vec!["view"], 2, ["no run is alive", "caraware train"]),
        (vec!["view", "town-7"], 2, ["no run named `town-7`", "alive: none"]),
        (
            vec!["view", "host:7447"],
            2,
            ["`host:7447` is not an endpoint", "tcp/host:7447"],
        ),
        (
            vec!["view", &endpoint, "--save", "unused.rrd"],
            1,
            ["nothing answers", "fanout.listen"],
        ),
    ] {
        let output = workplace.run(&arguments);
        let said = text(&output);
        assert_eq!(output.status.code(), Some(exit_code), "{arguments:?}: {said}");
        for part in parts {
            assert!(said.contains(part), "`{part}` is not in: {said}");
        }
        assert!(!said.contains("Traceback"), "{said}");
    }
}

#[test]
fn a_python_without_the_viewer_is_reported() {
    let workplace = Workplace::new();
    let bare = workplace.write("python", "#!/bin/sh\necho caraware_viewer rerun >&2\nexit 1\n");
    std::fs::set_permissions(&bare, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
    let output = workplace
        .command(&["view", "tcp/127.0.0.1:1"])
        .env("CARAWARE_PYTHON", &bare)
        .output()
        .unwrap();
    let said = text(&output);
    assert_eq!(output.status.code(), Some(3), "{said}");
    assert!(said.contains("pip install ./viewer"), "{said}");
}

/// A run that requires credentials requires them from its own viewer too, before a process starts.
#[test]
fn a_viewer_beside_a_guarded_run_must_authenticate() {
    let workplace = Workplace::new();
    let secret = |name: &str, text: &str| {
        let path = workplace.write(name, text);
        std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o600)).unwrap();
        path.display().to_string()
    };
    let users = format!("fanout.users={}", secret("users", "alice:a-secret\n"));
    let password = secret("password", "a-secret\n");
    let endpoint = format!("fanout.listen={}", free_endpoint());
    let mut arguments = vec!["simulate", "--name", "guarded"];
    for setting in [
        &users,
        &endpoint,
        "episode.ticks=60",
        "episode.training_episodes=1",
        "run.real_time_factor=1.0",
    ] {
        arguments.extend(["--set", setting]);
    }
    arguments.push("--viewer=web");
    let refused = workplace.run(&arguments);
    let said = text(&refused);
    assert_eq!(refused.status.code(), Some(2), "{said}");
    assert!(said.contains("--user NAME --password-file FILE"), "{said}");
    assert!(!workplace.path().join("runs/guarded").exists());
    arguments.extend(["--user", "alice", "--password-file", &password]);
    let said = text(&workplace.succeed(&arguments));
    assert!(said.contains("watching run guarded"), "{said}");
    workplace.assert_nothing_left();
}

/// The viewer serves a page that no browser opens, and ends with the run. The run's observations are the same as without it.
#[test]
fn a_viewer_beside_a_run_changes_nothing() {
    let workplace = Workplace::new();
    let endpoint = format!("fanout.listen={}", free_endpoint());
    let run = |name: &'static str, more: &[&str]| {
        let mut arguments = vec![
            "simulate",
            "--name",
            name,
            "--set",
            "episode.ticks=60",
            "--set",
            &endpoint,
        ];
        arguments.extend([
            "--set",
            "run.real_time_factor=1.0",
            "--set",
            "episode.training_episodes=1",
        ]);
        arguments.extend(more);
        let output = workplace.succeed(&arguments);
        (workplace.report(name)["observation_hash"].clone(), text(&output))
    };
    let (alone, _) = run("alone", &[]);
    let (watched, said) = run("watched", &["--viewer=web"]);
    assert_eq!(alone, watched);
    assert!(said.contains("watching run watched"), "{said}");
    assert!(said.contains("open http://127.0.0.1:"), "{said}");
    workplace.assert_nothing_left();
}
