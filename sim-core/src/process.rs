//! The process: reads `traffic` and `traffic-meta`, publishes one `world` message for each tick.

use std::{path::Path, sync::Arc};

use ipc_schema::{
    block::{self, BlockError},
    board::State,
    failure::{Failure, FailureKind},
    header::{FIRST_OF_EPISODE, LAST_OF_RUN, MessageHeader},
    membership::{RequiredConsumers, RunMembership, Wait},
    ports::{Message, PortError, Publisher, Subscriber},
    process::Process,
    services::Channel,
    traffic::{Kind, TrafficLayout, TrafficMetaLayout, TrafficState},
    world::WorldLayout,
};

use serde::{Deserialize, Serialize};

use crate::{
    collision::{CollisionCounts, ContactReporter, ContactState},
    driving::{HeroCounts, ports::HeroPorts},
    mirror::{
        Mirror, MirrorError, MirrorSettings,
        statistics::{TrackingStatistics, TrackingSummary},
    },
    names::RoadUserNames,
    resynchronisations::{ResynchronisationCounts, ResynchronisationReporter, ResynchronisationState},
    scene::{Scene, chart::Chart},
};

/// From this many heroes on, their poses are sent before what they see is computed: SUMO's next step needs the poses alone.
///
/// On two cores `traffic-bridge` and the learner then change cores in every tick, with cold caches. That costs them about a millisecond
/// together, as much as the views of some hundred heroes take.
const OVERLAPPED_HEROES: usize = 128;

/// What this process has counted when an episode begins.
#[derive(Debug, Default, Serialize, Deserialize)]
struct CoreState {
    tracking: TrackingStatistics,
    resynchronisations: u64,
    resynchronised: ResynchronisationState,
    guided: ResynchronisationState,
    vehicle_steps: u64,
    contacts: ContactState,
    #[serde(default)]
    heroes: HeroCounts,
}

/// What this process adds to the run's report.
#[derive(Debug, Serialize)]
struct CoreReport<'a> {
    tracking: TrackingSummary,
    resynchronisations: u64,
    /// By SUMO's class and the cause.
    resynchronisation_causes: &'a ResynchronisationCounts,
    /// How often vehicles began to be led along their path, by SUMO's class and the cause.
    guidance_causes: &'a ResynchronisationCounts,
    vehicle_steps: u64,
    drops: u64,
    /// Heroes, in the driving task.
    #[serde(skip_serializing_if = "Option::is_none")]
    heroes: Option<HeroCounts>,
    /// Buildings and props in the scene, of all maps.
    buildings: usize,
    props: usize,
    /// Contacts that began, if the run detects them.
    collisions: Option<CollisionCounts>,
}

/// Mirrors until the last tick of the run, or until the process is asked to stop.
///
/// # Errors
/// The scene's files are wrong, a port fails, or what SUMO sent cannot be mirrored.
pub fn run(run_file: &Path) -> Result<(), Failure> {
    let mut membership = RunMembership::join(run_file, Process::SimCore)?;
    let metas = membership.subscriber(Channel::TrafficMeta)?;
    let traffic = membership.subscriber(Channel::Traffic)?;
    let mut core = CoreProcess::open(membership, metas)?;
    while let Some(frame) = core.membership.next(&traffic)? {
        let header = *frame.header();
        if core.process_step(&frame)? == Wait::Stopped {
            break;
        }
        drop(frame);
        core.membership.consumed(header.tick + 1);
        if header.has(LAST_OF_RUN) {
            return core.leave();
        }
    }
    core.write_report()
}

struct CoreProcess {
    membership: RunMembership,
    metas: Subscriber,
    /// `traffic-meta` messages applied.
    meta_messages: u64,
    mirror: Mirror,
    /// The heroes and their actions, in the driving task.
    actions: Option<HeroPorts>,
    /// By map.
    scenes: Vec<Arc<Scene>>,
    contacts: Option<ContactReporter>,
    resynchronisations: ResynchronisationReporter,
    guidances: ResynchronisationReporter,
    names: RoadUserNames,
    world: Publisher,
    /// The required consumers of `world`.
    consumers: RequiredConsumers,
    /// Ticks sent.
    ticks: u64,
    vehicle_steps: u64,
}

