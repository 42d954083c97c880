//! The supervisor's socket: a request and its answer are a line of JSON each. Only the user of the run can enter its directory.

use std::{
    fs::Permissions,
    io::{BufRead as _, BufReader, ErrorKind, Read as _, Write as _},
    net::Shutdown,
    os::unix::{
        fs::PermissionsExt as _,
        net::{UnixListener, UnixStream},
    },
    path::PathBuf,
    time::Duration,
};

use ipc_schema::{
    control::{Command, Refusal, Reply},
    failure::{Failure, FailureKind},
    run::RunFile,
};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use crate::failure::Exit;

/// Longest request, bytes.
const MAX_REQUEST_BYTES: u64 = 1 << 16;
/// Longest time from a connection to its request.
const REQUEST_WITHIN: Duration = Duration::from_secs(2);

/// A request to a supervisor, as it is sent.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SupervisorRequest {
    /// Replace the trainer.
    Handover(HandoverRequest),
    /// Forward a command to the simulation.
    Control {
        /// Environment; `None` stands for all of them.
        #[serde(default)]
        env: Option<u32>,
        /// The command as JSON text, which the supervisor checks.
        request: String,
    },
}

/// What a user asks for with `caraware handover`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct HandoverRequest {
    /// Assignments, as after `--set`.
    pub set: Vec<String>,
    /// A checkpoint directory to take parameters from, instead of the newest of the run.
    pub checkpoint: Option<PathBuf>,
    /// True if the old trainer leaves at the next tick, and not after its next update.
    #[serde(default)]
    pub now: bool,
    /// Longest time to the old trainer's end, seconds; then the handover is refused.
    #[serde(default)]
    pub timeout_s: Option<f64>,
    /// True if the trainer learns together with others, which are replaced with it. Each supervisor answers [`HandoverAnswer::Ready`]
    /// first, and its old trainer is not asked to leave before the client permits it.
    #[serde(default)]
    pub together: bool,
}

/// The supervisor's answer to a [`HandoverRequest`].
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HandoverAnswer {
    /// The successor works.
    Done(HandoverReport),
    /// Nothing has changed.
    Refused(Failure),
    /// The successor is ready, and waits for those of the other ranks; another answer follows.
    Ready,
}

/// A completed handover.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct HandoverReport {
    /// Number of the successor among the trainers of the run; the first trainer is 0.
    pub incarnation: u32,
    /// The first tick that the successor received.
    pub first_tick: u64,
    /// Wall seconds from the end of the old trainer to the first tick of the successor.
    pub pause_s: f64,
    /// The request.
    pub request: HandoverRequest,
}

/// A request that arrived, with the socket for its answer.
#[derive(Debug)]
pub enum ReceivedRequest {
    /// Replace the trainer.
    Handover(HandoverRequest, ReplySocket),
    /// Forward a command to one environment, or to all of them.
    Control(Command, Option<u32>, ReplySocket),
}

/// What the client says to [`HandoverAnswer::Ready`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Permission {
    /// Nothing yet.
    Awaited,
    /// The old trainer may leave.
    Given,
    /// It has ended, or gives the handover up.
    Withdrawn,
}

/// The connection over which a request is answered.
#[derive(Debug)]
pub struct ReplySocket(UnixStream);

impl ReplySocket {
    /// Sends the answer; a connection that was closed meanwhile is only logged.
    pub fn answer(mut self, answer: &impl Serialize) {
        self.announce(answer);
    }

    /// Sends an answer that another one follows.
    pub fn announce(&mut self, answer: &impl Serialize) {
        let sent = serde_json::to_string(answer).map_err(std::io::Error::from);
        if let Err(error) = sent.and_then(|line| writeln!(self.0, "{line}")) {
            tracing::warn!(%error, "the connection was closed before the answer to its request");
        }
    }

    /// What the client has said to an announcement; does not wait.
    pub fn permission(&mut self) -> Permission {
        let read = self.0.set_nonblocking(true).and_then(|()| self.0.read(&mut [0; 1]));
        // The answer is written whole, however long that takes.
        let reset = self.0.set_nonblocking(false);
        match read.and_then(|read| reset.map(|()| read)) {
            Ok(0) => Permission::Withdrawn,
            Ok(_) => Permission::Given,
            Err(error) if error.kind() == ErrorKind::WouldBlock => Permission::Awaited,
            Err(_) => Permission::Withdrawn,
        }
    }

