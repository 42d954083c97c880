//! What the trainer chooses in the messages task: for each station, the candidates that its message lists.

use bytemuck::{Pod, Zeroable};
use ipc_schema::{
    block,
    failure::{Failure, FailureKind},
    header::MessageHeader,
    membership::RunMembership,
    observation::EMPTY_SLOT,
    ports::{Message, PortError, Subscriber},
    prediction::PredictionLayout,
    services::Channel,
};
use sensor_daemon::delivery::tick_publisher::TickPublisher;
use sim_core::action_log::ActionLog;

use crate::exchange::SlotMeasurement;

/// The choice of one station.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub struct LoggedChoice {
    /// Dense index of its vehicle.
    pub vehicle: u32,
    /// Bits of the candidates that are listed.
    pub places: u32,
}

/// Receives choices, and logs them: a process that is started again makes the same ticks from the log.
#[derive(Debug)]
pub struct ChoicePort {
    predictions: Subscriber,
    log: ActionLog<LoggedChoice>,
    candidates: usize,
}

impl ChoicePort {
    /// Opens the port before the process is attached, so that the trainer's first answer is not lost.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn open(membership: &mut RunMembership) -> Result<Self, Failure> {
        let run = &membership.run;
        // Sensors are ahead of messages by what lies in shared memory.
        let sensed_ahead = 4 * run.window_ticks();
        Ok(Self {
            log: ActionLog::new(&run.run_dir, run.env_index, sensed_ahead),
            candidates: run.config.v2x.candidates as usize,
            predictions: membership.subscriber(Channel::Prediction)?,
        })
    }

    /// The choices for the tick of `header`, whose `neighbours` have been published: those that an earlier process has logged, or those
    /// that the trainer answers. `None` once the process is asked to stop.
    ///
    /// # Errors
    /// A port fails, the log cannot be read, or the answer has the wrong shape.
    pub fn next(
        &mut self,
        membership: &mut RunMembership,
        neighbours: &mut TickPublisher,
        header: &MessageHeader,
        slots: &[SlotMeasurement],
    ) -> Result<Option<Vec<LoggedChoice>>, Failure> {
        // The choice at a tick moves the next one.
        let moved = header.tick + 1;
        if let Some(choices) = self.log.actions_before(&membership.run, header.episode, moved)? {
            // The trainer may answer these ticks again: its answers must not fill the queue.
            while self.predictions.receive()?.is_some() {}
            return Ok(Some(choices));
        }
        loop {
            let Some(answer) = neighbours.next(membership, &self.predictions)? else {
                return Ok(None);
            };
            let received = answer.header().tick;
            if received > header.tick {
                return Err(PortError::Gap {
                    channel: Channel::Prediction.name(),
                    expected: header.tick,
                    received,
                }
                .into());
            }
            if received == header.tick {
                let choices = self.read(&answer, slots)?;
                if let Err(error) = self.log.add(moved, &choices) {
                    tracing::warn!("choices of this episode are not logged any more: {error}");
                }
                return Ok(Some(choices));
            }
        }
    }

    /// The choices of an answer: an object is listed if its number is above 0, so what is not a number is not.
    fn read(&self, answer: &Message, slots: &[SlotMeasurement]) -> Result<Vec<LoggedChoice>, Failure> {
        let header = answer.header();
        let [rows, columns, ..] = header.shape.map(|size| size as usize);
        if rows != slots.len() || columns != self.candidates {
            return Err(Failure::new(
                FailureKind::Run,
                format!(
                    "tick {}: the trainer sent choices of shape [{rows}, {columns}], the task needs [{}, {}]",
                    header.tick,
                    slots.len(),
                    self.candidates
                ),
            )
            .with_help("send a number for each of `v2x.candidates` candidates of each slot"));
        }
        let numbers: &[f32] = block::view(answer.payload(), PredictionLayout::of(header).prediction)
            .map_err(|error| Failure::from_error(FailureKind::Run, &error))?;
        let rows = slots.iter().zip(numbers.chunks_exact(columns.max(1)));
        Ok(rows
            .filter(|(slot, _)| slot.vehicle != EMPTY_SLOT)
            .map(|(slot, numbers)| LoggedChoice {
                vehicle: slot.vehicle,
                places: places_of(numbers),
            })
            .collect())
    }
}

fn places_of(numbers: &[f32]) -> u32 {
    let bits = (0..u32::BITS).zip(numbers);
    bits.filter(|(_, number)| **number > 0.0)
        .fold(0, |places, (bit, _)| places | 1 << bit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_above_0_are_choices_and_what_is_no_number_is_none() {
        assert_eq!(places_of(&[0.1, 0.0, -0.1, f32::NAN, f32::INFINITY]), 0b10001);
        assert_eq!(places_of(&[1.0; 32]), u32::MAX);
        assert_eq!(places_of(&[]), 0);
    }
}
