//! Memory of the machine and of this process, as reported by the system: `/proc` and control groups on Linux, `sysctl` and `vm_stat` on
//! macOS. Other systems report nothing.

use std::path::Path;

/// Bytes of memory that the machine has, and that this process could still allocate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MachineMemory {
    pub total: Option<u64>,
    /// Memory that other processes do not use, limited by this process's control groups.
    pub available: Option<u64>,
}

/// Queries the machine's memory.
pub fn of_machine() -> MachineMemory {
    if cfg!(target_os = "macos") {
        of_macos(&output_of("sysctl", &["-n", "hw.memsize"]), &output_of("vm_stat", &[]))
    } else {
        under(Path::new("/"))
    }
}

/// Peak memory of this process in bytes (Linux), or its present memory; `None` if the system does not report it.
pub fn peak_of_process() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    kibibytes(&status, "VmHWM:").or_else(|| {
        let resident = if cfg!(unix) { output_of("ps", &["-o", "rss=", "-p", &std::process::id().to_string()]) } else { String::new() };
        resident.trim().parse::<u64>().ok().map(|k| k << 10)
    })
}

/// Resets [`peak_of_process`] to the present memory (Linux); elsewhere nothing happens.
pub fn reset_peak() {
    // If the system refuses, the peak since the start of the process is reported.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// Value of a file's line `KEY: N kB`, in bytes.
fn kibibytes(text: &str, key: &str) -> Option<u64> {
    let line = text.lines().find(|l| l.starts_with(key))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|k| k << 10)
}

/// Output of a system program; empty if it does not exist.
fn output_of(program: &str, arguments: &[&str]) -> String {
    let out = std::process::Command::new(program).args(arguments).output();
    out.map(|o| String::from_utf8_lossy(&o.stdout).into_owned()).unwrap_or_default()
}

fn of_macos(total: &str, vm_stat: &str) -> MachineMemory {
    let page = vm_stat.lines().next().and_then(|l| l.split("page size of ").nth(1)?.split(' ').next()?.parse::<u64>().ok());
    let pages = |key: &str| {
        let line = vm_stat.lines().find(|l| l.starts_with(key))?;
        line.rsplit(':').next()?.trim().trim_end_matches('.').parse::<u64>().ok()
    };
    let free: Option<u64> = ["Pages free", "Pages inactive", "Pages purgeable"].into_iter().map(pages).sum();
    MachineMemory { total: total.trim().parse().ok(), available: page.zip(free).map(|(page, free)| page * free) }
}

/// Memory from the files of a Linux system below `root`.
fn under(root: &Path) -> MachineMemory {
    let read = |path: &str| std::fs::read_to_string(root.join(path)).unwrap_or_default();
    let info = read("proc/meminfo");
    let allowed = of_groups(&read);
    // Memory that can be swapped out is available too.
    let available = kibibytes(&info, "MemAvailable:").map(|a| a + kibibytes(&info, "SwapFree:").unwrap_or(0));
    MachineMemory { total: kibibytes(&info, "MemTotal:"), available: available.into_iter().chain(allowed).min() }
}

/// Memory that the control groups of this process still allow, versions 2 and 1.
fn of_groups(read: &dyn Fn(&str) -> String) -> Option<u64> {
    let number = |path: &str| read(path).trim().parse::<u64>().ok();
    let field = |text: &str, key: &str| {
        let line = text.lines().find(|l| l.split(' ').next() == Some(key))?;
        line.split(' ').nth(1)?.parse::<u64>().ok()
    };
    let left = |folder: &str, limit: &str, usage: &str, cached: &str| {
        let limit = number(&format!("{folder}/{limit}"))?;
        // The file cache is released when memory is needed.
        let cache = field(&read(&format!("{folder}/memory.stat")), cached).unwrap_or(0);
        Some(limit.saturating_sub(number(&format!("{folder}/{usage}"))?.saturating_sub(cache)))
    };
    let mut least: Option<u64> = None;
    for line in read("proc/self/cgroup").lines() {
        let mut parts = line.splitn(3, ':');
        let (Some(_), Some(controllers), Some(path)) = (parts.next(), parts.next(), parts.next()) else { continue };
        let version2 = controllers.is_empty();
        if !version2 && !controllers.split(',').any(|c| c == "memory") {
            continue;
        }
        let base = if version2 { "sys/fs/cgroup" } else { "sys/fs/cgroup/memory" };
        // A group's limit applies to all groups below it.
        let mut at = path.trim_matches('/');
        loop {
            let folder = if at.is_empty() { base.to_string() } else { format!("{base}/{at}") };
            let found = if version2 {
                left(&folder, "memory.max", "memory.current", "inactive_file")
            } else {
                left(&folder, "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
            };
            least = least.into_iter().chain(found).min();
            match at.rfind('/') {
                Some(i) => at = &at[..i],
                None if at.is_empty() => break,
                None => at = "",
            }
        }
    }
    least
}

#[cfg(test)]
mod tests {
    use super::*;

    fn system(files: &[(&str, &str)]) -> MachineMemory {
        let dir = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let file = dir.path().join(name);
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            std::fs::write(file, text).unwrap();
        }
        under(dir.path())
    }

    const INFO: (&str, &str) = ("proc/meminfo", "MemTotal:   8000 kB\nMemFree: 10 kB\nMemAvailable:  5000 kB\nSwapFree:  100 kB\n");

    #[test]
    fn control_groups_and_their_parents_limit_what_is_available() {
        assert_eq!(system(&[INFO]), MachineMemory { total: Some(8000 << 10), available: Some(5100 << 10) });
        assert_eq!(system(&[]), MachineMemory::default());
        let second = [
            INFO,
            ("proc/self/cgroup", "0::/user/job\n"),
            ("sys/fs/cgroup/user/job/memory.max", "max\n"),
            ("sys/fs/cgroup/user/memory.max", "1000000\n"),
            ("sys/fs/cgroup/user/memory.current", "700000\n"),
            ("sys/fs/cgroup/user/memory.stat", "anon 5\ninactive_file 200000\n"),
        ];
        assert_eq!(system(&second).available, Some(500_000));
        let first = [
            INFO,
            ("proc/self/cgroup", "7:cpu:/x\n5:memory:/docker/a\n"),
            ("sys/fs/cgroup/memory/memory.limit_in_bytes", "2000000\n"),
            ("sys/fs/cgroup/memory/memory.usage_in_bytes", "500000\n"),
        ];
        assert_eq!(system(&first).available, Some(1_500_000));
    }

    #[test]
    fn vm_stat_is_read() {
        let text = "Mach Virtual Memory Statistics: (page size of 16384 bytes)\nPages free:      100.\nPages active: 7.\nPages inactive:  50.\nPages purgeable: 10.\n";
        assert_eq!(of_macos("17179869184\n", text), MachineMemory { total: Some(16 << 30), available: Some(160 * 16384) });
        assert_eq!(of_macos("", ""), MachineMemory::default());
    }

    #[test]
    fn this_process_has_a_peak_where_the_system_tells() {
        if cfg!(target_os = "linux") {
            assert!(peak_of_process().unwrap() > 1 << 20 && of_machine().available.unwrap() > 1 << 20);
        }
    }
}
