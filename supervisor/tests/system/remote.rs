//! Viewers on another host: a second network namespace, joined to that of the run by one virtual cable.
//!
//! These tests need `unshare`, `nsenter` and `ip`, and the right to make namespaces (root, or user namespaces). Without them they
//! fail with a message.

use std::{
    io::{BufRead as _, BufReader},
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    process::{Child, Command, Output, Stdio},
    time::{Duration, Instant},
};

use crate::common::{Workplace, text};
use ipc_schema::{ports::BoardReader, process::Process, run::RunFile, services};

/// Address of the run's machine on the cable.
const LAB: &str = "10.77.0.1";

/// Two machines: the lab, which has the runs, and the laptop.
struct Machines {
    lab: Child,
    laptop: u32,
    has_user_namespace: bool,
}

impl Drop for Machines {
    fn drop(&mut self) {
        let _ = self.lab.kill();
        let _ = self.lab.wait();
    }
}

const CABLE: &str = r#"
    ip link set lo up
    unshare --net setpriv --pdeathsig KILL sleep infinity &
    laptop=$!
    until [ "$(readlink /proc/$laptop/ns/net)" != "$(readlink /proc/$$/ns/net)" ]; do :; done
    ip link add lab type veth peer name laptop netns "$laptop"
    ip address add 10.77.0.1/24 dev lab
    ip link set lab up
    nsenter -t "$laptop" -n sh -euc 'ip link set lo up; ip address add 10.77.0.2/24 dev laptop; ip link set laptop up'
    echo "$laptop"
    wait
"#;

impl Machines {
    fn new() -> Self {
        let attempts = [(false, &["--net"][..]), (true, &["--user", "--map-root-user", "--net"])];
        let mut reasons = String::new();
        for (has_user_namespace, arguments) in attempts {
            let mut lab = Command::new("unshare")
                .args(arguments)
                .args(["--kill-child", "bash", "-euc", CABLE])
                .stdout(Stdio::piped())
                .stderr(Stdio::piped())
                .spawn()
                .unwrap_or_else(|error| panic!("these tests need `unshare` of util-linux: {error}"));
            let mut line = String::new();
            BufReader::new(lab.stdout.take().unwrap()).read_line(&mut line).unwrap();
            if let Ok(laptop) = line.trim().parse() {
                return Self {
                    lab,
                    laptop,
                    has_user_namespace,
                };
            }
            let output = lab.wait_with_output().unwrap();
            reasons.push_str(&format!("unshare {arguments:?}: {}\n", text(&output)));
        }
        panic!(
            "no network namespaces on this machine: run as root, or allow user namespaces, and install iproute2\n{reasons}"
        );
    }

    /// A command in the namespaces of a process. `nsenter` becomes the program, so both have one process id.
    fn inside(&self, pid: u32, program: &Path) -> Command {
        let mut command = Command::new("nsenter");
        command.args(["--target", &pid.to_string()]);
        if self.has_user_namespace {
            command.args(["--user", "--preserve-credentials"]);
        }
        command.arg("--net").arg(program);
        command
    }

    /// `unshare --kill-child` forks: the lab is its child.
    fn lab_pid(&self) -> u32 {
        let children = format!("/proc/{0}/task/{0}/children", self.lab.id());
        let children = std::fs::read_to_string(children).unwrap();
        children.split_whitespace().next().unwrap().parse().unwrap()
    }

    fn on_the_lab(&self, workplace: &Workplace, arguments: &[&str]) -> Command {
        let mut command = self.inside(self.lab_pid(), Path::new(env!("CARGO_BIN_EXE_caraware")));
        command
            .args(arguments)
            .current_dir(workplace.path())
            .env("CARAWARE_RUNTIME_DIR", workplace.path().join("run"))
            .env("NO_COLOR", "1");
        command
    }

    fn on_the_laptop(&self, arguments: &[&str]) -> Command {
        let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
        let mut command = self.inside(self.laptop, &root.join(".venv/bin/python"));
        command
            .args(arguments)
            .env("PYTHONPATH", root.join("viewer/src"))
            .env("RUST_LOG", "off");
        command
    }
}

/// A live run on the lab.
struct Run {
    child: Child,
    directory: PathBuf,
}

