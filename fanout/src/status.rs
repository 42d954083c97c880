//! The JSON topics: `map`, which is constant over a run, and `status`, which is published twice a second.

use std::collections::BTreeMap;

use ipc_schema::{
    activity::Activity,
    board::{Health, State, TrainingStatus},
    config::{Field, SensorUnit},
    process::Process,
    run::{MapInfo, Mode, RunFile},
};
use serde::Serialize;
use serde_json::{Value, json};

use crate::{
    frame::FrameError,
    meter::{DeliveringSensors, PositionErrors, RoadUserCounts},
    network::keys::Topic,
};

/// The `map` topic, without the scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct MapDocument<'a> {
    schema_version: u32,
    run: &'a str,
    run_id: String,
    env: u32,
    mode: Mode,
    task: &'static str,
    map: &'a MapInfo,
    tick_s: f64,
    sub_steps: u32,
    real_time_factor: f64,
    observation_fields: &'a [Field],
    rates_hz: BTreeMap<&'static str, f64>,
    lidar: Value,
    sensor_units: Vec<SensorUnit>,
    roadsides: Vec<Value>,
}

/// The run's identity as text, because JSON has no integers of 64 bits.
#[must_use]
pub fn run_id_text(run: &RunFile) -> String {
    format!("{:#018x}", run.run_id)
}

/// The `map` topic: facts from the run file, and the scene that `sim-core` has written, as JSON.
///
/// # Errors
/// A value has no form in JSON.
pub fn map_json(run: &RunFile, env: u32) -> Result<String, serde_json::Error> {
    let (fanout, lidar) = (&run.config.fanout, &run.config.lidar);
    let roadsides = run.config.roadsides.iter();
    let map = MapDocument {
        schema_version: run.schema_version,
        run: &run.name,
        run_id: run_id_text(run),
        env,
        mode: run.mode,
        task: run.config.task.kind.name(),
        map: &run.map,
        tick_s: run.config.run.tick_s,
        sub_steps: run.config.run.sub_steps,
        real_time_factor: run.config.run.real_time_factor,
        observation_fields: &run.config.observation.fields,
        rates_hz: BTreeMap::from([
            ("world", fanout.world_hz),
            ("observation", fanout.observation_hz),
            ("prediction", fanout.prediction_hz),
            ("neighbours", fanout.neighbours_hz),
            ("pointcloud", fanout.pointcloud_hz),
            ("image", fanout.image_hz),
            ("radar", fanout.radar_hz),
            ("event", fanout.event_hz),
            ("signals", fanout.signals_hz),
            ("vehicles", fanout.vehicles_hz),
            ("status", fanout.status_hz),
        ]),
        lidar: json!({ "vehicles": lidar.vehicles, "range_m": lidar.range_m, "mode": lidar.mode }),
        sensor_units: run.config.all_sensor_units(),
        roadsides: roadsides
            .map(|roadside| json!({ "name": roadside.name, "suite": roadside.suite }))
            .collect(),
    };
    let text = serde_json::to_string(&map)?;
    // The scene of a large net has many megabytes, so its text is inserted without parsing it into values.
    let scene = scene_json(run).unwrap_or_else(|| "null".into());
    Ok(format!(
        "{},\"scene\":{scene}}}",
        text.strip_suffix('}').unwrap_or(&text)
    ))
}

/// The scene that `sim-core` has written, if it is there and is JSON.
fn scene_json(run: &RunFile) -> Option<String> {
    let path = run.chart_path();
    let text = std::fs::read_to_string(&path).ok()?;
    match serde_json::from_str::<serde::de::IgnoredAny>(&text) {
        Ok(_) => Some(text),
        Err(error) => {
            tracing::warn!(%error, path = %path.display(), "the scene is not JSON: viewers get the map without it");
            None
        }
    }
}

/// State of one process.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ProcessStatus {
    /// Its name.
    pub name: &'static str,
    /// Its state; `stalled` if it hangs.
    pub state: &'static str,
    /// Seconds since it last finished a piece of work or looked for what it waits for.
    pub silent_s: f64,
    /// What it waits for: the name of a process, `–` for something else, or nothing.
    pub waits_for: String,
    /// Ticks produced or consumed.
    pub ticks: u64,
    /// Ticks that it is behind SUMO.
    pub lag: u64,
    /// Current episode.
    pub episode: u64,
    /// Road users in its newest tick.
    pub road_users: u32,
    /// Connected vehicles in its newest tick.
    pub cavs: u32,
    /// Messages dropped because a watcher's queue was full.
    pub drops: u64,
    /// Vehicle-steps so far.
    pub vehicle_steps: u64,
    /// Ticks of the whole run, 0 if unknown.
    pub total_ticks: u64,
}

