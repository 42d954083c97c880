//! Access control: which client may connect, read and command, with the real fan-out and a viewer's side of zenoh.

#![allow(clippy::unwrap_used, reason = "a failed step fails the test")]

#[cfg(test)]
#[allow(dead_code, reason = "each test file uses its own part")]
mod harness;

use std::{
    io::{BufRead as _, BufReader, Write as _},
    os::unix::{fs::PermissionsExt as _, net::UnixListener},
    path::Path,
    sync::{Arc, Mutex},
    time::Duration,
};

use fanout::network::{
    endpoint,
    keys::{RunKeys, Topic},
};
use harness::{PATIENCE, Run, ask, publisher, send_world, until};
use ipc_schema::{
    config::Commander,
    control::{Command, Done, Refusal, RefusalKind, Reply},
    process::Process,
    run::Mode,
    services::Channel,
};
use zenoh::Wait;

fn users(run: &mut Run, text: &str) {
    let path = run.file.run_dir.join("users");
    std::fs::write(&path, text).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
    run.file.config.fanout.users = Some(path);
    run.file.write().unwrap();
}

/// A supervisor that accepts every command, and the commands that it received.
fn start_supervisor(run: &Run) -> Arc<Mutex<Vec<Command>>> {
    let received = Arc::new(Mutex::new(Vec::new()));
    let listener = UnixListener::bind(run.file.control_socket()).unwrap();
    let kept = Arc::clone(&received);
    std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let mut line = String::new();
            BufReader::new(&stream).read_line(&mut line).unwrap();
            let request: serde_json::Value = serde_json::from_str(&line).unwrap();
            let command = Command::from_json(request["control"]["request"].as_str().unwrap().as_bytes()).unwrap();
            kept.lock().unwrap().push(command);
            let done = Reply::Done(Done {
                tick: 3,
                episode: 0,
                message: "accepted".into(),
            });
            writeln!(&stream, "{}", serde_json::to_string(&done).unwrap()).unwrap();
        }
    });
    received
}

/// One attempt to connect, with `more` in zenoh's configuration.
fn connect(run: &Run, more: &str) -> zenoh::Result<zenoh::Session> {
    let config = zenoh::Config::from_json5(&format!(
        r#"{{ mode: "client", connect: {{ endpoints: ["tcp/127.0.0.1:{}"], timeout_ms: 0 }},
             scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }}, {more} }}"#,
        run.port
    ))?;
    endpoint::open(config)
}

