//! The widest vectors this machine has: one piece of code compiled for several processors, chosen when it runs.
//!
//! No operation is fused or reordered in any of them, so all give the same bits (tests compare them).

/// Work that the compiler can turn into vector instructions: everything it calls must be inlined into it.
pub trait Work {
    /// What it gives.
    type Output;

    /// Does it; marked `#[inline(always)]` wherever it is implemented.
    fn run(self) -> Self::Output;
}

/// Instructions that a piece of work may be compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Path {
    /// What every processor of the target has.
    Plain,
    /// 256-bit vectors.
    Avx2,
    /// 512-bit vectors.
    Avx512,
}

impl Path {
    /// The widest one that this machine has.
    #[must_use]
    #[inline]
    pub fn widest() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx512f") {
                return Self::Avx512;
            }
            if std::arch::is_x86_feature_detected!("avx2") {
                return Self::Avx2;
            }
        }
        Self::Plain
    }

    /// All that this machine has.
    #[must_use]
    pub fn available() -> Vec<Self> {
        let widest = Self::widest();
        [Self::Plain, Self::Avx2, Self::Avx512]
            .into_iter()
            .filter(|path| *path as u32 <= widest as u32)
            .collect()
    }

    /// Does the work on this path, or on the widest that the machine has if that is narrower.
    #[inline]
    #[cfg_attr(
        target_arch = "x86_64",
        expect(
            unsafe_code,
            reason = "calls of functions compiled for more than the baseline processor: three times as fast"
        )
    )]
    pub fn run<W: Work>(self, work: W) -> W::Output {
        #[cfg(target_arch = "x86_64")]
        {
            if self == Self::Avx512 && std::arch::is_x86_feature_detected!("avx512f") {
                // SAFETY: the processor has been asked in this very condition and has the feature.
                return unsafe { avx512(work) };
            }
            if self != Self::Plain && std::arch::is_x86_feature_detected!("avx2") {
                // SAFETY: as above.
                return unsafe { avx2(work) };
            }
        }
        work.run()
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn avx512<W: Work>(work: W) -> W::Output {
    work.run()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn avx2<W: Work>(work: W) -> W::Output {
    work.run()
}
