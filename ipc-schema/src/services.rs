//! The services of a run: names, sizes and quality of service. The supervisor creates them all and keeps them open;
//! every other process only opens them (killing a process while it creates a service can leave its name unusable).

use std::{
    collections::VecDeque,
    fs::{File, Metadata},
    io::ErrorKind,
    os::unix::fs::MetadataExt as _,
    path::{Path, PathBuf},
    sync::Arc,
};

use iceoryx2::{
    config::Config as IpcConfig,
    node::{Node, NodeBuilder},
    port::listener::Listener,
    prelude::{Alignment, FileName, Path as IpcPath, SemanticString, ServiceName, SignalHandlingMode},
    service::{
        builder::{publish_subscribe::Builder as DataBuilder, request_response::Builder as ControlBuilder},
        ipc_threadsafe,
        port_factory::{blackboard, event, publish_subscribe, request_response},
    },
};

use crate::{
    activity::Activity,
    block::ALIGNMENT,
    board::{Health, Progress, Roster, TrainingStatus},
    channel::FullQueue,
    control::{ControlReply, ControlRequest},
    header::MessageHeader,
    process::{Process, ProcessScope},
    reserve,
    run::{RunFile, SharedMemory},
    storage::{self, reason_of, retry_on_full_disk},
};

pub use crate::channel::Channel;

/// The variant of iceoryx2 in use: between processes, ports usable from any thread.
pub type Shm = ipc_threadsafe::Service;
/// A process's place in a run's shared memory.
pub type RunNode = Arc<Node<Shm>>;
/// An opened data service.
pub type DataService = publish_subscribe::PortFactory<Shm, [u8], MessageHeader>;
/// An opened board.
pub type BoardService = blackboard::PortFactory<Shm, u32>;
/// The opened service for commands.
pub type ControlService = request_response::PortFactory<Shm, ControlRequest, (), ControlReply, ()>;
/// An opened wake-up service.
pub type WakeService = event::PortFactory<Shm>;

/// Board entry of the [`Progress`].
pub const PROGRESS_KEY: u32 = 0;
/// Board entry of the [`Health`].
pub const HEALTH_KEY: u32 = 1;
/// Board entry of the [`TrainingStatus`].
pub const TRAINING_KEY: u32 = 2;
/// Board entry of the [`Activity`].
pub const ACTIVITY_KEY: u32 = 3;
/// The one entry of the roster.
pub const ROSTER_KEY: u32 = 0;

/// Most processes that open one service at a time: all of a run, a successor for each, and spectators (`caraware ps`).
const MAX_NODES: usize = 24;
/// Boards of a process that exist at a time.
const KEPT_BOARDS: usize = 2;
/// Readers of one board.
const MAX_READERS: usize = 32;
/// Readers of the roster: every reader of a board reads it.
const MAX_ROSTER_READERS: usize = Process::COUNT * MAX_READERS;
/// Attempts to remove a run's directory.
const REMOVALS: usize = 5;
/// Commands that wait for an answer at a time.
const MAX_PENDING_COMMANDS: usize = 16;

/// A service or node could not be created or opened.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// The name is not acceptable to iceoryx2.
    #[error("\"{name}\" cannot be used as a name in shared memory: {reason}")]
    Name {
        /// The name.
        name: String,
        /// iceoryx2's reason.
        reason: String,
    },
    /// iceoryx2 refused.
    #[error("shared memory: {action} of {name} failed: {reason}")]
    Refused {
        /// "creation", "opening", …
        action: &'static str,
        /// What was to be created or opened.
        name: String,
        /// iceoryx2's reason.
        reason: String,
    },
}

fn refused(action: &'static str, name: impl Into<String>) -> impl FnOnce(&dyn std::fmt::Debug) -> ServiceError {
    let name = name.into();
    move |reason| ServiceError::Refused {
        action,
        name,
        reason: reason_of(reason),
    }
}

