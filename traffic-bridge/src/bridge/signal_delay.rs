//! Traffic lights that change as late as the mirrored road users move.
//!
//! With `vehicle.preview_s` the mirror is some frames behind SUMO. Lights that changed at once would show vehicles that cross at red and
//! start before green.

use std::collections::VecDeque;

use ipc_schema::traffic::SignalMeta;

use crate::sumo::frame::TrafficFrame;

/// Holds back the changes of traffic lights.
#[derive(Debug)]
pub(super) struct SignalDelay {
    frames: usize,
    /// Changes of the last frames, oldest first.
    held: VecDeque<Vec<SignalMeta>>,
}

impl SignalDelay {
    pub(super) fn new(frames: usize) -> Self {
        Self {
            frames,
            held: VecDeque::with_capacity(frames + 1),
        }
    }

    /// Replaces the lights that changed in the frame by those that changed so many frames ago. The first step of an episode has all lights;
    /// it keeps them.
    pub(super) fn apply(&mut self, frame: &mut TrafficFrame) {
        if frame.step <= 1 {
            self.held.clear();
        } else if self.frames > 0 {
            let due = match self.held.len() < self.frames {
                true => Vec::new(),
                false => self.held.pop_front().unwrap_or_default(),
            };
            self.held.push_back(std::mem::replace(&mut frame.signals, due));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Steps of an episode in which light number `step` changes in step `step`; returns the lights that each step shows.
    fn shown(delay: &mut SignalDelay, steps: u64) -> Vec<Vec<u32>> {
        let shows = |step| {
            let light = SignalMeta {
                signal: u32::try_from(step).unwrap_or(0),
                ..bytemuck::Zeroable::zeroed()
            };
            let mut frame = TrafficFrame {
                step,
                signals: vec![light],
                ..TrafficFrame::default()
            };
            delay.apply(&mut frame);
            frame.signals.iter().map(|light| light.signal).collect()
        };
        (1..=steps).map(shows).collect()
    }

    #[test]
    fn a_change_is_shown_so_many_frames_later_and_the_first_state_at_once() {
        let late: [&[u32]; 6] = [&[1], &[], &[], &[], &[2], &[3]];
        let mut delay = SignalDelay::new(3);
        assert_eq!(shown(&mut delay, 6), late);
        // What an episode holds back does not reach the next one.
        assert_eq!(shown(&mut delay, 6), late);
    }

    #[test]
    fn without_a_delay_nothing_is_held_back() {
        assert_eq!(shown(&mut SignalDelay::new(0), 3), [[1], [2], [3]]);
    }
}
