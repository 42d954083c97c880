//! The loop over the steps of an episode: waits for credit, steps SUMO, publishes.

use ipc_schema::{
    activity::Awaited,
    config::{HeroDriver, TrafficConfig, TrafficEngine},
    ego::EgoPose,
    failure::{Failure, FailureKind},
    header::{EVALUATION, FIRST_OF_EPISODE, LAST_OF_EPISODE, LAST_OF_RUN, MessageHeader},
    membership::Wait,
    ports::PortError,
    process::Process,
    run::{RunFile, RunMap, Source},
    schedule::Episode,
    sensor::fitted_sensors,
    services::Channel,
};

use super::{Bridge, EpisodeCounts, commands::CommandContext};
use crate::{
    heroes::{self, around::AroundHeroes},
    population::{HeroRoutes, Population, PopulationSize, trips::TripSelection},
    sumo::{
        Sumo,
        connected::ConnectedRule,
        engine::{Engine, RunningServer, TraciServer},
        error::SumoError,
        frame::TrafficFrame,
        interpolation::StepInterpolation,
        options::SumoOptions,
    },
};

/// SUMO with the road users of one episode.
pub(super) struct RunningEpisode {
    pub(super) sumo: Sumo,
    population: Option<Population>,
    pub(super) frame: TrafficFrame,
    /// Where SUMO steps more slowly than the mirror needs.
    interpolation: Option<StepInterpolation>,
    around: AroundHeroes,
    episode: Episode,
}

impl RunningEpisode {
    /// Runs the population update that the pause between two lessons skipped.
    pub(super) fn resume(mut self) -> Result<Self, SumoError> {
        if let Some(population) = &mut self.population {
            population.after_step(&mut self.sumo, &self.frame)?;
        }
        Ok(self)
    }
}

/// A segment of an episode that belongs to one lesson, or the whole episode.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct EpisodeSegment {
    /// Ticks of the episode at the segment's end; `None`: the segment ends with the episode.
    pub(super) ticks: Option<u64>,
    /// Stage of the curriculum, counted from 1; 0: the base configuration.
    pub(super) stage: u16,
    /// Map of the curriculum; 0: the run's own.
    pub(super) map: u16,
    /// Flags of its last tick, beside those of the episode.
    pub(super) last_flags: u32,
    /// The run ends with the episode.
    pub(super) is_last: bool,
}

/// The stage and the map of an episode.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct StageMap {
    /// Stage of the curriculum, counted from 1; 0: the base configuration.
    pub(super) stage: usize,
    /// Map among those of the run.
    pub(super) map: usize,
}

/// How an episode ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum EpisodeEnd {
    /// The episode or its segment is complete.
    Over,
    /// A command reset the episode: it begins again.
    Again,
    /// The process was asked to stop.
    Stopped,
}

/// SUMO's options for `episode`.
fn options(run: &RunFile, map: &RunMap, episode: &Episode, traffic: &TrafficConfig) -> Result<SumoOptions, SumoError> {
    let options = match &map.source {
        Source::Population {
            net_file,
            additional_files,
        } => SumoOptions::population(&run.sumo_home, net_file, additional_files, traffic.step_s, episode.seed)
            .map(|options| options.with_traffic_lights(traffic.traffic_lights)),
        Source::Scenario { sumocfg, own } => {
            let output_dir = run.run_dir.join("sumo");
            let rule = ConnectedRule::Scenario {
                heroes: traffic.hero_ids.iter().cloned().collect(),
                cav_share: traffic.cav_share,
                max_cavs: traffic.max_cavs,
            };
            let (home, step_s) = (&run.sumo_home, traffic.step_s);
            let options = SumoOptions::scenario(home, sumocfg, own, &output_dir, step_s, episode.seed, rule)?;
            Ok(options
                .with_scale(traffic.scale)
                .with_span(traffic.begin_s, traffic.end_s))
        }
    }?;
    Ok(options
        .with_world_origin(map.info.world_origin_m)
        .with_net_bounds(map.info.bounds_m)
        .with_engine(engine(run)))
}

