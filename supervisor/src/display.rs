//! Live progress: a bar on a terminal, otherwise one line every few seconds.

use std::{
    collections::BTreeMap,
    io::{IsTerminal as _, Write as _},
    time::{Duration, Instant},
};

use indicatif::{ProgressBar, ProgressStyle};
use ipc_schema::{
    board::{Health, TrainingStatus},
    metric::{self, MetricValues},
    process::Process,
    run::Mode,
};

use crate::{
    environment::Environment,
    live_table::LiveTable,
    phase::{PhaseShares, RunPhase},
};

/// Time between two lines when there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(5);

/// Rows of a table: it fits on most terminals.
const TABLE_ROWS: usize = 24;

/// Writes a line to standard error. A terminal that has been closed must not end the run.
pub fn notice(line: &str) {
    if let Err(error) = writeln!(std::io::stderr(), "{line}") {
        tracing::debug!(%error, line, "standard error is closed");
    }
}

/// Writes `text` to standard output, with the same care.
pub fn print(text: &str) {
    if let Err(error) = writeln!(std::io::stdout(), "{text}") {
        tracing::debug!(%error, "standard output is closed");
    }
}

/// Shows how far a file has been read: nothing in the first second, then a bar on a terminal, otherwise one line every few seconds.
#[derive(Debug)]
pub struct FileProgress {
    what: String,
    /// Bytes of the file.
    total: u64,
    shown_at: Instant,
    bar: Option<ProgressBar>,
}

/// Work that takes less time shows no progress.
const SHORT_WORK: Duration = Duration::from_secs(1);

impl FileProgress {
    /// Begins with the first byte of `total`. `what` is the work and the file.
    #[must_use]
    pub fn new(what: String, total: u64) -> Self {
        Self {
            what,
            total,
            shown_at: Instant::now() + SHORT_WORK,
            bar: None,
        }
    }

    /// Shows that `bytes` have been read.
    pub fn update(&mut self, bytes: u64) {
        if Instant::now() < self.shown_at {
            return;
        }
        if std::io::stderr().is_terminal() {
            let bar = self.bar.get_or_insert_with(|| {
                let bar = ProgressBar::new(self.total).with_style(style());
                bar.set_message(self.what.clone());
                bar
            });
            bar.set_position(bytes);
        } else {
            self.shown_at = Instant::now() + LINE_EVERY;
            notice(&format!("{:3} % {}", bytes * 100 / self.total.max(1), self.what));
        }
    }
}

impl Drop for FileProgress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// Shows the progress of a run.
#[derive(Debug)]
pub struct ProgressDisplay {
    bar: Option<ProgressBar>,
    is_silent: bool,
    last_line: Instant,
    last_text: String,
    shares: PhaseShares,
    /// When the first tick of this start was seen, and what had been made before it.
    begin: Option<ProgressBegin>,
    /// Ticks of all environments, and since when they are so many.
    newest: Option<(u64, Instant)>,
    boards: LastHealths,
    start: StartTimes,
}

/// What the boards said last. That of a process that starts again is empty: until its first tick what the one before it wrote is shown.
#[derive(Debug, Default)]
struct LastHealths(BTreeMap<(Process, u32), Health>);

impl LastHealths {
    fn newest(&mut self, process: Process, environment: &Environment) -> Health {
        let health = environment.board(process).health();
        let last = self.0.entry((process, environment.run.env_index)).or_insert(health);
        if health.ticks > 0 {
            *last = health;
        }
        *last
    }
}

/// When a run reached the stages of its start, until its first update is reported.
#[derive(Debug)]
struct StartTimes {
    started: Instant,
    first_tick_s: Option<f64>,
    is_reported: bool,
}

impl StartTimes {
    fn new() -> Self {
        Self {
            started: Instant::now(),
            first_tick_s: None,
            is_reported: false,
        }
    }