fn invalid(name: &str) -> impl FnOnce(&dyn std::fmt::Debug) -> ServiceError {
    let name = name.to_owned();
    move |reason| ServiceError::Name {
        name,
        reason: format!("{reason:?}"),
    }
}

/// A node in the run's own corner of shared memory.
///
/// # Errors
/// The root directory or prefix is unusable, or the run has ended.
pub fn node(memory: &SharedMemory) -> Result<RunNode, ServiceError> {
    // A supervisor that ends removes the run's files, also those that a spectator has open; iceoryx2 would warn of each.
    iceoryx2::prelude::set_log_level(iceoryx2::prelude::LogLevel::Error);
    reserve::guard(memory);
    storage::ipc_files_are_in(&memory.root);
    let config = ipc_config(memory)?;
    let create = || {
        NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Shm>()
    };
    let root = File::open(&memory.root).map_err(|e| refused("opening", "the run's directory")(&e))?;
    let node = retry_on_full_disk(create).map_err(|e| refused("creation", "node")(&e))?;
    // A run that has ended meanwhile has removed its files, and this node has made some of them again.
    if has_been_removed(&root, &memory.root) {
        drop(node);
        remove_shared(memory);
        let made = memory.root.join(config.global.node.directory.to_string());
        if let Err(error) = std::fs::remove_dir_all(made).and_then(|()| std::fs::remove_dir(&memory.root)) {
            tracing::debug!(%error, path = %memory.root.display(), "cannot remove what a node has made");
        }
        return Err(refused("creation", "node")(&"the run has ended"));
    }
    reserve::close_to_others(memory);
    Ok(Arc::new(node))
}

/// True if the directory is not at `path` any more; another one may be.
fn has_been_removed(directory: &File, path: &Path) -> bool {
    match (directory.metadata(), std::fs::metadata(path)) {
        (Ok(opened), Ok(found)) => !is_same(&opened, &found),
        _ => true,
    }
}

fn remove_shared(memory: &SharedMemory) {
    reserve::release(memory);
    for path in reserve::files(memory) {
        if let Err(error) = std::fs::remove_file(&path)
            && error.kind() != ErrorKind::NotFound
        {
            tracing::warn!(%error, path = %path.display(), "cannot remove shared memory");
        }
    }
}

/// Removes a run's shared memory and its directory, which must be known to be a run's. Failures are only logged.
pub fn remove_files(memory: &SharedMemory) {
    remove_shared(memory);
    // A client that attaches at this moment may add a file.
    let removed = (0..REMOVALS).find_map(|_| std::fs::remove_dir_all(&memory.root).ok());
    if removed.is_none() && memory.root.exists() {
        tracing::warn!(path = %memory.root.display(), "cannot remove the run's directory");
    }
    remove_shared(memory);
}

/// Removes files of a run in shared memory whose creators were killed before they had set the size.
///
/// iceoryx2 creates a file and then sets its size. A process that opens the file waits for the size. In version 0.10 that wait has no time
/// limit if the process runs as `root`, which may read a file whose permissions are not set yet. It ends when the file is removed.
pub fn remove_unfinished(memory: &SharedMemory) {
    let is_unfinished = |path: &Path| {
        path.symlink_metadata()
            .ok()
            .filter(|data| data.is_file() && data.len() == 0)
    };
    let found = reserve::files(memory).filter_map(|path| is_unfinished(&path).map(|data| (path, data)));
    let mut unfinished: Vec<(PathBuf, Metadata)> =
        found.filter(|(path, _)| !reserve::is_reserve(memory, path)).collect();
    if unfinished.is_empty() {
        return;
    }
    for open in open_files() {
        unfinished.retain(|(_, data)| !is_same(data, &open));
    }
    // A creator that lives has the file open; it may have set the size meanwhile, and closed it.
    for (path, _) in unfinished {
        if is_unfinished(&path).is_some() {
            tracing::debug!(path = %path.display(), "a killed process had not given it a size: it is removed");
            // Someone else may have removed it.
            let _ = std::fs::remove_file(&path);
        }
    }
}

