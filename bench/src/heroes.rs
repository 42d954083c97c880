//! Measures agent-steps per second of heroes that a policy drives, with processor time by process.

use std::{collections::BTreeMap, process::Command};

use caraware::{failure::Exit, install};
use serde::Deserialize;

use super::{BenchOptions, BenchReport, MedianSpread, ReportTable};

/// Numbers of heroes.
const HEROES: [u32; 3] = [16, 64, 256];
/// Policies of `caraware_bench.heroes`, with the names in the table.
const POLICIES: [(&str, &str); 2] = [("learnt", "learnt"), ("untrained", "two layers of 128, untrained")];
/// Processes of a tick, as `caraware_bench.heroes` names them.
const PROCESSES: [&str; 4] = ["traffic-bridge", "sim-core", "sensor-daemon", "learner"];
/// Rounds, each with all cases in turn.
const ROUNDS: usize = 3;
/// Ticks that are measured, and those before them in which heroes depart.
const TICKS: [u32; 2] = [600, 100];
/// The same of a quick measurement.
const QUICK_TICKS: [u32; 2] = [40, 20];

/// The output of `caraware_bench.heroes`.
#[derive(Debug, Clone, Deserialize)]
struct HeroFigures {
    ticks: u32,
    agent_steps: u64,
    ends: u64,
    policy_s: f64,
    agent_steps_per_s: f64,
    waiting_us: f64,
    cpu_s: BTreeMap<String, f64>,
}

impl HeroFigures {
    fn per_tick(&self, amount: f64) -> f64 {
        amount / f64::from(self.ticks.max(1))
    }

    /// Processor time of a process in a tick, microseconds.
    fn cpu_us(&self, process: &str) -> f64 {
        self.per_tick(1e6 * self.cpu_s.get(process).copied().unwrap_or(0.0))
    }
}

/// Runs `python -m caraware_bench.heroes` for each case in turn.
///
/// # Errors
/// Python is missing, or a run fails.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let python = install::python(&options.bin)?;
    let ([ticks, warm_up], rounds, sizes) = match options.quick {
        true => (QUICK_TICKS, 1, &HEROES[..1]),
        false => (TICKS, ROUNDS, &HEROES[..]),
    };
    let mut measured: BTreeMap<(&str, u32), Vec<HeroFigures>> = BTreeMap::new();
    for _ in 0..rounds {
        for (policy, _) in POLICIES {
            for &heroes in sizes {
                let mut command = Command::new(&python);
                command
                    .args(["-m", "caraware_bench.heroes", "--policy", policy])
                    .args(["--heroes", &heroes.to_string()])
                    .args(["--ticks", &ticks.to_string()])
                    .args(["--warm-up-ticks", &warm_up.to_string()])
                    .env("CARAWARE", install::program(&options.bin, "caraware")?);
                let figures: HeroFigures = super::report::from_program(command)?;
                measured.entry((policy, heroes)).or_default().push(figures);
            }
        }
    }
    let mut report = BenchReport::new(
        "heroes",
        "Heroes that a policy drives",
        format!(
            "The preset `driving` with more heroes, through `CarAwareVectorEnv`: simulation, observation, reward, policy and action of every \
             tick; nothing is learnt. An agent-step is one action of a hero that is there. `learnt` is the policy in maps/town (encoders, then \
             two layers of 128), by torch on one thread; the untrained one leaves the road within seconds, so many heroes depart. Medians of \
             {rounds} rounds of {ticks} ticks (smallest–largest). A tick has two loops: `sim-core`, `sensor-daemon` and the learner, and beside \
             them `traffic-bridge`, which moves every hero in SUMO and steps it as soon as `sim-core` has sent the poses. *Waiting* is the \
             wall time of a tick beside the work of the longer loop: handovers, `sim-core` while SUMO waits for the poses, and other programs \
             on the same cores."
        ),
    );
    report.tables.push(table(&measured, &mut report.figures)?);
    Ok(report)
}

fn table(
    measured: &BTreeMap<(&str, u32), Vec<HeroFigures>>,
    figures: &mut BTreeMap<String, f64>,
) -> Result<ReportTable, Exit> {
    let mut columns = vec![
        "policy",
        "heroes",
        "agent-steps/s",
        "heroes in a tick",
        "trips ended in a tick",
    ];
    let cpu = PROCESSES.map(|process| format!("{process}, CPU µs/tick"));
    columns.extend(cpu.iter().map(String::as_str));
    columns.extend(["of the learner's the policy, wall µs", "waiting, µs/tick"]);
    let mut table = ReportTable::new("", &columns);
    for (policy, name) in POLICIES {
        for heroes in HEROES {
            let Some(rounds) = measured.get(&(policy, heroes)) else {
                continue;
            };
            let median = |figure: &dyn Fn(&HeroFigures) -> f64| MedianSpread::of(rounds.iter().map(figure));
            let rate = median(&|round| round.agent_steps_per_s)?;
            let mut cells = vec![
                name.to_owned(),
                heroes.to_string(),
                format!("{rate:.0}"),
                format!(
                    "{:.0}",
                    median(&|round| round.per_tick(round.agent_steps as f64))?.median
                ),
                format!("{:.2}", median(&|round| round.per_tick(round.ends as f64))?.median),
            ];
            let case = format!("{policy}, {heroes} heroes");
            figures.insert(format!("{case}, agent-steps/s"), rate.median);
            for process in PROCESSES {
                let cpu_us = median(&|round| round.cpu_us(process))?.median;
                figures.insert(format!("{case}, {process}, CPU µs/tick"), cpu_us);
                cells.push(format!("{cpu_us:.0}"));
            }
            let policy_us = median(&|round| round.per_tick(1e6 * round.policy_s))?.median;
            let waiting_us = median(&|round| round.waiting_us)?.median;
            figures.insert(format!("{case}, waiting, µs/tick"), waiting_us);
            cells.extend([policy_us, waiting_us].map(|us| format!("{us:.0}")));
            table.push(cells);
        }
    }
    Ok(table)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::float_cmp, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;

    #[test]
    fn a_case_has_a_row_with_its_medians() {
        let round = |rate: f64| -> HeroFigures {
            let json = format!(
                r#"{{"ticks": 10, "agent_steps": 150, "ends": 5, "policy_s": 0.001, "agent_steps_per_s": {rate}, "waiting_us": 30,
                     "cpu_s": {{"traffic-bridge": 0.02, "sim-core": 0.01, "sensor-daemon": 0.001, "learner": 0.003}}}}"#
            );
            serde_json::from_str(&json).unwrap()
        };
        let measured = BTreeMap::from([(("learnt", 16), vec![round(900.0), round(1100.0), round(1000.0)])]);
        let mut figures = BTreeMap::new();
        let table = table(&measured, &mut figures).unwrap();
        assert_eq!(figures["learnt, 16 heroes, agent-steps/s"], 1000.0);
        let expected = [
            "learnt",
            "16",
            "1000 (900–1100)",
            "15",
            "0.50",
            "2000",
            "1000",
            "100",
            "300",
            "100",
            "30",
        ];
        assert_eq!(table.rows, [expected]);
        assert_eq!(table.columns.len(), expected.len());
    }
}