    /// Notes the stages that a run from nothing has reached; the line that reports its first update, once.
    fn report(&mut self, ticks: u64, updates: u64, ready_at: Option<Instant>) -> Option<String> {
        let now_s = self.started.elapsed().as_secs_f64();
        if self.first_tick_s.is_none() && ticks > 0 {
            self.first_tick_s = Some(now_s);
        }
        if self.is_reported || updates == 0 {
            return None;
        }
        self.is_reported = true;
        let ready_s = ready_at?.saturating_duration_since(self.started).as_secs_f64();
        Some(format!(
            "first training step {now_s:.1} s after the start: processes ready at {ready_s:.1} s, first tick at {:.1} s",
            self.first_tick_s?
        ))
    }
}

/// Where the rates of a run begin: a resumed one continues the counts of its earlier parts.
#[derive(Debug, Clone, Copy)]
struct ProgressBegin {
    at: Instant,
    steps: u64,
    ticks: u64,
}

impl ProgressDisplay {
    /// Shows a bar if standard error is a terminal, and lines otherwise.
    #[must_use]
    pub fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(ProgressBar::new_spinner);
        if let Some(bar) = &bar {
            bar.enable_steady_tick(Duration::from_millis(200));
        }
        Self {
            bar,
            is_silent: false,
            last_line: Instant::now(),
            last_text: String::new(),
            shares: PhaseShares::new(),
            begin: None,
            newest: None,
            boards: LastHealths::default(),
            start: StartTimes::new(),
        }
    }

    /// Shows nothing.
    #[must_use]
    pub fn silent() -> Self {
        Self {
            bar: None,
            is_silent: true,
            last_line: Instant::now(),
            last_text: String::new(),
            shares: PhaseShares::new(),
            begin: None,
            newest: None,
            boards: LastHealths::default(),
            start: StartTimes::new(),
        }
    }

    /// Shows the newest state of the boards, after `notes` on what is wrong at present.
    pub fn update(&mut self, environments: &[Environment], ready_at: Option<Instant>, notes: &[String]) {
        if self.is_silent {
            return;
        }
        if let Some(run) = environments.first().map(|environment| &environment.run)
            && run.mode == Mode::Play
            && let Some(table) = LiveTable::read(&run.run_dir)
        {
            self.show_table(&table);
            return;
        }
        let view = self.view(environments, ready_at, notes);
        let begins_from_nothing = environments.first().is_some_and(|first| first.run.beginning.is_none());
        if begins_from_nothing && let Some(line) = self.start.report(view.all_ticks, view.updates, ready_at) {
            match &self.bar {
                Some(bar) => bar.println(line),
                None => notice(&line),
            }
        }
        if let Some(bar) = &self.bar {
            if bar.length() != view.total_ticks && view.total_ticks.is_some() {
                bar.set_style(style());
                bar.set_length(view.total_ticks.unwrap_or(0));
            }
            bar.set_position(view.ticks);
            bar.set_message(view.text());
        } else if self.last_line.elapsed() >= LINE_EVERY {
            self.last_line = Instant::now();
            notice(&view.line());
        }
        self.last_text = view.line();
    }

    fn view(&mut self, environments: &[Environment], ready_at: Option<Instant>, notes: &[String]) -> ProgressView {
        let mut view = ProgressView::read(environments, &mut self.boards);
        if ready_at.is_some() && view.all_ticks > 0 {
            let now = Instant::now();
            if self.newest.is_none_or(|(ticks, _)| ticks != view.all_ticks) {
                self.newest = Some((view.all_ticks, now));
            }
            let silence = self
                .newest
                .map_or(Duration::ZERO, |(_, since)| now.saturating_duration_since(since));
            let phase = RunPhase::of(environments, view.is_evaluation, silence);
            self.shares.count(phase, now);
            view.shares = self.shares.text();
            if phase != RunPhase::Simulating {
                view.note = phase.name().to_owned();
            }
            let begin = *self.begin.get_or_insert(ProgressBegin {
                at: now,
                steps: view.steps,
                ticks: view.all_ticks,
            });
            view.set_rates(&begin, now);
        }
        if !notes.is_empty() {
            view.note = notes.join(", ");
        }
        view
    }

    /// Shows the errors of each vehicle: a table on a terminal, otherwise a line.
    fn show_table(&mut self, table: &LiveTable) {
        if let Some(bar) = &self.bar {
            bar.set_message(table.lines(TABLE_ROWS).join("\n"));
        } else if self.last_line.elapsed() >= LINE_EVERY {
            self.last_line = Instant::now();
            notice(&table.line());
        }
        self.last_text = table.line();
    }

    /// Leaves the last state on the screen.
    pub fn finish(&mut self) {
        match &self.bar {
            Some(bar) => bar.abandon(),
            None if self.is_silent => {}
            None => notice(&self.last_text),
        }
    }
}

