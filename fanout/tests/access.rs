//! Who is let in, who may read and who may command: the real fan-out, the real viewer's side of zenoh.

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

use fanout::keys::{Keys, Topic};
use harness::{Run, ask, publisher, send_world, until};
use ipc_schema::{
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
    run.file.config.fanout.users = path.to_string_lossy().into_owned();
    run.file.write().unwrap();
}

/// A supervisor that says yes to everything, and what it was asked.
fn supervisor(run: &Run) -> Arc<Mutex<Vec<Command>>> {
    let asked = Arc::new(Mutex::new(Vec::new()));
    let listener = UnixListener::bind(run.file.control_socket()).unwrap();
    let kept = Arc::clone(&asked);
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
                message: "so be it".into(),
            });
            writeln!(&stream, "{}", serde_json::to_string(&done).unwrap()).unwrap();
        }
    });
    asked
}

fn connect(run: &Run, more: &str) -> zenoh::Result<zenoh::Session> {
    let config = zenoh::Config::from_json5(&format!(
        r#"{{ mode: "client", connect: {{ endpoints: ["tcp/127.0.0.1:{}"], timeout_ms: 0 }},
             scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }}, {more} }}"#,
        run.port
    ))?;
    zenoh::open(config).wait()
}

fn as_user(run: &Run, user: &str, password: &str) -> zenoh::Result<zenoh::Session> {
    connect(
        run,
        &format!(r#"transport: {{ auth: {{ usrpwd: {{ user: "{user}", password: "{password}" }} }} }}"#),
    )
}

fn command(
    run: &Run,
    session: &zenoh::Session,
    payload: impl Into<zenoh::bytes::ZBytes>,
    wait: Duration,
) -> Option<Reply> {
    let key = Keys::new(&run.file.name, 0).control();
    let replies = session.get(key).payload(payload).timeout(wait).wait().unwrap();
    let reply = replies.recv().ok()?;
    let bytes = reply.result().ok()?.payload().to_bytes().into_owned();
    Some(serde_json::from_slice(&bytes).unwrap())
}

/// Waits until the run says that it is there: commands are taken then, but not yet when the port opens.
fn until_alive(run: &Run, session: &zenoh::Session) {
    let key = Keys::new(&run.file.name, 0).alive();
    until("a run that is there", || {
        let tokens = session.liveliness().get(&key).wait().unwrap();
        tokens.recv().is_ok_and(|token| token.result().is_ok())
    });
}

fn listening(run: &Run) -> harness::Fanout {
    let fanout = run.start_fanout();
    until("an open port", || {
        std::net::TcpStream::connect(("127.0.0.1", run.port)).is_ok()
    });
    fanout
}

const PAUSE: Duration = Duration::from_secs(10);
const SOON: Duration = Duration::from_millis(700);

/// Without the right name and password nobody gets in; with them everybody reads, and one commands.
#[test]
fn users_read_and_commanders_command() {
    let mut run = Run::new("guarded", Mode::Simulate);
    run.file.config.fanout.commanders = vec!["carol".into()];
    users(&mut run, "alice:secret\ncarol:other\n");
    let asked = supervisor(&run);
    let _fanout = listening(&run);
    for (user, password) in [("alice", "wrong"), ("mallory", "secret"), ("carol", "secret")] {
        assert!(as_user(&run, user, password).is_err(), "{user} {password}");
    }
    assert!(connect(&run, "").is_err());

    let alice = as_user(&run, "alice", "secret").unwrap();
    let (sim, worlds) = publisher(&run, Channel::World);
    until("attendance", || {
        sim.board_of(Process::Fanout).unwrap().progress().attached == 1
    });
    let frames = harness::watch(&alice, run.key(Topic::World));
    // Only a fresh tick goes out, and the first may be gone before the subscription is there.
    let mut tick = 0..;
    until("a subscription", || {
        send_world(&sim, &worlds, tick.next().unwrap(), 0, 3);
        frames.try_recv().unwrap().is_some()
    });
    assert!(ask(&alice, &run.key(Topic::Map)).is_some());
    let request = Command::Pause {}.to_json();
    assert_eq!(command(&run, &alice, request.clone(), SOON), None);
    assert_eq!(*asked.lock().unwrap(), []);

    let carol = as_user(&run, "carol", "other").unwrap();
    assert!(ask(&carol, &run.key(Topic::Map)).is_some());
    let reply = command(&run, &carol, request, PAUSE);
    assert!(matches!(reply, Some(Reply::Done(Done { tick: 3, .. }))), "{reply:?}");
    assert_eq!(*asked.lock().unwrap(), [Command::Pause {}]);
}

/// What a reader writes reaches neither another reader nor the queries that answer with the newest state.
#[test]
fn nobody_writes() {
    let run = Run::new("forged", Mode::Simulate);
    let _fanout = listening(&run);
    let (forger, reader) = (connect(&run, "").unwrap(), connect(&run, "").unwrap());
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
    std::thread::park_timeout(SOON);
    while let Some(sample) = seen.try_recv().unwrap() {
        assert_ne!(sample.payload().to_bytes().as_ref(), b"forged", "{}", sample.key_expr());
    }
}

/// By default nobody commands from the network, not even from this machine.
#[test]
fn without_commanders_nobody_commands() {
    let run = Run::new("closed", Mode::Simulate);
    let asked = supervisor(&run);
    let _fanout = listening(&run);
    let viewer = connect(&run, "").unwrap();
    assert!(ask(&viewer, &run.key(Topic::Map)).is_some());
    assert_eq!(command(&run, &viewer, Command::Reset {}.to_json(), SOON), None);
    assert_eq!(*asked.lock().unwrap(), []);
}

/// Random bytes, too many bytes, another version: typed refusals, which never get as far as the supervisor.
#[test]
fn garbage_commands_are_refused_and_counted() {
    let mut run = Run::new("pestered", Mode::Simulate);
    run.file.config.fanout.commanders = vec!["*".into()];
    run.file.write().unwrap();
    let asked = supervisor(&run);
    let _fanout = listening(&run);
    let viewer = connect(&run, "").unwrap();
    until_alive(&run, &viewer);
    let kind = |bytes: Vec<u8>| match command(&run, &viewer, bytes, PAUSE) {
        Some(Reply::Refused(Refusal { kind, .. })) => kind,
        reply => panic!("{reply:?}"),
    };
    let pause = Command::Pause {}.to_json();
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
    assert_eq!(*asked.lock().unwrap(), []);
    let reply = command(&run, &viewer, pause, PAUSE);
    assert!(matches!(reply, Some(Reply::Done(_))), "{reply:?}");
    until("a count of eight", || {
        let status = ask(&viewer, &run.key(Topic::Status)).unwrap_or_default();
        let status: serde_json::Value = serde_json::from_slice(&status).unwrap_or_default();
        status["fanout"]["refused_commands"] == 8
    });
}

/// TLS with certificates on both sides, made by the lines of docs/remote.md: the common name says who may command.
#[test]
fn certificates_open_the_door() {
    let mut run = Run::new("encrypted", Mode::Simulate);
    let pki = run.file.run_dir.join("pki");
    make_certificates(&pki);
    let file = |name: &str| pki.join(name).to_string_lossy().into_owned();
    let fanout = &mut run.file.config.fanout;
    fanout.listen = format!("tls/127.0.0.1:{}", run.port);
    (fanout.tls_certificate, fanout.tls_private_key) = (file("server.pem"), file("server.key"));
    fanout.tls_client_ca = file("ca.pem");
    fanout.commanders = vec!["carol".into()];
    run.file.write().unwrap();
    let asked = supervisor(&run);
    let _fanout = listening(&run);
    let enter = |tls: &str| {
        let config = zenoh::Config::from_json5(&format!(
            r#"{{ mode: "client", connect: {{ endpoints: ["tls/127.0.0.1:{}"], timeout_ms: 0 }},
                 scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }},
                 transport: {{ link: {{ tls: {{ {tls} }} }} }} }}"#,
            run.port
        ));
        zenoh::open(config.unwrap()).wait()
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
            let replies = session.get(run.key(Topic::Map)).timeout(SOON).wait().unwrap();
            replies.recv().is_ok_and(|reply| reply.result().is_ok())
        })
    };
    assert!(!may_read(connect(&run, "")), "in clear");
    assert!(
        !may_read(enter(&format!(r#"root_ca_certificate: "{}""#, file("ca.pem")))),
        "without a certificate"
    );
    let request = Command::Reset {}.to_json();
    let alice = enter(&with("alice")).unwrap();
    assert!(ask(&alice, &run.key(Topic::Map)).is_some());
    assert_eq!(command(&run, &alice, request.clone(), SOON), None);
    let carol = enter(&with("carol")).unwrap();
    let reply = command(&run, &carol, request, PAUSE);
    assert!(matches!(reply, Some(Reply::Done(_))), "{reply:?}");
    assert_eq!(*asked.lock().unwrap(), [Command::Reset {}]);
}

/// Runs the shell lines between the marks of docs/remote.md, with this machine's name.
fn make_certificates(directory: &Path) {
    let page = include_str!("../../docs/remote.md");
    let lines = page
        .split("```bash certificates\n")
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
