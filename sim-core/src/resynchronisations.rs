//! Reporting of mirrors that were set onto SUMO, or led along their path: a line each in the run's directory, and counts in its report.

use std::collections::BTreeMap;

use ipc_schema::{failure::Failure, header::MessageHeader, membership::RunMembership};
use serde::{Deserialize, Serialize};

use crate::{
    event_log::EventLog,
    mirror::resynchronisation::{Guidance, Resynchronisation, ResynchronisationCause},
    names::RoadUserNames,
};

/// How often for each reason, by SUMO's vehicle class.
pub type ResynchronisationCounts = BTreeMap<String, BTreeMap<ResynchronisationCause, u64>>;

/// Resynchronisations before an episode: their counts, and the length of their lines.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResynchronisationState {
    counts: ResynchronisationCounts,
    /// Bytes in the file of lines.
    line_bytes: u64,
}

/// How far a road user was set onto SUMO, or was from its path when guidance began, metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
enum Distance {
    JumpM(f64),
    AwayM(f64),
}

/// What becomes a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReportedEvent {
    vehicle: u32,
    cause: ResynchronisationCause,
    position_m: [f64; 3],
    distance: Distance,
}

impl From<&Resynchronisation> for ReportedEvent {
    fn from(set: &Resynchronisation) -> Self {
        Self {
            vehicle: set.vehicle,
            cause: set.cause,
            position_m: set.position_m,
            distance: Distance::JumpM(set.jump_m),
        }
    }
}

impl From<&Guidance> for ReportedEvent {
    fn from(guidance: &Guidance) -> Self {
        Self {
            vehicle: guidance.vehicle,
            cause: guidance.cause,
            position_m: guidance.position_m,
            distance: Distance::AwayM(guidance.away_m),
        }
    }
}

/// A line of `events/resynchronisations.jsonl` or `events/guidances.jsonl`.
#[derive(Debug, Serialize)]
struct ResynchronisationLine<'a> {
    tick: u64,
    episode: u64,
    sim_time_s: f64,
    vehicle: &'a str,
    class: &'a str,
    cause: ResynchronisationCause,
    position_m: [f64; 3],
    #[serde(flatten)]
    distance: Distance,
}

/// Counts a run's resynchronisations or guidances, and writes their lines.
#[derive(Debug)]
pub struct ResynchronisationReporter {
    lines: EventLog,
    counts: ResynchronisationCounts,
}

impl ResynchronisationReporter {
    /// Continues the file `events/NAME` from `before`. Lines behind its own are removed from the file: their ticks are made again.
    ///
    /// # Errors
    /// The file cannot be created.
    pub fn open(membership: &RunMembership, name: &str, before: ResynchronisationState) -> Result<Self, Failure> {
        Ok(Self {
            lines: EventLog::of_run(&membership.run.run_dir, name, before.line_bytes)?,
            counts: before.counts,
        })
    }

    /// Takes those of the tick of `header`.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn add<'a, E>(&mut self, header: &MessageHeader, events: &'a [E], names: &RoadUserNames) -> Result<(), Failure>
    where
        ReportedEvent: From<&'a E>,
    {
        for set in events.iter().map(ReportedEvent::from) {
            let class = names.class(set.vehicle);
            if !self.counts.contains_key(class) {
                self.counts.insert(class.to_owned(), BTreeMap::new());
            }
            if let Some(causes) = self.counts.get_mut(class) {
                *causes.entry(set.cause).or_default() += 1;
            }
            #[expect(clippy::cast_precision_loss, reason = "a time for human readers")]
            let sim_time_s = header.sim_time_ns as f64 / 1e9;
            self.lines.push(&ResynchronisationLine {
                tick: header.tick,
                episode: header.episode,
                sim_time_s,
                vehicle: names.id(set.vehicle),
                class,
                cause: set.cause,
                position_m: set.position_m,
                distance: set.distance,
            })?;
        }
        Ok(())
    }

    /// Those so far, whose lines are in the file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn state(&mut self) -> Result<ResynchronisationState, Failure> {
        self.lines.flush()?;
        Ok(ResynchronisationState {
            counts: self.counts.clone(),
            line_bytes: self.lines.written_bytes(),
        })
    }

    /// Writes what is buffered to the file and returns the counts so far.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(&mut self) -> Result<&ResynchronisationCounts, Failure> {
        self.lines.flush()?;
        Ok(&self.counts)
    }
}
