//! `caraware doctor`: checks the installation, the free memory and disk space, and what dead runs left.

use std::{net::TcpListener, path::Path, process::Command};

use ipc_schema::{process::Process, reserve::SHARED_MEMORY};

use crate::{failure::Exit, install::Install, prepare::free_bytes, registry};

/// System libraries that libsumo and SUMO's programs link, with the Debian package of each.
const LIBRARIES: [(&str, &str); 7] = [
    ("libX11.so.6", "libx11-6"),
    ("libXext.so.6", "libxext6"),
    ("libXrender.so.1", "libxrender1"),
    ("libatomic.so.1", "libatomic1"),
    ("libGL.so.1", "libgl1"),
    ("libexpat.so.1", "libexpat1"),
    ("libz.so.1", "zlib1g"),
];
/// Python packages that training and watching need.
const PACKAGES: [&str; 10] = [
    "torch",
    "numpy",
    "matplotlib",
    "tensorboard",
    "safetensors",
    "caraware",
    "sumo",
    "caraware_viewer",
    "rerun",
    "zenoh",
];
/// Programs that a run does not need: any one of the names, its purpose, and its Debian package.
const EXTRAS: [(&[&str], &str, &str); 4] = [
    (
        &["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"],
        "browser for the viewer's test",
        "chromium",
    ),
    (
        &["ip"],
        "network namespaces for the tests of remote viewers",
        "iproute2",
    ),
    (&["unshare"], "namespaces for the same tests", "util-linux"),
    (&["openssl"], "keys for remote viewers (docs/remote.md)", "openssl"),
];
/// Least free shared memory, MiB.
const SHARED_MEMORY_MIB: u64 = 64;
/// Least free disk space, MiB.
const DISK_MIB: u64 = 512;

/// Counts the checks that failed.
struct DoctorChecks {
    missing: u32,
}

impl DoctorChecks {
    /// Prints the result of one check: what was found, or what is missing and how to get it.
    fn print(&mut self, result: Result<String, (String, String)>, what: &str) {
        match result {
            Ok(text) => crate::say!("ok       {what}: {text}"),
            Err((text, fix)) => {
                self.missing += 1;
                crate::say!("MISSING  {what}: {text}\n         → {fix}");
            }
        }
    }
}

/// Prints a line for each check; with `clean` it also removes what dead runs left.
///
/// # Errors
/// A check failed.
pub fn doctor(clean: bool) -> Result<(), Exit> {
    let mut checks = DoctorChecks { missing: 0 };
    match Install::find() {
        Ok(install) => check_installation(&mut checks, &install),
        Err(Exit::Failure(failure)) => {
            checks.print(Err((failure.message, failure.help.unwrap_or_default())), "installation")
        }
        Err(other) => return Err(other),
    }
    check_space(
        &mut checks,
        "shared memory",
        SHARED_MEMORY,
        SHARED_MEMORY_MIB,
        "free it, or enlarge it (Docker: --shm-size=1g)",
    );
    check_space(&mut checks, "disk", ".", DISK_MIB, "free some disk space");
    check_viewer_port(&mut checks);
    print_extras();
    print_runs(clean);
    match checks.missing {
        0 => Ok(()),
        count => Err(Exit::missing(
            format!("{count} of the checks above failed"),
            "follow the arrows above",
        )),
    }
}

fn check_installation(checks: &mut DoctorChecks, install: &Install) {
    let processes = Process::ALL.into_iter().filter(|process| *process != Process::Trainer);
    // A replay has a program of its own in the place of `sensor-daemon`.
    for name in processes.map(Process::name).chain(["replay"]) {
        let found = install.binary(name);
        checks.print(
            found
                .map(|path| path.display().to_string())
                .map_err(|_| ("not built".into(), "run `make build`".into())),
            name,
        );
    }
    check_libraries(checks, install);
    check_packages(checks, install);
}