impl ProcessStatus {
    /// The state and the activity that `process` of `run` wrote onto its board, when SUMO has made `sumo_ticks` ticks.
    #[must_use]
    pub fn of(run: &RunFile, process: Process, health: &Health, activity: &Activity, sumo_ticks: u64) -> Self {
        Self {
            name: process.name(),
            state: activity.state_name(State::from_u32(health.state), run.config.run.stall_s),
            silent_s: activity.age_s(),
            waits_for: activity.awaited().to_string(),
            ticks: health.ticks,
            lag: sumo_ticks.saturating_sub(health.ticks),
            episode: health.episode,
            road_users: health.road_users,
            cavs: health.cavs,
            drops: health.drops,
            vehicle_steps: health.vehicle_steps,
            total_ticks: health.total_ticks,
        }
    }
}

/// FanoutCounters of the fan-out itself.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct FanoutCounters {
    /// Frames passed to zenoh.
    pub frames: u64,
    /// Ticks that came faster than the queues in shared memory were read.
    pub missed_ticks: u64,
    /// Messages refused: of another run or version, or shorter than their header promises.
    pub refused_messages: u64,
    /// Samples that other clients have put on this run's keys.
    pub refused_samples: u64,
    /// Road users and points left out of frames that were too long.
    pub thinned_rows: u64,
    /// Slots left out of frames that were too long.
    pub cut_rows: u64,
    /// Frames that were too long and could not be thinned.
    pub oversize_frames: u64,
    /// Sets after which the rate was lowered because a frame was long.
    pub slowed_sets: u64,
    /// Images that were sent with fewer planes or pixels, because they were too long.
    pub reduced_images: u64,
    /// Messages of mounted sensors whose carrier's id was not known yet.
    pub unnamed_messages: u64,
    /// Commands from the network that were refused.
    pub refused_commands: u64,
    /// Connections that were refused.
    pub refused_connections: u64,
}

impl FanoutCounters {
    /// The counter of the rows that frames of `topic` leave out.
    pub fn left_out(&mut self, topic: Topic) -> &mut u64 {
        match topic {
            Topic::Observation | Topic::Prediction | Topic::Neighbours => &mut self.cut_rows,
            _ => &mut self.thinned_rows,
        }
    }

    /// Counts a message that is not published, and logs the first.
    pub fn refuse(&mut self, topic: &'static str, error: &FrameError) {
        let counter = match error {
            FrameError::Block(_) | FrameError::Image => &mut self.refused_messages,
            FrameError::TooLong(_) => &mut self.oversize_frames,
        };
        *counter += 1;
        if *counter == 1 {
            tracing::warn!(topic, %error, "a message was not published; later ones are only counted");
        }
    }
}

/// The `status` topic.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunStatus {
    /// Version of the schema, as in every frame of this run.
    pub schema_version: u32,
    /// Name of the run.
    pub run: String,
    /// Identity of the run.
    pub run_id: String,
    /// Number of the environment.
    pub env: u32,
    /// Mode of the run.
    pub mode: Mode,
    /// Newest tick published.
    pub tick: u64,
    /// Episode of that tick.
    pub episode: u64,
    /// Ticks of that episode before this one.
    pub step: u64,
    /// Simulated time within that episode, nanoseconds.
    pub sim_time_ns: u64,
    /// True in an evaluation episode.
    pub evaluation: bool,
    /// Wall seconds since the run was started.
    pub run_age_s: f64,
    /// Ticks per wall second over the last two seconds.
    pub ticks_per_s: f64,
    /// Simulated seconds per wall second over the last two seconds.
    pub real_time_factor: f64,
    /// Road users by kind.
    pub road_users: RoadUserCounts,
    /// Vehicles on which each sensor delivers.
    pub sensors: DeliveringSensors,
    /// Mean errors of position of the newest set.
    pub errors_m: PositionErrors,
    /// State of every process of the run.
    pub processes: Vec<ProcessStatus>,
    /// Progress of learning; `None` in a run without a learner.
    pub training: Option<TrainingStatus>,
    /// FanoutCounters of the fan-out itself.
    pub fanout: FanoutCounters,
}

/// Seconds since process `pid` was started; 0 if there is no such process.
#[must_use]
pub fn age_s(pid: i32) -> f64 {
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    let uptime_s = read("/proc/uptime")
        .split_whitespace()
        .next()
        .and_then(|text| text.parse::<f64>().ok());
    let stat = read(&format!("/proc/{pid}/stat"));
    // The 22nd field, which is the 20th after the name in parentheses, in hundredths of a second (proc(5)).
    let started = stat.rsplit(')').next().and_then(|rest| rest.split_whitespace().nth(19));
    let started_s = started
        .and_then(|text| text.parse::<f64>().ok())
        .map(|ticks| ticks / 100.0);
    uptime_s
        .zip(started_s)
        .map_or(0.0, |(uptime, started)| uptime - started)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_has_an_age() {
        let own = i32::try_from(std::process::id()).unwrap();
        assert!((0.0..100_000.0).contains(&age_s(own)));
        assert_eq!(age_s(-1), 0.0);
    }
}
