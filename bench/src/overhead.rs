//! Measures the cost of co-simulation, compared with bare SUMO on the same scenario.

use caraware::{failure::Exit, generate::GeneratedCity, install::Install};

use super::{
    BenchOptions, BenchReport, MedianSpread, ReportTable,
    sides::{BareAllocator, BenchDirectory, ComparedScenario, OurRun, compare_results},
    stages::StageTimes,
};

/// Vehicles, simulated seconds, rounds.
const SIZE: (u32, f64, usize) = (5000, 60.0, 5);
/// The same with `--quick`.
const QUICK: (u32, f64, usize) = (60, 6.0, 1);

/// Runs bare SUMO with either allocator and caraware in turn on a generated city.
///
/// # Errors
/// One of them fails, or SUMO's results differ.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let (vehicles, duration_s, rounds) = if options.quick { QUICK } else { SIZE };
    let place = BenchDirectory::new("overhead")?;
    let install = Install::find()?;
    let sumocfg = GeneratedCity::of(vehicles, duration_s, 0.1, 1).write(&install, &place.path().join("city"))?;
    let scenario = ComparedScenario::new(options, &place, install, sumocfg, 1.0, vehicles)?;
    let mut table = ReportTable::new(
        "Rounds in turn",
        &[
            "round",
            "sumo, s",
            "sumo with mimalloc, s",
            "ours, s",
            "ours / sumo",
            "ours / sumo with mimalloc",
            "sumo, CPU s",
            "sumo with mimalloc, CPU s",
            "ours, CPU s",
        ],
    );
    let (mut ratios, mut same_allocator, mut last, mut files) = (Vec::new(), Vec::new(), None, 0);
    for round in 1..=rounds {
        let (bare, results) = scenario.bare(BareAllocator::System)?;
        let (with_mimalloc, also) = scenario.bare(BareAllocator::Mimalloc)?;
        let ours = scenario.ours()?;
        files = compare_results(&results, &ours.results)?;
        compare_results(&also, &ours.results)?;
        let ratio = ours.taken.wall_s / bare.wall_s;
        let same = ours.taken.wall_s / with_mimalloc.wall_s;
        table.row([
            round.to_string(),
            format!("{:.2}", bare.wall_s),
            format!("{:.2}", with_mimalloc.wall_s),
            format!("{:.2}", ours.taken.wall_s),
            format!("{ratio:.3}"),
            format!("{same:.3}"),
            format!("{:.2}", bare.cpu_s),
            format!("{:.2}", with_mimalloc.cpu_s),
            format!("{:.2}", ours.taken.cpu_s),
        ]);
        ratios.push(ratio);
        same_allocator.push(same);
        last = Some(ours);
    }
    let (ratio, same) = (MedianSpread::of(ratios)?, MedianSpread::of(same_allocator)?);
    let mut report = BenchReport::new(
        "overhead",
        "Co-simulation beside bare SUMO",
        format!(
            "{vehicles} vehicles on a generated city (`caraware generate`), {duration_s} s at steps of 0.1 s. Bare `sumo` on one core, \
             bare `sumo` with the allocator of `traffic-bridge` (mimalloc, by LD_PRELOAD), and caraware (ours, several processes on all cores) run \
             in turn. Ours moves every vehicle at 100 Hz, samples GNSS, IMU, speed and steering of every vehicle each 0.1 s, and delivers \
             them to a torch tensor in the consumer's process. The ratio of wall times, from start to end of the program with loading, is \
             {same:.3} beside `sumo` with the same allocator, and {ratio:.3} beside `sumo` with the system's. The {files} result files of SUMO are identical on all sides, except for the comment at their head and the \
             milliseconds that a step took."
        ),
    );
    report.figure("ratio of wall times", ratio.median);
    report.figure("ratio of wall times, same allocator", same.median);
    report.figure("result files compared", files as f64);
    report.tables.push(table);
    if let Some(ours) = last {
        let table = stages(&ours, &mut report)?;
        report.tables.push(table);
    }
    Ok(report)
}

/// Processor time of one run by stage.
fn stages(ours: &OurRun, report: &mut BenchReport) -> Result<ReportTable, Exit> {
    let stages = StageTimes::of(ours)?;
    let mut table = ReportTable::new(
        "Where processor time goes (the last round)",
        &["stage", "CPU s", "µs per vehicle-step", "share"],
    );
    for (name, seconds) in stages.named() {
        let each = stages.per_step_us(seconds);
        table.row([
            name.to_owned(),
            format!("{seconds:.2}"),
            format!("{each:.3}"),
            format!("{:.1} %", 100.0 * seconds / ours.taken.cpu_s),
        ]);
        report.figure(format!("{name}, µs per vehicle-step"), each);
    }
    let (start, rest) = (stages.start_s, (ours.taken.cpu_s - stages.sum_s()).max(0.0));
    for (name, seconds) in [
        ("loading, all processes", start),
        ("supervisor and the rest", rest - start),
    ] {
        table.row([
            name.to_owned(),
            format!("{seconds:.2}"),
            String::new(),
            format!("{:.1} %", 100.0 * seconds / ours.taken.cpu_s),
        ]);
    }
    Ok(table)
}
