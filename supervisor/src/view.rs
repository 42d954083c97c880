//! `caraware view`: finds the run and starts the Python viewer; `--viewer` starts one beside a run.

use std::{
    os::unix::process::CommandExt as _,
    path::Path,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use ipc_schema::{
    config::{EndpointProtocol, FanoutConfig},
    run::RunFile,
};
use rustix::process::{Pid, Signal, kill_process_group};

use crate::{
    cli::{Credentials, RunArgs, ViewArgs, ViewerKind},
    failure::Exit,
    install, registry,
};

/// Name of the viewer's Python package.
const MODULE: &str = "caraware_viewer";
/// Longest time that a viewer beside a run waits for the first tick, seconds.
const FIRST_TICK_WITHIN_S: &str = "120";
/// Longest time from the end of a run to the end of its viewer.
const LEAVE_WITHIN: Duration = Duration::from_secs(8);
/// Interval at which a leaving viewer is polled.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Shows a run until it ends: this process becomes the viewer.
///
/// # Errors
/// The run does not exist or has no fan-out, or the viewer is not installed.
pub fn view(args: &ViewArgs) -> Result<(), Exit> {
    let target = ViewTarget::find(args.endpoint.as_deref())?;
    let mut command = viewer_command(&target)?;
    command.args(args.env.map(|env| format!("--env={env}")));
    command.args(args.web.then_some("--web"));
    command.args(args.web_port.map(|port| format!("--web-port={port}")));
    command.args(args.save.as_ref().map(|path| format!("--save={}", path.display())));
    command.args(args.vehicle.iter().map(|id| format!("--vehicle={id}")));
    if !args.region.is_empty() {
        command.arg("--region").args(args.region.iter().map(f64::to_string));
    }
    command.args(args.rate.map(|rate| format!("--rate={rate}")));
    command.args(args.lidar.as_ref().map(|points| format!("--lidar={points}")));
    command.args(args.camera.iter().map(|name| format!("--camera={name}")));
    command.args(args.radar.iter().map(|name| format!("--radar={name}")));
    command.args(args.messages.then_some("--messages"));
    if let Some(name) = &args.run {
        command.arg(format!("--run={name}"));
    }
    command.args(credential_arguments(&args.credentials));
    let error = command.exec();
    Err(Exit::missing(
        format!("cannot start {}: {error}", command.get_program().to_string_lossy()),
        "run `make build`, then `caraware doctor`",
    ))
}

/// The credentials as arguments of the Python viewer.
fn credential_arguments(credentials: &Credentials) -> Vec<String> {
    let files = [
        ("password-file", &credentials.password_file),
        ("ca", &credentials.ca),
        ("certificate", &credentials.certificate),
        ("key", &credentials.key),
    ];
    let files = files
        .into_iter()
        .filter_map(|(option, path)| Some(format!("--{option}={}", path.as_ref()?.display())));
    let user = credentials.user.iter();
    user.map(|user| format!("--user={user}")).chain(files).collect()
}

/// The endpoint at which a run's `fanout` listens.
#[derive(Debug, Clone, PartialEq, Eq)]
struct ViewTarget {
    endpoint: String,
    /// Name of the run. Without a name the viewer shows the only run at the endpoint.
    run: Option<String>,
}

impl ViewTarget {
    /// Uses `text` if it is an endpoint or a saved file. Otherwise `text` names a live run of this machine; without `text` it is the only live run.
    fn find(text: Option<&str>) -> Result<Self, Exit> {
        if let Some(endpoint) = text.filter(|text| is_endpoint(text) || is_saved(text)) {
            return Ok(Self {
                endpoint: endpoint.to_owned(),
                run: None,
            });
        }
        if let Some(address) = text.filter(|text| looks_like_address(text)) {
            return Err(Exit::config(
                format!("`{address}` is not an endpoint: the protocol is missing"),
                format!("add the protocol: caraware view tcp/{address}"),
            ));
        }
        registry::find(text).and_then(|run| Self::of(&run))
    }

    fn of(run: &RunFile) -> Result<Self, Exit> {
        if !run.config.fanout.enabled {
            return Err(Exit::config(
                format!("{} cannot be viewed: its `fanout.enabled` is false", run.name),
                "start the run without `--set fanout.enabled=false`",
            ));
        }
        Ok(Self {
            endpoint: run.config.fanout.listen.on_this_machine().to_string(),
            run: Some(run.name.clone()),
        })
    }
}

/// True for the path of a file that a viewer has saved. The viewer takes it in the endpoint's place.
fn is_saved(text: &str) -> bool {
    Path::new(text).extension().is_some_and(|extension| extension == "rrd")
}

/// True for `tcp/host:port` and other protocols in this form.
fn is_endpoint(text: &str) -> bool {
    text.split_once('/').is_some_and(|(protocol, address)| {
        !protocol.is_empty()
            && protocol.chars().all(|c| c.is_ascii_lowercase() || c == '-')
            && looks_like_address(address)
    })
}

/// True for `host:port`.
fn looks_like_address(text: &str) -> bool {
    text.rsplit_once(':')
        .is_some_and(|(host, port)| !host.is_empty() && port.parse::<u16>().is_ok())
}

/// The command that starts a viewer of `target`. It fails if the viewer is not installed.
fn viewer_command(target: &ViewTarget) -> Result<Command, Exit> {
    let python = install::python(&install::programs()?)?;
    check_installed(&python)?;
    let mut command = Command::new(python);
    command.args(["-m", MODULE, &target.endpoint]);
    command.args(target.run.as_ref().map(|name| format!("--run={name}")));
    Ok(command)
}

/// Checks that the viewer and what it needs are installed for `python`.
///
/// # Errors
/// Something is missing, or Python does not start.
pub fn check_installed(python: &Path) -> Result<(), Exit> {
    let script = format!(
        "import importlib.util as u, sys; sys.exit(' '.join(p for p in ('{MODULE}', 'rerun', 'werkzeug', 'zenoh') if u.find_spec(p) is None))"
    );
    let help = "run `make build`; on a machine with only Python: pip install ./viewer";
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

/// The viewer that the command line asks for beside a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ViewerRequest {
    kind: ViewerKind,
    credentials: Credentials,
}

impl ViewerRequest {
    /// Reads the viewer and its credentials from the command line. `None` without `--viewer`.
    ///
    /// # Errors
    /// Credentials are given without a viewer, or the run requires credentials that the command line lacks.
    pub fn of(args: &RunArgs, fanout: &FanoutConfig) -> Result<Option<Self>, Exit> {
        let credentials = &args.credentials;
        let Some(kind) = args.viewer else {
            return match *credentials == Credentials::default() {
                true => Ok(None),
                false => Err(Exit::config(
                    "--user, --password-file, --ca, --certificate and --key are credentials of the viewer, but --viewer is missing",
                    "add --viewer or --viewer=web, or leave them out; fanout.users and fanout.tls_client_ca decide which viewers may connect",
                )),
            };
        };
        let (users, certificates) = (fanout.users.is_some(), fanout.tls_client_ca.is_some());
        let is_encrypted = fanout.listen.protocol == EndpointProtocol::Tls;
        let missing = [
            (users && credentials.user.is_none(), "--user NAME --password-file FILE"),
            (
                certificates && credentials.certificate.is_none(),
                "--certificate FILE --key FILE",
            ),
            (is_encrypted && credentials.ca.is_none(), "--ca FILE"),
        ];
        let missing: Vec<&str> = missing
            .iter()
            .filter(|(lacks, _)| *lacks)
            .map(|(_, what)| *what)
            .collect();
        if fanout.enabled && !missing.is_empty() {
            return Err(Exit::config(
                format!(
                    "every viewer of this run must authenticate, and the credentials of its own viewer are missing: {}",
                    missing.join(" ")
                ),
                "add them to the command line, or leave --viewer out (docs/remote.md)",
            ));
        }
        Ok(Some(Self {
            kind,
            credentials: credentials.clone(),
        }))
    }
}

/// A viewer beside a run. It ends with the run; the run continues if the viewer ends first.
#[derive(Debug)]
pub struct ViewerProcess {
    child: Child,
}

impl ViewerProcess {
    /// Starts a viewer that waits for the first tick of `run`. The viewer has its own process group, so Ctrl-C does not reach it:
    /// Ctrl-C ends the run, and the run ends its viewer.
    ///
    /// # Errors
    /// The run has no fan-out, or the viewer is not installed.
    pub fn start(run: &RunFile, request: &ViewerRequest) -> Result<Self, Exit> {
        let mut command = viewer_command(&ViewTarget::of(run)?)?;
        command.args(["--timeout", FIRST_TICK_WITHIN_S]);
        command.args((request.kind == ViewerKind::Web).then_some("--web"));
        command.args(credential_arguments(&request.credentials));
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
    /// Asks the viewer to draw what it has received and to end; kills it if it does not end in time.
    fn drop(&mut self) {
        for signal in [Signal::TERM, Signal::KILL] {
            if self.has_left() {
                return;
            }
            self.signal(signal);
            let deadline = Instant::now() + LEAVE_WITHIN;
            while Instant::now() < deadline && !self.has_left() {
                std::thread::park_timeout(POLL_INTERVAL);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_saved_file_stands_in_the_place_of_an_endpoint() {
        for path in ["run.rrd", "lab/a run.rrd", "./run.rrd"] {
            let expected = ViewTarget {
                endpoint: path.into(),
                run: None,
            };
            assert_eq!(ViewTarget::find(Some(path)).unwrap(), expected);
        }
        assert!(!is_saved("rrd") && !is_saved("town-1"));
    }

    #[test]
    fn endpoints_are_distinguished_from_names() {
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
    fn the_error_on_an_address_without_protocol_shows_the_endpoint() {
        let Err(Exit::Failure(failure)) = ViewTarget::find(Some("laptop:7447")) else {
            unreachable!("an address is not the name of a run");
        };
        assert!(failure.help.is_some_and(|help| help.contains("tcp/laptop:7447")));
    }
}