/// Where the run's SUMO runs.
fn engine(run: &RunFile) -> Engine {
    let traffic = &run.config.traffic;
    if !traffic.traci_host.is_empty() {
        return Engine::Attached(RunningServer {
            host: traffic.traci_host.clone(),
            port: traffic.traci_port,
            order: traffic.traci_order,
        });
    }
    let program = match traffic.engine {
        TrafficEngine::Libsumo => return Engine::InProcess,
        TrafficEngine::Traci => "sumo",
        TrafficEngine::TraciGui => "sumo-gui",
    };
    Engine::Traci(TraciServer {
        program: run.sumo_home.join("bin").join(program),
        port: traffic
            .traci_port
            .saturating_add(u16::try_from(run.env_index).unwrap_or(u16::MAX)),
        clients: traffic.traci_clients,
        log: run.run_dir.join("logs/sumo.log"),
    })
}

/// The name of a map, or of the scenario that has its own.
fn map_name(map: &RunMap) -> String {
    match &map.source {
        Source::Scenario { sumocfg, .. } => sumocfg.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
        Source::Population { .. } => map.name.clone(),
    }
}

/// Puts road users into an empty net; a scenario brings its own.
fn population(
    run: &RunFile,
    sumo: &mut Sumo,
    episode: &Episode,
    traffic: &TrafficConfig,
) -> Result<Option<Population>, SumoError> {
    match run.source {
        Source::Population { .. } => {
            sumo.scale_speed_limits(traffic.speed_limit_factor)?;
            let trips = TripSelection::of_episode(traffic.held_out_trips, episode.evaluation);
            let size = PopulationSize::from(traffic);
            let heroes = HeroRoutes {
                go_on: run.config.task.driver == HeroDriver::Sumo && run.mirror_delay_frames() > 0,
                ..HeroRoutes::from(traffic)
            };
            Population::start_on(sumo, size, heroes, trips, episode.seed).map(Some)
        }
        Source::Scenario { .. } => Ok(None),
    }
}

impl Bridge {
    /// Runs all episodes of a run without a curriculum.
    pub(super) fn run_episodes(&mut self, episodes: impl Iterator<Item = Episode>) -> Result<Wait, Failure> {
        let (mut before, mut episodes) = (None, episodes.peekable());
        while let Some(episode) = episodes.next() {
            let segment = EpisodeSegment {
                is_last: episodes.peek().is_none(),
                ..EpisodeSegment::default()
            };
            loop {
                let mut running = self.begin_episode(before.take(), &episode, StageMap::default())?;
                self.announce_length(&running.sumo);
                let end = self.run_segment(&mut running, segment)?;
                before = Some(running);
                match end {
                    EpisodeEnd::Over => break,
                    EpisodeEnd::Again => {}
                    EpisodeEnd::Stopped => return Ok(Wait::Stopped),
                }
            }
        }
        Ok(Wait::Ready)
    }

    /// Starts SUMO for `episode`, in the place of the episode before.
    pub(super) fn begin_episode(
        &mut self,
        before: Option<RunningEpisode>,
        episode: &Episode,
        StageMap { stage, map }: StageMap,
    ) -> Result<RunningEpisode, Failure> {
        self.store_state(episode)?;
        let run = &self.membership.run;
        let traffic = run.config.in_stage(stage).traffic;
        let options = options(run, &self.maps[map], episode, &traffic)?;
        // A file may crash SUMO, which cannot be caught: the failure is written before, and removed when SUMO has read the files.
        options.crashed().write(&run.run_dir, Process::TrafficBridge.name());
        let mut sumo = match before {
            None => Sumo::start(options)?,
            Some(before) => Sumo::reload(before.sumo, options)?,
        };
        Failure::remove(&run.run_dir, Process::TrafficBridge.name());
        let population = population(run, &mut sumo, episode, &traffic)?;
        let reads_positions = self.outbox.lanes.is_some();
        let lanes = match reads_positions || self.frames_per_step > 1 {
            true => Some(sumo.read_lanes()?),
            false => None,
        };
        if let (Some(lanes), Some(feed)) = (&lanes, &mut self.outbox.lanes) {
            sumo.read_positions();
            feed.begin_episode(sumo.begin_s(), &map_name(&self.maps[map]), lanes.ids())?;
        }
        let interpolation = lanes
            .filter(|_| self.frames_per_step > 1)
            .map(|lanes| StepInterpolation::new(lanes, self.frames_per_step, sumo.step_s()));
        self.commands.begin_episode();
        self.totals.traffic.of_episode = EpisodeCounts::default();
        Ok(RunningEpisode {
            sumo,
            population,
            frame: TrafficFrame::default(),
            interpolation,
            around: AroundHeroes::default(),
            episode: *episode,
        })
    }