impl CoreProcess {
    fn open(mut membership: RunMembership, metas: Subscriber) -> Result<Self, Failure> {
        let world = membership.publisher(Channel::World)?;
        let consumers = membership.required_consumers(Channel::World)?;
        let scenes = Scene::of_every_map(&membership.run)?;
        // Continue where the part of the run before this one stood when the episode began.
        let state: CoreState = membership.stored_episode_state()?.unwrap_or_default();
        let contacts = ContactReporter::open(&membership, &scenes, state.contacts)?;
        let events = |name, state| ResynchronisationReporter::open(&membership, name, state);
        let resynchronisations = events("resynchronisations.jsonl", state.resynchronised)?;
        let guidances = events("guidances.jsonl", state.guided)?;
        // Viewers see the run's own map. Heroes begin on it, and change to that of each episode.
        let scene = Arc::clone(&scenes[0]);
        draw_chart(&membership, &scene)?;
        let actions = match membership.run.config.drives() {
            true => Some(HeroPorts::open(&mut membership, scene, state.heroes)?),
            false => None,
        };
        membership.attach();
        let mut mirror = Mirror::new(MirrorSettings::of_run(&membership.run))
            .map_err(|error| Failure::from_error(FailureKind::Config, &error))?;
        mirror.restore_counts(state.tracking, state.resynchronisations);
        let ticks = membership.run.first_tick();
        Ok(Self {
            membership,
            metas,
            meta_messages: 0,
            mirror,
            actions,
            scenes,
            contacts,
            resynchronisations,
            guidances,
            names: RoadUserNames::default(),
            world,
            consumers,
            ticks,
            vehicle_steps: state.vehicle_steps,
        })
    }

    /// One SUMO step: its events, the states of all road users, and the ticks that lead there.
    fn process_step(&mut self, frame: &Message) -> Result<Wait, Failure> {
        let ticks_per_frame = self.membership.run.ticks_per_frame();
        let header = *frame.header();
        // The frame carries the number of the last of its ticks.
        let first_tick = (header.tick + 1).saturating_sub(ticks_per_frame);
        if first_tick != self.ticks {
            return Err(PortError::Gap {
                channel: "traffic",
                expected: self.ticks,
                received: first_tick,
            }
            .into());
        }
        if header.has(FIRST_OF_EPISODE) {
            self.store_state()?;
            if let (Some(actions), Some(scene)) = (&mut self.actions, self.scenes.get(usize::from(header.map))) {
                actions.enter_map(Arc::clone(scene));
            }
        }
        self.apply_metas(header.meta_messages)?;
        let layout = TrafficLayout::of(&header);
        let states: &[TrafficState] = block::view(frame.payload(), layout.states).map_err(unreadable)?;
        if let Some(actions) = &mut self.actions {
            actions.add_advice(
                &header,
                block::view(frame.payload(), layout.advice).map_err(unreadable)?,
            );
        }
        self.mirror.accept(&header, states).map_err(unmirrored)?;
        for tick in 0..u32::try_from(ticks_per_frame).unwrap_or(u32::MAX) {
            if self
                .membership
                .wait_for_credit(&self.consumers, first_tick + u64::from(tick))?
                == Wait::Stopped
            {
                return Ok(Wait::Stopped);
            }
            if let Some(actions) = &mut self.actions
                && actions.apply_actions(&self.membership, &header, &mut self.mirror)? == Wait::Stopped
            {
                return Ok(Wait::Stopped);
            }
            self.publish(&header, tick, states)?;
        }
        Ok(Wait::Ready)
    }

    /// Stores what has been counted before this tick, the first one of an episode.
    fn store_state(&mut self) -> Result<(), Failure> {
        let contacts = self.contacts.as_mut().map(ContactReporter::state).transpose()?;
        let state = CoreState {
            tracking: self.mirror.tracking().clone(),
            resynchronisations: self.mirror.resynchronisations(),
            resynchronised: self.resynchronisations.state()?,
            guided: self.guidances.state()?,
            vehicle_steps: self.vehicle_steps,
            contacts: contacts.unwrap_or_default(),
            heroes: self.actions.as_ref().map(HeroPorts::counts).unwrap_or_default(),
        };
        self.membership.store_episode_state(self.ticks, &state)
    }

    /// Applies announcements up to number `newest`, the last one before the current frame; all were sent before it.
    fn apply_metas(&mut self, newest: u64) -> Result<(), Failure> {
        while self.meta_messages < newest {
            let Some(message) = self.membership.next(&self.metas)? else {
                return Ok(());
            };
            self.meta_messages += 1;
            let received = message.header().meta_messages;
            if received != self.meta_messages {
                return Err(PortError::Gap {
                    channel: "traffic-meta",
                    expected: self.meta_messages,
                    received,
                }
                .into());
            }
            self.apply_meta(&message)?;
        }
        Ok(())
    }

    fn apply_meta(&mut self, message: &Message) -> Result<(), Failure> {
        let header = message.header();
        let layout = TrafficMetaLayout::of(header);
        // A message with points of routes has nothing else.
        let points = block::view(message.payload(), layout.route).map_err(unreadable)?;
        if !points.is_empty() {
            if let Some(actions) = &mut self.actions {
                actions.add_route(header, points);
            }
            return Ok(());
        }
        let vehicles = block::view(message.payload(), layout.vehicles).map_err(unreadable)?;
        self.mirror.apply_meta(header, vehicles).map_err(unmirrored)?;
        for class in self.mirror.take_unknown_classes() {
            tracing::warn!(
                class,
                "no parameter set lists this vehicle class: using the set `{}`",
                self.mirror.default_set()
            );
        }
        self.names.remember(header, vehicles);
        if let Some(actions) = &mut self.actions {
            let signals = block::view(message.payload(), layout.signals).map_err(unreadable)?;
            actions.add_metas(header, vehicles, signals);
        }
        Ok(())
    }

