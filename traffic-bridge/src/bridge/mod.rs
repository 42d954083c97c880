//! The process: runs SUMO episode after episode and publishes each step as `traffic` and `traffic-meta` messages.

pub mod census;
pub(crate) mod commands;
mod decisions;
mod episode;
mod id_log;
mod lane_feed;
mod lessons;
mod outbox;
mod pacing;
mod signal_delay;

use std::{collections::BTreeMap, path::Path};

use ipc_schema::{
    board::State,
    failure::Failure,
    membership::{RunMembership, Wait},
    ports::{BoardReader, ControlServer, Subscriber},
    process::Process,
    run::{RunMap, Source},
    schedule::{Episode, EpisodeCount},
    services::Channel,
    traffic::MetaEvent,
};

use serde::{Deserialize, Serialize};

use crate::sumo::{Sumo, SumoCost, frame::TrafficFrame};
use commands::CommandExecutor;
use id_log::IdLog;
use lessons::MapUsage;
use outbox::Outbox;
use pacing::Pacing;
use signal_delay::SignalDelay;

/// Runs all episodes of the run that `run_file` describes, or until the process is asked to stop.
///
/// # Errors
/// The user's files are wrong, the shared memory is gone, or SUMO fails.
pub fn run(run_file: &Path) -> Result<(), Failure> {
    let mut membership = RunMembership::join(run_file, Process::TrafficBridge)?;
    let episodes = membership.run.schedule();
    let poses = match membership.run.config.drives() {
        true => Some(membership.subscriber(Channel::EgoPose)?),
        false => None,
    };
    let mut bridge = Bridge::open(membership, poses)?;
    let waited = match bridge.membership.run.curriculum_plan() {
        Some(plan) => bridge.run_curriculum(plan)?,
        None => bridge.run_episodes(episodes)?,
    };
    match waited {
        Wait::Ready => bridge.leave(),
        Wait::Stopped => Ok(()),
    }
}

/// This process's place in the run: what it reads, what it publishes, and how far it has come.
struct Bridge {
    membership: RunMembership,
    outbox: Outbox,
    totals: BridgeTotals,
    /// Progress of `sensor-daemon`, which must be attached before sensors are switched.
    sensing: BoardReader,
    /// Poses of the heroes, in the driving task.
    poses: Option<Subscriber>,
    pacing: Pacing,
    signal_delay: SignalDelay,
    /// Ids of road users, in a scenario.
    ids: Option<IdLog>,
    /// The first tick that the clock paces.
    paced_from: u64,
    command_server: ControlServer,
    commands: CommandExecutor,
    ticks_per_step: u64,
    /// Frames that are sent for each step of SUMO.
    frames_per_step: u64,
    /// The frame between two steps that is being sent.
    between: TrafficFrame,
    /// The maps of the run.
    maps: Vec<RunMap>,
    /// Lessons and ticks on each map, in a run with a curriculum.
    map_usage: Vec<MapUsage>,
}

/// What this process has counted when an episode begins, and which episode that is.
#[derive(Debug, Serialize, Deserialize)]
struct BridgeState {
    episode: u64,
    resets: u64,
    vehicle_steps: u64,
    arrived: u64,
    repeated_ticks: u64,
    cost: SumoCost,
    map_usage: Vec<MapUsage>,
    #[serde(default)]
    traffic: TrafficCounts,
}

/// What happened to road users, over all episodes.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct TrafficCounts {
    /// Road users that departed, by SUMO's vehicle class; persons are pedestrians.
    departed: BTreeMap<String, u64>,
    /// Teleports that SUMO began.
    teleports: u64,
    /// Contacts that SUMO reported.
    contacts: u64,
    /// Times that a person boarded a vehicle.
    #[serde(default)]
    rides: u64,
    /// Times that a container was loaded onto a vehicle.
    #[serde(default)]
    container_loads: u64,
    /// What SUMO has counted in the running episode so far.
    #[serde(skip)]
    of_episode: EpisodeCounts,
}

/// What SUMO counts in an episode.
#[derive(Debug, Clone, Copy, Default)]
struct EpisodeCounts {
    contacts: u64,
    rides: u64,
    container_loads: u64,
}

/// What the bridge has done so far.
struct BridgeTotals {
    /// Ticks sent.
    ticks: u64,
    vehicle_steps: u64,
    /// Road users that have left the network.
    arrived: u64,
    /// Episodes that a command has reset, and the ticks that these episodes had.
    resets: u64,
    repeated_ticks: u64,
    traffic: TrafficCounts,
    /// Processor time of SUMO before this process was started.
    cost_before: SumoCost,
    /// Processor time of SUMO over the finished episodes.
    cost: Option<SumoCost>,
}

impl BridgeTotals {
    /// Counts a step that has been sent.
    fn add_step(&mut self, frame: &TrafficFrame, ticks_per_step: u64) {
        self.ticks += ticks_per_step;
        self.vehicle_steps += frame.states.len() as u64;
        let arrivals = frame
            .events
            .iter()
            .filter(|meta| meta.event == MetaEvent::Arrived as u32);
        self.arrived += arrivals.count() as u64;
        for meta in &frame.events {
            if meta.event == MetaEvent::Departed as u32 {
                *self.traffic.departed.entry(meta.class_text()).or_default() += 1;
            } else if meta.event == MetaEvent::Teleported as u32 {
                self.traffic.teleports += 1;
            }
        }
    }