impl Run {
    fn start(machines: &Machines, workplace: &Workplace, name: &str, mode: &str, settings: &[String]) -> Self {
        let mut arguments = vec![mode, "town", "--name", name, "--set", "run.real_time_factor=4"];
        // An episode that outlasts the test: its number shows whether a reader has reset it.
        arguments.extend(["--set", "episode.ticks=100000"]);
        arguments.extend(settings.iter().flat_map(|setting| ["--set", setting.as_str()]));
        let child = machines
            .on_the_lab(workplace, &arguments)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let directory = workplace.path().join("runs").join(name);
        Self { child, directory }
    }

    fn board(&mut self, process: Process) -> BoardReader {
        let run_file = self.directory.join("run.json");
        crate::common::until(&mut self.child, "a board", || {
            let file = RunFile::read(&run_file).ok()?;
            let node = services::node(&file.shared_memory).ok()?;
            let board = BoardReader::open(&node, &file, 0, process).ok()?;
            (board.health().ticks > 0).then_some(board)
        })
    }

    fn log(&self, process: &str) -> String {
        std::fs::read_to_string(self.directory.join("logs").join(format!("{process}.log"))).unwrap_or_default()
    }

    fn stop(mut self) {
        let pid = rustix::process::Pid::from_child(&self.child);
        rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
        assert_eq!(self.child.wait().unwrap().code(), Some(130));
    }
}

/// Makes certificates with the commands of docs/remote.md, for the lab's address.
fn make_certificates(directory: &Path) {
    let page = include_str!("../../../docs/remote.md");
    let lines = page
        .split("```sh certificates\n")
        .nth(1)
        .unwrap()
        .split("```")
        .next()
        .unwrap();
    let script = lines.replace("192.0.2.7", LAB);
    let output = Command::new("bash")
        .args(["-euc", &script])
        .current_dir(directory)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", text(&output));
}

fn secret(path: &Path, content: &str) -> String {
    std::fs::write(path, content).unwrap();
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o600)).unwrap();
    path.to_string_lossy().into_owned()
}

/// A viewer on another host sees the run over TLS with a password. Without one it is refused at once, and both sides report the reason.
/// A user without the right to command can only read.
#[test]
fn another_host_sees_the_run_and_is_refused_without_a_password() {
    let workplace = Workplace::new();
    let machines = Machines::new();
    make_certificates(workplace.path());
    let users = secret(&workplace.path().join("users.txt"), "alice:pass-a\ncarol:pass-c\n");
    let (alice, carol) = ("alice", "carol");
    let password = |user: &str| {
        secret(
            &workplace.path().join(format!("{user}.pw")),
            &format!("pass-{}\n", &user[..1]),
        )
    };
    let (alice_pw, carol_pw) = (password(alice), password(carol));
    let wrong_pw = secret(&workplace.path().join("wrong.pw"), "guess\n");
    let ca = workplace.path().join("ca.pem").to_string_lossy().into_owned();
    let endpoint = format!("tls/{LAB}:7447");
    let settings = [
        format!("fanout.listen=\"{endpoint}\""),
        format!("fanout.users=\"{users}\""),
        "fanout.tls_certificate=\"server.pem\"".into(),
        "fanout.tls_private_key=\"server.key\"".into(),
        "fanout.commanders=[\"carol\"]".into(),
        "traffic.cavs=4".into(),
    ];
    let mut run = Run::start(&machines, &workplace, "shown", "simulate", &settings);
    let board = run.board(Process::TrafficBridge);
    let fanout = run.board(Process::Fanout);

    // Viewers without credentials and with wrong ones: the time until the refusal, and its message.
    let knock = |more: &str| -> (f64, String) {
        let program = format!(
            "import time; from caraware_viewer import access; begun = time.monotonic()\n\
             try: access.connect({endpoint:?}, 20.0, access.Credentials({more}ca={ca:?}))\n\
             except access.AccessError as error: print(time.monotonic() - begun, error)"
        );
        let output = machines.on_the_laptop(&["-c", &program]).output().unwrap();
        let said = text(&output);
        let (seconds, message) = said.split_once(' ').unwrap_or_else(|| panic!("was let in: {said}"));
        (seconds.parse().unwrap_or_else(|_| panic!("{said}")), message.to_owned())
    };
    let (seconds, message) = knock("");
    assert!(seconds < 2.0, "{seconds} s");
    assert!(
        message.contains("refused by") && message.contains("--user and --password-file"),
        "{message}"
    );
    crate::common::until(&mut run.child, "a refusal", || {
        let log = std::fs::read_to_string(run.directory.join("logs/fanout.log")).ok()?;
        log.contains("no user and password given").then_some(())
    });
    let (seconds, message) = knock("user='alice', password='guess', ");
    assert!(seconds < 2.0, "{seconds} s");
    assert!(
        message.contains("does not know the user 'alice' with this password"),
        "{message}"
    );

    // With valid credentials the real viewer records the run.
    let viewer = |command: &[&str], user: &str, pw: &str| -> Command {
        let mut arguments = vec!["-m", "caraware_viewer"];
        arguments.extend(command);
        arguments.extend(["--timeout", "20", "--user", user, "--password-file", pw, "--ca", &ca]);
        machines.on_the_laptop(&arguments)
    };
    let recording = workplace.path().join("run.rrd");
    let mut watching = viewer(&[&endpoint, "--save", recording.to_str().unwrap()], alice, &alice_pw)
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = String::new();
    BufReader::new(watching.stderr.take().unwrap())
        .read_line(&mut said)
        .unwrap();
    assert!(said.contains("watching run shown"), "{said}");
    crate::common::until(&mut run.child, "a recording", || {
        (std::fs::metadata(&recording).ok()?.len() > 20_000).then_some(())
    });
    watching.kill().unwrap();
    watching.wait().unwrap();

    let command = |user: &str, pw: &str, what: &str| -> Output {
        let head = ["command", &endpoint];
        let mut command = viewer(&head, user, pw);
        command.arg(what).output().unwrap()
    };
    let output = command(alice, &wrong_pw, "pause");
    assert!(text(&output).contains("refused by"), "{}", text(&output));
    let output = command(alice, &alice_pw, "reset");
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    assert!(text(&output).contains("fanout.commanders"), "{}", text(&output));
    let before = board.health().ticks;
    crate::common::until(&mut run.child, "ticks", || {
        (board.health().ticks > before + 5).then_some(())
    });
    assert_eq!(board.health().episode, 0, "a reader has reset the episode");

    let output = command(carol, &carol_pw, "pause");
    assert!(output.status.success(), "{}", text(&output));
    let said = text(&output);
    let tick: u64 = said
        .split("tick ")
        .nth(1)
        .unwrap()
        .split(':')
        .next()
        .unwrap()
        .parse()
        .unwrap();
    std::thread::park_timeout(Duration::from_millis(500));
    assert_eq!(board.health().ticks, tick);
    drop((board, fanout));
    run.stop();
    workplace.assert_nothing_left();
}

