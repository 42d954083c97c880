//! Measures cost and memory of a vehicle with 1 000 to 50 000 vehicles, on a real motorway, and with long steps of SUMO.

use caraware::{failure::Exit, generate::GeneratedCity, install::Install};

use super::{
    BenchOptions, BenchReport, CurveLine, ReportCurve, ReportTable,
    sides::{BareAllocator, BenchDirectory, ComparedScenario, OurRun, ProcessCost, compare_results},
    stages::StageTimes,
};

/// Vehicles and simulated seconds of each city.
const CITIES: [(u32, f64); 5] = [
    (1000, 60.0),
    (5000, 60.0),
    (10_000, 40.0),
    (20_000, 20.0),
    (50_000, 12.0),
];
/// The same with `--quick`.
const QUICK: [(u32, f64); 2] = [(50, 5.0), (100, 5.0)];
/// Vehicles and simulated seconds of city and country at steps of 1 s.
const LONG_STEPS: (u32, f64) = (20_000, 180.0);
const LONG_STEPS_QUICK: (u32, f64) = (100, 10.0);
/// Factors on the motorway's demand.
const MOTORWAY_SCALES: [f64; 2] = [1.0, 3.0];
/// Room for the road users of the motorway at the largest factor.
const MOTORWAY_ROAD_USERS: u32 = 8192;

/// One case, measured with bare SUMO, with either allocator, and with caraware.
struct ScaleCase {
    vehicles: u32,
    bare: ProcessCost,
    /// Bare SUMO with the allocator of `traffic-bridge`.
    with_mimalloc: ProcessCost,
    ours: OurRun,
    stages: StageTimes,
    /// Peak memory of the three processes that hold vehicles, KiB for each vehicle. Shared memory counts in every process that uses it.
    memory_kib: f64,
}

impl ScaleCase {
    fn measure(scenario: &ComparedScenario, vehicles: u32) -> Result<Self, Exit> {
        let (bare, results) = scenario.bare(BareAllocator::System)?;
        let (with_mimalloc, also) = scenario.bare(BareAllocator::Mimalloc)?;
        let ours = scenario.ours()?;
        compare_results(&results, &ours.results)?;
        compare_results(&also, &ours.results)?;
        let stages = StageTimes::of(&ours)?;
        let mut mib = 0.0;
        for process in ["traffic-bridge", "sim-core", "sensor-daemon"] {
            mib += ours.number(&format!("/processes/{process}/peak_memory_mib"))?;
        }
        Ok(Self {
            vehicles,
            bare,
            with_mimalloc,
            ours,
            stages,
            memory_kib: 1024.0 * mib / f64::from(vehicles),
        })
    }

    /// Cost of a vehicle-step outside SUMO, µs.
    fn outside_us(&self) -> f64 {
        self.stages.per_step_us(self.stages.outside_s())
    }
}

/// Runs all cases, each once on all sides.
///
/// # Errors
/// A run fails, or SUMO's results differ.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let place = BenchDirectory::new("scale")?;
    let mut report = BenchReport::new(
        "scale",
        "From a thousand to fifty thousand vehicles",
        "Generated cities with ten vehicles on a kilometre of lane (`caraware generate`). Every vehicle moves dynamically at 100 Hz and senses \
         every 0.1 s, and its observations are delivered to a consumer's tensor. The cost is processor time in the loop for each sensed \
         vehicle-step, without loading. Memory is the peak of `traffic-bridge` (with SUMO), `sim-core` and `sensor-daemon` for each vehicle; \
         shared memory counts in each of them. Bare `sumo` runs with the system's allocator and with that of `traffic-bridge`, mimalloc.",
    );
    let cities = if options.quick { &QUICK[..] } else { &CITIES[..] };
    let mut cases = Vec::new();
    for &(vehicles, duration_s) in cities {
        let city = GeneratedCity::of(vehicles, duration_s, 0.1, 1);
        cases.push(generated(options, &place, &city, &format!("city-{vehicles}"))?);
    }
    report.tables.push(costs(&cases));
    report.curves.push(curve(&cases));
    for case in &cases {
        report.figure(
            format!("{} vehicles, µs per vehicle-step outside SUMO", case.vehicles),
            case.outside_us(),
        );
        report.figure(format!("{} vehicles, KiB per vehicle", case.vehicles), case.memory_kib);
    }
    let at = |vehicles| {
        cases
            .iter()
            .find(|case| case.vehicles == vehicles)
            .map(ScaleCase::outside_us)
    };
    if let (Some(few), Some(many)) = (at(5000), at(50_000)) {
        report.figure("cost outside SUMO at 50 000 vehicles over that at 5 000", many / few);
        report.text += &format!(
            " Outside SUMO a vehicle-step costs {:.2} times as much at 50 000 vehicles as at 5 000.",
            many / few
        );
    }
    large(options, &place, &mut report)?;
    Ok(report)
}