/// Asks the dynamic linker whether every library that libsumo needs is installed.
fn check_libraries(checks: &mut DoctorChecks, install: &Install) {
    let library = install.sumo_home.join("lib64/libsumocpp.so");
    let listing = match Command::new("ldd").arg(&library).output() {
        Ok(output) => String::from_utf8_lossy(&output.stdout).into_owned(),
        Err(error) => {
            let unknown = (
                format!("ldd cannot be started: {error}"),
                "apt-get install libc-bin".into(),
            );
            return checks.print(Err(unknown), "libraries for SUMO");
        }
    };
    for (name, package) in LIBRARIES {
        let absent = listing
            .lines()
            .any(|line| line.contains(name) && line.contains("not found"));
        let result = if absent {
            Err((format!("{name} is not installed"), format!("apt-get install {package}")))
        } else {
            Ok(name.to_owned())
        };
        checks.print(result, "library for SUMO");
    }
}

fn check_packages(checks: &mut DoctorChecks, install: &Install) {
    let script = format!(
        "import importlib.util as u; print(' '.join(p for p in {:?} if u.find_spec(p) is None))",
        PACKAGES
    );
    let result = match Command::new(&install.python).args(["-c", &script]).output() {
        Ok(output) if output.status.success() => match String::from_utf8_lossy(&output.stdout).trim() {
            "" => Ok(install.python.display().to_string()),
            absent => Err((format!("not installed: {absent}"), "run `make build`".into())),
        },
        Ok(output) => Err((
            String::from_utf8_lossy(&output.stderr).trim().to_owned(),
            "run `make build`".into(),
        )),
        Err(error) => Err((
            format!("{} cannot be started: {error}", install.python.display()),
            "run `make build`".into(),
        )),
    };
    checks.print(result, "Python packages");
}

fn check_space(checks: &mut DoctorChecks, what: &str, path: &str, least_mib: u64, fix: &str) {
    let result = match free_bytes(Path::new(path)) {
        Ok(bytes) if bytes >> 20 >= least_mib => Ok(format!("{} MiB free", bytes >> 20)),
        Ok(bytes) => Err((format!("only {} MiB free in {path}", bytes >> 20), fix.to_owned())),
        Err(_) => Err((format!("the free space of {path} cannot be read"), fix.to_owned())),
    };
    checks.print(result, what);
}

fn check_viewer_port(checks: &mut DoctorChecks) {
    let result = match TcpListener::bind("127.0.0.1:7447") {
        Ok(_) => Ok("127.0.0.1:7447 is free".to_owned()),
        Err(_) => Ok(
            "127.0.0.1:7447 is in use, perhaps by a run: another run needs --set fanout.listen=tcp/127.0.0.1:PORT"
                .to_owned(),
        ),
    };
    checks.print(result, "port for viewers");
}

/// Prints which of the programs for tests and remote viewers are installed.
fn print_extras() {
    let directories = std::env::var_os("PATH").unwrap_or_default();
    for (names, purpose, package) in EXTRAS {
        let found = std::env::split_paths(&directories)
            .flat_map(|directory| names.iter().map(move |name| directory.join(name)))
            .find(|path| path.is_file());
        match found {
            Some(path) => crate::say!("ok       {purpose}: {}", path.display()),
            None => crate::say!(
                "note     {purpose}: no {}\n         → apt-get install {package}",
                names.join(" or ")
            ),
        }
    }
}

fn print_runs(clean: bool) {
    let entries = registry::entries();
    for entry in &entries {
        let name = entry.run.as_ref().map_or("(unreadable)", |run| run.name.as_str());
        let size = entry.shared_memory_bytes() >> 10;
        match (entry.alive, clean) {
            (true, _) => crate::say!("ok       run {name}: alive, {size} KiB of shared memory"),
            (false, false) => crate::say!(
                "note     run {name}: dead, left {size} KiB of shared memory; removed by the next run or `caraware doctor --clean`"
            ),
            (false, true) => {
                entry.clean();
                crate::say!("cleaned  run {name}: {size} KiB of shared memory removed");
            }
        }
    }
    if entries.is_empty() {
        crate::say!("ok       no stale run");
    }
    if clean {
        registry::sweep();
        registry::forget_base(&registry::base());
    }
    for path in registry::foreign_paths() {
        crate::say!("note     {}: not a run of caraware; it is not touched", path.display());
    }
}
