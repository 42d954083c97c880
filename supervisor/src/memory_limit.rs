//! The memory limit of this program's control group (a container's, or a job's): what it leaves free, and whether the kernel has ended a
//! process because of it.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// Where the kernel describes the groups of this process.
const OWN_GROUPS: &str = "/proc/self/cgroup";
/// Where control groups are mounted.
const MOUNTS: &str = "/sys/fs/cgroup";
/// A version-1 group without a limit has the largest number of pages; no machine has that much memory.
const UNLIMITED_BYTES: u64 = 1 << 60;

/// Names of the files of a version of control groups.
#[derive(Debug, Clone, Copy)]
struct GroupFiles {
    limit: &'static str,
    used: &'static str,
    /// Has a line `oom_kill N`.
    events: &'static str,
    /// Lines of `memory.stat` with memory that the kernel can take back: pages of files that are not shared memory.
    reclaimable: [&'static str; 2],
}

const VERSION_1: GroupFiles = GroupFiles {
    limit: "memory.limit_in_bytes",
    used: "memory.usage_in_bytes",
    events: "memory.oom_control",
    reclaimable: ["total_inactive_file", "total_active_file"],
};
const VERSION_2: GroupFiles = GroupFiles {
    limit: "memory.max",
    used: "memory.current",
    events: "memory.events",
    reclaimable: ["inactive_file", "active_file"],
};

/// A control group that limits memory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MemoryLimit {
    /// The limit, bytes.
    pub limit_bytes: u64,
    /// What is left below it, counting what the kernel can take back, bytes.
    pub free_bytes: u64,
}

/// The control groups of this process that may limit its memory: its own, and those above it.
#[derive(Debug, Default)]
pub struct MemoryGroups {
    groups: Vec<(PathBuf, GroupFiles)>,
}

impl MemoryGroups {
    /// The groups of this process.
    #[must_use]
    pub fn own() -> Self {
        Self::of(&fs::read_to_string(OWN_GROUPS).unwrap_or_default(), Path::new(MOUNTS))
    }

    /// The groups that `described` names, as `/proc/self/cgroup` does, below `mounts`.
    fn of(described: &str, mounts: &Path) -> Self {
        let mut groups = Vec::new();
        for line in described.lines() {
            let mut parts = line.splitn(3, ':').skip(1);
            let (Some(controllers), Some(path)) = (parts.next(), parts.next()) else {
                continue;
            };
            let (mount, files) = match controllers {
                "" => (mounts.to_owned(), VERSION_2),
                _ if controllers.split(',').any(|name| name == "memory") => (mounts.join("memory"), VERSION_1),
                _ => continue,
            };
            // In a namespace of its own a group is the root; the path may then lead nowhere.
            let own = mount.join(path.trim_start_matches('/'));
            let above = own.ancestors().take_while(|above| above.starts_with(&mount));
            groups.extend(above.map(|above| (above.to_owned(), files)));
        }
        Self { groups }
    }

    /// The limit that leaves the least memory; `None` without any.
    #[must_use]
    pub fn tightest(&self) -> Option<MemoryLimit> {
        let limits = self.groups.iter().filter_map(|(group, files)| {
            let number = |name: &str| fs::read_to_string(group.join(name)).ok()?.trim().parse::<u64>().ok();
            let limit_bytes = number(files.limit).filter(|limit| *limit < UNLIMITED_BYTES)?;
            let stat = fs::read_to_string(group.join("memory.stat")).unwrap_or_default();
            let reclaimable_bytes: u64 = files.reclaimable.iter().filter_map(|name| value(&stat, name)).sum();
            let used_bytes = number(files.used)?.saturating_sub(reclaimable_bytes);
            Some(MemoryLimit {
                limit_bytes,
                free_bytes: limit_bytes.saturating_sub(used_bytes),
            })
        });
        limits.min_by_key(|limit| limit.free_bytes)
    }