/// What the open files are of all processes that this user may look into.
fn open_files() -> impl Iterator<Item = Metadata> {
    let entries = |path: &Path| std::fs::read_dir(path).into_iter().flatten().flatten();
    let processes = entries(Path::new("/proc"));
    let handles = processes.flat_map(move |process| entries(&process.path().join("fd")));
    handles.filter_map(|handle| std::fs::metadata(handle.path()).ok())
}

fn is_same(one: &Metadata, other: &Metadata) -> bool {
    (one.dev(), one.ino()) == (other.dev(), other.ino())
}

/// Takes what dead processes left in the services that others hold open: their places there are free again.
pub fn forget_dead(node: &RunNode) {
    let global = &node.config().global;
    remove_unfinished(&SharedMemory {
        root: PathBuf::from(global.root_path().to_string()),
        prefix: global.prefix.to_string(),
    });
    let state = node.try_cleanup_dead_nodes();
    if state.failed_cleanups > 0 {
        tracing::warn!(?state, "a dead process is still in the way");
    }
}

fn ipc_config(memory: &SharedMemory) -> Result<IpcConfig, ServiceError> {
    let root = memory.root.to_string_lossy();
    let mut config = IpcConfig::default();
    let path = IpcPath::new(root.as_bytes()).map_err(|e| invalid(&root)(&e))?;
    config.global.set_root_path(&path);
    config.global.prefix = FileName::new(memory.prefix.as_bytes()).map_err(|e| invalid(&memory.prefix)(&e))?;
    // The supervisor cleans up after dead processes; a child that opens a service must not stall on it.
    config.global.service.cleanup_dead_nodes_on_open = false;
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    Ok(config)
}

/// Name of a service of environment `env_index`.
fn service_name(run: &RunFile, env_index: u32, service: &str) -> Result<ServiceName, ServiceError> {
    let name = format!("caraware/{}/{env_index}/{service}", run.name);
    ServiceName::new(&name).map_err(|e| invalid(&name)(&e))
}

/// Name and alignment of a data service.
fn data_name(run: &RunFile, env_index: u32, channel: Channel) -> Result<(ServiceName, Alignment), ServiceError> {
    let alignment = Alignment::new(ALIGNMENT).ok_or_else(|| invalid("alignment")(&ALIGNMENT))?;
    Ok((service_name(run, env_index, channel.name())?, alignment))
}

fn data_builder(
    node: &Node<Shm>,
    (name, alignment): &(ServiceName, Alignment),
    run: &RunFile,
    channel: Channel,
) -> DataBuilder<[u8], MessageHeader, Shm> {
    node.service_builder(name)
        .publish_subscribe::<[u8]>()
        .user_header::<MessageHeader>()
        .payload_alignment(*alignment)
        .enable_safe_overflow(channel.spec().when_full == FullQueue::DropOldest)
        .history_size(0)
        .max_publishers(2)
        .max_subscribers(channel.max_subscribers())
        .max_nodes(MAX_NODES)
        .subscriber_max_buffer_size(channel.queue_length(run))
        .subscriber_max_borrowed_samples((channel.spec().in_hand)(run))
}

/// Opens a data service.
///
/// # Errors
/// It does not exist, or its layout differs from this program's.
pub fn open_data(
    node: &Node<Shm>,
    run: &RunFile,
    env_index: u32,
    channel: Channel,
) -> Result<DataService, ServiceError> {
    let name = data_name(run, env_index, channel)?;
    retry_on_full_disk(|| data_builder(node, &name, run, channel).open())
        .map_err(|e| refused("opening", channel.name())(&e))
}

/// Opens the service for commands.
///
/// # Errors
/// It does not exist.
pub fn open_control(node: &Node<Shm>, run: &RunFile, env_index: u32) -> Result<ControlService, ServiceError> {
    let name = service_name(run, env_index, "control")?;
    retry_on_full_disk(|| control_builder(node, &name).open()).map_err(|e| refused("opening", "control")(&e))
}

