//! Cores for processes that are compared: each has one of its own, and what else runs has the others.

use std::{collections::BTreeMap, fs};

use caraware::failure::Exit;
use rustix::{
    process::Pid,
    thread::{CpuSet, sched_getaffinity, sched_setaffinity},
};

/// Cores for compared processes, and cores for all else. The processors of a core share it, so a compared process has the first and the
/// others stay idle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BenchCores {
    /// The processor of each compared process.
    own: Vec<usize>,
    /// Processors of all else.
    others: Vec<usize>,
    /// All processors that this program may use.
    all: Vec<usize>,
}

impl BenchCores {
    /// A plan for this machine: `own` cores for one process each, and `others` cores at least; `None` if it has fewer.
    ///
    /// # Errors
    /// The system does not say which processors this program may use.
    pub fn of_machine(own: usize, others: usize) -> Result<Option<Self>, Exit> {
        let allowed = sched_getaffinity(None).map_err(|error| Exit::run(format!("no processors: {error}"), ""))?;
        let allowed = (0..CpuSet::MAX_CPU).filter(|cpu| allowed.is_set(*cpu));
        let core_of = |cpu: usize| {
            let path = format!("/sys/devices/system/cpu/cpu{cpu}/topology/thread_siblings_list");
            fs::read_to_string(path).unwrap_or_else(|_| cpu.to_string())
        };
        Ok(Self::of(allowed.map(|cpu| (cpu, core_of(cpu))), own, others))
    }

    /// A plan for these processors and the cores that they belong to.
    fn of(cpus: impl Iterator<Item = (usize, String)>, own: usize, others: usize) -> Option<Self> {
        let mut by_core: BTreeMap<String, Vec<usize>> = BTreeMap::new();
        for (cpu, core) in cpus {
            by_core.entry(core).or_default().push(cpu);
        }
        let mut cores: Vec<Vec<usize>> = by_core.into_values().collect();
        cores.sort();
        let all = cores.concat();
        let rest = cores.split_off(own.min(cores.len()));
        (cores.len() == own && rest.len() >= others).then(|| Self {
            own: cores.into_iter().map(|cpus| cpus[0]).collect(),
            others: rest.concat(),
            all,
        })
    }

    /// Keeps this thread, and what it starts from now on, off the cores that processes have for themselves.
    ///
    /// # Errors
    /// The system refuses.
    pub fn keep_off(&self) -> Result<(), Exit> {
        put(None, &self.others)
    }

    /// Lets this thread run everywhere again.
    ///
    /// # Errors
    /// The system refuses.
    pub fn release(&self) -> Result<(), Exit> {
        put(None, &self.all)
    }

    /// Puts each of these processes on its own core, the first on core `first` of those.
    ///
    /// # Errors
    /// The system refuses.
    pub fn pin(&self, first: usize, pids: impl IntoIterator<Item = i32>) -> Result<(), Exit> {
        for (pid, cpu) in pids.into_iter().zip(&self.own[first..]) {
            let threads = fs::read_dir(format!("/proc/{pid}/task"));
            for thread in threads.into_iter().flatten().flatten() {
                let id = thread.file_name().to_str().and_then(|id| id.parse().ok());
                if let Some(id) = id.and_then(Pid::from_raw) {
                    put(Some(id), &[*cpu])?;
                }
            }
        }
        Ok(())
    }
}

/// Lets a thread (`None`: this one) run on these processors alone.
fn put(thread: Option<Pid>, cpus: &[usize]) -> Result<(), Exit> {
    let mut set = CpuSet::new();
    cpus.iter().for_each(|cpu| set.set(*cpu));
    sched_setaffinity(thread, &set).map_err(|error| Exit::run(format!("cannot use processors {cpus:?}: {error}"), ""))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;

    #[test]
    fn a_process_has_a_core_to_itself() {
        // Two processors on each core, numbered one core after the other, and then in two rounds.
        for cores in [[0, 0, 1, 1, 2, 2, 3, 3], [0, 1, 2, 3, 0, 1, 2, 3]] {
            let cpus = cores.into_iter().map(|core: usize| core.to_string()).enumerate();
            let plan = BenchCores::of(cpus.clone(), 3, 1).unwrap();
            let core_of = |cpu: &usize| cores[*cpu];
            assert_eq!(plan.own.iter().map(core_of).collect::<Vec<_>>(), [0, 1, 2]);
            assert_eq!(plan.others.iter().map(core_of).collect::<Vec<_>>(), [3, 3]);
            assert_eq!(plan.all.len(), 8);
            assert_eq!(BenchCores::of(cpus, 3, 2), None, "four cores are too few");
        }
        assert_eq!(BenchCores::of(std::iter::empty(), 1, 0), None);
    }
}