    fn publish(&mut self, frame: &MessageHeader, tick: u32, states: &[TrafficState]) -> Result<(), Failure> {
        let count = self.mirror.count(tick);
        let heroes = match &self.actions {
            Some(_) => self.mirror.hero_count(tick),
            None => 0,
        };
        let (ours, settings) = (self.membership.header(), self.mirror.settings());
        let trailing = self.mirror.trailing_count(tick);
        let layout = WorldLayout::with_heroes(count, settings.sub_steps as usize, heroes, trailing);
        let header = MessageHeader {
            run_id: ours.run_id,
            incarnation: ours.incarnation,
            shape: layout.shape,
            ..settings.tick_header(frame, tick)
        };
        let mut draft = match &self.actions {
            // Heroes' views are written only where there is something to see, so the loan is zeroed.
            Some(_) => self.world.loan(header, layout.len)?,
            None => self.world.loan_unwritten(header, layout.len)?,
        };
        self.mirror.write_tick(tick, draft.payload_mut()).map_err(unmirrored)?;
        if let Some(contacts) = &mut self.contacts {
            contacts.report_contacts(&header, draft.payload_mut(), layout.states, &self.names, &self.mirror)?;
        }
        let resynchronised = self.mirror.resynchronised();
        self.resynchronisations.add(&header, resynchronised, &self.names)?;
        self.guidances.add(&header, self.mirror.guidances(), &self.names)?;
        let poses = match &mut self.actions {
            Some(actions) => actions.end_tick(&layout, draft.payload_mut()).map_err(unreadable)?,
            None => Vec::new(),
        };
        let overlaps = heroes >= OVERLAPPED_HEROES;
        if let Some(actions) = &self.actions {
            if overlaps {
                actions.send_poses(&header, &poses)?;
            }
            actions.write_views(&layout, draft.payload_mut()).map_err(unreadable)?;
        }
        draft.send()?;
        self.consumers.sent(header.tick);
        if let Some(actions) = &self.actions
            && !overlaps
        {
            actions.send_poses(&header, &poses)?;
        }
        self.ticks += 1;
        self.vehicle_steps += count as u64;
        self.report(&header, states);
        Ok(())
    }

    fn report(&mut self, header: &MessageHeader, states: &[TrafficState]) {
        let cavs = states.iter().filter(|state| state.kind == Kind::Cav as u32).count();
        let (ticks, vehicle_steps, drops) = (self.ticks, self.vehicle_steps, self.world.drops());
        let resynchronisations = self.mirror.resynchronisations();
        self.membership.report(|health| {
            health.state = State::Running as u32;
            health.ticks = ticks;
            health.episode = header.episode;
            health.sim_time_ns = header.sim_time_ns;
            health.road_users = header.shape[0];
            health.cavs = cavs as u32;
            health.vehicle_steps = vehicle_steps;
            health.drops = drops;
            health.resynchronisations = resynchronisations;
        });
    }

    /// Leaves once everything sent has been consumed.
    fn leave(mut self) -> Result<(), Failure> {
        self.write_report()?;
        if self.membership.wait_until_consumed(&self.consumers, self.ticks)? == Wait::Ready {
            self.membership.report(|health| health.state = State::Done as u32);
        }
        Ok(())
    }

    fn write_report(&mut self) -> Result<(), Failure> {
        let collisions = self.contacts.as_mut().map(ContactReporter::finish).transpose()?;
        self.membership.write_part(&CoreReport {
            tracking: self.mirror.tracking().summary(),
            resynchronisations: self.mirror.resynchronisations(),
            resynchronisation_causes: self.resynchronisations.finish()?,
            guidance_causes: self.guidances.finish()?,
            vehicle_steps: self.vehicle_steps,
            drops: self.world.drops(),
            heroes: self.actions.as_ref().map(HeroPorts::counts),
            buildings: self.scenes.iter().map(|scene| scene.buildings().len()).sum(),
            props: self.scenes.iter().map(|scene| scene.props().len()).sum(),
            collisions,
        })
    }
}

/// Writes the chart of the scene for viewers, if the run allows viewers.
fn draw_chart(membership: &RunMembership, scene: &Scene) -> Result<(), Failure> {
    if !membership.run.config.fanout.enabled {
        return Ok(());
    }
    let path = membership.run.chart_path();
    Chart::of_run(&membership.run, scene)?.write(&path).map_err(|error| {
        Failure::new(FailureKind::Run, format!("cannot write {}: {error}", path.display()))
            .with_help("check free space and permissions of the run directory")
    })
}

fn unreadable(error: BlockError) -> Failure {
    Failure::from_error(FailureKind::Run, &error)
}

fn unmirrored(error: MirrorError) -> Failure {
    Failure::from_error(FailureKind::Run, &error)
}