fn control_builder(node: &Node<Shm>, name: &ServiceName) -> ControlBuilder<ControlRequest, (), ControlReply, (), Shm> {
    node.service_builder(name)
        .request_response::<ControlRequest, ControlReply>()
        .enable_safe_overflow_for_requests(false)
        .enable_safe_overflow_for_responses(false)
        .enable_fire_and_forget_requests(false)
        .max_active_requests_per_client(MAX_PENDING_COMMANDS)
        .max_loaned_requests(1)
        .max_response_buffer_size(1)
        .max_borrowed_responses_per_pending_response(1)
        .max_servers(1)
        .max_clients(2)
        .max_nodes(MAX_NODES)
}

/// The boards of a process of one environment: each incarnation has its own, because iceoryx2 leaves the entries of a killed writer
/// locked.
#[derive(Debug, Clone)]
pub struct BoardSeries(String);

impl BoardSeries {
    /// The boards of `process` in environment `env_index`.
    #[must_use]
    pub fn new(run: &RunFile, env_index: u32, process: Process) -> Self {
        Self(format!("caraware/{}/{env_index}/board/{process}", run.name))
    }

    fn name(&self, incarnation: u32) -> Result<ServiceName, ServiceError> {
        let name = format!("{}/{incarnation}", self.0);
        ServiceName::new(&name).map_err(|e| invalid(&name)(&e))
    }

    /// Opens the board of an incarnation.
    ///
    /// # Errors
    /// It does not exist: the supervisor has not created it yet, or has removed it.
    pub fn open(&self, node: &Node<Shm>, incarnation: u32) -> Result<BoardService, ServiceError> {
        let name = self.name(incarnation)?;
        retry_on_full_disk(|| node.service_builder(&name).blackboard_opener::<u32>().open())
            .map_err(|e| refused("opening", format!("{}/{incarnation}", self.0))(&e))
    }

    fn create(&self, node: &Node<Shm>, incarnation: u32) -> Result<BoardService, ServiceError> {
        let name = self.name(incarnation)?;
        let create = || {
            node.service_builder(&name)
                .blackboard_creator::<u32>()
                .max_readers(MAX_READERS)
                .max_nodes(MAX_NODES)
                .add(PROGRESS_KEY, Progress::default())
                .add(HEALTH_KEY, Health::default())
                .add(TRAINING_KEY, TrainingStatus::default())
                .add(ACTIVITY_KEY, Activity::default())
                .create()
        };
        retry_on_full_disk(create).map_err(|e| refused("creation", format!("{}/{incarnation}", self.0))(&e))
    }
}

/// Opens the roster: which incarnation of each process counts.
///
/// # Errors
/// It does not exist.
pub fn open_roster(node: &Node<Shm>, run: &RunFile, env_index: u32) -> Result<BoardService, ServiceError> {
    let name = service_name(run, env_index, "roster")?;
    retry_on_full_disk(|| node.service_builder(&name).blackboard_opener::<u32>().open())
        .map_err(|e| refused("opening", "roster")(&e))
}

/// Opens the wake-up service of a process.
///
/// # Errors
/// It does not exist.
pub fn open_wake(
    node: &Node<Shm>,
    run: &RunFile,
    env_index: u32,
    process: Process,
) -> Result<WakeService, ServiceError> {
    let name = wake_name(run, env_index, process)?;
    retry_on_full_disk(|| node.service_builder(&name).event().open())
        .map_err(|e| refused("opening", format!("wake-up of {process}"))(&e))
}

/// A process of the whole run waits for all environments at once: its wake-up is that of environment 0.
fn wake_name(run: &RunFile, env_index: u32, process: Process) -> Result<ServiceName, ServiceError> {
    let home = match process.spec().scope {
        ProcessScope::Run => 0,
        ProcessScope::Environment => env_index,
    };
    service_name(run, home, &format!("wake/{process}"))
}

/// A listener that empties itself when it wakes.
pub type WakeListener = Listener<Shm>;