fn generated(
    options: &BenchOptions,
    place: &BenchDirectory,
    city: &GeneratedCity,
    name: &str,
) -> Result<ScaleCase, Exit> {
    let install = Install::find()?;
    let sumocfg = city.write(&install, &place.path().join(name))?;
    let scenario = ComparedScenario::new(options, place, install, sumocfg, 1.0, city.vehicles)?;
    ScaleCase::measure(&scenario, city.vehicles)
}

fn costs(cases: &[ScaleCase]) -> ReportTable {
    let mut table = ReportTable::new(
        "µs per vehicle-step",
        &[
            "vehicles",
            "SUMO's own step",
            "getters",
            "conversion",
            "dynamics",
            "sensors",
            "consumer",
            "all outside SUMO",
            "KiB per vehicle",
            "wall, × sumo",
            "wall, × sumo with mimalloc",
        ],
    );
    for case in cases {
        let each = |seconds| format!("{:.3}", case.stages.per_step_us(seconds));
        table.row([
            case.vehicles.to_string(),
            each(case.stages.sumo_s),
            each(case.stages.getters_s),
            each(case.stages.bridge_s),
            each(case.stages.dynamics_s),
            each(case.stages.sensors_s),
            each(case.stages.consumer_s),
            each(case.stages.outside_s()),
            format!("{:.1}", case.memory_kib),
            format!("{:.2}", case.ours.taken.wall_s / case.bare.wall_s),
            format!("{:.2}", case.ours.taken.wall_s / case.with_mimalloc.wall_s),
        ]);
    }
    table
}

fn curve(cases: &[ScaleCase]) -> ReportCurve {
    let line = |name: &str, of: fn(&StageTimes) -> f64| CurveLine {
        name: name.to_owned(),
        points: cases
            .iter()
            .map(|case| [f64::from(case.vehicles), case.stages.per_step_us(of(&case.stages))])
            .collect(),
    };
    ReportCurve {
        name: "scale".into(),
        title: "Cost of a vehicle-step".into(),
        x: "vehicles".into(),
        y: "processor time, µs".into(),
        logarithmic: [true, true],
        lines: vec![
            line("SUMO's own step", |stages| stages.sumo_s),
            line("everything else", StageTimes::outside_s),
            line("dynamics", |stages| stages.dynamics_s),
            line("sensors", |stages| stages.sensors_s),
            line("getters", |stages| stages.getters_s),
        ],
    }
}

/// Steps of SUMO that are longer than a tick, and SUMO's own motorway at increased demand.
fn large(options: &BenchOptions, place: &BenchDirectory, report: &mut BenchReport) -> Result<(), Exit> {
    let mut table = ReportTable::new(
        "SUMO steps longer than the tick of 0.1 s",
        &[
            "scenario",
            "vehicles at once",
            "sensed vehicle-steps",
            "vehicle-steps/s",
            "× real time",
            "sumo, s",
            "sumo with mimalloc, s",
            "ours, s",
            "ours / sumo",
            "ours / sumo with mimalloc",
        ],
    );
    let (vehicles, duration_s) = if options.quick { LONG_STEPS_QUICK } else { LONG_STEPS };
    let cities = [
        ("city", GeneratedCity::of(vehicles, duration_s, 1.0, 1)),
        ("country roads", GeneratedCity::country(vehicles, duration_s, 1.0, 1)),
    ];
    for (name, city) in cities {
        let case = generated(options, place, &city, name)?;
        report.figure(
            format!("{name}, {vehicles} vehicles at steps of 1 s, sensed vehicle-steps/s"),
            case.ours.number("/env_steps_per_s")?,
        );
        table.row(row(&format!("{name}, {vehicles} vehicles, steps of 1 s"), &case)?);
    }
    let scales = if options.quick { &[][..] } else { &MOTORWAY_SCALES[..] };
    for &scale in scales {
        let install = Install::find()?;
        let sumocfg = install.sumo_home.join("tools/game/A10KW.sumocfg");
        let scenario = ComparedScenario::new(options, place, install, sumocfg, scale, MOTORWAY_ROAD_USERS)?;
        let case = ScaleCase::measure(&scenario, 1)?;
        report.figure(
            format!("A10KW at {scale} × its demand, × real time"),
            case.ours.number("/real_time_factor")?,
        );
        table.row(row(&format!("A10KW, demand × {scale}, steps of 0.5 s"), &case)?);
    }
    report.tables.push(table);
    Ok(())
}

fn row(name: &str, case: &ScaleCase) -> Result<[String; 10], Exit> {
    let ours = &case.ours;
    Ok([
        name.to_owned(),
        format!("{:.0}", ours.number("/vehicles")?),
        format!("{:.0}", ours.number("/vehicle_steps")?),
        format!("{:.0}", ours.number("/env_steps_per_s")?),
        format!("{:.1}", ours.number("/real_time_factor")?),
        format!("{:.2}", case.bare.wall_s),
        format!("{:.2}", case.with_mimalloc.wall_s),
        format!("{:.2}", ours.taken.wall_s),
        format!("{:.2}", ours.taken.wall_s / case.bare.wall_s),
        format!("{:.2}", ours.taken.wall_s / case.with_mimalloc.wall_s),
    ])
}
