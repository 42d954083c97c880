//! What a road user knows of SUMO's path: the mean of SUMO's last states, and how the mirror follows it.

use std::collections::VecDeque;

use ipc_schema::{config::PreviewFrames, traffic::TrafficState};

use super::{
    pace::{PacedPath, PathLimits},
    prefetch::PrefetchRange,
    window::{StateWindow, WindowStep},
};

/// The path ahead of one road user.
#[derive(Debug, Clone, PartialEq)]
pub struct PathAhead {
    window: StateWindow,
    path: PacedPath,
    /// SUMO's own states since the path began, newest first, as far back as a frame before the mirror's time.
    recent: VecDeque<TrafficState>,
    /// Frames by which the mirror is behind SUMO.
    delay: usize,
}

impl PathAhead {
    /// A path that belongs to no road user yet.
    #[must_use]
    pub fn new(frames: PreviewFrames) -> Self {
        Self {
            window: StateWindow::new(frames.window_states),
            path: PacedPath::new(frames),
            recent: VecDeque::with_capacity(frames.delay() + 2),
            delay: frames.delay(),
        }
    }

    /// Begins with a road user that has come to `now` straight ahead at its speed, in frames of `frame_s`. Returns its mirror's state.
    pub fn restart(&mut self, now: &TrafficState, frame_s: f64) -> TrafficState {
        self.recent.clear();
        self.recent.push_front(*now);
        self.window.restart(now, frame_s);
        self.path.restart(self.window.mean(), frame_s)
    }

    /// Prefetches what the next state needs, of a path whose own numbers are in the cache.
    #[inline]
    pub fn prefetch(&self) {
        self.window.prefetch();
        self.path.prefetch();
        PrefetchRange::new(self.recent.as_slices().0, 0, 1).fetch_all();
    }

    /// Takes the next state of a body of `length_m`, and moves its `mirror` for a frame. `None` if no vehicle moves like that. A road user
    /// without `limits` is always on time.
    pub fn advance(
        &mut self,
        now: &TrafficState,
        length_m: f64,
        limits: Option<&PathLimits>,
        frame_s: f64,
        mirror: &mut TrafficState,
    ) -> Option<WindowStep> {
        let step = self.window.advance(now, length_m, frame_s)?;
        if self.recent.len() == self.delay + 2 {
            self.recent.pop_back();
        }
        self.recent.push_front(*now);
        let mean = (self.window.mean(), self.window.deviation_m());
        self.path.advance(mean, step, limits, frame_s, mirror);
        Some(step)
    }

    /// Frames by which the mirror is behind SUMO.
    #[must_use]
    pub fn delay(&self) -> usize {
        self.delay
    }

    /// SUMO's own states within a frame of the mirror's time, newest first; none if the path began later.
    pub fn delayed(&self) -> impl Iterator<Item = &TrafficState> {
        self.recent.iter().skip(self.delay.saturating_sub(1))
    }

    /// Distance along the path by which the mirror is later than it should be, metres.
    #[must_use]
    pub fn late_m(&self) -> f64 {
        self.path.late_m()
    }

    /// True where the path begins to turn so narrowly that the vehicle has to be led.
    #[must_use]
    pub fn turns_narrowly(&self) -> bool {
        self.path.turns_narrowly()
    }

    /// True near a turn of the path that is narrower than the vehicle's turning circle.
    #[must_use]
    pub fn is_narrow(&self) -> bool {
        self.path.is_narrow()
    }

    /// Distance of the mirror's place on the path from SUMO's own path, metres.
    #[must_use]
    pub fn deviation_m(&self) -> f64 {
        self.path.deviation_m()
    }
}
