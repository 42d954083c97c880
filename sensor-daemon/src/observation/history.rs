//! The last observations of every slot, one after the other (a frame stack).

/// Frames of all slots, oldest first in each.
#[derive(Debug, Clone)]
pub struct FrameHistory {
    frame: usize,
    frames: usize,
    values: Vec<f32>,
}

impl FrameHistory {
    /// Histories of `frames` frames of `frame` numbers each.
    #[must_use]
    pub fn new(frame: usize, frames: usize) -> Self {
        Self {
            frame,
            frames: frames.max(1),
            values: Vec::new(),
        }
    }

    /// Numbers in a row.
    #[must_use]
    pub fn width(&self) -> usize {
        self.frame * self.frames
    }

    /// Fills `row` with the history of `slot`. `row` already holds the newest frame at its end. The first frame of a trajectory is
    /// repeated for the frames before it.
    pub fn stack(&mut self, slot: usize, is_first: TrajectoryFrame, row: &mut [f32]) {
        let (frame, width) = (self.frame, self.width());
        if self.frames == 1 {
            return;
        }
        if self.values.len() < (slot + 1) * width {
            self.values.resize((slot + 1) * width, 0.0);
        }
        let past = &mut self.values[slot * width..(slot + 1) * width];
        let (older, newest) = row.split_at_mut(width - frame);
        match is_first {
            TrajectoryFrame::First => older
                .chunks_exact_mut(frame)
                .for_each(|place| place.copy_from_slice(newest)),
            TrajectoryFrame::Later => older.copy_from_slice(&past[frame..]),
        }
        past.copy_from_slice(row);
    }
}

/// Position of a frame in its trajectory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrajectoryFrame {
    /// The frame begins the trajectory.
    First,
    /// The frame continues the trajectory.
    Later,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn push(history: &mut FrameHistory, slot: usize, is_first: TrajectoryFrame, frame: [f32; 2]) -> Vec<f32> {
        let mut row = vec![9.0; history.width()];
        let at = row.len() - 2;
        row[at..].copy_from_slice(&frame);
        history.stack(slot, is_first, &mut row);
        row
    }

    #[test]
    fn the_newest_is_last_and_the_first_repeats() {
        let mut history = FrameHistory::new(2, 3);
        assert_eq!(
            push(&mut history, 1, TrajectoryFrame::First, [1.0, 2.0]),
            [1.0, 2.0, 1.0, 2.0, 1.0, 2.0]
        );
        push(&mut history, 0, TrajectoryFrame::First, [7.0, 7.0]);
        assert_eq!(
            push(&mut history, 1, TrajectoryFrame::Later, [3.0, 4.0]),
            [1.0, 2.0, 1.0, 2.0, 3.0, 4.0]
        );
        assert_eq!(
            push(&mut history, 1, TrajectoryFrame::Later, [5.0, 6.0]),
            [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
        );
        assert_eq!(push(&mut history, 1, TrajectoryFrame::First, [8.0, 8.0]), [8.0; 6]);
    }

    #[test]
    fn one_frame_is_itself() {
        let mut history = FrameHistory::new(2, 1);
        assert_eq!(push(&mut history, 0, TrajectoryFrame::Later, [1.0, 2.0]), [1.0, 2.0]);
    }
}
