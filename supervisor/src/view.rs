//! `caraware view`: finds the run and starts the Python viewer; `--viewer` starts one beside a run.

use std::{
    os::unix::process::CommandExt as _,
    path::Path,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use ipc_schema::{config::FanoutConfig, run::RunFile};
use rustix::process::{Pid, Signal, kill_process_group};

use crate::{
    cli::{Credentials, RunArgs, ViewArgs, ViewerKind},
    failure::Exit,
    install, registry,
};

/// The Python package that shows a run.
const MODULE: &str = "caraware_viewer";
/// What a viewer beside a run waits for its first tick, seconds.
const FIRST_TICK_WITHIN_S: &str = "120";
/// Longest time from the end of a run to the end of its viewer.
const LEAVE_WITHIN: Duration = Duration::from_secs(8);
/// Time between two looks at a leaving viewer.
const LOOK: Duration = Duration::from_millis(50);

/// Shows a run until it ends: this process becomes the viewer.
///
/// # Errors
/// No such run, one that is not fanned out, or no viewer on this machine.
pub fn view(args: &ViewArgs) -> Result<(), Exit> {
    let target = ViewTarget::find(args.endpoint.as_deref())?;
    let mut command = viewer(&target)?;
    command.args(args.env.map(|env| format!("--env={env}")));
    command.args(args.web.then_some("--web"));
    command.args(args.web_port.map(|port| format!("--web-port={port}")));
    command.args(args.save.as_ref().map(|path| format!("--save={}", path.display())));
    command.args(args.vehicle.iter().map(|id| format!("--vehicle={id}")));
    command.args(args.lidar.as_ref().map(|points| format!("--lidar={points}")));
    if let Some(name) = &args.run {
        command.arg(format!("--run={name}"));
    }
    command.args(arguments_of(&args.credentials));
    let error = command.exec();
    Err(Exit::missing(
        format!("cannot start {}: {error}", command.get_program().to_string_lossy()),
        "run `make build`, then `caraware doctor`",
    ))
}

/// The same credentials for the Python viewer.
fn arguments_of(who: &Credentials) -> Vec<String> {
    let files = [
        ("password-file", &who.password_file),
        ("ca", &who.ca),
        ("certificate", &who.certificate),
        ("key", &who.key),
    ];
    let files = files
        .into_iter()
        .filter_map(|(option, path)| Some(format!("--{option}={}", path.as_ref()?.display())));
    who.user
        .iter()
        .map(|user| format!("--user={user}"))
        .chain(files)
        .collect()
}

/// Where a run is fanned out.
#[derive(Debug, Clone, PartialEq, Eq)]
struct ViewTarget {
    endpoint: String,
    /// Its name, where it is known; else the viewer takes the only one there.
    run: Option<String>,
}

impl ViewTarget {
    /// An endpoint as it stands; else a run of this machine, by name or the only one.
    fn find(text: Option<&str>) -> Result<Self, Exit> {
        if let Some(endpoint) = text.filter(|text| is_endpoint(text)) {
            return Ok(Self {
                endpoint: endpoint.to_owned(),
                run: None,
            });
        }
        if let Some(address) = text.filter(|text| looks_like_address(text)) {
            return Err(Exit::config(
                format!("`{address}` is no endpoint"),
                format!("write the protocol too: caraware view tcp/{address}"),
            ));
        }
        registry::find(text).and_then(|run| Self::of(&run))
    }

    fn of(run: &RunFile) -> Result<Self, Exit> {
        if !run.config.fanout.enabled {
            return Err(Exit::config(
                format!("{} shows nothing: its `fanout.enabled` is false", run.name),
                "start it without `--set fanout.enabled=false`",
            ));
        }
        Ok(Self {
            endpoint: reachable(&run.config.fanout.listen),
            run: Some(run.name.clone()),
        })
    }
}

/// An endpoint to connect to for one to listen on: every address of this machine is no address to call.
fn reachable(listen: &str) -> String {
    listen.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
}

/// `tcp/host:port` and its like.
fn is_endpoint(text: &str) -> bool {
    text.split_once('/').is_some_and(|(protocol, address)| {
        !protocol.is_empty()
            && protocol.chars().all(|c| c.is_ascii_lowercase() || c == '-')
            && looks_like_address(address)
    })
}

/// `host:port`.
fn looks_like_address(text: &str) -> bool {
    text.rsplit_once(':')
        .is_some_and(|(host, port)| !host.is_empty() && port.parse::<u16>().is_ok())
}

/// The command of a viewer of `target`, checked to be installed.
fn viewer(target: &ViewTarget) -> Result<Command, Exit> {
    let python = install::python(&install::programs()?)?;
    check_installed(&python)?;
    let mut command = Command::new(python);
    command.args(["-m", MODULE, &target.endpoint]);
    command.args(target.run.as_ref().map(|name| format!("--run={name}")));
    Ok(command)
}

fn check_installed(python: &Path) -> Result<(), Exit> {
    let script = format!(
        "import importlib.util as u, sys; sys.exit(' '.join(p for p in ('{MODULE}', 'rerun', 'zenoh') if u.find_spec(p) is None))"
    );
    let help = "run `make build`; elsewhere, with Python alone: pip install ./viewer";
    let output = Command::new(python)
        .args(["-c", &script])
        .stdin(Stdio::null())
        .output()
        .map_err(|error| Exit::missing(format!("cannot start {}: {error}", python.display()), help))?;
    match String::from_utf8_lossy(&output.stderr).trim() {
        "" => Ok(()),
        absent => Err(Exit::missing(
            format!("the viewer is not installed for {}: {absent}", python.display()),
            help,
        )),
    }
}

/// A viewer that is wanted beside a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ViewerRequest {
    kind: ViewerKind,
    credentials: Credentials,
}

