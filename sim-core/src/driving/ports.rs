//! The driving task's ports: reads `prediction`, publishes `ego-pose`.

use std::{collections::BTreeMap, sync::Arc};

use ipc_schema::{
    block::{self, BlockError, Section},
    config::HeroDriver,
    ego::{EgoPose, EgoPoseLayout},
    failure::{Failure, FailureKind},
    header::MessageHeader,
    membership::{RequiredConsumers, RunMembership, Wait},
    observation::EMPTY_SLOT,
    ports::{Message, PortError, Publisher, Subscriber},
    prediction::{ACTION_COLUMNS, PredictionLayout},
    services::Channel,
    traffic::{HeroAdvice, Kind, RoutePoint, SignalMeta, VehicleMeta},
    world::{HeroView, VehicleState, WorldLayout},
};

use super::{DrivingTask, HeroCounts, RefusedAction, action::LoggedAction};
use crate::{action_log::ActionLog, mirror::Mirror, scene::Scene};

/// Ticks that sensors are ahead of the actions, in strict lock-step.
const SENSED_AHEAD: u64 = 2;

/// Heroes, and the ports that drive them.
#[derive(Debug)]
pub struct HeroPorts {
    driving: DrivingTask<Arc<Scene>>,
    /// SUMO's ids of the heroes of this episode, by dense index.
    ids: BTreeMap<u32, String>,
    driver: HeroDriver,
    log: ActionLog<LoggedAction>,
    predictions: Subscriber,
    poses: Publisher,
    /// The required consumers of `ego-pose`.
    pose_consumers: RequiredConsumers,
}

impl HeroPorts {
    /// Opens the ports before the process is attached, so that the trainer's first prediction is not lost. `counts` are those of an
    /// earlier process.
    ///
    /// # Errors
    /// A service cannot be opened.
    pub fn open(membership: &mut RunMembership, scene: Arc<Scene>, counts: HeroCounts) -> Result<Self, Failure> {
        let mut driving = DrivingTask::new(&membership.run.config, scene);
        driving.restore_counts(counts);
        Ok(Self {
            ids: BTreeMap::new(),
            driving,
            driver: membership.run.config.task.driver,
            log: ActionLog::new(&membership.run.run_dir, membership.run.env_index, SENSED_AHEAD),
            predictions: membership.subscriber(Channel::Prediction)?,
            poses: membership.publisher(Channel::EgoPose)?,
            pose_consumers: membership.required_consumers(Channel::EgoPose)?,
        })
    }

    /// Goes to the map of the next episode.
    pub fn enter_map(&mut self, scene: Arc<Scene>) {
        self.driving.set_ground(scene);
    }

    /// Counts so far.
    #[must_use]
    pub fn counts(&self) -> HeroCounts {
        self.driving.counts()
    }

    /// Adds points of routes.
    pub fn add_route(&mut self, header: &MessageHeader, points: &[RoutePoint]) {
        self.driving.enter_episode(header.episode);
        self.driving.add_route(points);
    }

    /// Adds heroes that departed, and states of traffic lights.
    pub fn add_metas(&mut self, header: &MessageHeader, metas: &[VehicleMeta], signals: &[SignalMeta]) {
        self.driving.enter_episode(header.episode);
        for meta in metas.iter().filter(|meta| meta.kind == Kind::Hero as u32) {
            self.ids.insert(meta.vehicle, meta.id_text());
        }
        self.driving.add_signals(signals);
    }

    /// Adds what SUMO's own driver would have done with the heroes.
    pub fn add_advice(&mut self, header: &MessageHeader, advice: &[HeroAdvice]) {
        self.driving.enter_episode(header.episode);
        self.driving.add_advice(advice);
    }

    /// Waits for the prediction to the observation before the tick of `frame`, and applies its actions to the heroes. Actions that an
    /// earlier process has logged for that tick are applied again.
    ///
    /// # Errors
    /// A port fails, or the prediction does not contain actions.
    pub fn apply_actions(
        &mut self,
        membership: &RunMembership,
        frame: &MessageHeader,
        mirror: &mut Mirror,
    ) -> Result<Wait, Failure> {
        self.driving.enter_episode(frame.episode);
        if self.driver == HeroDriver::Sumo {
            return Ok(Wait::Ready);
        }
        let run = &membership.run;
        if let Some(actions) = self.log.actions_before(run, frame.episode, frame.tick)? {
            // The trainer may answer these ticks again: its answers must not fill the queue.
            while self.predictions.receive()?.is_some() {}
            self.apply(&actions, frame.tick, mirror);
            return Ok(Wait::Ready);
        }
        // The first tick of this process begins an episode: no hero has been seen before it.
        let Some(before) = frame
            .tick
            .checked_sub(1)
            .filter(|_| frame.tick > membership.run.first_tick())
        else {
            return Ok(Wait::Ready);
        };
        let Some(answer) = next(membership, &self.predictions, before)? else {
            return Ok(Wait::Stopped);
        };
        // Actions of the episode before belong to heroes that ended with it.
        let mut of_heroes = Vec::new();
        if answer.header().episode == frame.episode {
            let (vehicles, actions) = actions(&answer)?;
            let pairs = vehicles.iter().zip(actions);
            of_heroes.extend(
                pairs
                    .filter(|(vehicle, _)| **vehicle != EMPTY_SLOT)
                    .map(|(&vehicle, &action)| LoggedAction { vehicle, action }),
            );
        }
        if let Err(error) = self.log.add(frame.tick, &of_heroes) {
            tracing::warn!("actions of this episode are not logged any more: {error}");
        }
        self.apply(&of_heroes, frame.tick, mirror);
        Ok(Wait::Ready)
    }

