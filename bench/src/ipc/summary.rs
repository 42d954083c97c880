//! Summarises the latencies: percentiles over all rounds, ratios within each round.

use std::collections::BTreeMap;

use caraware::failure::Exit;

use super::{LatenciesBySize, LatencyRound, OurLatencies, ROUNDS};
use crate::{BenchReport, CurveLine, MedianSpread, ReportCurve, ReportTable};

/// One-way latencies, microseconds.
#[derive(Debug, Clone, Copy)]
struct LatencyPercentiles {
    median: f64,
    ninety: f64,
    ninety_nine: f64,
}

impl LatencyPercentiles {
    fn of(mut latencies_ns: Vec<f64>) -> Result<Self, Exit> {
        latencies_ns.sort_by(f64::total_cmp);
        #[expect(
            clippy::cast_precision_loss,
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "an index of a short list"
        )]
        let at = |share: f64| {
            let index = (share * latencies_ns.len().saturating_sub(1) as f64).round() as usize;
            latencies_ns.get(index).map(|ns| ns / 1e3)
        };
        match (at(0.5), at(0.9), at(0.99)) {
            (Some(median), Some(ninety), Some(ninety_nine)) => Ok(Self {
                median,
                ninety,
                ninety_nine,
            }),
            _ => Err(Exit::run("a receiver measured nothing", "")),
        }
    }

    fn cells(self) -> [String; 3] {
        [self.median, self.ninety, self.ninety_nine].map(|us| format!("{us:.2}"))
    }
}

/// Size of the block, bytes → its latencies.
type PercentilesBySize = BTreeMap<usize, LatencyPercentiles>;

/// Selects the latencies of one way.
type LatencySelector = fn(&OurLatencies) -> &LatenciesBySize;

/// The ways that the report shows, with their labels.
const WAYS: [(&str, LatencySelector); 5] = [
    ("taken", |ours| &ours.taken),
    ("tensor", |ours| &ours.tensor),
    ("tensor of an observation to keep", |ours| &ours.received),
    ("tensor of an observation to keep, asleep", |ours| &ours.asleep),
    ("tensor, two values written", |ours| &ours.two_values_written),
];

/// End of the name of a peer that polls (`caraware_bench.ipc_peers`).
const POLLS: &str = ", polling";

/// The report over all rounds.
///
/// # Errors
/// A receiver measured nothing.
pub(super) fn report(rounds: &[LatencyRound], peers: &BTreeMap<String, LatenciesBySize>) -> Result<BenchReport, Exit> {
    let mut report = BenchReport::new(
        "ipc",
        "Observation hop",
        format!(
            "One-way latency in microseconds, from right before publish in one process to the other. Ours is the channel `observation` of a run. \
             `Channel.lease` polls and reads it in place, whatever the size: \"taken\" is the time until the receiver has the block, \"tensor\" \
             the time until Python has a torch tensor over it, which is lent until the next block is taken. In turn with it, \
             `Channel.receive(busy=True)` polls and gives a tensor of an observation that may be kept, and `Channel.receive` gives the same, but \
             sleeps until it is woken. The sender writes the whole block before it \
             publishes, as `sensor-daemon` does; after 16 MiB it publishes later. In the rows \"two values written\" it writes only the first and \
             the last value, so that only the size differs. The bare message is eight bytes between two Rust processes that poll iceoryx2. Bare \
             message and ours alternate in {ROUNDS} rounds, and the sizes take turns within a round. A ratio compares medians of one round; it \
             is that of the median round (smallest–largest). The peers send the same number of bytes from Python to Python and make a tensor of \
             the message without further copies, asleep until the kernel wakes them or, where it says so, polling without a pause. A peer that polls \
             stands beside our tensors that polled, a peer that sleeps beside ours that slept. One message is under way at a time."
        ),
    );
    let bare = LatencyPercentiles::of(rounds.iter().flat_map(|round| round.bare.clone()).collect())?;
    report.figure("bare iceoryx2, median µs", bare.median);
    let mut all: Vec<(String, PercentilesBySize)> = Vec::new();
    for (way, of) in WAYS {
        all.push((
            format!("ours, {way}"),
            pooled(rounds.iter().map(|round| of(&round.ours)))?,
        ));
    }
    for (peer, by_size) in peers {
        all.push((peer.clone(), pooled(std::iter::once(by_size))?));
    }
    let mut ratios = own_ratios(&mut report, rounds)?;
    let (ours, theirs) = all.split_at(WAYS.len());
    for (peer, by_size) in theirs {
        // Like with like: `WAYS` by the manner in which they wait.
        let like = if peer.ends_with(POLLS) {
            &[("tensor", &ours[1].1), ("tensor to keep", &ours[2].1)][..]
        } else {
            &[("tensor to keep, asleep", &ours[3].1)][..]
        };
        for ((way, ours), bytes) in like
            .iter()
            .flat_map(|ours| [1 << 10, 1 << 20, 1 << 24].map(|bytes| (ours, bytes)))
        {
            if let (Some(theirs), Some(ours)) = (by_size.get(&bytes), ours.get(&bytes)) {
                let ratio = format!("{:.1} ×", theirs.median / ours.median);
                ratios.row([format!("{peer}, to our {way}, {}", name(bytes)), ratio]);
            }
        }
    }
    let mut table = ReportTable::new("", &["message", "median µs", "90 %", "99 %"]);
    let [median, ninety, ninety_nine] = bare.cells();
    table.row(["bare iceoryx2, 8 bytes".into(), median, ninety, ninety_nine]);
    for (label, by_size) in &all {
        for (bytes, percentiles) in by_size {
            let [median, ninety, ninety_nine] = percentiles.cells();
            table.row([format!("{label}, {}", name(*bytes)), median, ninety, ninety_nine]);
            report.figure(format!("{label}, {}, median µs", name(*bytes)), percentiles.median);
        }
    }
    report.tables.extend([ratios, table]);
    report.curves.push(curve(&all));
    Ok(report)
}