    /// Runs an episode to the end of the segment, or to its own.
    pub(super) fn run_segment(
        &mut self,
        running: &mut RunningEpisode,
        segment: EpisodeSegment,
    ) -> Result<EpisodeEnd, Failure> {
        let RunningEpisode {
            sumo,
            population,
            frame,
            interpolation,
            around,
            episode,
        } = running;
        loop {
            // Wait for credit and, in the driving task, for the heroes' poses.
            let tick = self.totals.ticks + self.ticks_per_step - 1;
            if self.wait_to_send(tick, sumo, population.as_mut(), episode, frame)? == Wait::Stopped {
                return Ok(EpisodeEnd::Stopped);
            }
            let Some(moved) = self.move_heroes(sumo, episode, frame)? else {
                return Ok(EpisodeEnd::Stopped);
            };

            // Step SUMO, and determine what ends with the step.
            sumo.step(frame)?;
            if self.membership.run.config.advises_heroes() {
                frame.advice = heroes::advice(sumo, frame, &moved)?;
            }
            self.commands.track_presence(&frame.events);
            if let Some(ids) = &mut self.ids {
                ids.add(&frame.departed_ids);
            }
            let is_reset = self.commands.take_reset();
            let pauses = segment
                .ticks
                .is_some_and(|ticks| frame.step * self.ticks_per_step >= ticks);
            let ends = is_reset || segment.ticks.is_none() && self.episode_ends(sumo, episode, frame)?;
            let ends_run = ends && segment.is_last && !is_reset;
            let header = self.header(episode, frame, tick, sumo.step_s(), ends, ends_run);
            let header = MessageHeader {
                flags: header.flags | if pauses { segment.last_flags } else { 0 },
                stage: segment.stage,
                map: segment.map,
                ..header
            };

            // Publish: switches and routes first, so that they arrive before the step.
            if self.publish_switches(episode)? == Wait::Stopped {
                return Ok(EpisodeEnd::Stopped);
            }
            if self.poses.is_some() {
                self.follow_heroes(sumo, frame, around, header)?;
            }
            let header = match interpolation {
                Some(interpolation) => self.publish_between(interpolation, frame, header)?,
                None => header,
            };
            self.publish_step(frame, header)?;

            // Close the episode or the segment, or prepare the next step.
            self.totals.take_counts(EpisodeCounts {
                contacts: sumo.contacts(),
                rides: sumo.rides(),
                container_loads: sumo.container_loads(),
            });
            if ends {
                self.check_that_road_users_came()?;
                self.totals.cost = Some(self.totals.cost_before.plus(sumo.cost()));
            }
            if is_reset {
                self.totals.resets += 1;
                self.totals.repeated_ticks += frame.step * self.ticks_per_step;
                return Ok(EpisodeEnd::Again);
            }
            if ends || pauses {
                return Ok(EpisodeEnd::Over);
            }
            if let Some(population) = population {
                population.after_step(sumo, frame)?;
            }
        }
    }

    /// A scenario in which no vehicle ever drives is a mistake: an end before the first departure, or no routes.
    fn check_that_road_users_came(&self) -> Result<(), Failure> {
        match &self.membership.run.source {
            Source::Scenario { sumocfg, .. } if self.totals.vehicle_steps == 0 => Err(Failure::new(
                FailureKind::Config,
                format!("{}: no road user departed before its end", sumocfg.display()),
            )
            .with_help("name routes or flows in its route-files, and check its begin, its end and their depart times")),
            _ => Ok(()),
        }
    }

