//! Viewers that draw nothing: they count the samples that arrive, that are lost on the way and that must be refused. For tests and
//! `caraware bench fanout`.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{self, LineWriter, Read, Write},
    net::{TcpListener, TcpStream},
    process::ExitCode,
    sync::{Arc, Mutex, PoisonError},
    thread,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use fanout::{
    network::{endpoint, keys::RunKeys, publisher::read_attachment},
    reader,
};
use ipc_schema::{
    header::MessageHeader,
    process_main::{answer_help, misused},
};
use zenoh::{Wait, sample::Sample};

const USAGE: &str = "\
usage: fanout-watch ENDPOINT RUN [OPTIONS]

Viewers that draw nothing: they print as JSON how many samples have arrived, were lost, and must be refused.

  --env N          the environment; default 0
  --viewers N      default 1
  --seconds S      default 10
  --bytes-per-s B  speed of the link; 0, the default, leaves it as it is
  --log FILE       receives a line for each `world` frame: tick, and UNIX time in nanoseconds";

type Failure = Box<dyn std::error::Error + Send + Sync>;

/// The command line.
struct WatchOptions {
    endpoint: String,
    run: String,
    env: u32,
    viewers: usize,
    seconds: f64,
    /// Speed of the link; 0 leaves it as it is.
    bytes_per_s: u64,
    /// Receives a line for each `world` frame: tick and UNIX time in nanoseconds.
    log: Option<File>,
}

impl WatchOptions {
    fn read() -> Result<Self, Failure> {
        let mut arguments = std::env::args().skip(1);
        let mut next = |what: &str| arguments.next().ok_or_else(|| format!("{what} is missing"));
        let mut options = Self {
            endpoint: next("ENDPOINT")?,
            run: next("RUN")?,
            env: 0,
            viewers: 1,
            seconds: 10.0,
            bytes_per_s: 0,
            log: None,
        };
        while let Ok(name) = next("") {
            let value = next(&name)?;
            match name.as_str() {
                "--env" => options.env = value.parse()?,
                "--viewers" => options.viewers = value.parse()?,
                "--seconds" => options.seconds = value.parse()?,
                "--bytes-per-s" => options.bytes_per_s = value.parse()?,
                "--log" => options.log = Some(File::create(value)?),
                _ => return Err(format!("unknown option {name}").into()),
            }
        }
        Ok(options)
    }
}

/// Counts of one topic, over all viewers.
#[derive(Default, serde::Serialize)]
struct TopicCounts {
    received: u64,
    bytes: u64,
    /// Samples lost on the way, from the gaps in the sequence numbers.
    lost: u64,
    /// Sequences that started again at 0, which means another fan-out.
    begun_anew: u64,
    refused: u64,
    /// Median time from shared memory to here, milliseconds.
    median_age_ms: f64,
    #[serde(skip)]
    ages_ms: Vec<f64>,
    #[serde(skip)]
    sequences: BTreeMap<(usize, String), u64>,
}

impl TopicCounts {
    fn add(&mut self, viewer: usize, env: u32, sample: &Sample, topic: &str, now_ns: u64) {
        let bytes = sample.payload().to_bytes();
        self.received += 1;
        self.bytes += bytes.len() as u64;
        let attached = sample
            .attachment()
            .and_then(|attachment| read_attachment(&attachment.to_bytes()));
        let checked = reader::check(topic, &bytes, None);
        let is_of_env = |header: Option<MessageHeader>| header.is_none_or(|header| header.env_index == env);
        let (true, Some((sequence, taken_ns))) = (checked.is_ok_and(is_of_env), attached) else {
            self.refused += 1;
            return;
        };
        self.ages_ms.push(now_ns.saturating_sub(taken_ns) as f64 / 1e6);
        let key = (viewer, sample.key_expr().to_string());
        match self.sequences.insert(key, sequence) {
            Some(before) if sequence > before => self.lost += sequence - before - 1,
            Some(_) => self.begun_anew += 1,
            None => {}
        }
    }
}

/// Counts of all topics.
#[derive(Default)]
struct WatchCounts {
    env: u32,
    topics: BTreeMap<String, TopicCounts>,
    log: Option<LineWriter<File>>,
}

