//! The supervisor's socket, in the run's own directory, which only its user can enter: a line of JSON each way.

use std::{
    io::{BufRead as _, BufReader, Read as _, Write as _},
    os::unix::net::{UnixListener, UnixStream},
    time::Duration,
};

use ipc_schema::{
    control::{Command, Refusal, Reply},
    failure::{Failure, FailureKind},
    run::RunFile,
};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use crate::{failure::Exit, swap};

/// Longest request, bytes.
const MAX_LINE_BYTES: u64 = 1 << 16;
/// Longest time that somebody who has connected takes to ask.
const ASK_WITHIN: Duration = Duration::from_secs(2);

/// What may be asked of a supervisor.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Asking {
    /// Another trainer.
    Swap(swap::Request),
    /// A command to the simulation.
    Control {
        /// Environment; none = all of them.
        #[serde(default)]
        env: Option<u32>,
        /// The request as JSON text, which is looked at here.
        request: String,
    },
}

/// A request that came in.
#[derive(Debug)]
pub enum Asked {
    /// Another trainer.
    Swap(swap::Asked),
    /// A command to the simulation in an environment, or in all of them.
    Control(Command, Option<u32>, Line),
}

/// The way back to somebody who asked.
#[derive(Debug)]
pub struct Line(UnixStream);

impl Line {
    /// Answers; whoever has gone meanwhile is not missed.
    pub fn answer(mut self, answer: &impl Serialize) {
        let line = serde_json::to_string(answer).unwrap_or_default();
        if let Err(error) = writeln!(self.0, "{line}") {
            tracing::warn!(%error, "nobody waits for the answer to a request");
        }
    }

    /// Answers that a command changes nothing.
    pub fn refuse(self, refusal: Refusal) {
        self.answer(&Reply::Refused(refusal));
    }
}

/// Listens for requests until the run's directory goes; each is handed to `take`.
///
/// # Errors
/// The socket cannot be created.
pub fn listen(run: &RunFile, take: impl Fn(Asked) -> bool + Send + 'static) -> Result<(), Exit> {
    let path = run.control_socket();
    let listener = UnixListener::bind(&path).map_err(|error| Exit::io("listen on", &path, &error))?;
    let serve = move || {
        for stream in listener.incoming().flatten() {
            if let Some(asked) = read(stream)
                && !take(asked)
            {
                return;
            }
        }
    };
    std::thread::Builder::new()
        .name("control".into())
        .spawn(serve)
        .map(drop)
        .map_err(|error| Exit::run(format!("cannot listen for requests: {error}"), ""))
}

fn read(stream: UnixStream) -> Option<Asked> {
    stream.set_read_timeout(Some(ASK_WITHIN)).ok()?;
    let mut text = String::new();
    let mut reader = BufReader::new(stream.take(MAX_LINE_BYTES));
    reader.read_line(&mut text).ok()?;
    let line = Line(reader.into_inner().into_inner());
    match serde_json::from_str(&text).ok()? {
        Asking::Swap(request) => Some(Asked::Swap(swap::Asked::new(request, line))),
        Asking::Control { env, request } => match Command::from_json(request.as_bytes()) {
            Ok(command) => Some(Asked::Control(command, env, line)),
            Err(refusal) => {
                line.refuse(refusal);
                None
            }
        },
    }
}

/// Asks the supervisor of `run` and waits for its answer.
///
/// # Errors
/// The run is over, or ends before it has answered.
pub fn ask<Answer: DeserializeOwned>(run: &RunFile, asking: &Asking) -> Result<Answer, Exit> {
    let socket = run.control_socket();
    let failed = |error: &std::io::Error| Exit::io("ask the supervisor through", &socket, error);
    let mut stream = UnixStream::connect(&socket).map_err(|error| failed(&error))?;
    writeln!(stream, "{}", serde_json::to_string(asking).unwrap_or_default()).map_err(|error| failed(&error))?;
    let mut line = String::new();
    BufReader::new(stream)
        .read_line(&mut line)
        .map_err(|error| failed(&error))?;
    serde_json::from_str(&line).map_err(|_| {
        Exit::Failure(
            Failure::new(FailureKind::Run, "the run ended before it had answered").with_help("its report says how"),
        )
    })
}