/// Percentiles of each size over all rounds.
fn pooled<'a>(parts: impl Iterator<Item = &'a LatenciesBySize>) -> Result<PercentilesBySize, Exit> {
    let mut all = LatenciesBySize::new();
    for (bytes, latencies) in parts.flatten() {
        all.entry(*bytes).or_default().extend(latencies);
    }
    let each = all
        .into_iter()
        .map(|(bytes, all)| Ok((bytes, LatencyPercentiles::of(all)?)));
    each.collect()
}

/// Ratios between sizes, and to the bare message, round by round.
fn own_ratios(report: &mut BenchReport, rounds: &[LatencyRound]) -> Result<ReportTable, Exit> {
    let mut table = ReportTable::new("", &["ratio of medians", "figure"]);
    for (way, of) in WAYS {
        let (mut among_sizes, mut to_bare) = (Vec::new(), Vec::new());
        for round in rounds {
            let bare = LatencyPercentiles::of(round.bare.clone())?.median;
            let by_size = pooled(std::iter::once(of(&round.ours)))?;
            let medians = || by_size.values().map(|percentiles| percentiles.median);
            let (smallest, largest) = (medians().fold(f64::MAX, f64::min), medians().fold(0.0, f64::max));
            among_sizes.push(largest / smallest);
            to_bare.push(largest / bare);
        }
        for (of, ratios) in [
            ("slowest size to fastest size, 1 KiB to 16 MiB", among_sizes),
            ("slowest size to the bare message", to_bare),
        ] {
            let spread = MedianSpread::of(ratios)?;
            table.row([format!("ours, {way}: {of}"), format!("{spread} ×")]);
            report.figure(format!("{way}: {of}"), spread.median);
        }
    }
    Ok(table)
}

fn curve(all: &[(String, PercentilesBySize)]) -> ReportCurve {
    let line = |(label, by_size): &(String, PercentilesBySize)| {
        #[expect(clippy::cast_precision_loss, reason = "a coordinate")]
        let points = by_size.iter().map(|(bytes, p)| [*bytes as f64, p.median]);
        CurveLine {
            name: label.clone(),
            points: points.collect(),
        }
    };
    ReportCurve {
        name: "ipc".into(),
        title: "From publish to a visible tensor".into(),
        x: "message (bytes)".into(),
        y: "one way, median (µs)".into(),
        logarithmic: [true, true],
        lines: all.iter().map(line).collect(),
    }
}

fn name(bytes: usize) -> String {
    match bytes >> 10 {
        kibi if kibi < 1024 => format!("{kibi} KiB"),
        kibi => format!("{} MiB", kibi >> 10),
    }
}