impl WatchCounts {
    fn add(&mut self, viewer: usize, sample: &Sample, prefix: usize) {
        #[expect(clippy::disallowed_methods, reason = "compared with the time that samples carry")]
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let now_ns = u64::try_from(now.as_nanos()).unwrap_or(u64::MAX);
        let topic = sample.key_expr().as_str().get(prefix..).unwrap_or_default();
        let name = topic.split('/').next().unwrap_or_default();
        self.topics
            .entry(name.to_owned())
            .or_default()
            .add(viewer, self.env, sample, topic, now_ns);
        if let (Some(log), "world") = (&mut self.log, name)
            && let Some((header, _)) = fanout::frame::decode(&sample.payload().to_bytes())
            && writeln!(log, "{},{now_ns}", header.tick).is_err()
        {
            self.log = None;
        }
    }
}

/// A viewer's zenoh session, once the fan-out listens.
fn connect(endpoint: &str) -> Result<zenoh::Session, Failure> {
    let endpoint = serde_json::to_string(endpoint)?;
    let config = zenoh::Config::from_json5(&format!(
        r#"{{ mode: "client", connect: {{ endpoints: [{endpoint}], timeout_ms: 20000 }},
             scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }},
             transport: {{ shared_memory: {{ enabled: false }} }} }}"#
    ))?;
    endpoint::open(config)
}

/// Starts a link of `bytes_per_s` to `endpoint`, and returns its address. Its buffers are short, as those of a real link.
fn start_slow_link(endpoint: &str, bytes_per_s: u64) -> Result<String, Failure> {
    let address = endpoint.strip_prefix("tcp/").ok_or("only tcp/HOST:PORT")?.to_owned();
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let local = format!("tcp/{}", listener.local_addr()?);
    thread::spawn(move || {
        for client in listener.incoming().flatten() {
            let Ok(server) = TcpStream::connect(&address) else {
                continue;
            };
            let (Ok(up), Ok(up_to)) = (client.try_clone(), server.try_clone()) else {
                continue;
            };
            thread::spawn(move || copy_at_rate(up, up_to, u64::MAX));
            thread::spawn(move || copy_at_rate(server, client, bytes_per_s));
        }
    });
    Ok(local)
}

/// Copies bytes at no more than `bytes_per_s`.
fn copy_at_rate(mut from: TcpStream, mut to: TcpStream, bytes_per_s: u64) -> io::Result<()> {
    let mut buffer = [0; 2048];
    let (begun, mut copied) = (Instant::now(), 0_u64);
    loop {
        let length = from.read(&mut buffer)?;
        if length == 0 {
            return Ok(());
        }
        to.write_all(&buffer[..length])?;
        copied += length as u64;
        let due = Duration::from_secs_f64(copied as f64 / bytes_per_s as f64);
        thread::park_timeout(due.saturating_sub(begun.elapsed()));
    }
}

/// Counts what all viewers receive, and prints the counts.
fn watch(mut options: WatchOptions) -> Result<(), Failure> {
    if options.bytes_per_s > 0 {
        options.endpoint = start_slow_link(&options.endpoint, options.bytes_per_s)?;
    }
    let all = RunKeys::new(&options.run, options.env).all();
    let prefix = all.len() - "**".len();
    let counts = Arc::new(Mutex::new(WatchCounts {
        env: options.env,
        log: options.log.take().map(LineWriter::new),
        ..WatchCounts::default()
    }));
    let mut viewers = Vec::new();
    for viewer in 0..options.viewers {
        let session = connect(&options.endpoint)?;
        let counts = Arc::clone(&counts);
        let count = move |sample: Sample| {
            counts
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .add(viewer, &sample, prefix);
        };
        let subscriber = session.declare_subscriber(all.clone()).callback(count).wait()?;
        viewers.push((subscriber, session));
    }
    let _ = writeln!(io::stdout(), "watching");
    let until = Instant::now() + Duration::from_secs_f64(options.seconds);
    while Instant::now() < until {
        thread::park_timeout(until.saturating_duration_since(Instant::now()));
    }
    drop(viewers);
    let mut counts = counts.lock().unwrap_or_else(PoisonError::into_inner);
    for count in counts.topics.values_mut() {
        count.ages_ms.sort_by(f64::total_cmp);
        count.median_age_ms = count.ages_ms.get(count.ages_ms.len() / 2).copied().unwrap_or_default();
    }
    if let Some(log) = &mut counts.log {
        log.flush()?;
    }
    writeln!(io::stdout(), "{}", serde_json::to_string(&counts.topics)?)?;
    Ok(())
}

fn main() -> ExitCode {
    answer_help(USAGE);
    let options = WatchOptions::read().unwrap_or_else(|error| misused(&error.to_string(), USAGE));
    match watch(options) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let _ = writeln!(io::stderr(), "fanout-watch: {error}");
            ExitCode::FAILURE
        }
    }
}