/// Sockets in the network namespace of `pid` that accept data from outside: address and port as the kernel writes them.
fn open_sockets(pid: u32) -> Vec<String> {
    let mut sockets = Vec::new();
    for (table, state) in [
        ("tcp", Some("0A")),
        ("tcp6", Some("0A")),
        ("udp", None),
        ("udp6", None),
        ("raw", None),
    ] {
        let text = std::fs::read_to_string(format!("/proc/{pid}/net/{table}")).unwrap();
        for line in text.lines().skip(1) {
            let columns: Vec<&str> = line.split_whitespace().collect();
            if state.is_none_or(|state| columns[3] == state) {
                sockets.push(format!("{table} {}", columns[1]));
            }
        }
    }
    sockets
}

/// A default run with its learner, in a network namespace of its own: one socket listens, on loopback. From the other machine every port
/// is closed.
#[test]
fn a_default_run_is_closed_to_other_machines() {
    let workplace = Workplace::new();
    let machines = Machines::new();
    assert_eq!(open_sockets(machines.lab_pid()), [] as [String; 0]);
    let mut run = Run::start(&machines, &workplace, "default", "train", &[]);
    let boards = [Process::Trainer, Process::Fanout].map(|process| run.board(process));
    // 127.0.0.1:7447, least significant byte first.
    assert_eq!(open_sockets(machines.lab_pid()), ["tcp 0100007F:1D17"]);
    let scan = format!(
        "import socket\n\
         for port in range(1, 65536):\n\
         \x20   s = socket.socket(); s.settimeout(1.0)\n\
         \x20   if s.connect_ex(({LAB:?}, port)) == 0: print('open', port)\n\
         \x20   s.close()\n\
         print('scanned')"
    );
    let begun = Instant::now();
    let output = machines.on_the_laptop(&["-c", &scan]).output().unwrap();
    assert_eq!(text(&output), "scanned\n", "{:?}", begun.elapsed());
    assert_eq!(run.log("fanout").matches("refused").count(), 0);
    drop(boards);
    run.stop();
    workplace.assert_nothing_left();
}