    fn apply(&mut self, actions: &[LoggedAction], tick: u64, mirror: &mut Mirror) {
        for LoggedAction { vehicle, action } in actions {
            let (input, refusal) = self.driving.apply_action(*vehicle, *action);
            mirror.set_input(*vehicle, input);
            if let Some(RefusedAction { part, value, held }) = refusal {
                let id = self.ids.get(vehicle).map_or("", String::as_str);
                tracing::warn!(
                    "hero {id}, tick {tick}: {part} {value} is not a number in -1 … 1; {held:?} is held; further refusals of this hero are only counted"
                );
            }
        }
    }

    /// Ends the heroes' tick in the `world` message and returns their poses for SUMO.
    ///
    /// # Errors
    /// The payload is too short.
    pub fn end_tick(&mut self, layout: &WorldLayout, payload: &mut [u8]) -> Result<Vec<EgoPose>, BlockError> {
        Ok(self.driving.end_tick(block::view_mut(payload, layout.states)?))
    }

    /// Writes what the heroes see into the `world` message of a tick that has ended.
    ///
    /// # Errors
    /// The payload is too short.
    pub fn write_views(&self, layout: &WorldLayout, payload: &mut [u8]) -> Result<(), BlockError> {
        let [states, views] = block::split_mut(payload, &[layout.states, layout.heroes])?;
        let whole = |section: Section, element: usize| BlockError {
            actual: section.len,
            offset: section.offset,
            len: section.len,
            element,
        };
        let states: &[VehicleState] =
            bytemuck::try_cast_slice(states).map_err(|_| whole(layout.states, size_of::<VehicleState>()))?;
        let views: &mut [HeroView] =
            bytemuck::try_cast_slice_mut(views).map_err(|_| whole(layout.heroes, size_of::<HeroView>()))?;
        self.driving.write_views(states, views);
        Ok(())
    }

    /// Sends the heroes' poses to `traffic-bridge`, which waits for them after every tick.
    ///
    /// # Errors
    /// The port fails.
    pub fn send_poses(&self, world: &MessageHeader, poses: &[EgoPose]) -> Result<(), Failure> {
        let layout = EgoPoseLayout::sized(poses.len());
        let header = MessageHeader {
            shape: layout.shape,
            ..*world
        };
        let mut draft = self.poses.loan(header, layout.len)?;
        let written = block::view_mut(draft.payload_mut(), layout.poses).map_err(unreadable)?;
        written.copy_from_slice(poses);
        draft.send()?;
        self.pose_consumers.sent(header.tick);
        Ok(())
    }
}

/// The prediction for `tick`; skips older ones. `None` once the process is asked to stop.
fn next(membership: &RunMembership, predictions: &Subscriber, tick: u64) -> Result<Option<Message>, Failure> {
    loop {
        let Some(message) = membership.next(predictions)? else {
            return Ok(None);
        };
        let received = message.header().tick;
        if received > tick {
            return Err(PortError::Gap {
                channel: Channel::Prediction.name(),
                expected: tick,
                received,
            }
            .into());
        }
        if received == tick {
            return Ok(Some(message));
        }
    }
}

/// The vehicle of each slot, and its action.
fn actions(answer: &Message) -> Result<(&[u32], &[[f32; 2]]), Failure> {
    let header = answer.header();
    let [rows, columns, _, answered] = header.shape;
    if columns as usize != ACTION_COLUMNS || answered != rows {
        return Err(Failure::new(
            FailureKind::Run,
            format!(
                "tick {}: the trainer sent actions of shape [{rows}, {columns}] for {answered} slots, the task needs [n, {ACTION_COLUMNS}] \
                 for n slots",
                header.tick
            ),
        )
        .with_help("send steering and acceleration for each slot of every observation"));
    }
    let layout = PredictionLayout::of(header);
    let vehicles = block::view(answer.payload(), layout.vehicle).map_err(unreadable)?;
    let actions = block::view(answer.payload(), layout.prediction).map_err(unreadable)?;
    Ok((vehicles, actions))
}

fn unreadable(error: BlockError) -> Failure {
    Failure::from_error(FailureKind::Run, &error)
}
