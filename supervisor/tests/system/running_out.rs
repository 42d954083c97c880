//! Whole runs that run out of shared memory, of disk space or of file handles: a clear error or a wait, never a signal or a hang.

use std::{
    collections::{BTreeMap, BTreeSet},
    ffi::OsString,
    fs::{DirBuilder, File},
    io::Write as _,
    net::TcpStream,
    os::{
        fd::AsRawFd as _,
        unix::{fs::DirBuilderExt as _, process::ExitStatusExt as _},
    },
    path::{Path, PathBuf},
    process::{Child, Command, Output, Stdio},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use crate::common::{Workplace, free_port, text, until, with_mounts};
use rustix::process::{Pid, Resource, Rlimit, Signal, getrlimit, kill_process, prlimit};

/// A short training run of six vehicles, without viewers.
const SHORT: [&str; 12] = [
    "traffic.cavs=6",
    "traffic.others=3",
    "traffic.pedestrians=3",
    "episode.ticks=150",
    "episode.training_episodes=4",
    "episode.evaluation_interval=2",
    "episode.evaluation_ticks=40",
    "trainer.checkpoint_interval=1",
    "trainer.plots=false",
    "trainer.horizon=900",
    "trainer.batch_size=300",
    "fanout.enabled=false",
];

fn train<'a>(name: &'a str, settings: &[&'a str]) -> Vec<&'a str> {
    let set = SHORT.iter().chain(settings).flat_map(|setting| ["--set", *setting]);
    ["train", "town", "--name", name].into_iter().chain(set).collect()
}

/// Process id of the process whose command line has both words.
fn pid_of(words: [&str; 2]) -> Option<Pid> {
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    let pids = processes.filter_map(|entry| entry.file_name().to_string_lossy().parse::<i32>().ok());
    pids.filter_map(Pid::from_raw).find(|pid| {
        let line = std::fs::read(format!("/proc/{}/cmdline", pid.as_raw_nonzero())).unwrap_or_default();
        let line = String::from_utf8_lossy(&line).replace('\0', " ");
        words.iter().all(|word| line.contains(word)) && !line.contains("unshare")
    })
}

/// Processor time of the processes with `word` in their command lines, in the kernel's ticks of 10 ms, and those that run or could.
/// The supervisor is left out, because it looks for space all the time.
fn processor_time(word: &str) -> (u64, BTreeSet<OsString>) {
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    let ours = processes.filter(|entry| {
        let line = std::fs::read(entry.path().join("cmdline")).unwrap_or_default();
        String::from_utf8_lossy(&line).contains(word)
    });
    let (mut ticks, mut busy) = (0, BTreeSet::new());
    for entry in ours {
        let stat = std::fs::read_to_string(entry.path().join("stat")).unwrap_or_default();
        if stat.contains("(caraware)") {
            continue;
        }
        // The name in parentheses may have spaces; see proc_pid_stat(5).
        let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
        let number = |index: usize| {
            fields
                .get(index)
                .and_then(|field| field.parse::<u64>().ok())
                .unwrap_or(0)
        };
        if fields.first() == Some(&"R") {
            busy.insert(entry.file_name());
        }
        ticks += number(11) + number(12);
    }
    (ticks, busy)
}

/// Another program's file, which takes all space of a file system until it is dropped, also what is freed later: a process whose
/// checkpoint does not fit removes what it has written of it.
struct Filling {
    path: PathBuf,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Filling {
    /// Returns once the file system of `directory` is full.
    fn of(directory: &Path) -> Self {
        let path = directory.join("other");
        let file = File::create(&path).unwrap();
        fill(&file);
        let stop = Arc::new(AtomicBool::new(false));
        let seen = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            while !seen.load(Relaxed) {
                std::thread::park_timeout(Duration::from_millis(1));
                fill(&file);
            }
        });
        Self {
            path,
            stop,
            thread: Some(thread),
        }
    }
}

impl Drop for Filling {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        self.thread.take().map(JoinHandle::join);
        std::fs::remove_file(&self.path).unwrap();
    }
}