/// One attempt to connect as `user`.
fn connect_as(run: &Run, user: &str, password: &str) -> zenoh::Result<zenoh::Session> {
    connect(
        run,
        &format!(r#"transport: {{ auth: {{ usrpwd: {{ user: "{user}", password: "{password}" }} }} }}"#),
    )
}

/// A session that must be granted, tried again as long as a busy machine lets the handshake time out.
fn until_connected(mut connect: impl FnMut() -> zenoh::Result<zenoh::Session>) -> zenoh::Session {
    let mut session = None;
    until("a connection", || {
        session = connect().ok();
        session.is_some()
    });
    session.unwrap()
}

/// Sends a command; `None` if no answer arrives within `wait`.
fn command(
    run: &Run,
    session: &zenoh::Session,
    payload: impl Into<zenoh::bytes::ZBytes>,
    wait: Duration,
) -> Option<Reply> {
    let key = RunKeys::new(&run.file.name, 0).control();
    let replies = session.get(key).payload(payload).timeout(wait).wait().unwrap();
    let reply = replies.recv().ok()?;
    let bytes = reply.result().ok()?.payload().to_bytes().into_owned();
    Some(serde_json::from_slice(&bytes).unwrap())
}

/// Waits for the run's liveliness token: the fan-out takes commands from then on, but not yet when the port opens.
fn until_alive(run: &Run, session: &zenoh::Session) {
    let key = RunKeys::new(&run.file.name, 0).alive();
    until("the liveliness token", || {
        let tokens = session.liveliness().get(&key).wait().unwrap();
        tokens.recv().is_ok_and(|token| token.result().is_ok())
    });
}

/// Starts the fan-out, and waits until it listens. It answers queries somewhat later: see [`until_alive`].
fn start_listening(run: &Run) -> harness::Fanout {
    let fanout = run.start_fanout();
    until("an open port", || {
        std::net::TcpStream::connect(("127.0.0.1", run.port)).is_ok()
    });
    fanout
}

/// Longest wait for an answer that must come.
const ANSWER_LIMIT: Duration = PATIENCE;
/// Wait for an answer that must not come: access control drops the query, and nothing else reports that.
const SILENCE: Duration = Duration::from_millis(700);

/// Only clients with a right name and password may connect. Each of them may read, and the commander may command.
#[test]
fn users_read_and_commanders_command() {
    let mut run = Run::new("guarded", Mode::Simulate);
    run.file.config.fanout.commanders = vec![Commander::Named("carol".into())];
    users(&mut run, "alice:secret\ncarol:other\n");
    let received = start_supervisor(&run);
    let _fanout = start_listening(&run);
    for (user, password) in [("alice", "wrong"), ("mallory", "secret"), ("carol", "secret")] {
        assert!(connect_as(&run, user, password).is_err(), "{user} {password}");
    }
    assert!(connect(&run, "").is_err());

    let alice = until_connected(|| connect_as(&run, "alice", "secret"));
    until_alive(&run, &alice);
    let (sim, worlds) = publisher(&run, Channel::World);
    until("attendance", || {
        sim.board_of(Process::Fanout).unwrap().progress().attached == 1
    });
    let frames = harness::watch(&alice, run.key(Topic::World));
    // Only a new tick is published, and the first one may be published before the subscription exists.
    let mut tick = 0..;
    until("a subscription", || {
        send_world(&sim, &worlds, tick.next().unwrap(), 0, 3);
        frames.try_recv().unwrap().is_some()
    });
    assert!(ask(&alice, &run.key(Topic::Map)).is_some());
    let request = Command::Pause {}.to_json().unwrap();
    assert_eq!(command(&run, &alice, request.clone(), SILENCE), None);
    assert_eq!(*received.lock().unwrap(), []);

    let carol = until_connected(|| connect_as(&run, "carol", "other"));
    assert!(ask(&carol, &run.key(Topic::Map)).is_some());
    let reply = command(&run, &carol, request, ANSWER_LIMIT);
    assert!(matches!(reply, Some(Reply::Done(Done { tick: 3, .. }))), "{reply:?}");
    assert_eq!(*received.lock().unwrap(), [Command::Pause {}]);
}

/// What a client writes reaches neither another client nor the answers to queries.
#[test]
fn no_client_may_write() {
    let run = Run::new("forged", Mode::Simulate);
    let _fanout = start_listening(&run);
    let [forger, reader] = [(), ()].map(|()| until_connected(|| connect(&run, "")));
    until_alive(&run, &reader);
    let key = run.key(Topic::Map);
    let honest = ask(&reader, &key).unwrap();
    let seen = harness::watch(&reader, "caraware/**".into());
    for key in [run.key(Topic::World), run.key(Topic::Map), run.alive_key()] {
        forger.put(&key, "forged").wait().unwrap();
        forger.delete(&key).wait().unwrap();
    }
    let _forged = forger
        .declare_queryable(&key)
        .callback(|query| query.reply(query.key_expr().clone(), "forged").wait().unwrap())
        .wait()
        .unwrap();
    assert_eq!(ask(&reader, &key).unwrap(), honest);
    // Access control has dropped all of it once it is counted.
    until("the count of forged samples", || {
        let status = ask(&reader, &run.key(Topic::Status)).unwrap_or_default();
        let status: serde_json::Value = serde_json::from_slice(&status).unwrap_or_default();
        status["fanout"]["refused_samples"]
            .as_u64()
            .is_some_and(|count| count >= 6)
    });
    while let Some(sample) = seen.try_recv().unwrap() {
        assert_ne!(sample.payload().to_bytes().as_ref(), b"forged", "{}", sample.key_expr());
    }
}

/// Reading is not writing: neither a subscription nor a query counts as a sample.
#[test]
fn what_a_client_reads_is_not_counted_as_written() {
    let run = Run::new("reader", Mode::Simulate);
    let _fanout = start_listening(&run);
    let reader = until_connected(|| connect(&run, ""));
    until_alive(&run, &reader);
    let topics = [
        Topic::World,
        Topic::Vehicles,
        Topic::Observation,
        Topic::Event,
        Topic::Status,
    ];
    let _seen = topics.map(|topic| harness::watch(&reader, run.key(topic)));
    let _all = harness::watch(&reader, "caraware/**".into());
    for _ in 0..3 {
        for topic in topics {
            let _ = ask(&reader, &run.key(topic));
        }
    }
    // The count of a status is newer than all that was read before a sample that is denied.
    let writer = until_connected(|| connect(&run, ""));
    writer.put(run.key(Topic::World), "forged").wait().unwrap();
    let counted = || {
        let status = ask(&reader, &run.key(Topic::Status)).unwrap_or_default();
        let status: serde_json::Value = serde_json::from_slice(&status).unwrap_or_default();
        status["fanout"]["refused_samples"].as_u64()
    };
    until("the count of the one sample", || {
        counted().is_some_and(|count| count > 0)
    });
    assert_eq!(counted(), Some(1));
}

/// Without passwords and certificates, a run is shown to its own user and to root alone, also on loopback.
#[test]
fn another_user_of_the_machine_sees_nothing() {
    if !rustix::process::getuid().is_root() {
        // Only root can act as another user.
        return;
    }
    let mut run = Run::new("private", Mode::Simulate);
    // Also with the right to command for every client.
    run.file.config.fanout.commanders = vec![Commander::EveryClient];
    run.file.write().unwrap();
    let _fanout = start_listening(&run);
    let own = until_connected(|| connect(&run, ""));
    until_alive(&run, &own);

    let dir = tempfile::tempdir().unwrap();
    std::fs::set_permissions(dir.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
    let program = dir.path().join("fanout-watch");
    std::fs::copy(env!("CARGO_BIN_EXE_fanout-watch"), &program).unwrap();
    let endpoint = format!("tcp/127.0.0.1:{}", run.port);
    let watch = |user: &str| {
        let mut command = std::process::Command::new("setpriv");
        command.args([&format!("--reuid={user}"), &format!("--regid={user}"), "--clear-groups"]);
        command
            .arg(&program)
            .args([&endpoint, &run.file.name, "--seconds", "2"]);
        command.current_dir("/").output().unwrap()
    };
    let refused = || {
        let status = ask(&own, &run.key(Topic::Status)).unwrap_or_default();
        let status: serde_json::Value = serde_json::from_slice(&status).unwrap_or_default();
        status["fanout"]["refused_connections"].as_u64()
    };
    let received = |output: &std::process::Output| {
        let line = output
            .stdout
            .trim_ascii_end()
            .rsplit(|byte| *byte == b'\n')
            .next()
            .unwrap();
        let counts: serde_json::Value = serde_json::from_slice(line).unwrap_or_default();
        counts["status"]["received"].as_u64()
    };
    let seen = watch("0");
    assert!(received(&seen).is_some_and(|count| count > 0), "{seen:?}");
    until("a status", || refused() == Some(0));
    let unseen = watch("65534");
    assert!(!unseen.status.success() && unseen.stdout.is_empty(), "{unseen:?}");
    until("a refused connection in the status", || {
        refused().is_some_and(|count| count > 0)
    });
    assert!(ask(&own, &run.key(Topic::Map)).is_some());
}

/// By default no client may command, not even one on this machine.
#[test]
fn without_commanders_no_client_may_command() {
    let run = Run::new("closed", Mode::Simulate);
    let received = start_supervisor(&run);
    let _fanout = start_listening(&run);
    let viewer = until_connected(|| connect(&run, ""));
    until_alive(&run, &viewer);
    assert!(ask(&viewer, &run.key(Topic::Map)).is_some());
    assert_eq!(
        command(&run, &viewer, Command::Reset {}.to_json().unwrap(), SILENCE),
        None
    );
    assert_eq!(*received.lock().unwrap(), []);
}

/// Random bytes, too many bytes and another version get typed refusals, and never reach the supervisor.
#[test]
fn garbage_commands_are_refused_and_counted() {
    let mut run = Run::new("pestered", Mode::Simulate);
    run.file.config.fanout.commanders = vec![Commander::EveryClient];
    run.file.write().unwrap();
    let received = start_supervisor(&run);
    let _fanout = start_listening(&run);
    let viewer = until_connected(|| connect(&run, ""));
    until_alive(&run, &viewer);
    let kind = |bytes: Vec<u8>| match command(&run, &viewer, bytes, ANSWER_LIMIT) {
        Some(Reply::Refused(Refusal { kind, .. })) => kind,
        reply => panic!("{reply:?}"),
    };
    let pause = Command::Pause {}.to_json().unwrap();
    let mut state = 1_u64;
    for length in [0, 1, 72, 500, 4096, 4097, 1_000_000] {
        let garbage = std::iter::repeat_with(|| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 56) as u8
        });
        assert_eq!(kind(garbage.take(length).collect()), RefusalKind::Malformed, "{length}");
    }
    let other = pause.replace("schema_version\":", "schema_version\":9").into_bytes();
    assert_eq!(kind(other), RefusalKind::Schema);
    assert_eq!(*received.lock().unwrap(), []);
    let reply = command(&run, &viewer, pause, ANSWER_LIMIT);
    assert!(matches!(reply, Some(Reply::Done(_))), "{reply:?}");
    until("a count of eight", || {
        let status = ask(&viewer, &run.key(Topic::Status)).unwrap_or_default();
        let status: serde_json::Value = serde_json::from_slice(&status).unwrap_or_default();
        status["fanout"]["refused_commands"] == 8
    });
}

