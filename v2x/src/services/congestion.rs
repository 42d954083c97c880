//! Decentralised congestion control: ETSI TS 102 687 V1.2.1, reactive (annex A) and adaptive (section 5.4).

use ipc_schema::config::V2xCongestionControl;

use super::MS;

/// Channel loads from which the states of the reactive control begin: active 1 to 3, restrictive.
const LOADS: [f64; 4] = [0.3, 0.4, 0.5, 0.6];
/// Least time between messages of at most 0.5 ms of air time by state, milliseconds (table A.2).
const SHORT_MESSAGES_MS: [u64; 5] = [50, 100, 200, 250, 1000];
/// The same for messages of up to 1 ms (table A.1).
const LONG_MESSAGES_MS: [u64; 5] = [100, 200, 400, 500, 1000];
/// Longest air time of the table of short messages, seconds.
const SHORT_S: f64 = 0.5e-3;

/// Parameters of the adaptive control, table 3.
const ALPHA: f64 = 0.016;
const BETA: f64 = 0.0012;
const TARGET_LOAD: f64 = 0.68;
const DUTY_RANGE: [f64; 2] = [0.0006, 0.03];
const OFFSET_RANGE: [f64; 2] = [-0.000_25, 0.0005];
/// Time between two updates of the adaptive control, nanoseconds.
const UPDATE_NS: u64 = 200 * MS;
/// Range of the time between messages of the adaptive control, nanoseconds.
const GAP_NS: [u64; 2] = [25 * MS, 1000 * MS];

/// Congestion control of one station.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CongestionControl {
    kind: V2xCongestionControl,
    /// `CBR_ITS-S`, smoothed.
    smoothed_load: f64,
    /// The load of the half of an update before the present one.
    earlier_load: f64,
    newest_load: f64,
    /// Share of time on air that the station may take, δ.
    duty: f64,
    updated_ns: Option<u64>,
}

impl CongestionControl {
    /// Congestion control of a station that has heard nothing.
    #[must_use]
    pub fn new(kind: V2xCongestionControl) -> Self {
        Self {
            kind,
            smoothed_load: 0.0,
            earlier_load: 0.0,
            newest_load: 0.0,
            duty: DUTY_RANGE[1],
            updated_ns: None,
        }
    }

    /// Takes the channel load of the last 100 ms, measured at `now_ns`.
    pub fn measure(&mut self, now_ns: u64, load: f64) {
        (self.earlier_load, self.newest_load) = (self.newest_load, load);
        if self.updated_ns.is_some_and(|updated| now_ns - updated < UPDATE_NS) {
            return;
        }
        self.updated_ns = Some(now_ns);
        self.smoothed_load = 0.5 * self.smoothed_load + 0.25 * (self.newest_load + self.earlier_load);
        let away = BETA * (TARGET_LOAD - self.smoothed_load);
        let offset = away.clamp(OFFSET_RANGE[0], OFFSET_RANGE[1]);
        self.duty = ((1.0 - ALPHA) * self.duty + offset).clamp(DUTY_RANGE[0], DUTY_RANGE[1]);
    }

    /// Least time between two messages of `air_time_s`, nanoseconds.
    #[must_use]
    pub fn gap_ns(&self, air_time_s: f64) -> u64 {
        match self.kind {
            V2xCongestionControl::Off => 0,
            V2xCongestionControl::Reactive => {
                let state = LOADS.iter().filter(|load| self.newest_load >= **load).count();
                let table = if air_time_s <= SHORT_S {
                    SHORT_MESSAGES_MS
                } else {
                    LONG_MESSAGES_MS
                };
                table[state] * MS
            }
            V2xCongestionControl::Adaptive => ((air_time_s / self.duty * 1e9) as u64).clamp(GAP_NS[0], GAP_NS[1]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reactive_control_follows_its_table() {
        let gap_ms = |load, air_time_s| {
            let mut control = CongestionControl::new(V2xCongestionControl::Reactive);
            control.measure(0, load);
            control.gap_ns(air_time_s) / MS
        };
        let loads = [0.0, 0.29, 0.3, 0.39, 0.4, 0.49, 0.5, 0.59, 0.6, 1.0];
        assert_eq!(
            loads.map(|load| gap_ms(load, 0.4e-3)),
            [50, 50, 100, 100, 200, 200, 250, 250, 1000, 1000]
        );
        assert_eq!(
            loads.map(|load| gap_ms(load, 0.9e-3)),
            [100, 100, 200, 200, 400, 400, 500, 500, 1000, 1000]
        );
    }

    #[test]
    fn the_adaptive_control_settles_where_its_equation_does() {
        // δ = (1 − α) δ + β (target − load) at rest: δ = β (target − load) / α, within its range.
        for (load, expected) in [
            (0.5, BETA * 0.18 / ALPHA),
            (0.65, BETA * 0.03 / ALPHA),
            (0.9, DUTY_RANGE[0]),
            (0.0, DUTY_RANGE[1]),
        ] {
            let mut control = CongestionControl::new(V2xCongestionControl::Adaptive);
            for update in 0..2000 {
                control.measure(update * UPDATE_NS, load);
            }
            assert!(
                (control.duty - expected).abs() < 1e-9,
                "load {load}: {} for {expected}",
                control.duty
            );
            let gap_ns = (0.4e-3 / expected * 1e9).clamp(25e6, 1e9);
            assert!((control.gap_ns(0.4e-3) as f64 - gap_ns).abs() < 1e3);
        }
    }

    #[test]
    fn stations_that_share_a_channel_reach_the_same_share() {
        // 400 stations of 0.4 ms: the load is what they take together, whatever they began with.
        let mut stations = vec![CongestionControl::new(V2xCongestionControl::Adaptive); 400];
        stations[0].duty = DUTY_RANGE[0];
        for update in 0..3000_u64 {
            let load: f64 = stations.iter().map(|station| station.duty).sum::<f64>().min(1.0);
            stations
                .iter_mut()
                .for_each(|station| station.measure(update * UPDATE_NS, load));
        }
        let load: f64 = stations.iter().map(|station| station.duty).sum();
        // At rest α δ = β (target − N δ): the load is N β target / (α + N β).
        let expected = 400.0 * BETA * TARGET_LOAD / (ALPHA + 400.0 * BETA);
        assert!((load - expected).abs() < 1e-3, "{load} for {expected}");
        assert!((stations[0].duty - stations[1].duty).abs() < 1e-9);
    }
}