/// What a run writes to its standard error, shown where a test fails.
struct Said(PathBuf);

impl Said {
    fn read(&self) -> String {
        std::fs::read_to_string(&self.0).unwrap()
    }
}

impl Drop for Said {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("{}", self.read());
        }
    }
}

/// Writes to `file` until not one byte more has space.
fn fill(mut file: &File) {
    let block = vec![1_u8; 1 << 16];
    let mut size = block.len();
    // What is left is too little for a block: smaller ones follow.
    while size > 0 {
        if file.write_all(&block[..size]).is_err() {
            size /= 2;
        }
    }
}

fn assert_ended_clearly(output: &Output, what: &str) {
    assert_eq!(output.status.signal(), None, "{what}: {}", text(output));
    assert!(
        output.status.success() || !text(output).contains("panicked"),
        "{what}: {}",
        text(output)
    );
}

#[test]
fn little_shared_memory_is_an_error_that_names_what_is_needed() {
    let workplace = Workplace::new();
    for mib in [1, 16, 64] {
        let name = format!("of-{mib}");
        let mount = format!("mount -t tmpfs -o size={mib}m none /dev/shm");
        let Some(mut command) = with_mounts(&workplace.command(&train(&name, &[])), &mount) else {
            return;
        };
        let output = command.output().unwrap();
        assert_ended_clearly(&output, &name);
        let said = text(&output);
        match mib {
            64 => assert!(output.status.success(), "{said}"),
            mib => {
                assert_eq!(output.status.code(), Some(3), "{said}");
                assert!(
                    said.contains(&format!("/dev/shm has {mib} MiB free, but this run needs")),
                    "{said}"
                );
                assert!(said.contains("--shm-size"), "{said}");
            }
        }
    }
    workplace.assert_nothing_left();
}

#[test]
fn a_run_keeps_the_memory_that_it_reserved_when_others_fill_the_rest() {
    let workplace = Workplace::new();
    let hash = |name: &str| workplace.report(name)["observation_hash"].clone();
    workplace.succeed(&train("alone", &[]));
    // Another program fills the memory as soon as the run has been prepared: no process has started.
    let disturb = "mount -t tmpfs -o size=80m none /dev/shm && \
        { (until [ -s /dev/shm/*reserve ]; do :; done; cat /dev/zero > /dev/shm/other; touch filled) > /dev/null 2>&1 & }";
    let command = workplace.command(&train("beside", &[]));
    let Some(mut command) = with_mounts(&command, disturb) else {
        return;
    };
    let mut run = command.stderr(Stdio::piped()).spawn().unwrap();
    // The trainer is killed while the memory is full: its successor gets what it had.
    let checkpoint = workplace.path().join("runs/beside/checkpoints/latest");
    until(&mut run, "checkpoint", || checkpoint.exists().then_some(()));
    assert!(workplace.path().join("filled").exists());
    let trainer = pid_of(["caraware.train", &workplace.path().to_string_lossy()]);
    let killed = trainer.is_some_and(|pid| kill_process(pid, Signal::KILL).is_ok());
    let output = run.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    assert_eq!(hash("alone"), hash("beside"));
    assert!(!killed || workplace.report("beside")["lost_ticks"] == 0);
    workplace.assert_nothing_left();
}

/// A run whose files and iceoryx2's are on a small disk, which is full once the run has a checkpoint.
struct RunOnFullDisk {
    run: Child,
    /// The disk, as this process sees it, also after the run's end.
    disk: PathBuf,
    filling: Filling,
    /// Keeps `disk` until the file that fills it is removed.
    _held: File,
    said: Said,
}

