//! Who may connect through loopback. Every user of a machine can open a connection to its loopback addresses, and Linux gives such an
//! endpoint no permissions. So zenoh listens on a socket file that only its user can reach, and [`LoopbackGate`] passes on the
//! connections of that user and of root: docs/decisions/0063-loopback-is-for-one-user.md.

use std::{
    collections::BTreeMap,
    io,
    net::{IpAddr, SocketAddr, TcpListener as StdTcpListener},
    path::{Path, PathBuf},
    time::Duration,
};

use procfs::net::{TcpNetEntry, TcpState};
use rustix::process::Uid;
use socket2::SockRef;
use tokio::{
    io::copy_bidirectional_with_sizes,
    net::{TcpListener, TcpStream, UnixStream},
    runtime::Builder,
    sync::{mpsc, oneshot},
    task::{JoinSet, spawn_blocking},
    time::{sleep, timeout},
};

use crate::network::access;

/// Bytes that Linux keeps for a viewer that reads slowly.
const SEND_BUFFER_BYTES: usize = 65536;
/// Bytes that are copied at once, towards zenoh and towards the viewer.
const COPIED_BYTES: (usize, usize) = (4096, 65536);
/// Connections whose users one reading of Linux's tables finds.
const LOOKED_UP_AT_ONCE: usize = 1024;
/// Pause after Linux has refused a connection, which it does while there are no file handles.
const PAUSE: Duration = Duration::from_millis(100);

/// Accepts connections on a thread, closes those of other users, and passes the others on to a socket file.
#[derive(Debug)]
pub struct LoopbackGate {
    /// Sent, or dropped: accept nothing more.
    stop: oneshot::Sender<Duration>,
    thread: std::thread::JoinHandle<()>,
}

impl LoopbackGate {
    /// Passes the connections of `listener` on to the socket file `socket`.
    ///
    /// # Errors
    /// No thread can be started, or the listener cannot be set up.
    pub fn open(listener: StdTcpListener, socket: &Path) -> io::Result<Self> {
        listener.set_nonblocking(true)?;
        // Accepted connections inherit it.
        SockRef::from(&listener).set_send_buffer_size(SEND_BUFFER_BYTES)?;
        let runtime = Builder::new_current_thread()
            .enable_all()
            .max_blocking_threads(1)
            .build()?;
        let (stop, stopped) = oneshot::channel();
        let socket = socket.to_owned();
        let thread = std::thread::Builder::new().name("loopback".into()).spawn(move || {
            runtime.block_on(serve(listener, socket, stopped));
            // A lookup may still be going on.
            runtime.shutdown_background();
        })?;
        Ok(Self { stop, thread })
    }

    /// Accepts nothing more, and waits at most `limit` until viewers have taken what zenoh sent before it closed.
    pub fn close(self, limit: Duration) {
        if self.stop.send(limit).is_err() || self.thread.join().is_err() {
            tracing::warn!("the thread for viewers on this machine had ended");
        }
    }
}

async fn serve(listener: StdTcpListener, socket: PathBuf, mut stopped: oneshot::Receiver<Duration>) {
    let listener = match TcpListener::from_std(listener) {
        Ok(listener) => listener,
        Err(error) => return tracing::error!(%error, "viewers on this machine cannot connect"),
    };
    let (questions, asked) = mpsc::channel(LOOKED_UP_AT_ONCE);
    // It ends when nothing can ask any more.
    tokio::spawn(find_users(asked));
    let mut relays = JoinSet::new();
    let limit = loop {
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((viewer, peer)) => {
                    relays.spawn(relay(viewer, peer, questions.clone(), socket.clone()));
                }
                Err(error) => {
                    tracing::debug!(%error, "a connection cannot be accepted");
                    sleep(PAUSE).await;
                }
            },
            Some(_) = relays.join_next(), if !relays.is_empty() => {}
            limit = &mut stopped => break limit.unwrap_or_default(),
        }
    };
    drop(listener);
    let ended = async { while relays.join_next().await.is_some() {} };
    if timeout(limit, ended).await.is_err() {
        tracing::debug!("a viewer did not take what was left");
    }
}

