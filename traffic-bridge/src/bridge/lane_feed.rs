//! Road users in SUMO's terms, as late as the mirrored road users move, and the ids of lanes and edges in the run's directory.

use std::{
    collections::{BTreeMap, VecDeque},
    path::PathBuf,
};

use ipc_schema::{
    failure::{Failure, FailureKind},
    header::{FIRST_OF_EPISODE, MessageHeader},
    lane_position::{LANE_IDS, LanePosition, LanePositionLayout, LanePositionSections},
    membership::RunMembership,
    ports::Publisher,
    services::Channel,
};

use super::outbox::too_many;
use crate::sumo::{frame::TrafficFrame, lanes::LaneIds};

/// SUMO counts milliseconds.
const TICKS_OF_SUMO_PER_S: f64 = 1000.0;

/// Sends `lane-position`.
pub(super) struct LaneFeed {
    publisher: Publisher,
    /// Frames by which the mirrored road users are behind SUMO.
    delay_frames: usize,
    frame_s: f64,
    /// SUMO's time at the start of the episode, seconds.
    begin_s: f64,
    /// Positions of the last frames, oldest first.
    held: VecDeque<Vec<LanePosition>>,
    ids_file: PathBuf,
    /// Ids of lanes and edges by the name of their map.
    ids: BTreeMap<String, LaneIds>,
}

impl LaneFeed {
    pub(super) fn open(membership: &RunMembership) -> Result<Self, Failure> {
        let run = &membership.run;
        Ok(Self {
            publisher: membership.publisher(Channel::LanePosition)?,
            delay_frames: run.mirror_delay_frames(),
            frame_s: run.config.run.tick_s * run.ticks_per_frame() as f64,
            begin_s: 0.0,
            held: VecDeque::new(),
            ids_file: run.run_dir.join(LANE_IDS),
            ids: BTreeMap::new(),
        })
    }

    /// Begins an episode at this time of SUMO on the map of this name. Writes the ids of a map that is new.
    pub(super) fn begin_episode(&mut self, begin_s: f64, map: &str, ids: LaneIds) -> Result<(), Failure> {
        self.begin_s = begin_s;
        if !self.ids.contains_key(map) {
            self.ids.insert(map.to_owned(), ids);
            let json = serde_json::to_string(&self.ids)
                .map_err(std::io::Error::from)
                .and_then(|json| std::fs::write(&self.ids_file, json));
            json.map_err(|error| Failure::from_error(FailureKind::Run, &error))?;
        }
        Ok(())
    }

    /// Sends the positions that belong to the mirrored states of the tick of `header`, and holds back those of `frame`.
    pub(super) fn publish(&mut self, frame: &TrafficFrame, header: MessageHeader) -> Result<(), Failure> {
        if header.flags & FIRST_OF_EPISODE != 0 {
            self.held.clear();
        }
        self.held.push_back(frame.positions.clone());
        let due = match self.held.len() > self.delay_frames {
            true => self.held.pop_front().unwrap_or_default(),
            false => Vec::new(),
        };
        let time_s = self.begin_s + header.sim_time_ns as f64 * 1e-9 - self.delay_frames as f64 * self.frame_s;
        let layout = LanePositionLayout::new(due.len());
        let header = MessageHeader {
            shape: layout.shape,
            ..header
        };
        let mut draft = self.publisher.loan(header, layout.len).map_err(too_many)?;
        let sections = LanePositionSections::split(draft.payload_mut(), &layout)
            .map_err(|error| Failure::from_error(FailureKind::Run, &error))?;
        sections.sumo_time_s[0] = (time_s * TICKS_OF_SUMO_PER_S).round() / TICKS_OF_SUMO_PER_S;
        sections.positions.copy_from_slice(&due);
        draft.send()?;
        Ok(())
    }
}