impl RunOnFullDisk {
    /// `None` if this system allows no mounts. `options` are the command's, `settings` the run's.
    fn start(workplace: &Workplace, options: &[&str], settings: &[&str]) -> Option<Self> {
        let small = workplace.path().join("small");
        std::fs::create_dir(&small).unwrap();
        let arguments = [&train("full", settings)[..], options, &["--runs", "small"]].concat();
        let mount = format!("mount -t tmpfs -o size=48m none {}", small.display());
        let mut command = workplace.command(&arguments);
        command.env("CARAWARE_RUNTIME_DIR", small.join("r"));
        let mut command = with_mounts(&command, &mount)?;
        let said = Said(workplace.path().join("said"));
        command.stderr(File::create(&said.0).unwrap()).stdout(Stdio::null());
        let mut run = command.spawn().unwrap();
        // The run's mounts are seen through its process, and through an open directory also after its end.
        let inside = PathBuf::from(format!("/proc/{}/root{}", run.id(), small.display()));
        until(&mut run, "checkpoint", || {
            inside.join("full/checkpoints/latest").exists().then_some(())
        });
        let held = File::open(&inside).unwrap();
        let disk = PathBuf::from(format!("/proc/self/fd/{}", held.as_raw_fd()));
        let filling = Filling::of(&disk);
        Some(Self {
            run,
            disk,
            filling,
            _held: held,
            said,
        })
    }

    /// A command of caraware that sees the run's disk.
    fn inside(&self, workplace: &Workplace, arguments: &[&str]) -> Command {
        let alone = workplace.command(arguments);
        let mut inside = Command::new("nsenter");
        inside.args(["--target", &self.run.id().to_string(), "--mount"]);
        if !rustix::process::getuid().is_root() {
            inside.args(["--user", "--preserve-credentials"]);
        }
        inside.args(["sh", "-c", "cd \"$0\" && exec \"$@\""]);
        inside.arg(alone.get_current_dir().unwrap());
        inside.arg(alone.get_program()).args(alone.get_args());
        inside.envs(alone.get_envs().filter_map(|(key, value)| Some((key, value?))));
        inside.env("CARAWARE_RUNTIME_DIR", workplace.path().join("small/r"));
        inside
    }

    fn wait_until_it_says(&mut self, words: &str) {
        let said = &self.said;
        until(&mut self.run, words, || said.read().contains(words).then_some(()));
    }

    /// Waits until the run stands still: for two seconds none of its processes has computed or wanted to. Their logs do not say that
    /// they wait, because there is no space for that either.
    ///
    /// A process that only looks whether there is space again gets its core late where others use the machine. So a process wants to
    /// compute if it is seen so without a pause.
    fn wait_until_it_stands_still(&mut self) {
        const LOOKS: u32 = 8;
        const MOST_TICKS: u64 = 10;
        let workplace = self.said.0.parent().unwrap().to_string_lossy().into_owned();
        let mut since = (Instant::now(), u64::MAX);
        let mut looks = BTreeMap::new();
        until(&mut self.run, "a run that stands still", || {
            let (ticks, busy) = processor_time(&workplace);
            looks.retain(|process, _| busy.contains(process));
            for process in busy {
                *looks.entry(process).or_insert(0) += 1;
            }
            if looks.values().any(|&looks| looks >= LOOKS) || ticks.abs_diff(since.1) > MOST_TICKS {
                since = (Instant::now(), ticks);
            }
            std::thread::park_timeout(Duration::from_millis(20));
            (since.0.elapsed() > Duration::from_secs(2)).then_some(())
        });
    }

    /// Frees the disk, and waits for the run's end. Returns its report, what it said, and what its processes have logged.
    fn finish(mut self) -> (serde_json::Value, String, String) {
        drop(self.filling);
        let status = self.run.wait().unwrap();
        let said = self.said.read();
        let logs = logs(&self.disk);
        assert!(status.success(), "{said}\n{logs}");
        let report = std::fs::read_to_string(self.disk.join("full/report.json")).unwrap();
        (serde_json::from_str(&report).unwrap(), said, logs)
    }
}