impl ViewerRequest {
    /// What the command line asks for, if the run will let such a viewer in.
    ///
    /// # Errors
    /// The run is not fanned out, or asks who the viewer is and the command line does not say.
    pub fn of(args: &RunArgs, fanout: &FanoutConfig) -> Result<Option<Self>, Exit> {
        let who = &args.credentials;
        let Some(kind) = args.viewer else {
            return match *who == Credentials::default() {
                true => Ok(None),
                false => Err(Exit::config(
                    "--user, --password-file, --ca, --certificate and --key say who the viewer is, and none is asked for",
                    "add --viewer or --viewer=web, or leave them out; who may watch is said by fanout.users and fanout.tls_client_ca",
                )),
            };
        };
        let (users, certificates) = (!fanout.users.is_empty(), !fanout.tls_client_ca.is_empty());
        let missing = [
            (users && who.user.is_none(), "--user NAME --password-file FILE"),
            (
                certificates && who.certificate.is_none(),
                "--certificate FILE --key FILE",
            ),
            (fanout.listen.starts_with("tls/") && who.ca.is_none(), "--ca FILE"),
        ];
        let missing: Vec<&str> = missing
            .iter()
            .filter(|(lacks, _)| *lacks)
            .map(|(_, what)| *what)
            .collect();
        if fanout.enabled && !missing.is_empty() {
            return Err(Exit::config(
                format!(
                    "this run lets in only those who say who they are, and so has its own viewer to: {}",
                    missing.join(" ")
                ),
                "add that to the command line, or leave --viewer out (docs/remote.md)",
            ));
        }
        Ok(Some(Self {
            kind,
            credentials: who.clone(),
        }))
    }
}

/// A viewer beside a run: it ends with the run, and its own end disturbs nobody.
#[derive(Debug)]
pub struct ViewerProcess {
    child: Child,
}

impl ViewerProcess {
    /// Starts a viewer that waits for the first tick of `run`, in a process group of its own: Ctrl-C ends the run, and the run's end
    /// the viewer.
    ///
    /// # Errors
    /// The run is not fanned out, or no viewer is installed.
    pub fn start(run: &RunFile, wanted: &ViewerRequest) -> Result<Self, Exit> {
        let mut command = viewer(&ViewTarget::of(run)?)?;
        command.args(["--timeout", FIRST_TICK_WITHIN_S]);
        command.args((wanted.kind == ViewerKind::Web).then_some("--web"));
        command.args(arguments_of(&wanted.credentials));
        command.stdin(Stdio::null()).process_group(0);
        let child = command.spawn().map_err(|error| {
            Exit::missing(
                format!("cannot start the viewer: {error}"),
                "run `make build`, then `caraware doctor`",
            )
        })?;
        Ok(Self { child })
    }

    fn has_left(&mut self) -> bool {
        !matches!(self.child.try_wait(), Ok(None))
    }

    fn signal(&self, signal: Signal) {
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw)
            && let Err(error) = kill_process_group(pid, signal)
        {
            tracing::debug!(%error, "cannot signal the viewer");
        }
    }
}

impl Drop for ViewerProcess {
    /// Lets it draw what is left, then ends it.
    fn drop(&mut self) {
        for signal in [Signal::TERM, Signal::KILL] {
            if self.has_left() {
                return;
            }
            self.signal(signal);
            let deadline = Instant::now() + LEAVE_WITHIN;
            while Instant::now() < deadline && !self.has_left() {
                std::thread::park_timeout(LOOK);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_and_names_are_told_apart() {
        for endpoint in [
            "tcp/127.0.0.1:7447",
            "tls/host.example:7448",
            "tcp/[::1]:7447",
            "unixsock-stream/x:1",
        ] {
            assert!(is_endpoint(endpoint), "{endpoint}");
        }
        for other in [
            "town-1",
            "host:7447",
            "tcp/host",
            "tcp/host:port",
            "tcp/:7447",
            "/host:1",
            "TCP/host:1",
            "a/b",
        ] {
            assert!(!is_endpoint(other), "{other}");
        }
    }

    #[test]
    fn every_address_of_this_machine_is_called_by_one() {
        for (listen, calls) in [
            ("tls/0.0.0.0:7447", "tls/127.0.0.1:7447"),
            ("tcp/[::]:7447", "tcp/[::1]:7447"),
            ("tcp/10.0.0.0:7447", "tcp/10.0.0.0:7447"),
        ] {
            assert_eq!(reachable(listen), calls);
        }
    }

    #[test]
    fn an_address_without_protocol_is_told_how_to_be_written() {
        let Err(Exit::Failure(failure)) = ViewTarget::find(Some("laptop:7447")) else {
            unreachable!("an address is no run");
        };
        assert!(failure.help.is_some_and(|help| help.contains("tcp/laptop:7447")));
    }
}