/// TLS with certificates on both sides, made by the lines of docs/remote.md: commanders are named by their common names.
#[test]
fn certificates_grant_access() {
    let mut run = Run::new("encrypted", Mode::Simulate);
    let pki = run.file.run_dir.join("pki");
    make_certificates(&pki);
    let file = |name: &str| pki.join(name).display().to_string();
    let fanout = &mut run.file.config.fanout;
    fanout.listen = format!("tls/127.0.0.1:{}", run.port).parse().unwrap();
    (fanout.tls_certificate, fanout.tls_private_key) = (Some(pki.join("server.pem")), Some(pki.join("server.key")));
    fanout.tls_client_ca = Some(pki.join("ca.pem"));
    fanout.commanders = vec![Commander::Named("carol".into())];
    run.file.write().unwrap();
    let received = start_supervisor(&run);
    let _fanout = start_listening(&run);
    let connect_tls = |tls: &str| {
        let config = zenoh::Config::from_json5(&format!(
            r#"{{ mode: "client", connect: {{ endpoints: ["tls/127.0.0.1:{}"], timeout_ms: 0 }},
                 scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }},
                 transport: {{ link: {{ tls: {{ {tls} }} }} }} }}"#,
            run.port
        ));
        endpoint::open(config.unwrap())
    };
    let with = |name: &str| {
        format!(
            r#"root_ca_certificate: "{}", enable_mtls: true, connect_certificate: "{}", connect_private_key: "{}""#,
            file("ca.pem"),
            file(&format!("{name}.pem")),
            file(&format!("{name}.key"))
        )
    };
    let may_read = |session: zenoh::Result<zenoh::Session>| {
        session.is_ok_and(|session| {
            let replies = session.get(run.key(Topic::Map)).timeout(SILENCE).wait().unwrap();
            replies.recv().is_ok_and(|reply| reply.result().is_ok())
        })
    };
    assert!(!may_read(connect(&run, "")), "without TLS");
    assert!(
        !may_read(connect_tls(&format!(r#"root_ca_certificate: "{}""#, file("ca.pem")))),
        "without a certificate"
    );
    let request = Command::Reset {}.to_json().unwrap();
    let alice = until_connected(|| connect_tls(&with("alice")));
    until_alive(&run, &alice);
    assert!(ask(&alice, &run.key(Topic::Map)).is_some());
    assert_eq!(command(&run, &alice, request.clone(), SILENCE), None);
    let carol = until_connected(|| connect_tls(&with("carol")));
    let reply = command(&run, &carol, request, ANSWER_LIMIT);
    assert!(matches!(reply, Some(Reply::Done(_))), "{reply:?}");
    assert_eq!(*received.lock().unwrap(), [Command::Reset {}]);
}

/// Runs the shell lines for certificates of docs/remote.md, with this machine's name.
fn make_certificates(directory: &Path) {
    let page = include_str!("../../docs/remote.md");
    let lines = page
        .split("```sh certificates\n")
        .nth(1)
        .and_then(|rest| rest.split("```").next())
        .unwrap();
    let script = lines
        .replace("lab.example.org", "localhost")
        .replace("192.0.2.7", "127.0.0.1");
    std::fs::create_dir(directory).unwrap();
    let output = std::process::Command::new("bash")
        .args(["-euc", &script])
        .current_dir(directory)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