/// A killed supervisor is started again once there is space. Another run is refused meanwhile, and leaves nothing.
#[test]
fn a_run_with_restart_waits_for_space_before_it_resumes() {
    let workplace = Workplace::new();
    let longer = ["episode.training_episodes=10"];
    workplace.succeed(&train("alone", &longer));
    let reference = workplace.report("alone")["observation_hash"].clone();
    let Some(mut full) = RunOnFullDisk::start(&workplace, &["--restart"], &longer) else {
        return;
    };
    full.wait_until_it_says("is full");
    let run: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(full.disk.join("full/run.json")).unwrap()).unwrap();
    let supervisor = i32::try_from(run["supervisor_pid"].as_i64().unwrap()).unwrap();
    kill_process(Pid::from_raw(supervisor).unwrap(), Signal::KILL).unwrap();
    full.wait_until_it_says("the run resumes once there is space");
    // Its results would go to another disk.
    let other = full.inside(&workplace, &train("other", &[])).output().unwrap();
    assert_eq!(other.status.code(), Some(1), "{}", text(&other));
    assert!(text(&other).contains("caraware-run.json"), "{}", text(&other));
    let left = std::fs::read_dir(full.disk.join("r")).into_iter().flatten().flatten();
    let unnamed: Vec<_> = left
        .map(|entry| entry.file_name())
        .filter(|name| name.to_string_lossy().len() == ".0123abcd".len())
        .collect();
    assert!(unnamed.is_empty(), "{unnamed:?}");
    let (report, said, _) = full.finish();
    assert_undisturbed(&report, &reference, &said);
}

/// The run has completed with this observation hash, and has lost or learnt twice nothing.
fn assert_undisturbed(report: &serde_json::Value, reference: &serde_json::Value, said: &str) {
    assert_eq!(
        (&report["result"], &report["observation_hash"]),
        (&"completed".into(), reference),
        "{said}"
    );
    assert_eq!(
        (&report["lost_ticks"], &report["duplicated_ticks"]),
        (&0.into(), &0.into())
    );
}

/// What the processes of the run on `disk` have logged.
fn logs(disk: &Path) -> String {
    let logs = std::fs::read_dir(disk.join("full/logs")).unwrap().flatten();
    logs.filter_map(|entry| std::fs::read_to_string(entry.path()).ok())
        .collect()
}

#[test]
fn a_full_disk_is_waited_for() {
    let workplace = Workplace::new();
    let longer = ["episode.training_episodes=10"];
    workplace.succeed(&train("alone", &longer));
    let reference = workplace.report("alone")["observation_hash"].clone();
    let Some(mut full) = RunOnFullDisk::start(&workplace, &[], &longer) else {
        return;
    };
    // Whichever process is the first to need space waits for it.
    full.wait_until_it_says("is full");
    full.wait_until_it_stands_still();
    let (report, said, logs) = full.finish();
    assert!(said.contains("has space again"), "{said}");
    assert!(logs.contains("there is space again"), "{logs}");
    assert_eq!(
        (&report["result"], &report["observation_hash"]),
        (&"completed".into(), &reference)
    );
    assert_eq!((&report["lost_ticks"], &report["restarts"]), (&0.into(), &0.into()));
    assert!(report["disk_full"].as_u64().unwrap() >= 1, "{report:#}");
}

/// What dies while the disk is full is started again, and has its part of shared memory once there is space.
#[test]
fn processes_that_die_while_the_disk_is_full_are_replaced() {
    let workplace = Workplace::new();
    let longer = ["episode.training_episodes=10"];
    workplace.succeed(&train("alone", &longer));
    let reference = workplace.report("alone")["observation_hash"].clone();
    let Some(mut full) = RunOnFullDisk::start(&workplace, &[], &longer) else {
        return;
    };
    full.wait_until_it_says("is full");
    let kill = |name| {
        let pid = pid_of([name, &workplace.path().to_string_lossy()]).unwrap();
        kill_process(pid, Signal::KILL).unwrap();
    };
    kill("caraware.train");
    full.wait_until_it_says("a successor continues");
    kill("/sim-core");
    // The supervisor needs space for the successor, be it in iceoryx2's directory or in run.json.
    full.wait_until_it_says("WARN the disk is full: ");
    let (report, said, _) = full.finish();
    assert_undisturbed(&report, &reference, &said);
    assert!(report["restarts"].as_u64().unwrap() >= 1, "{report:#}");
}

