//! Memory available to a run.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

/// Limit of the memory that a run may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryLimit {
    /// Bytes.
    pub bytes: u64,
    /// Origin of the limit.
    pub source: MemorySource,
}

/// Origin of a memory limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum MemorySource {
    /// Memory that is free in the system or can be freed.
    System,
    /// The limit of a control group, as set by containers and job schedulers.
    ControlGroup,
    /// A limit of the process, as set by `ulimit -v` or `ulimit -d`.
    Process,
    /// A limit given by the user.
    User,
}

impl fmt::Display for MemorySource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::System => "MemAvailable of /proc/meminfo",
            Self::ControlGroup => "the limit of this process's control group",
            Self::Process => "the limit of this process (`ulimit -v` or `-d`)",
            Self::User => "the limit that was given",
        })
    }
}

impl MemoryLimit {
    /// A limit given by the user.
    #[must_use]
    pub fn of_user(bytes: u64) -> Self {
        Self { bytes, source: MemorySource::User }
    }

    /// Memory available to this process; `None` if the system does not report it.
    #[must_use]
    pub fn of_machine() -> Option<Self> {
        Self::from_system_files(Path::new("/"))
    }

    /// Memory available according to the system's files below `root`.
    fn from_system_files(root: &Path) -> Option<Self> {
        let system = available_bytes(&fs::read_to_string(root.join("proc/meminfo")).ok()?);
        let system = system.map(|bytes| Self { bytes, source: MemorySource::System });
        let groups = group_bytes(root).map(|bytes| Self { bytes, source: MemorySource::ControlGroup });
        let process = process_bytes(root).map(|bytes| Self { bytes, source: MemorySource::Process });
        system.into_iter().chain(groups).chain(process).min_by_key(|limit| limit.bytes)
    }
}

fn available_bytes(meminfo: &str) -> Option<u64> {
    line_bytes(meminfo, "MemAvailable:")
}

/// The number of bytes in the line `NAME: 12 kB` of a file of the system.
fn line_bytes(file: &str, name: &str) -> Option<u64> {
    let line = file.lines().find_map(|line| line.strip_prefix(name))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    kibibytes.checked_mul(1024)
}

/// Memory left below the limits of this process, bytes: an allocation beyond them fails, whatever the machine has.
fn process_bytes(root: &Path) -> Option<u64> {
    let limits = fs::read_to_string(root.join("proc/self/limits")).ok()?;
    let used = fs::read_to_string(root.join("proc/self/status")).ok()?;
    let left = |(limit, name)| {
        let line = limits.lines().find_map(|line| line.strip_prefix(limit))?;
        let soft: u64 = line.split_whitespace().next()?.parse().ok()?;
        Some(soft.saturating_sub(line_bytes(&used, name)?))
    };
    [("Max address space", "VmSize:"), ("Max data size", "VmData:")].into_iter().filter_map(left).min()
}

/// Memory left in the tightest of this process's control groups and their ancestors, bytes.
fn group_bytes(root: &Path) -> Option<u64> {
    let groups = fs::read_to_string(root.join("proc/self/cgroup")).ok()?;
    groups.lines().filter_map(|line| group_line_bytes(root, line)).min()
}

/// Memory left in the control group named by one line of `/proc/self/cgroup`: `0::PATH` of version 2, or `ID:CONTROLLERS:PATH` of
/// version 1.
fn group_line_bytes(root: &Path, line: &str) -> Option<u64> {
    let mut parts = line.splitn(3, ':').skip(1);
    let (controllers, path) = (parts.next()?, parts.next()?);
    let (mount, files) = match controllers {
        "" => (root.join("sys/fs/cgroup"), ["memory.max", "memory.current", "inactive_file"]),
        _ if controllers.split(',').any(|name| name == "memory") => (
            root.join("sys/fs/cgroup/memory"),
            ["memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"],
        ),
        _ => return None,
    };
    // In a container the path may be that of the host, while the mount itself is the container's group.
    let innermost: PathBuf = mount.join(path.trim_start_matches('/'));
    let folders = innermost.ancestors().take_while(|folder| folder.starts_with(&mount));
    folders.filter_map(|folder| folder_bytes(folder, files)).min()
}

