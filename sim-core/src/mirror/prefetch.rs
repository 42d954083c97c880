//! Prefetching: with tens of thousands of vehicles the mirror waits for memory as long as it computes, unless the cache lines of
//! the next vehicles arrive while the current batch moves.

/// Bytes that the processor fetches at a time.
const LINE: usize = 64;

/// A range of memory that will be needed soon.
#[derive(Debug, Clone, Copy)]
pub struct PrefetchRange {
    start: *const i8,
    lines: usize,
}

impl PrefetchRange {
    /// Up to `count` values from `first` on.
    #[must_use]
    pub fn new<T>(values: &[T], first: usize, count: usize) -> Self {
        let values = values.get(first..).unwrap_or_default();
        let values = &values[..count.min(values.len())];
        Self {
            start: values.as_ptr().cast(),
            lines: size_of_val(values).div_ceil(LINE),
        }
    }

    /// Prefetches the whole range.
    #[inline(always)]
    pub fn fetch_all(self) {
        self.fetch(0, 1);
    }

    /// Prefetches one of `parts` equal parts.
    #[inline(always)]
    pub fn fetch(self, part: usize, parts: usize) {
        let (from, to) = (self.lines * part / parts, self.lines * (part + 1) / parts);
        for line in from..to {
            fetch(self.start.wrapping_add(line * LINE));
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[inline(always)]
#[expect(
    unsafe_code,
    reason = "the intrinsic: a tenth less time per vehicle at 50 000 (cargo bench -p sim-core --bench mirror)"
)]
fn fetch(address: *const i8) {
    use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
    // SAFETY: a prefetch reads nothing that the program sees and does not fault, whatever the address.
    unsafe { _mm_prefetch(address, _MM_HINT_T0) }
}

#[cfg(not(target_arch = "x86_64"))]
#[inline(always)]
fn fetch(_: *const i8) {}