/// The directory of a run is moved away while the run is alive: it ends with an error that names it.
#[test]
fn a_directory_that_vanishes_is_named() {
    let workplace = Workplace::new();
    let said = workplace.path().join("said");
    let mut command = workplace.command(&train("results", &["episode.training_episodes=100000"]));
    let mut run = command.stderr(File::create(&said).unwrap()).spawn().unwrap();
    let begun = workplace.path().join("runs/results/learning.jsonl");
    until(&mut run, "update", || begun.exists().then_some(()));
    // At once, because processes write into it meanwhile.
    std::fs::rename(
        workplace.path().join("runs/results"),
        workplace.path().join("elsewhere"),
    )
    .unwrap();
    let status = run.wait().unwrap();
    let said = std::fs::read_to_string(&said).unwrap();
    // Lines are broken to the width of the terminal.
    let words: Vec<&str> = said.split_whitespace().filter(|word| *word != "│").collect();
    let words = words.join(" ");
    assert!(words.contains("was removed while the run was alive"), "{said}");
    assert!(status.code() == Some(1) && !said.contains("panicked"), "{said}");
    assert!(workplace.shared_memory().is_empty(), "{:?}", workplace.shared_memory());
}

/// The runtime directory of a live run is removed. Nothing can be opened in it any more: sooner or later a process needs that, be it at
/// the start of an episode or because another has died. Then the run ends, with a reason, a checkpoint and a report, and can be resumed.
#[test]
fn a_runtime_directory_that_vanishes_is_named() {
    for killed in [None, Some("caraware.train"), Some("/sim-core")] {
        let workplace = Workplace::new();
        let said = Said(workplace.path().join("said"));
        let mut command = workplace.command(&train("results", &["episode.training_episodes=100000"]));
        let mut run = command.stderr(File::create(&said.0).unwrap()).spawn().unwrap();
        let checkpoint = workplace.path().join("runs/results/checkpoints/latest");
        until(&mut run, "checkpoint", || checkpoint.exists().then_some(()));
        assert!(
            !workplace.shared_memory().is_empty(),
            "the names of its files are known"
        );
        std::fs::remove_dir_all(workplace.path().join("run")).unwrap();
        // A process that has found it out by itself may have ended already.
        if let Some(pid) = killed.and_then(|name| pid_of([name, &workplace.path().to_string_lossy()])) {
            let _ = kill_process(pid, Signal::KILL);
        }
        let status = run.wait().unwrap();
        assert_eq!(status.code(), Some(1), "{killed:?}: {status}");
        let words = said.read().replace('│', "");
        let words = words.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(words.contains("was removed while the run was alive"), "{killed:?}");
        assert!(!words.contains("panicked"), "{killed:?}");
        let report = workplace.report("results");
        assert_eq!(report["result"], "failed", "{report:#}");
        assert!(
            report["failure"].to_string().contains("the runtime directory"),
            "{report:#}"
        );
        assert!(report["checkpoint"].is_string(), "{report:#}");
        workplace.assert_nothing_left();
        let resumed = ["train", "--resume", "results", "--set", "episode.training_episodes=2"];
        let registry = workplace.path().join("run");
        DirBuilder::new().mode(0o700).recursive(true).create(registry).unwrap();
        workplace.succeed(&resumed);
        assert_eq!(workplace.report("results")["lost_ticks"], 0);
    }
}

/// `command` in a shell that first runs `before`.
fn in_shell(command: &Command, before: &str) -> Command {
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!("{before} && exec \"$@\""), "sh"]);
    shell.arg(command.get_program()).args(command.get_args());
    shell.current_dir(command.get_current_dir().unwrap());
    shell.envs(command.get_envs().filter_map(|(key, value)| Some((key, value?))));
    shell
}