    /// Processes that the kernel has ended so far because a limit was reached.
    #[must_use]
    pub fn kills(&self) -> u64 {
        let counts = self.groups.iter().filter_map(|(group, files)| {
            let events = fs::read_to_string(group.join(files.events)).ok()?;
            value(&events, "oom_kill")
        });
        // A group above counts those of the groups below as well, in version 2.
        counts.max().unwrap_or(0)
    }
}

/// The number on the line of `text` that begins with `name`.
fn value(text: &str, name: &str) -> Option<u64> {
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix(name)?.strip_prefix(' '))?;
    line.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes files of a group.
    fn group(directory: &Path, files: &[(&str, &str)]) {
        fs::create_dir_all(directory).unwrap();
        for (name, text) in files {
            fs::write(directory.join(name), text).unwrap();
        }
    }

    const MIB: u64 = 1 << 20;

    #[test]
    fn the_tightest_limit_of_version_2_counts_what_can_be_taken_back() {
        let mounts = tempfile::tempdir().unwrap();
        let root = mounts.path();
        group(root, &[("cgroup.procs", "1\n")]);
        let limit = (512 * MIB).to_string();
        group(
            &root.join("jobs"),
            &[
                ("memory.max", &format!("{limit}\n")),
                ("memory.current", &format!("{}\n", 300 * MIB)),
                (
                    "memory.stat",
                    &format!(
                        "anon 1\nfile {}\ninactive_file {}\nactive_file {}\n",
                        250 * MIB,
                        60 * MIB,
                        40 * MIB
                    ),
                ),
                ("memory.events", "low 0\nhigh 0\nmax 7\noom 3\noom_kill 2\n"),
            ],
        );
        group(
            &root.join("jobs/7"),
            &[
                ("memory.max", "max\n"),
                ("memory.current", "1\n"),
                ("memory.events", "oom 1\noom_kill 1\n"),
            ],
        );
        let groups = MemoryGroups::of("0::/jobs/7\n", root);
        let limit = MemoryLimit {
            limit_bytes: 512 * MIB,
            free_bytes: 312 * MIB,
        };
        assert_eq!(groups.tightest(), Some(limit));
        assert_eq!(groups.kills(), 2);
    }

    #[test]
    fn version_1_has_its_own_names_and_a_number_for_no_limit() {
        let mounts = tempfile::tempdir().unwrap();
        let memory = mounts.path().join("memory");
        group(&memory, &[("memory.limit_in_bytes", "9223372036854771712\n")]);
        let described = "9:name=systemd:/\n4:cpu,memory:/docker/a:b\n0::/\n";
        assert_eq!(MemoryGroups::of(described, mounts.path()).tightest(), None);
        group(
            &memory.join("docker/a:b"),
            &[
                ("memory.limit_in_bytes", "1000000\n"),
                ("memory.usage_in_bytes", "700000\n"),
                ("memory.stat", "total_inactive_file 100000\n"),
                ("memory.oom_control", "oom_kill_disable 0\nunder_oom 0\noom_kill 5\n"),
            ],
        );
        let groups = MemoryGroups::of(described, mounts.path());
        assert_eq!(groups.tightest().unwrap().free_bytes, 400_000);
        assert_eq!(groups.kills(), 5);
    }

    #[test]
    fn a_group_of_another_namespace_leaves_the_root_which_is_its_own() {
        let mounts = tempfile::tempdir().unwrap();
        group(mounts.path(), &[("memory.max", "5000\n"), ("memory.current", "9000\n")]);
        let groups = MemoryGroups::of("0::/elsewhere/job\n", mounts.path());
        assert_eq!(groups.tightest().unwrap().free_bytes, 0);
        assert_eq!(MemoryGroups::of("", mounts.path()).tightest(), None);
    }

    #[test]
    fn the_groups_of_this_process_can_be_read() {
        // With or without a limit: a number or none, and no error.
        let groups = MemoryGroups::own();
        assert!(
            groups
                .tightest()
                .is_none_or(|limit| limit.free_bytes <= limit.limit_bytes)
        );
        let _ = groups.kills();
    }
}
