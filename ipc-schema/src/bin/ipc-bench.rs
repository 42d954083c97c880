//! Measures the time that a bare iceoryx2 message takes between two processes that busy-poll: the reference of `caraware bench ipc`.
//!
//! It starts itself again as the receiving process.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a measurement that cannot run ends with the reason"
)]

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use iceoryx2::{
    config::Config,
    prelude::{FileName, NodeBuilder, Path as IpcPath, SemanticString as _, ServiceName, ipc},
    service::port_factory::publish_subscribe::PortFactory,
};
use ipc_schema::{
    clock::monotonic_ns,
    process_main::{answer_help, misused},
};

const USAGE: &str = "\
usage: ipc-bench [--messages N] --json FILE

Measures the time of a bare iceoryx2 message between two processes: the reference of `caraware bench ipc`.

  --messages N  messages that are measured; default 50000
  --json FILE   where the times go";

/// Messages before the measurement, while pages and caches warm up.
const WARM_UP: u64 = 2_000;
/// Pause between two messages, as in `caraware bench ipc`: meanwhile the receiver polls again.
const PAUSE_NS: u64 = 100_000;

/// Service of the messages, each of which holds the time at which it was sent.
const STAMPS: &str = "stamps";
/// Service of the answers: one for each message that was taken.
const TAKEN: &str = "taken";

/// Prefix of the names of a measurement's shared memory.
fn prefix(root: &Path) -> String {
    format!("{}_", root.file_name().unwrap().to_string_lossy())
}

/// The shared memory of a measurement. Dropping it removes what is left.
struct Place {
    root: PathBuf,
}

impl Drop for Place {
    fn drop(&mut self) {
        let prefix = prefix(&self.root);
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&prefix) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
        let _ = std::fs::remove_dir_all(&self.root);
    }
}

/// The service `name` below `root`.
fn service(root: &Path, name: &str) -> PortFactory<ipc::Service, u64, ()> {
    let mut config = Config::default();
    config
        .global
        .set_root_path(&IpcPath::new(root.as_os_str().as_encoded_bytes()).unwrap());
    config.global.prefix = FileName::new(prefix(root).as_bytes()).unwrap();
    let node = NodeBuilder::new().config(&config).create::<ipc::Service>().unwrap();
    node.service_builder(&ServiceName::new(name).unwrap())
        .publish_subscribe::<u64>()
        .open_or_create()
        .unwrap()
}

fn receive(root: &Path, messages: u64, json: &Path) {
    let subscriber = service(root, STAMPS).subscriber_builder().create().unwrap();
    let taken = service(root, TAKEN).publisher_builder().create().unwrap();
    println!("ready");
    let mut latencies = Vec::new();
    for _ in 0..messages + WARM_UP {
        let sample = loop {
            if let Some(sample) = subscriber.receive().unwrap() {
                break sample;
            }
            std::hint::spin_loop();
        };
        latencies.push(monotonic_ns() - *sample);
        drop(sample);
        taken.send_copy(0).unwrap();
    }
    let report = serde_json::json!({ "latencies_ns": latencies[usize::try_from(WARM_UP).unwrap()..] });
    std::fs::write(json, report.to_string()).unwrap();
}

fn send(root: &Path, messages: u64) {
    let publisher = service(root, STAMPS).publisher_builder().create().unwrap();
    let taken = service(root, TAKEN).subscriber_builder().create().unwrap();
    for _ in 0..messages + WARM_UP {
        let begin = monotonic_ns();
        while monotonic_ns() - begin < PAUSE_NS {
            std::hint::spin_loop();
        }
        let sample = publisher.loan_uninit().unwrap();
        sample.write_payload(monotonic_ns()).send().unwrap();
        while taken.receive().unwrap().is_none() {
            std::hint::spin_loop();
        }
    }
}

fn main() {
    answer_help(USAGE);
    let mut messages = 50_000;
    let mut json = None;
    let mut receiver_root: Option<PathBuf> = None;
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || {
            arguments
                .next()
                .unwrap_or_else(|| misused(&format!("{argument} needs a value"), USAGE))
        };
        match argument.as_str() {
            "--messages" => messages = value().parse().unwrap(),
            "--json" => json = Some(PathBuf::from(value())),
            "--receive" => receiver_root = Some(value().into()),
            other => misused(&format!("unknown option {other}"), USAGE),
        }
    }
    let json = json.unwrap_or_else(|| misused("--json FILE is missing", USAGE));
    if let Some(root) = receiver_root {
        return receive(&root, messages, &json);
    }
    let root = std::env::temp_dir().join(format!("ipc-bench-{}", std::process::id()));
    std::fs::create_dir_all(&root).unwrap();
    let place = Place { root: root.clone() };
    // Held here, so that the services outlive the process that ends first.
    let held = [STAMPS, TAKEN].map(|name| service(&root, name));
    let mut receiver = Command::new(std::env::current_exe().unwrap())
        .arg("--receive")
        .arg(&root)
        .args(["--messages", &messages.to_string(), "--json"])
        .arg(&json)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    std::io::BufRead::read_line(&mut std::io::BufReader::new(receiver.stdout.take().unwrap()), &mut line).unwrap();
    send(&root, messages);
    let status = receiver.wait().unwrap();
    drop(held);
    drop(place);
    assert!(status.success(), "the receiver ended with {status}");
}