    /// Executes commands while it waits for credit up to `tick`, for the end of a pause, and for its time if the run is paced.
    fn wait_to_send(
        &mut self,
        tick: u64,
        sumo: &mut Sumo,
        population: Option<&mut Population>,
        episode: &Episode,
        frame: &TrafficFrame,
    ) -> Result<Wait, Failure> {
        let step_s = sumo.step_s();
        let number = self.episode_number(episode);
        let run = &self.membership.run;
        let mut context = CommandContext {
            sumo,
            population,
            tick: self.totals.ticks,
            episode: number,
            step: frame.step,
            ticks_per_step: self.ticks_per_step,
            fitted_sensors: fitted_sensors(&run.config),
            has_lessons: !run.config.curriculum.stages.is_empty(),
            senses_persons: run.config.gnss.pedestrians,
        };
        self.commands.replay(&mut context)?;
        let (commands, server, consumers) = (&mut self.commands, &self.command_server, self.outbox.consumers());
        let mut failure = None;
        let waited = self.membership.wait_while(|| {
            while failure.is_none() {
                match server.serve(|command| commands.answer(command, &mut context)) {
                    Ok(true) => {}
                    Ok(false) => break,
                    Err(error) => failure = Some(error),
                }
            }
            if failure.is_some() {
                return None;
            }
            match commands.holds(context.tick) {
                true => Some(Awaited::Other),
                false => consumers.lacks_credit(tick).map(Awaited::Credit),
            }
        })?;
        match (failure, waited) {
            (Some(failure), _) => Err(failure),
            // Ticks that are made again are not paced.
            (None, Wait::Ready) if tick < self.paced_from => Ok(Wait::Ready),
            (None, Wait::Ready) => Ok(self.pacing.wait(&self.membership, step_s)?),
            (None, Wait::Stopped) => Ok(Wait::Stopped),
        }
    }

    /// Sends what commands switch at the next tick, before the tick itself: `sensor-daemon` has the switch when it senses that tick.
    fn publish_switches(&mut self, episode: &Episode) -> Result<Wait, Failure> {
        let switches = self.commands.take_switches();
        if switches.is_empty() {
            return Ok(Wait::Ready);
        }
        // Wait until `sensor-daemon` is attached: a message sent earlier is lost, while ticks wait for it in `sim-core`.
        let sensing = &self.sensing;
        let waited = self.membership.wait_until(|| sensing.progress().attached == 1)?;
        if waited == Wait::Ready {
            let header = MessageHeader {
                tick: self.totals.ticks,
                episode: self.episode_number(episode),
                ..self.membership.header()
            };
            self.outbox.publish_switches(&switches, header)?;
        }
        Ok(waited)
    }

    /// In the driving task: waits for the poses of the last tick sent and moves the heroes of `frame`, its step, to them. Returns the poses
    /// if SUMO is asked for advice, and `None` once the process is asked to stop.
    fn move_heroes(
        &mut self,
        sumo: &mut Sumo,
        episode: &Episode,
        frame: &TrafficFrame,
    ) -> Result<Option<Vec<EgoPose>>, Failure> {
        let Some(poses) = &self.poses else {
            return Ok(Some(Vec::new()));
        };
        // No pose comes before the first tick of this process.
        let is_later = self.totals.ticks > self.membership.run.first_tick();
        let Some(before) = self.totals.ticks.checked_sub(1).filter(|_| is_later) else {
            return Ok(Some(Vec::new()));
        };
        let Some(message) = self.membership.next(poses)? else {
            return Ok(None);
        };
        let header = message.header();
        if header.tick != before {
            return Err(PortError::Gap {
                channel: Channel::EgoPose.name(),
                expected: before,
                received: header.tick,
            }
            .into());
        }
        // Poses of the episode before belong to heroes that ended with it.
        if header.episode == self.episode_number(episode) {
            let poses = heroes::poses(&message).map_err(|error| Failure::from_error(FailureKind::Run, &error))?;
            let config = &self.membership.run.config;
            heroes::apply(sumo, frame, poses, config.task.driver)?;
            if config.advises_heroes() {
                return Ok(Some(poses.to_vec()));
            }
        }
        Ok(Some(Vec::new()))
    }