    /// Takes over what SUMO has counted in the running episode.
    fn take_counts(&mut self, now: EpisodeCounts) {
        let counts = &mut self.traffic;
        counts.contacts += now.contacts - counts.of_episode.contacts.min(now.contacts);
        counts.rides += now.rides - counts.of_episode.rides.min(now.rides);
        counts.container_loads += now.container_loads - counts.of_episode.container_loads.min(now.container_loads);
        counts.of_episode = now;
    }
}

/// What this process adds to the run's report: processor time, seconds.
#[derive(Debug, serde::Serialize)]
struct BridgeReport<'a> {
    /// SUMO's own steps.
    sumo_step_s: f64,
    /// Reading events and states of all road users.
    getters_s: f64,
    /// Reading traffic lights.
    signals_s: f64,
    /// Road users, summed over SUMO's steps.
    vehicle_steps: u64,
    /// Road users that departed, teleports and SUMO's contacts.
    #[serde(flatten)]
    traffic: &'a TrafficCounts,
    /// Episodes that a command has reset.
    resets: u64,
    /// The maps of a curriculum that has several: lessons on each, and their ticks.
    #[serde(skip_serializing_if = "<[MapUsage]>::is_empty")]
    maps: &'a [MapUsage],
}

impl Bridge {
    fn open(membership: RunMembership, poses: Option<Subscriber>) -> Result<Self, Failure> {
        let outbox = Outbox::open(&membership)?;
        let maps = membership.run.every_map();
        // Continue where the part of the run before this one stood when the episode began.
        let state: Option<BridgeState> = membership.stored_episode_state()?;
        let counted = |count: fn(&BridgeState) -> u64| state.as_ref().map_or(0, count);
        let totals = BridgeTotals {
            ticks: membership.run.first_tick(),
            vehicle_steps: counted(|state| state.vehicle_steps),
            arrived: counted(|state| state.arrived),
            resets: membership.run.start().resets,
            repeated_ticks: counted(|state| state.repeated_ticks),
            traffic: state.as_ref().map(|state| state.traffic.clone()).unwrap_or_default(),
            cost_before: state.as_ref().map_or(SumoCost::default(), |state| state.cost),
            cost: None,
        };
        let usage_before = state.map(|state| state.map_usage);
        Ok(Self {
            outbox,
            totals,
            sensing: membership.board_of(Process::SensorDaemon)?,
            poses,
            paced_from: membership.run.restart.map_or(0, |restart| restart.sensed_ticks),
            pacing: Pacing::new(membership.run.config.run.real_time_factor),
            signal_delay: SignalDelay::new(membership.run.mirror_delay_frames()),
            ids: match membership.run.source {
                Source::Scenario { .. } => Some(IdLog::open(&membership.run.run_dir)),
                Source::Population { .. } => None,
            },
            command_server: membership.control_server()?,
            commands: CommandExecutor::of_run(&membership.run.run_dir)?,
            ticks_per_step: membership.run.ticks_per_traffic_step(),
            frames_per_step: membership.run.ticks_per_traffic_step() / membership.run.ticks_per_frame(),
            between: TrafficFrame::default(),
            map_usage: usage_before.unwrap_or_else(|| maps.iter().map(|map| MapUsage::new(&map.name)).collect()),
            maps,
            membership,
        })
    }

    /// Stores what has been counted before an episode begins.
    fn store_state(&self, episode: &Episode) -> Result<(), Failure> {
        let totals = &self.totals;
        let state = BridgeState {
            episode: self.episode_number(episode),
            resets: totals.resets,
            vehicle_steps: totals.vehicle_steps,
            arrived: totals.arrived,
            repeated_ticks: totals.repeated_ticks,
            cost: totals.cost.unwrap_or(totals.cost_before),
            map_usage: self.map_usage.clone(),
            traffic: totals.traffic.clone(),
        };
        self.membership.store_episode_state(totals.ticks, &state)
    }

    /// Reports that the run has begun, and its length where it is known.
    fn announce_length(&mut self, sumo: &Sumo) {
        let per_step = self.ticks_per_step;
        let scenario = sumo.duration_s().map_or(0, |duration_s| {
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "a number of steps"
            )]
            let steps = (duration_s / sumo.step_s()).ceil() as u64;
            steps * per_step
        });
        let ticks = |count: EpisodeCount| {
            let of_one = count.ticks;
            count.episodes * of_one.map_or(scenario, |ticks| ticks.div_ceil(per_step) * per_step)
        };
        let counts = self.membership.run.episode_counts();
        let total_ticks: u64 = counts.into_iter().map(ticks).sum();
        let total_ticks = match total_ticks {
            0 => 0,
            ticks => ticks + self.totals.repeated_ticks,
        };
        if self.totals.ticks == 0 {
            self.membership.begin_work();
        }
        self.membership.report(|health| {
            health.state = State::Running as u32;
            health.total_ticks = total_ticks;
        });
    }

    /// Leaves once everything sent has been consumed.
    fn leave(mut self) -> Result<(), Failure> {
        self.write_report()?;
        if self
            .membership
            .wait_until_consumed(self.outbox.consumers(), self.totals.ticks)?
            == Wait::Ready
        {
            self.membership.report(|health| health.state = State::Done as u32);
        }
        Ok(())
    }

    fn write_report(&self) -> Result<(), Failure> {
        let Some(cost) = self.totals.cost else {
            return Ok(());
        };
        self.membership.write_part(&BridgeReport {
            sumo_step_s: cost.step_s,
            getters_s: cost.getters_s,
            signals_s: cost.signals_s,
            vehicle_steps: self.totals.vehicle_steps,
            traffic: &self.totals.traffic,
            resets: self.totals.resets,
            maps: if self.map_usage.len() > 1 { &self.map_usage } else { &[] },
        })
    }
}