    /// Answers a command with a refusal.
    pub fn refuse(self, refusal: Refusal) {
        self.answer(&Reply::Refused(refusal));
    }
}

/// Listens for requests on a thread and passes each to `take`, until `take` returns false.
///
/// # Errors
/// The socket cannot be created.
pub fn listen(run: &RunFile, take: impl Fn(ReceivedRequest) -> bool + Send + 'static) -> Result<(), Exit> {
    let path = run.control_socket();
    let listener = UnixListener::bind(&path).map_err(|error| Exit::io("listen on", &path, &error))?;
    std::fs::set_permissions(&path, Permissions::from_mode(0o600))
        .map_err(|error| Exit::io("close to other users", &path, &error))?;
    let serve = move || {
        for stream in listener.incoming().flatten() {
            match read_request(stream) {
                Ok(Some(request)) => {
                    if !take(request) {
                        return;
                    }
                }
                Ok(None) => {}
                Err(error) => tracing::warn!(%error, "a request cannot be read, and is not answered"),
            }
        }
    };
    std::thread::Builder::new()
        .name("control".into())
        .spawn(serve)
        .map(drop)
        .map_err(|error| Exit::run(format!("cannot listen for requests: {error}"), ""))
}

/// Reads a request. `None`: the request was a wrong command, which is refused.
fn read_request(stream: UnixStream) -> std::io::Result<Option<ReceivedRequest>> {
    stream.set_read_timeout(Some(REQUEST_WITHIN))?;
    let mut text = String::new();
    let mut reader = BufReader::new(stream.take(MAX_REQUEST_BYTES));
    reader.read_line(&mut text)?;
    let socket = ReplySocket(reader.into_inner().into_inner());
    Ok(match serde_json::from_str(&text)? {
        SupervisorRequest::Handover(request) => Some(ReceivedRequest::Handover(request, socket)),
        SupervisorRequest::Control { env, request } => match Command::from_json(request.as_bytes()) {
            Ok(command) => Some(ReceivedRequest::Control(command, env, socket)),
            Err(refusal) => {
                socket.refuse(refusal);
                None
            }
        },
    })
}

/// A request that has been sent to the supervisor of a run. Dropping it withdraws what the client has not permitted.
#[derive(Debug)]
pub struct SentRequest {
    stream: BufReader<UnixStream>,
    socket: PathBuf,
}

impl SentRequest {
    /// Sends a request to the supervisor of `run`.
    ///
    /// # Errors
    /// The run is over.
    pub fn new(run: &RunFile, request: &SupervisorRequest) -> Result<Self, Exit> {
        let socket = run.control_socket();
        let failed = |error: &std::io::Error| Exit::io("ask the supervisor through", &socket, error);
        let mut stream = UnixStream::connect(&socket).map_err(|error| failed(&error))?;
        let text = serde_json::to_string(request).map_err(|error| failed(&error.into()))?;
        writeln!(stream, "{text}").map_err(|error| failed(&error))?;
        Ok(Self {
            stream: BufReader::new(stream),
            socket,
        })
    }

    /// Waits for the next answer.
    ///
    /// # Errors
    /// The run ends before it has answered.
    pub fn answer<Answer: DeserializeOwned>(&mut self) -> Result<Answer, Exit> {
        let mut line = String::new();
        let read = self.stream.read_line(&mut line);
        read.map_err(|error| Exit::io("ask the supervisor through", &self.socket, &error))?;
        serde_json::from_str(&line).map_err(|_| {
            Exit::Failure(
                Failure::new(FailureKind::Run, "the run ended before it answered")
                    .with_help("report.json in its directory shows how it ended"),
            )
        })
    }

    /// Withdraws what it has not permitted, and waits for the last answer.
    pub fn withdraw(mut self) {
        // A run that is over has nothing left to withdraw.
        if self.stream.get_mut().shutdown(Shutdown::Write).is_ok() {
            while matches!(self.answer(), Ok(HandoverAnswer::Ready)) {}
        }
    }

    /// Permits what [`HandoverAnswer::Ready`] announced.
    ///
    /// # Errors
    /// The run is over.
    pub fn permit(&mut self) -> Result<(), Exit> {
        let written = self.stream.get_mut().write_all(b"\n");
        written.map_err(|error| Exit::io("ask the supervisor through", &self.socket, &error))
    }
}
