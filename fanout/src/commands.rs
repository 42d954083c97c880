//! Commands from the network: queries on `caraware-control/RUN/ENV`, which only commanders may send, go to the supervisor's socket and
//! its answer goes back. A thread of its own does so: whoever commands cannot hold up what is shown.

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

use crate::outlet::OutletError;

/// Commands that wait their turn; more are refused.
const QUEUE: usize = 16;
/// Longest wait for the supervisor, which itself waits at most 10 s for the simulation.
const ANSWER_WITHIN: Duration = Duration::from_secs(12);
/// Longest answer, bytes.
const MAX_ANSWER_BYTES: u64 = 1 << 16;

/// Takes commands as long as it lives.
pub struct Commands {
    refused: Arc<AtomicU64>,
    // Held: dropping it withdraws it, and ends the thread.
    _queryable: Queryable<()>,
}

impl Commands {
    /// Declares `key` and passes on what comes for environment `env_index` to the supervisor behind `socket`.
    ///
    /// # Errors
    /// zenoh or the system refuses.
    pub fn open(session: &zenoh::Session, key: String, env_index: u32, socket: PathBuf) -> Result<Self, OutletError> {
        let failed =
            |action: &'static str, key: String| move |reason: String| OutletError::Refused { action, key, reason };
        let (sender, receiver) = sync_channel(QUEUE);
        let refused = Arc::new(AtomicU64::new(0));
        let counter = Arc::clone(&refused);
        std::thread::Builder::new()
            .name("commands".into())
            .spawn(move || pass_on(&receiver, env_index, &socket, &counter))
            .map_err(|error| failed("a thread for commands", key.clone())(error.to_string()))?;
        let counter = Arc::clone(&refused);
        let queryable = session
            .declare_queryable(&key)
            .callback(move |query| enqueue(&sender, query, &counter))
            .wait()
            .map_err(|error| failed("declaration", key.clone())(error.to_string()))?;
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

/// Runs on zenoh's receiving thread: only looks whether there is room.
fn enqueue(sender: &SyncSender<Query>, query: Query, refused: &AtomicU64) {
    if let Err(TrySendError::Full(query)) = sender.try_send(query) {
        let refusal = Refusal::new(RefusalKind::Busy, "too many commands at a time: ask again");
        refused.fetch_add(1, Ordering::Relaxed);
        answer(&query, &Reply::Refused(refusal));
    }
}

fn pass_on(queries: &Receiver<Query>, env_index: u32, socket: &PathBuf, refused: &AtomicU64) {
    while let Ok(query) = queries.recv() {
        let bytes = query.payload().map(|payload| payload.to_bytes().into_owned());
        let reply = match Command::from_json(&bytes.unwrap_or_default()) {
            Ok(command) => ask(socket, env_index, &command).unwrap_or_else(|error| {
                let message = format!("the supervisor does not answer: {error}");
                Reply::Refused(Refusal::new(RefusalKind::Unanswered, message))
            }),
            Err(refusal) => Reply::Refused(refusal),
        };
        if let Reply::Refused(refusal) = &reply {
            let count = refused.fetch_add(1, Ordering::Relaxed) + 1;
            tracing::warn!("refused command {count} from the network: {refusal}");
        }
        answer(&query, &reply);
    }
}

fn ask(socket: &PathBuf, env_index: u32, command: &Command) -> std::io::Result<Reply> {
    let mut stream = UnixStream::connect(socket)?;
    stream.set_read_timeout(Some(ANSWER_WITHIN))?;
    let request = serde_json::json!({ "control": { "env": env_index, "request": command.to_json() } });
    writeln!(stream, "{request}")?;
    let mut line = String::new();
    BufReader::new(stream.take(MAX_ANSWER_BYTES)).read_line(&mut line)?;
    serde_json::from_str(&line).map_err(|_| std::io::Error::other("the run has ended"))
}

fn answer(query: &Query, reply: &Reply) {
    let text = serde_json::to_string(reply).unwrap_or_default();
    let sent = query
        .reply(query.key_expr().clone(), text)
        .encoding(Encoding::APPLICATION_JSON)
        .wait();
    if let Err(error) = sent {
        tracing::debug!(%error, "nobody waits for the answer to a command");
    }
}
