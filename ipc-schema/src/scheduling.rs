//! Short time slices for processes that must keep to the clock.

use std::io;

/// The requested time slice. The kernel runs a thread with a shorter slice sooner, without giving it more time in total.
const SLICE_NS: u64 = 100_000;

/// Requests a short time slice for the calling thread and the threads that it starts later: they run soon after they wake, even while
/// other processes keep the cores busy.
///
/// With the usual slice of some milliseconds, a tick in real time waits that long for a core that a viewer has just taken. Kernels
/// before Linux 6.12 have no such request, and nothing changes there.
///
/// # Errors
/// The system refuses: a kernel or a sandbox without the call.
pub fn ask_for_short_turns() -> io::Result<()> {
    let size = u32::try_from(size_of::<libc::sched_attr>()).unwrap_or_default();
    let mut wanted = libc::sched_attr {
        size,
        sched_policy: 0,
        sched_flags: 0,
        sched_nice: 0,
        sched_priority: 0,
        sched_runtime: 0,
        sched_deadline: 0,
        sched_period: 0,
    };
    call(|| {
        #[expect(unsafe_code, reason = "libc has no function for this system call")]
        // SAFETY: the kernel writes at most `size` bytes to `wanted`, which has as many.
        unsafe {
            libc::syscall(libc::SYS_sched_getattr, 0, &raw mut wanted, size, 0)
        }
    })?;
    wanted.sched_runtime = SLICE_NS;
    call(|| {
        #[expect(unsafe_code, reason = "libc has no function for this system call")]
        // SAFETY: the kernel reads `wanted.size` bytes of `wanted`, which are there.
        unsafe {
            libc::syscall(libc::SYS_sched_setattr, 0, &raw const wanted, 0)
        }
    })
}

fn call(system_call: impl FnOnce() -> libc::c_long) -> io::Result<()> {
    match system_call() {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernel_accepts_the_request() {
        std::thread::spawn(|| ask_for_short_turns().unwrap()).join().unwrap();
    }
}
