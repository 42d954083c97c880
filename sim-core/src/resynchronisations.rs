//! Reporting of mirrors that were set onto SUMO: a line each in the run's directory, and counts in its report.

use std::collections::BTreeMap;

use ipc_schema::{failure::Failure, header::MessageHeader, membership::RunMembership};
use serde::{Deserialize, Serialize};

use crate::{
    event_log::EventLog,
    mirror::resynchronisation::{Resynchronisation, ResynchronisationCause},
    names::RoadUserNames,
};

/// How often for each reason, by SUMO's vehicle class.
pub type ResynchronisationCounts = BTreeMap<String, BTreeMap<ResynchronisationCause, u64>>;

/// Resynchronisations before an episode: their counts, and the length of their lines.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResynchronisationState {
    counts: ResynchronisationCounts,
    /// Bytes in `events/resynchronisations.jsonl`.
    line_bytes: u64,
}

/// A line of `events/resynchronisations.jsonl`.
#[derive(Debug, Serialize)]
struct ResynchronisationLine<'a> {
    tick: u64,
    episode: u64,
    sim_time_s: f64,
    vehicle: &'a str,
    class: &'a str,
    cause: ResynchronisationCause,
    position_m: [f64; 3],
    jump_m: f64,
}

/// Counts a run's resynchronisations and writes their lines.
#[derive(Debug)]
pub struct ResynchronisationReporter {
    lines: EventLog,
    counts: ResynchronisationCounts,
}

impl ResynchronisationReporter {
    /// Continues from `before`. Lines behind its own are removed from the file: their ticks are made again.
    ///
    /// # Errors
    /// The file cannot be created.
    pub fn open(membership: &RunMembership, before: ResynchronisationState) -> Result<Self, Failure> {
        Ok(Self {
            lines: EventLog::of_run(&membership.run.run_dir, "resynchronisations.jsonl", before.line_bytes)?,
            counts: before.counts,
        })
    }

    /// Takes those of the tick of `header`.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn add(
        &mut self,
        header: &MessageHeader,
        resynchronised: &[Resynchronisation],
        names: &RoadUserNames,
    ) -> Result<(), Failure> {
        for set in resynchronised {
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
                jump_m: set.jump_m,
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
