//! The process: episode after episode, SUMO's steps go out as `traffic` and `traffic-meta` messages.

mod lessons;

use std::path::Path;

use ipc_schema::{
    block::Section,
    board::State,
    failure::{Failure, FailureKind},
    flow,
    header::{EVALUATION, FIRST_OF_EPISODE, LAST_OF_EPISODE, LAST_OF_RUN, MessageHeader},
    ports::{BoardReader, ControlServer, PortError, Publisher, Subscriber, Waker},
    process::Process,
    run::{RunFile, RunMap, Source},
    schedule::Episode,
    services::Channel,
    session::{Session as Membership, Wait},
    traffic::{EVENTS_PER_MESSAGE, MetaEvent, ROUTES, RoutePoint, SIGNALS_PER_MESSAGE, TrafficMetaLayout},
};

use lessons::Taught;

use crate::{
    census::Census,
    control::{Control, Place},
    error::SumoError,
    fleet::Fleet,
    frame::Frame,
    heroes,
    options::Options,
    pacing::Pacing,
    population::{Population, Size},
    session::{Cost, Session},
    trips::Trips,
};

/// Runs all episodes of the run named by `run_file`, or until the process is asked to stop.
///
/// # Errors
/// The user's files are wrong, the shared memory is gone, or SUMO fails.
pub fn run(run_file: &Path) -> Result<(), Failure> {
    let mut membership = Membership::join(run_file, Process::TrafficBridge)?;
    let episodes = membership.run.schedule();
    let poses = match membership.run.config.drives() {
        true => Some(membership.subscriber(Channel::EgoPose)?),
        false => None,
    };
    let mut bridge = Bridge::open(membership, poses)?;
    let waited = match bridge.membership.run.course() {
        Some(course) => bridge.follow(course)?,
        None => bridge.all(episodes)?,
    };
    match waited {
        Wait::Ready => bridge.leave(),
        Wait::Stopped => Ok(()),
    }
}

/// SUMO with the road users of one episode.
struct Underway {
    session: Session,
    population: Option<Population>,
    frame: Frame,
    episode: Episode,
}

impl Underway {
    /// After a pause: what the last step was not yet followed by.
    fn go_on(mut self) -> Result<Self, SumoError> {
        if let Some(population) = &mut self.population {
            population.after_step(&mut self.session, &self.frame)?;
        }
        Ok(self)
    }
}

/// What a stretch of an episode means.
#[derive(Debug, Clone, Copy, Default)]
struct Stretch {
    /// Ticks of the episode until it is over; `None`: until the episode is.
    ticks: Option<u64>,
    /// Flags of all its ticks, beside those of the episode.
    flags: u32,
    /// Flags of its last tick.
    last_flags: u32,
    /// The run ends with the episode.
    is_last: bool,
}

/// Where an episode takes place, and who is there.
#[derive(Debug, Clone, Copy, Default)]
struct Setting {
    /// Step of the curriculum, counted from 1; 0: the base configuration.
    step: usize,
    /// Map among those of the run.
    map: usize,
}

/// What SUMO is to be told for `episode`.
fn options(run: &RunFile, source: &Source, episode: &Episode) -> Result<Options, SumoError> {
    let traffic = &run.config.traffic;
    match source {
        Source::Population {
            net_file,
            additional_files,
        } => Options::population(&run.sumo_home, net_file, additional_files, traffic.step_s, episode.seed),
        Source::Scenario { sumocfg } => {
            let output_dir = run.run_dir.join("sumo");
            let fleet = Fleet::Scenario {
                heroes: traffic.hero_ids.iter().cloned().collect(),
                cav_share: traffic.cav_share,
                max_cavs: traffic.max_cavs,
            };
            let options = Options::scenario(
                &run.sumo_home,
                sumocfg,
                &output_dir,
                traffic.step_s,
                episode.seed,
                fleet,
            )?;
            Ok(options.with_scale(traffic.scale))
        }
    }
}

/// The road users that we put into an empty net; a scenario brings its own.
fn population(
    run: &RunFile,
    session: &mut Session,
    episode: &Episode,
    step: usize,
) -> Result<Option<Population>, SumoError> {
    match run.source {
        Source::Population { .. } => {
            let traffic = &run.config.in_step(step).traffic;
            let trips = Trips::of_episode(traffic.held_out_trips, episode.evaluation);
            let size = Size::from(traffic);
            Population::start_on(session, size, &traffic.hero_route, trips, episode.seed).map(Some)
        }
        Source::Scenario { .. } => Ok(None),
    }
}