#[test]
fn too_few_file_handles_are_an_error_that_names_the_limit() {
    let workplace = Workplace::new();
    for limit in [12, 24, 48, 64, 96, 128, 192, 256] {
        let command = workplace.command(&train("handles", &[]));
        let output = in_shell(&command, &format!("ulimit -n {limit}")).output().unwrap();
        let said = text(&output);
        assert_eq!(output.status.code(), Some(3), "{limit}: {said}");
        assert!(
            said.contains(&format!("a process may open {limit} files")),
            "{limit}: {said}"
        );
        assert!(said.contains("`ulimit -n 320`"), "{limit}: {said}");
    }
    assert!(!workplace.path().join("runs").exists());
    // What is asked for is enough, and a limit that the user may raise is raised.
    for (name, before) in [("hard", "ulimit -n 320"), ("soft", "ulimit -S -n 64")] {
        let output = in_shell(&workplace.command(&train(name, &[])), before)
            .output()
            .unwrap();
        assert!(output.status.success(), "{before}: {}", text(&output));
    }
    workplace.assert_nothing_left();
}

/// Numbers of the files that a process has open.
fn open_files(pid: Pid) -> BTreeSet<u64> {
    let numbers = std::fs::read_dir(format!("/proc/{}/fd", pid.as_raw_nonzero())).unwrap();
    let numbers = numbers.flatten();
    numbers
        .filter_map(|entry| entry.file_name().to_str()?.parse().ok())
        .collect()
}

/// Lowers the soft limit of a running process: from now on it may open files with numbers below `limit` only.
fn limit_open_files(pid: Pid, limit: u64) {
    let limit = Rlimit {
        current: Some(limit),
        maximum: getrlimit(Resource::Nofile).maximum,
    };
    prlimit(Some(pid), Resource::Nofile, limit).unwrap();
}

/// The exit code of a run that must end by itself within two minutes.
fn exit_code_in_time(run: &mut Child) -> i32 {
    let begun = Instant::now();
    loop {
        if let Some(status) = run.try_wait().unwrap() {
            return status
                .code()
                .unwrap_or_else(|| panic!("the run ended with a signal: {status}"));
        }
        assert!(begun.elapsed() < Duration::from_secs(120), "the run hangs");
        std::thread::park_timeout(Duration::from_millis(20));
    }
}

/// A process that can open no further file ends the run with an error that says so, as soon as it needs one; the supervisor needs
/// some to replace another process. A trainer that cannot even write its failure is replaced. The fan-out does without: no viewer is
/// let in, and the run is completed.
#[test]
fn a_process_that_runs_out_of_file_handles_ends_the_run_with_an_error() {
    let processes = [
        "supervisor",
        "/traffic-bridge",
        "/sim-core",
        "/sensor-daemon",
        "caraware.train",
        "/fanout",
    ];
    for exhausted in processes {
        let workplace = Workplace::new();
        let here = workplace.path().to_string_lossy().into_owned();
        let said = Said(workplace.path().join("said"));
        let port = free_port();
        let listen = format!("fanout.listen=tcp/127.0.0.1:{port}");
        let settings = [
            "episode.training_episodes=8",
            "run.real_time_factor=20",
            "fanout.enabled=true",
            &listen,
        ];
        let mut command = workplace.command(&train("handles", &settings));
        let mut run = command.stderr(File::create(&said.0).unwrap()).spawn().unwrap();
        let checkpoint = workplace.path().join("runs/handles/checkpoints/latest");
        until(&mut run, "checkpoint", || checkpoint.exists().then_some(()));
        if exhausted == "supervisor" {
            // What it closes at the end it may use for cleaning up.
            let supervisor = Pid::from_child(&run);
            limit_open_files(supervisor, open_files(supervisor).len() as u64);
            kill_process(pid_of(["/sim-core", &here]).unwrap(), Signal::KILL).unwrap();
        } else {
            let pid = pid_of([exhausted, &here]).unwrap();
            let open = open_files(pid);
            limit_open_files(pid, (0..).find(|number| !open.contains(number)).unwrap());
        }
        let _viewers: Vec<_> = (0..4).map(|_| TcpStream::connect(("127.0.0.1", port))).collect();
        let code = exit_code_in_time(&mut run);
        let report = workplace.report("handles");
        let failure = report["failure"].to_string();
        // The files that the end of another process closes may suffice for its replacement; a trainer that cannot write its failure is
        // replaced like one that is killed.
        let may_complete = ["supervisor", "/fanout", "caraware.train"].contains(&exhausted);
        if may_complete && report["result"] == "completed" {
            assert_eq!((code, &report["lost_ticks"]), (0, &0.into()), "{exhausted}");
        } else {
            assert_eq!((code, &report["result"]), (1, &"failed".into()), "{exhausted}");
            assert!(
                exhausted != "/fanout" && failure.contains("Too many open files"),
                "{exhausted}: {failure}"
            );
        }
        assert!(!said.read().contains("panicked"), "{exhausted}");
        workplace.assert_nothing_left();
    }
}