impl Default for ProgressDisplay {
    fn default() -> Self {
        Self::new()
    }
}

fn style() -> ProgressStyle {
    ProgressStyle::with_template("{elapsed} [{bar:14}] {percent:>3}% {wide_msg} eta {eta}")
        .unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// The figures that are shown.
struct ProgressView {
    /// What is wrong at present, or what the run does but to simulate; empty if there is nothing to say.
    note: String,
    /// Shares of the time that the run has spent on what else it does.
    shares: String,
    is_evaluation: bool,
    /// Updates of a policy so far.
    updates: u64,
    ticks: u64,
    /// Of all environments.
    all_ticks: u64,
    tick_s: f64,
    total_ticks: Option<u64>,
    episode: u64,
    sim_time_s: f64,
    cavs: u32,
    road_users: u32,
    arrived: u64,
    /// Ticks behind SUMO: dynamics, sensors and, where there is one, the trainer.
    lags: Vec<u64>,
    steps: u64,
    steps_per_s: f64,
    /// Simulated seconds per wall second, all environments.
    real_time_factor: f64,
    policy_std: f64,
    reward: f64,
    metrics: MetricValues,
}

impl ProgressView {
    /// Sums the boards of all environments. Tick, episode and simulated time are those of the slowest environment.
    fn read(environments: &[Environment], boards: &mut LastHealths) -> Self {
        let mut all = |process: Process| {
            let healths = environments
                .iter()
                .map(|environment| boards.newest(process, environment));
            healths.collect::<Vec<_>>()
        };
        // Health of every environment, by process.
        let (sensings, worlds) = (all(Process::SensorDaemon), all(Process::SimCore));
        let sources = all(Process::TrafficBridge);
        let slowest = sensings.iter().min_by_key(|health| health.ticks).copied();
        let sensing = Health {
            cavs: sensings.iter().map(|health| health.cavs).sum(),
            vehicle_steps: sensings.iter().map(|health| health.vehicle_steps).sum(),
            ..slowest.unwrap_or_default()
        };
        let first = environments.first();
        let training = first.map_or_else(TrainingStatus::default, |first| {
            first.board(Process::Trainer).training()
        });
        // Largest lag behind SUMO of any environment.
        let behind = |healths: &[Health]| {
            let lags = sources
                .iter()
                .zip(healths)
                .map(|(source, health)| source.ticks.saturating_sub(health.ticks));
            lags.max().unwrap_or(0)
        };
        let mut lags = vec![behind(&worlds), behind(&sensings)];
        if first.is_some_and(|first| first.run.mode.has_trainer()) {
            lags.push(behind(&all(Process::Trainer)));
        }
        #[expect(clippy::cast_precision_loss, reason = "for display")]
        let sim_time_s = sensing.sim_time_ns as f64 * 1e-9;
        let counts = first.map(|first| first.run.episode_counts()).unwrap_or_default();
        let ticks = counts.iter().map(|count| Some(count.ticks? * count.episodes));
        let total: Option<u64> = ticks.sum();
        let now = first.and_then(|first| first.run.episode(sensing.episode));
        Self {
            note: String::new(),
            shares: String::new(),
            is_evaluation: now.is_some_and(|episode| episode.evaluation),
            updates: training.updates,
            ticks: sensing.ticks,
            all_ticks: sensings.iter().map(|health| health.ticks).sum(),
            tick_s: first.map_or(0.0, |first| first.run.config.run.tick_s),
            total_ticks: total,
            episode: sensing.episode,
            sim_time_s,
            cavs: sensing.cavs,
            road_users: worlds.iter().map(|health| health.road_users).sum(),
            arrived: sources.iter().map(|health| health.arrived).sum(),
            lags,
            steps: sensing.vehicle_steps,
            steps_per_s: 0.0,
            real_time_factor: 0.0,
            policy_std: training.policy_std,
            reward: training.reward,
            metrics: training.metrics,
        }
    }

    /// Rates since `begin`.
    fn set_rates(&mut self, begin: &ProgressBegin, now: Instant) {
        let wall_s = now.saturating_duration_since(begin.at).as_secs_f64();
        if wall_s <= 0.0 {
            return;
        }
        #[expect(clippy::cast_precision_loss, reason = "for display")]
        let [steps, ticks] = [(self.steps, begin.steps), (self.all_ticks, begin.ticks)]
            .map(|(now, before)| now.saturating_sub(before) as f64);
        self.steps_per_s = steps / wall_s;
        self.real_time_factor = self.tick_s * ticks / wall_s;
    }

    fn text(&self) -> String {
        let (rate, traffic) = (self.rate(), self.traffic());
        let measured = metric::summary(&self.metrics);
        // The metrics come first, because a narrow terminal cuts the end.
        let learning = match (self.updates, measured.is_empty()) {
            (0, true) => format!("{:7.1} s", self.sim_time_s),
            (0, false) => measured,
            (_, true) => format!("σ {:.3}  reward {:.3}", self.policy_std, self.reward),
            (_, false) => format!("{measured}  σ {:.3}  reward {:.3}", self.policy_std, self.reward),
        };
        let note = match self.note.is_empty() {
            true => String::new(),
            false => format!("[{}]  ", self.note),
        };
        let shares = match self.shares.is_empty() {
            true => String::new(),
            false => format!("  {}", self.shares),
        };
        format!(
            "{note}episode {:3}  {learning}  {rate}  {traffic}{shares}",
            self.episode
        )
    }

    fn rate(&self) -> String {
        format!(
            "{:.0} steps/s  {:.1} × real time",
            self.steps_per_s, self.real_time_factor
        )
    }

    /// Road users, those that sense, arrivals, and how many ticks each process is behind SUMO.
    fn traffic(&self) -> String {
        let lags: Vec<String> = self.lags.iter().map(ToString::to_string).collect();
        format!(
            "{} of {} road users sensing, {} arrived  lag {} ticks",
            self.cavs,
            self.road_users,
            self.arrived,
            lags.join("/")
        )
    }

    fn line(&self) -> String {
        match self.total_ticks {
            #[expect(clippy::cast_precision_loss, reason = "for display")]
            Some(total) if total > 0 => format!(
                "{:5.1} %  {:8} steps  {}",
                100.0 * self.ticks as f64 / total as f64,
                self.steps,
                self.text()
            ),
            _ => format!("{:8} steps  {}", self.steps, self.text()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_update_is_reported_once_with_what_came_before_it() {
        let (mut start, ready_at) = (StartTimes::new(), Some(Instant::now()));
        assert_eq!(start.report(0, 0, None), None);
        assert_eq!(start.report(12, 0, ready_at), None);
        let line = start.report(300, 1, ready_at).unwrap_or_default();
        assert!(
            line.starts_with("first training step 0.0 s after the start: processes ready at 0.0 s"),
            "{line}"
        );
        assert_eq!(start.report(400, 2, ready_at), None);
    }

    /// The boards of a resumed run begin with what was made before.
    #[test]
    fn the_rates_of_a_resumed_run_leave_out_what_was_made_before() {
        let (mut view, at) = (ProgressView::read(&[], &mut LastHealths::default()), Instant::now());
        (view.tick_s, view.steps, view.all_ticks) = (0.5, 1_000_500, 40_200);
        let begin = ProgressBegin {
            at,
            steps: 1_000_000,
            ticks: 40_000,
        };
        view.set_rates(&begin, at + Duration::from_secs(2));
        assert_eq!(view.rate(), "250 steps/s  50.0 × real time");
    }
}