/// Memory left in one control group, bytes. Inactive file pages can be freed, so they do not count as used.
fn folder_bytes(folder: &Path, [limit, usage, unused]: [&str; 3]) -> Option<u64> {
    let number = |name: &str| fs::read_to_string(folder.join(name)).ok()?.trim().parse::<u64>().ok();
    let stat = fs::read_to_string(folder.join("memory.stat")).unwrap_or_default();
    let unused = stat.lines().find_map(|line| line.strip_prefix(unused)?.trim().parse::<u64>().ok());
    let used = number(usage)?.saturating_sub(unused.unwrap_or(0));
    Some(number(limit)?.saturating_sub(used))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn system(files: &[(&str, &str)]) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = root.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        root
    }

    const MEMINFO: (&str, &str) =
        ("proc/meminfo", "MemTotal:       24000000 kB\nMemAvailable:   20000000 kB\nBuffers:  1 kB\n");

    fn limit(files: &[(&str, &str)]) -> Option<(u64, MemorySource)> {
        let limit = MemoryLimit::from_system_files(system(files).path());
        limit.map(|limit| (limit.bytes, limit.source))
    }

    #[test]
    fn without_groups_the_system_sets_the_limit() {
        let system = Some((20_480_000_000, MemorySource::System));
        assert_eq!(limit(&[MEMINFO]), system);
        // A group without a limit, and one of other controllers.
        let free = ("sys/fs/cgroup/memory.max", "max\n");
        assert_eq!(limit(&[MEMINFO, ("proc/self/cgroup", "0::/\n"), free]), system);
        assert_eq!(limit(&[MEMINFO, ("proc/self/cgroup", "3:cpu,cpuacct:/x\n")]), system);
        assert_eq!(limit(&[]), None);
        assert_eq!(limit(&[("proc/meminfo", "MemTotal: 5 kB\n")]), None);
        assert_eq!(limit(&[("proc/meminfo", "MemAvailable: many\n")]), None);
    }

    #[test]
    fn a_limit_of_the_process_is_less_what_it_uses() {
        let status = ("proc/self/status", "Name:\tx\nVmSize:\t 1000000 kB\nVmData:\t  400000 kB\n");
        let table = |address: &str, data: &str| {
            format!(
                "Limit                     Soft Limit           Hard Limit           Units     \n\
                 Max data size             {data:<20} unlimited            bytes     \n\
                 Max address space         {address:<20} unlimited            bytes     \n"
            )
        };
        for (address, data, expected) in [
            ("unlimited", "unlimited", (20_480_000_000, MemorySource::System)),
            ("4096000000", "unlimited", (3_072_000_000, MemorySource::Process)),
            ("4096000000", "1024000000", (614_400_000, MemorySource::Process)),
            ("1000", "unlimited", (0, MemorySource::Process)),
        ] {
            let limits = table(address, data);
            assert_eq!(limit(&[MEMINFO, status, ("proc/self/limits", &limits)]), Some(expected));
        }
    }

    #[test]
    fn the_tightest_group_sets_the_limit() {
        let files = [
            MEMINFO,
            ("proc/self/cgroup", "0::/jobs/ours\n"),
            ("sys/fs/cgroup/jobs/memory.max", "4000000000\n"),
            ("sys/fs/cgroup/jobs/memory.current", "3000000000\n"),
            ("sys/fs/cgroup/jobs/memory.stat", "anon 1000000000\nfile 2000000000\ninactive_file 500000000\n"),
            ("sys/fs/cgroup/jobs/ours/memory.max", "max\n"),
            ("sys/fs/cgroup/jobs/ours/memory.current", "1000\n"),
        ];
        assert_eq!(limit(&files), Some((1_500_000_000, MemorySource::ControlGroup)));
    }

    #[test]
    fn groups_of_version_1_are_known() {
        let files = [
            MEMINFO,
            ("proc/self/cgroup", "5:cpu:/a\n9:memory:/docker/0123\n0::/\n"),
            ("sys/fs/cgroup/memory/memory.limit_in_bytes", "2000000000\n"),
            ("sys/fs/cgroup/memory/memory.usage_in_bytes", "700000000\n"),
            ("sys/fs/cgroup/memory/memory.stat", "inactive_file 1\ntotal_inactive_file 200000000\n"),
        ];
        assert_eq!(limit(&files), Some((1_500_000_000, MemorySource::ControlGroup)));
    }

    #[test]
    fn this_machine_has_a_limit() {
        if cfg!(target_os = "linux") {
            assert!(MemoryLimit::of_machine().is_some_and(|limit| limit.bytes > 0));
        }
    }
}