/// Passes a connection on until one side closes it, if its other end belongs to this program's user.
async fn relay(mut viewer: TcpStream, peer: SocketAddr, questions: mpsc::Sender<Question>, socket: PathBuf) {
    let refusal = match user_of(&viewer, peer, questions).await {
        Ok(Some(user)) if may_connect(user) => None,
        Ok(Some(user)) => Some(format!(
            "it belongs to another user of this machine (user id {})",
            user.as_raw()
        )),
        // Its other end is closed already.
        Ok(None) => return,
        Err(error) => Some(format!("its user cannot be looked up: {error}")),
    };
    if let Some(reason) = refusal {
        return access::count_refusal(reason);
    }
    let mut zenoh = match UnixStream::connect(&socket).await {
        Ok(zenoh) => zenoh,
        Err(error) => return access::count_refusal(format!("{}: {error}", socket.display())),
    };
    let (to_zenoh, to_viewer) = COPIED_BYTES;
    if let Err(error) = copy_bidirectional_with_sizes(&mut viewer, &mut zenoh, to_zenoh, to_viewer).await {
        tracing::debug!(%error, "a viewer's connection ended");
    }
}

fn may_connect(user: Uid) -> bool {
    user.is_root() || user == rustix::process::geteuid()
}

/// Both ends of a connection, the viewer's first.
type Ends = [(IpAddr, u16); 2];

/// Which user has opened a connection? `None` if that user has closed it.
struct Question {
    ends: Ends,
    answer: oneshot::Sender<io::Result<Option<Uid>>>,
}

/// The user that has opened the other end of an established connection; `None` if that end is closed.
async fn user_of(viewer: &TcpStream, peer: SocketAddr, questions: mpsc::Sender<Question>) -> io::Result<Option<Uid>> {
    viewer.set_nodelay(true)?;
    let ends = [canonical(peer), canonical(viewer.local_addr()?)];
    let (answer, answered) = oneshot::channel();
    let ended = |_| io::Error::other("nothing looks it up any more");
    questions.send(Question { ends, answer }).await.map_err(ended)?;
    answered
        .await
        .unwrap_or_else(|_| Err(io::Error::other("the lookup has failed")))
}

/// Answers questions, all that wait by one reading of Linux's tables, and counts the readings. A reading takes some milliseconds, so a
/// viewer would wait for long behind a flood of connections that are looked up one by one.
async fn find_users(mut questions: mpsc::Receiver<Question>) -> usize {
    let mut readings = 0;
    let mut waiting = Vec::new();
    while questions.recv_many(&mut waiting, LOOKED_UP_AT_ONCE).await > 0 {
        readings += 1;
        let users = spawn_blocking(users_of_connections)
            .await
            .unwrap_or_else(|error| Err(error.into()));
        for Question { ends, answer } in waiting.drain(..) {
            let user = match &users {
                Ok(users) => Ok(users.get(&ends).copied()),
                Err(error) => Err(io::Error::new(error.kind(), error.to_string())),
            };
            // The connection may have ended meanwhile.
            let _ = answer.send(user);
        }
    }
    readings
}

/// The user of each established connection's first end.
fn users_of_connections() -> io::Result<BTreeMap<Ends, Uid>> {
    let mut users = BTreeMap::new();
    // An IPv4 connection may belong to an IPv6 socket.
    for table in [procfs::net::tcp, procfs::net::tcp6] {
        match table() {
            Ok(sockets) => users.extend(sockets.iter().filter_map(user_of_socket)),
            // A machine without IPv6 has no such table.
            Err(procfs::ProcError::NotFound(_)) => {}
            Err(error) => return Err(io::Error::other(error)),
        }
    }
    Ok(users)
}

/// Only an open socket names its user: one that is closed and still sends, or waits for late packets, is listed as root's.
fn user_of_socket(socket: &TcpNetEntry) -> Option<(Ends, Uid)> {
    let ends = [canonical(socket.local_address), canonical(socket.remote_address)];
    (socket.state == TcpState::Established).then(|| (ends, Uid::from_raw(socket.uid)))
}

fn canonical(address: SocketAddr) -> (IpAddr, u16) {
    (address.ip().to_canonical(), address.port())
}

#[cfg(test)]
mod tests {
    use std::net::TcpStream as StdTcpStream;

    use super::*;