/// A control group with a limit on memory. Dropping it removes it.
struct LimitedGroup(PathBuf);

impl LimitedGroup {
    /// A group of either version; `None` if this user may not create one.
    fn new(limit_mib: u64) -> Option<Self> {
        let name = format!("caraware-test-{}", std::process::id());
        let version_1 = (
            "/sys/fs/cgroup/memory",
            "memory.limit_in_bytes",
            "memory.memsw.limit_in_bytes",
        );
        let version_2 = ("/sys/fs/cgroup", "memory.max", "memory.swap.max");
        [version_1, version_2].into_iter().find_map(|(parent, limit, swap)| {
            let group = Self(Path::new(parent).join(&name));
            std::fs::create_dir(&group.0).ok()?;
            // Below a directory that is no control group no such file appears.
            let limit = group.0.join(limit);
            let limited = limit.exists() && std::fs::write(&limit, (limit_mib << 20).to_string()).is_ok();
            let swap = group.0.join(swap);
            if swap.exists() {
                let most = if swap.ends_with("memory.swap.max") {
                    0
                } else {
                    limit_mib << 20
                };
                std::fs::write(&swap, most.to_string()).ok()?;
            }
            limited.then_some(group)
        })
    }
}

impl Drop for LimitedGroup {
    fn drop(&mut self) {
        // A group whose processes have just ended may need a moment.
        for _ in 0..100 {
            if std::fs::remove_dir(&self.0).is_ok() {
                return;
            }
            std::thread::park_timeout(Duration::from_millis(50));
        }
    }
}

/// The kernel kills a trainer that needs more than the group's limit: the run ends with a report that says so. The weights alone need
/// 2 GiB; what a trainer of the preset needs (200 MiB, and its libraries' pages) is too near what the simulators need.
///
/// A page of a file counts for the group that read it first. A run outside the group reads what the programs need: else the kernel takes
/// the running programs' own pages from them, and reads them again, for minutes before it kills anyone.
#[test]
fn a_limit_on_memory_that_the_kernel_enforces_is_named() {
    const LIMIT_MIB: u64 = 800;
    let workplace = Workplace::new();
    let Some(group) = LimitedGroup::new(LIMIT_MIB) else {
        eprintln!("not tested: this user may not create a control group with a limit on memory");
        return;
    };
    workplace.succeed(&train("before", &["episode.ticks=2", "episode.training_episodes=1"]));
    let join = format!("echo $$ > {}/cgroup.procs", group.0.display());
    let output = in_shell(
        &workplace.command(&train("limited", &["trainer.hidden=[16384,16384]"])),
        &join,
    )
    .output()
    .unwrap();
    assert_ended_clearly(&output, "limited");
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    let report = workplace.report("limited");
    assert_eq!(report["result"], "failed", "{report:#}");
    let message = report["failure"]["message"].as_str().unwrap();
    let named = format!("the kernel has ended trainer: the limit on memory of {LIMIT_MIB} MiB was reached");
    assert!(message.contains(&named), "{message}");
    workplace.assert_nothing_left();
}
