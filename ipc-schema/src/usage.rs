//! The processor time and memory of a process, for the report of a run.

use rustix::time::ClockId;
use serde::Serialize;

use crate::clock;

/// Clock ticks per second: the unit in which Linux reports the processor time of other processes.
const CLOCK_TICKS_PER_S: f64 = 100.0;

/// Processor time and memory of one process.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Usage {
    /// Processor time of all threads since the process started, seconds.
    pub cpu_s: f64,
    /// The part of it after all ports were open, without the loading of programs, maps and scenes.
    pub loop_cpu_s: f64,
    /// Peak of resident memory, including the shared memory that it has touched, MiB.
    pub peak_memory_mib: u64,
}

impl Usage {
    /// The usage so far. `start_cpu_s` is the processor time that was used before the work began.
    #[must_use]
    pub fn so_far(start_cpu_s: f64) -> Self {
        let cpu_s = processor_time_s();
        Self {
            cpu_s,
            loop_cpu_s: (cpu_s - start_cpu_s).max(0.0),
            peak_memory_mib: peak_memory_kib().div_ceil(1024),
        }
    }
}

/// Processor time of all threads of this process, seconds.
#[must_use]
pub fn processor_time_s() -> f64 {
    clock::seconds(ClockId::ProcessCPUTime)
}

/// Processor time of a process and of its children that it has waited for, seconds. A process that has ended is readable until its parent
/// waits for it.
#[must_use]
pub fn family_processor_time_s(pid: u32) -> Option<f64> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    Some(family_ticks(&text)? / CLOCK_TICKS_PER_S)
}

/// Sum of the fields 14 to 17 of `/proc/<pid>/stat`: user and system time of the process and of its children. Fields are counted from the
/// name in brackets, which is field 2.
fn family_ticks(stat: &str) -> Option<f64> {
    let (_, fields) = stat.rsplit_once(')')?;
    let numbers = fields.split_whitespace().skip(11).take(4);
    numbers.map(|text| text.parse::<f64>().ok()).sum()
}

fn peak_memory_kib() -> u64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.and_then(|rest| rest.split_whitespace().next()?.parse().ok())
        .unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_program_may_hold_anything() {
        let stat = "7 (a) b (c)) S 1 7 7 0 -1 4 100 0 0 0 250 50 9 9 20 0 1 0 5 6 7";
        assert_eq!(family_ticks(stat), Some(318.0));
    }

    #[test]
    fn work_shows_in_the_time_and_memory_in_the_peak() {
        let before = processor_time_s();
        let memory = vec![1_u8; 64 << 20];
        while processor_time_s() < before + 0.05 {
            std::hint::black_box(memory.iter().map(|byte| u64::from(*byte)).sum::<u64>());
        }
        let usage = Usage::so_far(before);
        assert!(usage.loop_cpu_s >= 0.05 && usage.loop_cpu_s <= usage.cpu_s, "{usage:?}");
        assert!(usage.peak_memory_mib >= 64, "{usage:?}");
    }
}