/// How an episode ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    /// At its end.
    Over,
    /// By a reset: it begins anew.
    Again,
    /// The process was asked to stop.
    Stopped,
}

/// This process's ports, and how far the run has come.
struct Bridge {
    membership: Membership,
    traffic: Publisher,
    meta: Publisher,
    /// For whoever watches, if anybody may.
    census: Option<(Publisher, Census)>,
    consumer: BoardReader,
    consumer_wake: Waker,
    /// Where the heroes are, in the driving task.
    poses: Option<Subscriber>,
    pacing: Pacing,
    commands: ControlServer,
    control: Control,
    /// Sensors that commands switch, and the board of the process that must not miss it.
    switches: Publisher,
    sensing: BoardReader,
    /// Episodes that were reset, and the ticks that were made of them.
    resets: u64,
    repeated_ticks: u64,
    ticks_per_step: u64,
    /// The maps of the run.
    maps: Vec<RunMap>,
    /// Lessons and ticks on each of them, in a run with a curriculum.
    taught: Vec<Taught>,
    /// `traffic-meta` messages sent.
    meta_messages: u64,
    /// Ticks sent.
    ticks: u64,
    vehicle_steps: u64,
    /// Road users that have left the network.
    arrived: u64,
    /// Where processor time went, over the episodes so far.
    cost: Option<Cost>,
}

/// What this process adds to the run's report: processor time, seconds.
#[derive(Debug, serde::Serialize)]
struct Part<'a> {
    /// SUMO's own steps.
    sumo_step_s: f64,
    /// Finding out what happened and where everybody is.
    getters_s: f64,
    /// Looking at traffic lights.
    signals_s: f64,
    /// Road users, over SUMO's steps.
    vehicle_steps: u64,
    /// The maps of a curriculum that has several: lessons on each, and their ticks.
    #[serde(skip_serializing_if = "<[Taught]>::is_empty")]
    maps: &'a [Taught],
}

impl Bridge {
    fn open(membership: Membership, poses: Option<Subscriber>) -> Result<Self, Failure> {
        let traffic = membership.publisher(Channel::Traffic)?;
        let meta = membership.publisher(Channel::TrafficMeta)?;
        let census = match membership.run.config.fanout.enabled {
            true => Some((membership.publisher(Channel::Census)?, Census::default())),
            false => None,
        };
        let consumer = membership.board_of(Process::SimCore)?;
        let consumer_wake = membership.waker(Process::SimCore)?;
        let pacing = Pacing::new(membership.run.config.run.real_time_factor);
        let ticks_per_step = membership.run.ticks_per_traffic_step();
        let ticks = membership.run.first_tick();
        let commands = membership.control_server()?;
        let control = Control::of_run(&membership.run.run_dir)?;
        let resets = membership.run.start().resets;
        let switches = membership.publisher(Channel::Switch)?;
        let sensing = membership.board_of(Process::SensorDaemon)?;
        let maps = membership.run.every_map();
        let taught = maps.iter().map(|map| Taught {
            name: map.name.clone(),
            lessons: 0,
            ticks: 0,
        });
        Ok(Self {
            taught: taught.collect(),
            maps,
            commands,
            control,
            switches,
            sensing,
            resets,
            repeated_ticks: 0,
            membership,
            traffic,
            meta,
            census,
            consumer,
            consumer_wake,
            poses,
            pacing,
            ticks_per_step,
            meta_messages: 0,
            ticks,
            vehicle_steps: 0,
            arrived: 0,
            cost: None,
        })
    }

    /// Number of the episode in the run: by its schedule, and one more for each that was reset.
    fn number(&self, episode: &Episode) -> u64 {
        episode.index + self.resets
    }

