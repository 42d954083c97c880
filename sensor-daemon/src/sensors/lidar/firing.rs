//! The time at which each column fires.
//!
//! The head turns counter-clockwise as seen from above and points ahead when a rotation begins. A tick is a whole number of rotations
//! or a whole part of one; the tick's number selects the part. Column *j* of *n* fires at `(j + 1) / n` of the tick, the last one at
//! its end.

use std::f64::consts::TAU;

use ipc_schema::config::Config;

use super::{error::LidarError, pattern::RayPattern};

/// Most columns of a span: its results stay in the processor's nearest memory.
pub(super) const SPAN: usize = 64;
/// Longest span, seconds: within it every object moves along a straight line and turns by a small angle.
const SPAN_S: f64 = 4e-3;

/// Consecutive columns that are scanned together. Within a span every object moves along a straight line.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct ColumnSpan {
    /// First column, counted from the begin of the tick, including columns out of the field of view.
    pub(super) first: usize,
    /// Columns.
    pub(super) count: usize,
    /// Columns that are fired before it in this tick.
    pub(super) fired_before: usize,
    /// Times of its first and its last column, as shares of the tick.
    pub(super) at: [f64; 2],
    /// The sub-step it lies in.
    pub(super) sub_step: usize,
}

/// The turning head.
#[derive(Debug, Clone)]
pub(super) struct FiringSequence {
    /// Columns of a rotation.
    pub(super) per_rotation: usize,
    /// Columns after which the sequence repeats.
    cycle: usize,
    /// Ticks in a cycle.
    phases: usize,
    /// Sines and cosines of the azimuths of the columns of a rotation and of the first columns of the next: a span and a chunk may
    /// reach beyond the end.
    pub(super) sines: Vec<f64>,
    pub(super) cosines: Vec<f64>,
    /// Whether a column is within the field of view.
    is_seen: Vec<bool>,
    tick_s: f64,
}

impl FiringSequence {
    pub(super) fn new(config: &Config, pattern: &RayPattern) -> Result<Self, LidarError> {
        let (lidar, tick_s) = (&config.lidar, config.run.tick_s);
        let wrong = LidarError::Rotation {
            rotation_hz: lidar.rotation_hz,
            tick_s,
        };
        let (rotations, phases) = rotations_and_ticks(lidar.rotation_hz * tick_s).ok_or(wrong)?;
        let per_rotation = if pattern.is_table {
            pattern.groups.len()
        } else {
            let columns = lidar.points_per_second as f64 / (pattern.lasers as f64 * lidar.rotation_hz);
            (columns.round() as usize).max(1)
        };
        let angle = |column: usize| TAU * column as f64 / per_rotation as f64;
        let half = 0.5 * lidar.horizontal_fov_deg.to_radians() + 1e-9;
        let off_centre = |column: usize| angle(column).min(TAU - angle(column));
        let azimuth = |column: usize| match pattern.is_table {
            true => (0.0, 1.0),
            false => libm::sincos(angle(column % per_rotation)),
        };
        Ok(Self {
            per_rotation,
            cycle: per_rotation * rotations,
            phases,
            sines: (0..per_rotation + SPAN).map(|column| azimuth(column).0).collect(),
            cosines: (0..per_rotation + SPAN).map(|column| azimuth(column).1).collect(),
            is_seen: (0..per_rotation)
                .map(|column| pattern.is_table || off_centre(column) <= half)
                .collect(),
            tick_s,
        })
    }

    /// First column of a tick within the cycle, and the number of its columns.
    pub(super) fn tick(&self, tick: u64) -> (usize, usize) {
        let phase = (tick % self.phases as u64) as usize;
        let begin = phase * self.cycle / self.phases;
        (begin, (phase + 1) * self.cycle / self.phases - begin)
    }

    /// Most columns that are fired in one tick.
    pub(super) fn most_columns(&self) -> usize {
        let fired = |phase: usize| {
            let (begin, count) = self.tick(phase as u64);
            (begin..begin + count)
                .filter(|column| self.is_seen[column % self.per_rotation])
                .count()
        };
        (0..self.phases).map(fired).max().unwrap_or(0)
    }

    /// The spans of a tick of `sub_steps` sub-steps (0: nothing moves), into `spans`.
    pub(super) fn spans(&self, tick: u64, sub_steps: usize, spans: &mut Vec<ColumnSpan>) {
        spans.clear();
        let (begin, count) = self.tick(tick);
        let most = ((SPAN_S / self.tick_s * count as f64) as usize).clamp(1, SPAN);
        let most = if sub_steps == 0 { SPAN } else { most };
        let (mut next, mut fired) = (0, 0);
        while next < count {
            let sub_step = ((next + 1) * sub_steps.max(1) - 1) / count;
            // Column j ends its share (j + 1) / count of the tick: the last that still lies in this sub-step.
            let last = ((sub_step + 1) * count / sub_steps.max(1)).max(next + 1);
            let run = balanced(last - next, most);
            let in_row = (next..next + run).take_while(|column| self.is_seen[(begin + column) % self.per_rotation]);
            let seen = in_row.count();
            if seen == 0 {
                next += 1;
                continue;
            }
            let at = |column: usize| {
                if sub_steps == 0 {
                    1.0
                } else {
                    (column + 1) as f64 / count as f64
                }
            };
            spans.push(ColumnSpan {
                first: next,
                count: seen,
                fired_before: fired,
                at: [at(next), at(next + seen - 1)],
                sub_step,
            });
            fired += seen;
            next += seen;
        }
    }
}

/// The first of several runs of nearly equal length, none longer than `most`, that make up `count`.
fn balanced(count: usize, most: usize) -> usize {
    count.div_ceil(count.div_ceil(most))
}

/// Whole rotations in a number of ticks, one of the two being 1.
fn rotations_and_ticks(rotations_per_tick: f64) -> Option<(usize, usize)> {
    let whole = |value: f64| {
        let rounded = value.round();
        (rounded >= 1.0 && (value - rounded).abs() < 1e-6 * rounded).then_some(rounded as usize)
    };
    let several = whole(rotations_per_tick).map(|rotations| (rotations, 1));
    several.or_else(|| whole(1.0 / rotations_per_tick).map(|ticks| (1, ticks)))
}
