//! Runs code with the widest vectors of this machine: it is compiled for several instruction sets and chosen at run time.
//!
//! No operation is fused or reordered in any of them, so all give the same bits (tests compare them).

/// Work that the compiler turns into vector instructions. Every function that it calls must be inlined.
pub trait VectorWork {
    /// Result of the work.
    type Output;

    /// Does the work. Mark each implementation `#[inline(always)]`.
    fn run(self) -> Self::Output;
}

/// Instruction set that work is compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VectorPath {
    /// The baseline instructions of the target.
    Plain,
    /// 256-bit vectors.
    Avx2,
    /// 512-bit vectors.
    Avx512,
}

impl VectorPath {
    /// The widest vectors of this machine.
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

    /// All instruction sets of this machine.
    #[must_use]
    pub fn available() -> Vec<Self> {
        let widest = Self::widest();
        [Self::Plain, Self::Avx2, Self::Avx512]
            .into_iter()
            .filter(|path| *path as u32 <= widest as u32)
            .collect()
    }

    /// Does the work with these instructions, or with the widest of this machine if those are narrower.
    #[inline]
    #[cfg_attr(
        target_arch = "x86_64",
        expect(
            unsafe_code,
            reason = "calls of functions compiled for more than the baseline processor: three times as fast"
        )
    )]
    pub fn run<W: VectorWork>(self, work: W) -> W::Output {
        #[cfg(target_arch = "x86_64")]
        {
            if self == Self::Avx512 && std::arch::is_x86_feature_detected!("avx512f") {
                // SAFETY: the condition above has detected the feature on this processor.
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
fn avx512<W: VectorWork>(work: W) -> W::Output {
    work.run()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn avx2<W: VectorWork>(work: W) -> W::Output {
    work.run()
}