    /// Tells the length of the run.
    fn announce(&mut self, session: &Session) {
        let per_step = self.ticks_per_step;
        let scenario = session.duration_s().map_or(0, |duration_s| {
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "a number of steps"
            )]
            let steps = (duration_s / session.step_s()).ceil() as u64;
            steps * per_step
        });
        let ticks = |episode: &Episode| {
            episode
                .ticks
                .map_or(scenario, |ticks| ticks.div_ceil(per_step) * per_step)
        };
        let total_ticks: u64 = self.membership.run.episodes().iter().map(ticks).sum();
        let total_ticks = match total_ticks {
            0 => 0,
            ticks => ticks + self.repeated_ticks,
        };
        if self.ticks == 0 {
            self.membership.begin_work();
        }
        self.membership.report(|health| {
            health.state = State::Running as u32;
            health.total_ticks = total_ticks;
        });
    }

    /// Runs all episodes of a run without a curriculum.
    fn all(&mut self, episodes: impl Iterator<Item = Episode>) -> Result<Wait, Failure> {
        let (mut before, mut episodes) = (None, episodes.peekable());
        while let Some(episode) = episodes.next() {
            let stretch = Stretch {
                is_last: episodes.peek().is_none(),
                ..Stretch::default()
            };
            loop {
                let mut underway = self.begin(before.take(), &episode, Setting::default())?;
                self.announce(&underway.session);
                let end = self.run(&mut underway, stretch)?;
                before = Some(underway);
                match end {
                    End::Over => break,
                    End::Again => {}
                    End::Stopped => return Ok(Wait::Stopped),
                }
            }
        }
        Ok(Wait::Ready)
    }

    /// SUMO at the beginning of `episode`.
    fn begin(
        &mut self,
        before: Option<Underway>,
        episode: &Episode,
        Setting { step, map }: Setting,
    ) -> Result<Underway, Failure> {
        let run = &self.membership.run;
        let options = options(run, &self.maps[map].source, episode)?;
        let mut session = match before {
            None => Session::start(options)?,
            Some(before) => Session::reload(before.session, options)?,
        };
        let population = population(run, &mut session, episode, step)?;
        self.control.begin_episode();
        Ok(Underway {
            session,
            population,
            frame: Frame::default(),
            episode: *episode,
        })
    }

    /// Runs an episode to the end of the stretch, or to its own.
    fn run(&mut self, underway: &mut Underway, stretch: Stretch) -> Result<End, Failure> {
        let Underway {
            session,
            population,
            frame,
            episode,
        } = underway;
        loop {
            let tick = self.ticks + self.ticks_per_step - 1;
            if self.may_send(tick, session, population.as_mut(), episode, frame)? == Wait::Stopped {
                return Ok(End::Stopped);
            }
            if self.move_heroes(session, episode, frame)? == Wait::Stopped {
                return Ok(End::Stopped);
            }
            session.step(frame)?;
            self.control.note(&frame.events);
            let is_reset = self.control.take_reset();
            let pauses = stretch
                .ticks
                .is_some_and(|ticks| frame.step * self.ticks_per_step >= ticks);
            let ends = is_reset || stretch.ticks.is_none() && self.ends(session, episode, frame)?;
            let flags = stretch.flags | if pauses { stretch.last_flags } else { 0 };
            let ends_run = ends && stretch.is_last && !is_reset;
            let header = self.header(episode, frame, tick, session.step_s(), ends, ends_run);
            let header = MessageHeader {
                flags: header.flags | flags,
                ..header
            };
            if self.publish_switches(episode)? == Wait::Stopped {
                return Ok(End::Stopped);
            }
            if self.poses.is_some() {
                self.publish_routes(&heroes::take_over(session, frame)?, header)?;
            }
            self.publish(frame, header)?;
            if ends {
                self.check_that_somebody_came()?;
                self.cost = Some(session.cost());
            }
            if is_reset {
                self.resets += 1;
                self.repeated_ticks += frame.step * self.ticks_per_step;
                return Ok(End::Again);
            }
            if ends || pauses {
                return Ok(End::Over);
            }
            if let Some(population) = population {
                population.after_step(session, frame)?;
            }
        }
    }

    /// A scenario in which nobody ever drives is a mistake: an end before the first departure, or no routes.
    fn check_that_somebody_came(&self) -> Result<(), Failure> {
        match &self.membership.run.source {
            Source::Scenario { sumocfg } if self.vehicle_steps == 0 => Err(Failure::new(
                FailureKind::Config,
                format!("{}: no road user came before its end", sumocfg.display()),
            )
            .with_help("name routes or flows in its route-files, and look at its begin, end and their depart times")),
            _ => Ok(()),
        }
    }

    /// Carries out commands while it waits for credit up to `tick`, for the end of a pause, and for its time if the run is paced.
    fn may_send(
        &mut self,
        tick: u64,
        session: &mut Session,
        population: Option<&mut Population>,
        episode: &Episode,
        frame: &Frame,
    ) -> Result<Wait, Failure> {
        let step_s = session.step_s();
        let number = self.number(episode);
        let run = &self.membership.run;
        let mut place = Place {
            session,
            population,
            tick: self.ticks,
            episode: number,
            step: frame.step,
            ticks_per_step: self.ticks_per_step,
            has_lidars: run.config.lidar.vehicles > 0,
            has_lessons: !run.config.curriculum.steps.is_empty(),
            senses_persons: run.config.gnss.pedestrians,
        };
        self.control.replay(&mut place)?;
        let window = run.traffic_window_ticks();
        let (control, commands, consumer) = (&mut self.control, &self.commands, &self.consumer);
        let mut failure = None;
        let waited = self.membership.wait_until(|| {
            while failure.is_none() {
                match commands.serve(|command| control.answer(command, &mut place)) {
                    Ok(true) => {}
                    Ok(false) => break,
                    Err(error) => failure = Some(error),
                }
            }
            failure.is_some() || !control.holds(place.tick) && flow::has_credit(tick, &consumer.progress(), window)
        })?;
        match (failure, waited) {
            (Some(failure), _) => Err(failure),
            (None, Wait::Ready) => Ok(self.pacing.wait(&self.membership, step_s)?),
            (None, Wait::Stopped) => Ok(Wait::Stopped),
        }
    }

    /// Sends what commands switch at the next tick: before the tick itself, so that it is there when its world is sensed.
    fn publish_switches(&mut self, episode: &Episode) -> Result<Wait, Failure> {
        let switches = self.control.take_switches();
        if switches.is_empty() {
            return Ok(Wait::Ready);
        }
        // Who is not there yet misses what is sent; ticks would wait for it in `sim-core`.
        let sensing = &self.sensing;
        let waited = self.membership.wait_until(|| sensing.progress().attached == 1)?;
        if waited == Wait::Ready {
            let header = MessageHeader {
                tick: self.ticks,
                episode: self.number(episode),
                ..self.membership.header()
            };
            send(&self.switches, header, switches.len(), bytemuck::cast_slice(&switches))?;
        }
        Ok(waited)
    }

    /// In the driving task: waits for the poses of the tick sent last and sets the heroes of `frame`, its step, to them.
    fn move_heroes(&mut self, session: &mut Session, episode: &Episode, frame: &Frame) -> Result<Wait, Failure> {
        let Some(poses) = &self.poses else {
            return Ok(Wait::Ready);
        };
        let Some(before) = self.ticks.checked_sub(1) else {
            return Ok(Wait::Ready);
        };
        let Some(message) = self.membership.next(poses)? else {
            return Ok(Wait::Stopped);
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
        // The heroes of the episode before went with it.
        if header.episode == self.number(episode) {
            let poses = heroes::poses(&message).map_err(|error| Failure::from_error(FailureKind::Run, &error))?;
            heroes::apply(session, frame, poses)?;
        }
        Ok(Wait::Ready)
    }

    fn publish_routes(&mut self, points: &[RoutePoint], header: MessageHeader) -> Result<(), Failure> {
        for part in heroes::parts(points) {
            self.meta_messages += 1;
            let header = MessageHeader {
                flags: header.flags | ROUTES,
                sequence: self.meta_messages,
                ..header
            };
            send(&self.meta, header, part.len(), bytemuck::cast_slice(part))?;
        }
        Ok(())
    }

    fn ends(&self, session: &Session, episode: &Episode, frame: &Frame) -> Result<bool, SumoError> {
        let full = episode
            .ticks
            .is_some_and(|ticks| frame.step * self.ticks_per_step >= ticks);
        match self.membership.run.source {
            Source::Population { .. } => Ok(full),
            Source::Scenario { .. } => Ok(full || session.finished()?),
        }
    }

    fn header(
        &self,
        episode: &Episode,
        frame: &Frame,
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
            episode: self.number(episode),
            episode_seed: episode.seed,
            tick,
            sim_time_ns: frame.step * nanoseconds(step_s),
            ..self.membership.header()
        }
    }

    /// Sends one step: first what happened, then where everybody is.
    fn publish(&mut self, frame: &Frame, header: MessageHeader) -> Result<(), Failure> {
        self.publish_meta(frame, header)?;
        let header = MessageHeader {
            sequence: self.meta_messages,
            ..header
        };
        send(
            &self.traffic,
            header,
            frame.states.len(),
            bytemuck::cast_slice(&frame.states),
        )?;
        self.consumer_wake.wake();
        if let Some((publisher, census)) = &mut self.census {
            census.enter(frame);
            census.publish_if_due(publisher, header)?;
        }
        self.ticks += self.ticks_per_step;
        self.vehicle_steps += frame.states.len() as u64;
        let arrivals = frame
            .events
            .iter()
            .filter(|meta| meta.event == MetaEvent::Arrived as u32);
        self.arrived += arrivals.count() as u64;
        self.report(frame, &header);
        Ok(())
    }

    /// Sends events of road users and changes of traffic lights, in as many messages as they need; none if nothing happened.
    fn publish_meta(&mut self, frame: &Frame, header: MessageHeader) -> Result<(), Failure> {
        let mut events = frame.events.chunks(EVENTS_PER_MESSAGE);
        let mut signals = frame.signals.chunks(SIGNALS_PER_MESSAGE);
        loop {
            let (vehicles, lights) = match (events.next(), signals.next()) {
                (None, None) => return Ok(()),
                (vehicles, lights) => (vehicles.unwrap_or_default(), lights.unwrap_or_default()),
            };
            self.meta_messages += 1;
            let layout = TrafficMetaLayout::new(vehicles.len(), lights.len());
            let header = MessageHeader {
                sequence: self.meta_messages,
                count: rows(vehicles.len()),
                columns: rows(lights.len()),
                ..header
            };
            let mut draft = self.meta.loan(header, layout.len).map_err(too_many)?;
            let payload = draft.payload_mut();
            let at = |section: Section| section.offset..section.offset + section.len;
            payload[at(layout.vehicles)].copy_from_slice(bytemuck::cast_slice(vehicles));
            payload[at(layout.signals)].copy_from_slice(bytemuck::cast_slice(lights));
            draft.send()?;
        }
    }

    fn report(&mut self, frame: &Frame, header: &MessageHeader) {
        let (ticks, vehicle_steps, arrived) = (self.ticks, self.vehicle_steps, self.arrived);
        let drops = self.traffic.drops() + self.meta.drops();
        self.membership.report(|health| {
            health.ticks = ticks;
            health.episode = header.episode;
            health.sim_time_ns = header.sim_time_ns;
            health.road_users = header.count;
            health.cavs = frame.cavs;
            health.vehicle_steps = vehicle_steps;
            health.arrived = arrived;
            health.drops = drops;
        });
    }

    /// Leaves once everything sent has been consumed.
    fn leave(mut self) -> Result<(), Failure> {
        self.write_part()?;
        if self.membership.wait_until_consumed(&self.consumer, self.ticks)? == Wait::Ready {
            self.membership.report(|health| health.state = State::Done as u32);
        }
        Ok(())
    }
}

impl Bridge {
    fn write_part(&self) -> Result<(), Failure> {
        let Some(cost) = self.cost else {
            return Ok(());
        };
        self.membership.write_part(&Part {
            sumo_step_s: cost.step_s,
            getters_s: cost.getters_s,
            signals_s: cost.signals_s,
            vehicle_steps: self.vehicle_steps,
            maps: if self.taught.len() > 1 { &self.taught } else { &[] },
        })
    }
}

fn rows(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(u32::MAX)
}

fn send(publisher: &Publisher, header: MessageHeader, count: usize, bytes: &[u8]) -> Result<(), Failure> {
    let count = rows(count);
    let mut draft = publisher
        .loan(MessageHeader { count, ..header }, bytes.len())
        .map_err(too_many)?;
    draft.payload_mut().copy_from_slice(bytes);
    draft.send()?;
    Ok(())
}

/// More road users than the user made room for is for the user to settle.
fn too_many(error: PortError) -> Failure {
    match &error {
        PortError::TooLong { .. } => Failure::from_error(FailureKind::Config, &error)
            .with_help("raise `traffic.max_road_users`, or use a scenario with fewer road users at a time"),
        _ => error.into(),
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