/// All services of one environment, held open as long as the run lives.
#[derive(Debug)]
pub struct ServiceHolder {
    /// Data services, in the order of [`Channel::ALL`].
    _data: Vec<DataService>,
    /// Boards of each process, in the order of [`Process::ALL`]: of its newest incarnation, and of the one before, from which readers
    /// may still have to turn.
    boards: Vec<VecDeque<BoardService>>,
    roster: BoardService,
    control: ControlService,
    _wakes: Vec<WakeService>,
}

impl ServiceHolder {
    /// Creates every service of environment `env_index`.
    ///
    /// # Errors
    /// iceoryx2 refuses one.
    pub fn create(node: &Node<Shm>, run: &RunFile, env_index: u32) -> Result<Self, ServiceError> {
        let data = Channel::ALL.into_iter().map(|channel| {
            let name = data_name(run, env_index, channel)?;
            retry_on_full_disk(|| data_builder(node, &name, run, channel).create())
                .map_err(|e| refused("creation", channel.name())(&e))
        });
        let boards = Process::ALL.into_iter().map(|process| {
            let first = BoardSeries::new(run, env_index, process).create(node, 0)?;
            Ok(VecDeque::from([first]))
        });
        let wakes = Process::ALL
            .into_iter()
            .filter(|process| env_index == 0 || process.spec().scope == ProcessScope::Environment)
            .map(|process| create_wake(node, run, env_index, process));
        let control = service_name(run, env_index, "control")?;
        Ok(Self {
            _data: data.collect::<Result<_, _>>()?,
            boards: boards.collect::<Result<_, ServiceError>>()?,
            roster: create_roster(node, run, env_index)?,
            control: retry_on_full_disk(|| control_builder(node, &control).create())
                .map_err(|e| refused("creation", "control")(&e))?,
            _wakes: wakes.collect::<Result<_, _>>()?,
        })
    }

    /// Creates the board of the next incarnation of `process`, and removes the one before the present one. Call it before the roster
    /// names that incarnation.
    ///
    /// # Errors
    /// iceoryx2 refuses.
    pub fn add_board(
        &mut self,
        node: &Node<Shm>,
        run: &RunFile,
        process: Process,
        incarnation: u32,
    ) -> Result<(), ServiceError> {
        let board = BoardSeries::new(run, run.env_index, process).create(node, incarnation)?;
        let boards = &mut self.boards[process.index()];
        boards.push_back(board);
        while boards.len() > KEPT_BOARDS {
            boards.pop_front();
        }
        Ok(())
    }

    /// The service for commands.
    #[must_use]
    pub fn control(&self) -> &ControlService {
        &self.control
    }

    /// The roster.
    #[must_use]
    pub fn roster(&self) -> &BoardService {
        &self.roster
    }
}

fn create_roster(node: &Node<Shm>, run: &RunFile, env_index: u32) -> Result<BoardService, ServiceError> {
    let name = service_name(run, env_index, "roster")?;
    let create = || {
        node.service_builder(&name)
            .blackboard_creator::<u32>()
            .max_readers(MAX_ROSTER_READERS)
            .max_nodes(MAX_NODES)
            .add(ROSTER_KEY, Roster::default())
            .create()
    };
    retry_on_full_disk(create).map_err(|e| refused("creation", "roster")(&e))
}

fn create_wake(node: &Node<Shm>, run: &RunFile, env_index: u32, process: Process) -> Result<WakeService, ServiceError> {
    let envs = run.config.run.envs as usize;
    let name = wake_name(run, env_index, process)?;
    let create = || {
        node.service_builder(&name)
            .event()
            .max_nodes(MAX_NODES + Process::ALL.len() * envs)
            .max_notifiers(2 * Process::ALL.len() * envs)
            .max_listeners(2)
            .event_id_max_value(1)
            .create()
    };
    retry_on_full_disk(create).map_err(|e| refused("creation", format!("wake-up of {process}"))(&e))
}