    /// Both ends of a connection to `address`: the client's, and the accepted one.
    fn connected(address: &str, client_of: &str) -> Option<(StdTcpStream, StdTcpStream)> {
        let listener = StdTcpListener::bind((address, 0)).ok()?;
        let port = listener.local_addr().unwrap().port();
        let client = StdTcpStream::connect((client_of, port)).unwrap();
        Some((client, listener.accept().unwrap().0))
    }

    fn ends_of(accepted: &StdTcpStream) -> Ends {
        [accepted.peer_addr(), accepted.local_addr()].map(|address| canonical(address.unwrap()))
    }

    fn user_at(accepted: &StdTcpStream) -> Option<Uid> {
        users_of_connections().unwrap().get(&ends_of(accepted)).copied()
    }

    #[test]
    fn the_other_end_of_a_connection_has_a_user() {
        let me = Some(rustix::process::geteuid());
        let (_client, accepted) = connected("127.0.0.1", "127.0.0.1").unwrap();
        assert_eq!(user_at(&accepted), me);
        // A machine may have no IPv6. The second client reaches a listener of IPv6 by its IPv4 address.
        if let Some((_client, accepted)) = connected("::1", "::1") {
            assert_eq!(user_at(&accepted), me);
            let (_client, accepted) = connected("::", "127.0.0.1").unwrap();
            assert_eq!(user_at(&accepted), me);
        }
    }

    /// Linux lists the user of such an end as root.
    #[test]
    fn a_closed_end_has_no_user() {
        let (client, accepted) = connected("127.0.0.1", "127.0.0.1").unwrap();
        drop(client);
        assert_eq!(user_at(&accepted), None);
    }

    #[test]
    fn one_reading_answers_all_questions_that_wait() {
        let (client, accepted) = connected("127.0.0.1", "127.0.0.1").unwrap();
        let (closed, left) = connected("127.0.0.1", "127.0.0.1").unwrap();
        drop(closed);
        let (questions, asked) = mpsc::channel(LOOKED_UP_AT_ONCE);
        let ask = |accepted: &StdTcpStream| {
            let (answer, answered) = oneshot::channel();
            let ends = ends_of(accepted);
            questions.try_send(Question { ends, answer }).ok().unwrap();
            answered
        };
        let answers: Vec<_> = (0..LOOKED_UP_AT_ONCE / 2)
            .flat_map(|_| [ask(&accepted), ask(&left)])
            .collect();
        drop(questions);
        let runtime = Builder::new_current_thread().build().unwrap();
        assert_eq!(runtime.block_on(find_users(asked)), 1);
        for (number, mut answer) in answers.into_iter().enumerate() {
            let user = (number % 2 == 0).then(rustix::process::geteuid);
            assert_eq!(answer.try_recv().unwrap().unwrap(), user);
        }
        drop(client);
    }

    #[test]
    fn only_its_own_user_and_root_may_connect() {
        let me = rustix::process::geteuid();
        assert!(may_connect(me) && may_connect(Uid::ROOT));
        assert!(!may_connect(Uid::from_raw(me.as_raw() + 1)));
    }

    /// What was sent before the end arrives, also if nothing has been read until then.
    #[test]
    fn viewers_get_what_was_sent_before_the_gate_closed() {
        use std::{
            io::{Read as _, Write as _},
            os::unix::net::UnixListener,
        };

        let dir = tempfile::tempdir().unwrap();
        let socket = dir.path().join("zenoh");
        let zenoh = UnixListener::bind(&socket).unwrap();
        let listener = StdTcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let gate = LoopbackGate::open(listener, &socket).unwrap();
        let mut viewer = StdTcpStream::connect(address).unwrap();
        viewer.write_all(b"hello").unwrap();
        let (mut link, _) = zenoh.accept().unwrap();
        let mut heard = [0; 5];
        link.read_exact(&mut heard).unwrap();
        assert_eq!(&heard, b"hello");
        let sent: Vec<u8> = (0..200_000_u32).map(|i| (i % 251) as u8).collect();
        link.write_all(&sent).unwrap();
        drop(link);
        let mut received = Vec::new();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                viewer.read_to_end(&mut received).unwrap();
                viewer.shutdown(std::net::Shutdown::Both).unwrap();
            });
            gate.close(Duration::from_secs(60));
        });
        assert!(received == sent, "{} of {} bytes", received.len(), sent.len());
        assert!(StdTcpStream::connect(address).is_err(), "it still listens");
    }
}
