//! Tracking statistics of a run: percentiles from counts, so that millions of samples need no memory.

use ipc_schema::world::{APPEARED, GUIDED, RESYNCHRONISED, VehicleState};
use serde::{Deserialize, Serialize};

/// Width of a bin, metres.
const BIN_M: f64 = 0.01;
/// Bins: the last one holds everything from 10 m on.
const BINS: usize = 1_001;

/// Counts of sizes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Histogram {
    bins: Vec<u64>,
    count: u64,
    largest_m: f64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self {
            bins: vec![0; BINS],
            count: 0,
            largest_m: 0.0,
        }
    }
}

/// Percentiles of sizes, metres: upper ends of bins of 1 cm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Percentiles {
    /// Half are at most this.
    pub p50_m: f64,
    /// 99 % are at most this.
    pub p99_m: f64,
    /// 99.9 % are at most this.
    pub p999_m: f64,
    /// None is more than this.
    pub max_m: f64,
}

impl Histogram {
    /// Counts one size (metres, not negative).
    #[inline]
    pub fn add(&mut self, size_m: f64) {
        // Narrower than `usize`: a conversion to 32 bits takes three instructions.
        let bin = (size_m * (1.0 / BIN_M)) as u32 as usize;
        self.bins[bin.min(BINS - 1)] += 1;
        self.count += 1;
        self.largest_m = self.largest_m.max(size_m);
    }

    /// The size that a share of all does not exceed.
    fn percentile(&self, share: f64) -> f64 {
        let wanted = share * self.count as f64;
        let mut seen = 0;
        for (bin, count) in self.bins.iter().enumerate() {
            seen += count;
            if seen as f64 >= wanted {
                return ((bin + 1) as f64 * BIN_M).min(self.largest_m);
            }
        }
        self.largest_m
    }

    /// The percentiles; `None` if nothing was counted.
    #[must_use]
    pub fn percentiles(&self) -> Option<Percentiles> {
        (self.count > 0).then(|| Percentiles {
            p50_m: self.percentile(0.5),
            p99_m: self.percentile(0.99),
            p999_m: self.percentile(0.999),
            max_m: self.largest_m,
        })
    }
}

/// Tracking of a run's vehicles.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrackingStatistics {
    lateral: Histogram,
    longitudinal: Histogram,
    reference: Histogram,
    guided: u64,
}

/// Tracking as it stands in the report.
#[derive(Debug, Clone, Serialize)]
pub struct TrackingSummary {
    /// Vehicle-ticks counted: those in which the vehicle drove to its pose.
    pub samples: u64,
    /// Vehicle-ticks in which it was led along its path; only the distance from SUMO's own path counts these as well.
    pub guided: u64,
    /// Reference minus front bumper, across the heading.
    pub lateral: Option<Percentiles>,
    /// Reference minus front bumper, along the heading.
    pub longitudinal: Option<Percentiles>,
    /// Distance of the reference from SUMO's own path.
    pub reference_from_sumo: Option<Percentiles>,
}

impl TrackingStatistics {
    /// Counts a vehicle at the end of a tick, unless its pose was set.
    #[inline]
    pub fn add(&mut self, state: &VehicleState) {
        if state.flags & (RESYNCHRONISED | APPEARED) != 0 {
            return;
        }
        self.reference.add(f64::from(state.reference_offset_m));
        if state.flags & GUIDED != 0 {
            self.guided += 1;
            return;
        }
        self.lateral.add(f64::from(state.tracking_lateral_m.abs()));
        self.longitudinal.add(f64::from(state.tracking_longitudinal_m.abs()));
    }

    /// For the report.
    #[must_use]
    pub fn summary(&self) -> TrackingSummary {
        TrackingSummary {
            samples: self.lateral.count,
            guided: self.guided,
            lateral: self.lateral.percentiles(),
            longitudinal: self.longitudinal.percentiles(),
            reference_from_sumo: self.reference.percentiles(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_of_a_known_spread() {
        let mut histogram = Histogram::default();
        assert_eq!(histogram.percentiles(), None);
        (0..10_000).for_each(|i| histogram.add((f64::from(i) + 0.5) * 1e-4));
        histogram.add(25.0);
        let found = histogram.percentiles().unwrap();
        for (value, expected) in [(found.p50_m, 0.5), (found.p99_m, 0.99), (found.p999_m, 1.0)] {
            assert!((value - expected).abs() < 0.011, "{found:?}");
        }
        assert_eq!(found.max_m, 25.0);
    }
}
