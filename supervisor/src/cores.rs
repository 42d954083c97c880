//! Decides which cores the processes of a run may use.
//!
//! The three processes of an environment exchange messages a thousand times a second. On neighbouring cores they share a cache,
//! and environments do not displace each other. With one environment, or with too few cores, the kernel decides.

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// Processes of an environment, each of which can keep a core busy.
const ENVIRONMENT_CORES: usize = 3;
/// Cores that a learner needs beside the environments: one for each of its networks.
const TRAINER_CORES: usize = 2;

/// The cores of each environment and of the other processes.
#[derive(Debug, PartialEq, Eq)]
pub struct CorePlan {
    /// Cores of each environment.
    pub environments: Vec<Vec<usize>>,
    /// Cores of the processes that belong to the whole run.
    pub rest: Vec<usize>,
}

/// Distributes `cores` to `envs` environments and, if the run trains, to the trainer. `None` if every process may use all cores.
#[must_use]
pub fn plan(cores: &[usize], envs: usize, trains: bool) -> Option<CorePlan> {
    let spare = if trains { TRAINER_CORES } else { 0 };
    let each = (cores.len().saturating_sub(spare) / envs.max(1)).min(ENVIRONMENT_CORES);
    if envs < 2 || each == 0 || trains && each < ENVIRONMENT_CORES {
        return None;
    }
    let (shared, rest) = cores.split_at(each * envs);
    Some(CorePlan {
        environments: shared.chunks(each).map(<[usize]>::to_vec).collect(),
        rest: if rest.is_empty() { cores } else { rest }.to_vec(),
    })
}

/// The cores that this process may use.
#[must_use]
pub fn available() -> Vec<usize> {
    sched_getaffinity(None)
        .map(|set| (0..CpuSet::MAX_CPU).filter(|core| set.is_set(*core)).collect())
        .unwrap_or_default()
}

/// Runs `start` while this thread is bound to `cores`. A process that `start` creates inherits the binding.
pub fn within<T>(cores: Option<&[usize]>, start: impl FnOnce() -> T) -> T {
    let Some(cores) = cores else { return start() };
    let before = available();
    bind(cores);
    let result = start();
    bind(&before);
    result
}

fn bind(cores: &[usize]) {
    let mut set = CpuSet::new();
    cores.iter().for_each(|core| set.set(*core));
    if let Err(error) = sched_setaffinity(None, &set) {
        tracing::debug!(%error, "cannot bind to cores");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cores(count: usize) -> Vec<usize> {
        (0..count).collect()
    }

    #[test]
    fn one_environment_is_left_to_the_kernel() {
        assert_eq!(plan(&cores(16), 1, true), None);
    }

    #[test]
    fn sixteen_cores_hold_four_environments_and_a_trainer() {
        let plan = plan(&cores(16), 4, true).unwrap();
        assert_eq!(plan.environments.len(), 4);
        assert_eq!(plan.environments[1], [3, 4, 5]);
        assert_eq!(plan.rest, [12, 13, 14, 15]);
    }

    #[test]
    fn with_too_few_cores_every_process_shares_all_of_them() {
        assert_eq!(plan(&cores(2), 2, true), None);
        assert_eq!(plan(&cores(16), 8, true), None);
    }

    #[test]
    fn without_a_trainer_two_cores_have_an_environment_each() {
        let plan = plan(&cores(2), 2, false).unwrap();
        assert_eq!(plan.environments, [[0], [1]]);
        assert_eq!(plan.rest, [0, 1]);
    }

    #[test]
    fn more_environments_than_cores_are_left_to_the_kernel() {
        assert_eq!(plan(&cores(2), 3, false), None);
    }
}
