//! Commands from the network: passes queries on `caraware-control/RUN/ENV`, which only commanders may send, to the supervisor's socket,
//! and the supervisor's answer back. A separate thread does so, so that a command cannot delay what viewers see.

use std::{
    io::{BufRead as _, BufReader, Read as _, Write as _},
    os::unix::net::UnixStream,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
    },
    time::Duration,
};

use ipc_schema::control::{Command, Refusal, RefusalKind, Reply};
use zenoh::{
    Wait,
    bytes::Encoding,
    query::{Query, Queryable},
};

use crate::error::NetworkError;

/// Most commands that wait to be passed on; more are refused.
const QUEUE: usize = 16;
/// Longest wait for the supervisor, which itself waits at most 10 s for the simulation.
const ANSWER_WITHIN: Duration = Duration::from_secs(12);
/// Longest answer, bytes.
const MAX_ANSWER_BYTES: u64 = 1 << 16;

/// Accepts commands until it is dropped.
pub struct CommandGateway {
    refused: Arc<AtomicU64>,
    // Dropping it withdraws the key, and ends the thread.
    _queryable: Queryable<()>,
}

impl CommandGateway {
    /// Declares `key`, and passes its queries to the supervisor behind `socket` as commands for environment `env_index`.
    ///
    /// # Errors
    /// zenoh or the operating system refuses.
    pub fn open(session: &zenoh::Session, key: String, env_index: u32, socket: PathBuf) -> Result<Self, NetworkError> {
        let (sender, receiver) = sync_channel(QUEUE);
        let refused = Arc::new(AtomicU64::new(0));
        let counter = Arc::clone(&refused);
        std::thread::Builder::new()
            .name("commands".into())
            .spawn(move || pass_commands(&receiver, env_index, &socket, &counter))
            .map_err(|source| NetworkError::Thread {
                task: "passes commands on",
                source,
            })?;
        let counter = Arc::clone(&refused);
        let queryable = session
            .declare_queryable(&key)
            .callback(move |query| enqueue(&sender, query, &counter))
            .wait()
            .map_err(NetworkError::refused("declaration", key.clone()))?;
        Ok(Self {
            refused,
            _queryable: queryable,
        })
    }

    /// Commands refused so far.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }
}

/// Queues a query or refuses it. Runs on zenoh's receiving thread, which must not wait.
fn enqueue(sender: &SyncSender<Query>, query: Query, refused: &AtomicU64) {
    if let Err(TrySendError::Full(query)) = sender.try_send(query) {
        let refusal = Refusal::new(RefusalKind::Busy, "too many commands at a time: send it again");
        refused.fetch_add(1, Ordering::Relaxed);
        send_reply(&query, &Reply::Refused(refusal));
    }
}

/// Passes commands to the supervisor, one after another, and sends its answers.
fn pass_commands(queries: &Receiver<Query>, env_index: u32, socket: &PathBuf, refused: &AtomicU64) {
    while let Ok(query) = queries.recv() {
        let bytes = query.payload().map(|payload| payload.to_bytes().into_owned());
        let reply = match Command::from_json(&bytes.unwrap_or_default()) {
            Ok(command) => ask_supervisor(socket, env_index, &command).unwrap_or_else(|error| {
                let message = format!("the supervisor does not answer: {error}");
                Reply::Refused(Refusal::new(RefusalKind::Unanswered, message))
            }),
            Err(refusal) => Reply::Refused(refusal),
        };
        if let Reply::Refused(refusal) = &reply {
            let count = refused.fetch_add(1, Ordering::Relaxed) + 1;
            tracing::warn!("refused command {count} from the network: {refusal}");
        }
        send_reply(&query, &reply);
    }
}

/// The supervisor's answer to `command`.
fn ask_supervisor(socket: &PathBuf, env_index: u32, command: &Command) -> std::io::Result<Reply> {
    let mut stream = UnixStream::connect(socket)?;
    stream.set_read_timeout(Some(ANSWER_WITHIN))?;
    let request = serde_json::json!({ "control": { "env": env_index, "request": command.to_json()? } });
    writeln!(stream, "{request}")?;
    let mut line = String::new();
    BufReader::new(stream.take(MAX_ANSWER_BYTES)).read_line(&mut line)?;
    serde_json::from_str(&line).map_err(|_| std::io::Error::other("the run has ended"))
}

fn send_reply(query: &Query, reply: &Reply) {
    let text = match serde_json::to_string(reply) {
        Ok(text) => text,
        Err(error) => return tracing::error!(%error, "the answer to a command has no form in JSON"),
    };
    let sent = query
        .reply(query.key_expr().clone(), text)
        .encoding(Encoding::APPLICATION_JSON)
        .wait();
    if let Err(error) = sent {
        tracing::debug!(%error, "the answer to a command could not be sent: its sender has left");
    }
}