    /// Takes control of the heroes that departed in the step, sends their routes, and lets others be careful of those that stand.
    fn follow_heroes(
        &mut self,
        sumo: &mut Sumo,
        frame: &TrafficFrame,
        around: &mut AroundHeroes,
        header: MessageHeader,
    ) -> Result<(), Failure> {
        let config = &self.membership.run.config;
        let driver = config.task.driver;
        let points = heroes::take_over(sumo, frame, driver, config.advises_heroes())?;
        self.outbox.publish_routes(&points, header)?;
        if driver == HeroDriver::Actions {
            around.update(sumo, frame)?;
        }
        Ok(())
    }

    fn episode_ends(&self, sumo: &Sumo, episode: &Episode, frame: &TrafficFrame) -> Result<bool, SumoError> {
        let full = episode
            .ticks
            .is_some_and(|ticks| frame.step * self.ticks_per_step >= ticks);
        match self.membership.run.source {
            Source::Population { .. } => Ok(full),
            Source::Scenario { .. } => Ok(full || sumo.finished()?),
        }
    }

    /// Number of the episode in the run: by its schedule, and one more for each episode that was reset.
    pub(super) fn episode_number(&self, episode: &Episode) -> u64 {
        episode.index + self.totals.resets
    }

    fn header(
        &self,
        episode: &Episode,
        frame: &TrafficFrame,
        tick: u64,
        step_s: f64,
        ends: bool,
        ends_run: bool,
    ) -> MessageHeader {
        let flag = |bit: u32, is_set: bool| if is_set { bit } else { 0 };
        MessageHeader {
            flags: flag(EVALUATION, episode.evaluation)
                | flag(FIRST_OF_EPISODE, frame.step == 1)
                | flag(LAST_OF_EPISODE, ends)
                | flag(LAST_OF_RUN, ends_run),
            episode: self.episode_number(episode),
            episode_seed: episode.seed,
            tick,
            sim_time_ns: frame.step * nanoseconds(step_s),
            ..self.membership.header()
        }
    }

    /// Sends the frames between the last step and this one. Returns the header of the step itself.
    fn publish_between(
        &mut self,
        interpolation: &mut StepInterpolation,
        frame: &TrafficFrame,
        header: MessageHeader,
    ) -> Result<MessageHeader, Failure> {
        interpolation.take_step(frame);
        let frames = self.frames_per_step;
        let ticks_per_frame = self.ticks_per_step / frames;
        let frame_ns = nanoseconds(self.membership.run.config.run.tick_s * ticks_per_frame as f64);
        let mut between = std::mem::take(&mut self.between);
        for number in 1..frames {
            interpolation.fill(number, &mut between);
            between.step = frame.step;
            self.signal_delay.apply(&mut between);
            let left = frames - number;
            let first = if number == 1 { FIRST_OF_EPISODE } else { 0 };
            let header = MessageHeader {
                flags: header.flags & (EVALUATION | first),
                tick: header.tick - left * ticks_per_frame,
                sim_time_ns: header.sim_time_ns - left * frame_ns,
                ..header
            };
            self.outbox.publish_step(&between, header)?;
        }
        self.between = between;
        Ok(MessageHeader {
            flags: header.flags & !FIRST_OF_EPISODE,
            ..header
        })
    }

    /// Sends one step, counts it and reports the progress.
    fn publish_step(&mut self, frame: &mut TrafficFrame, header: MessageHeader) -> Result<(), Failure> {
        self.signal_delay.apply(frame);
        let header = self.outbox.publish_step(frame, header)?;
        self.totals.add_step(frame, self.ticks_per_step);
        let (totals, drops) = (&self.totals, self.outbox.drops());
        self.membership.report(|health| {
            health.ticks = totals.ticks;
            health.episode = header.episode;
            health.sim_time_ns = header.sim_time_ns;
            health.road_users = header.shape[0];
            health.cavs = frame.cavs;
            health.vehicle_steps = totals.vehicle_steps;
            health.arrived = totals.arrived;
            health.drops = drops;
        });
        Ok(())
    }
}

fn nanoseconds(seconds: f64) -> u64 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a step is positive and short"
    )]
    let nanoseconds = (seconds * 1e9).round() as u64;
    nanoseconds
}
