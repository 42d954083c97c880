//! Unsafe parts of the project, included as they are, under Miri: the vector kernels of LIDAR and noise against their plain versions,
//! and iceoryx2's cell of a board.
//!
//! Not here, because Miri has no foreign functions and no shared memory: SUMO's shim, Python's buffers, the handler of SIGBUS, iceoryx2's
//! ports.

#![allow(dead_code, reason = "only the kernels are called, not what is built on them")]

/// The kernels name the crate of the wire's types.
extern crate self as ipc_schema;

mod noise;
mod sensors;
#[path = "../../src/wide.rs"]
mod wide;

/// The type that the kernels write: eight words, as in `ipc-schema`.
pub mod pointcloud {
    /// A return.
    #[repr(C)]
    #[derive(Debug, Clone, Copy, PartialEq, Default, bytemuck::Pod, bytemuck::Zeroable)]
    pub struct LidarPoint {
        /// Everything in it.
        pub words: [u32; 8],
    }
}

#[cfg(test)]
mod tests {
    extern crate iceoryx2_bb_loggers;

    use iceoryx2_bb_lock_free::spmc::unrestricted_atomic::UnrestrictedAtomic;

    use crate::{
        noise::normals::philox4x32,
        wide::{VectorPath, VectorWork},
    };

    #[test]
    fn work_runs_with_the_vectors_that_were_detected() {
        struct Sum([u32; 4]);
        impl VectorWork for Sum {
            type Output = u32;
            #[inline(always)]
            fn run(self) -> u32 {
                philox4x32(self.0, [5, 6]).into_iter().fold(0, u32::wrapping_add)
            }
        }
        let plain = VectorPath::Plain.run(Sum([1, 2, 3, 4]));
        for path in VectorPath::available() {
            assert_eq!(path.run(Sum([1, 2, 3, 4])), plain, "{path:?}");
        }
    }

    #[test]
    fn a_board_returns_what_was_written() {
        let board = UnrestrictedAtomic::<[u64; 5]>::new([0; 5]);
        let producer = board.acquire_producer().unwrap();
        assert!(board.acquire_producer().is_none(), "one writer");
        for value in 1..6 {
            producer.store([value; 5]);
            assert_eq!(board.load(), [value; 5]);
        }
    }

    #[cfg(any(not(miri), feature = "racing-board"))]
    #[test]
    fn a_board_that_is_written_meanwhile_is_not_torn() {
        let board = UnrestrictedAtomic::<[u64; 5]>::new([0; 5]);
        let producer = board.acquire_producer().unwrap();
        let values = if cfg!(miri) { 20 } else { 1_000_000 };
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let mut newest = 0;
                while newest < values {
                    let words = board.load();
                    assert!(words.iter().all(|word| *word == words[0]), "{words:?}");
                    assert!(words[0] >= newest);
                    newest = words[0];
                }
            });
            for value in 1..=values {
                producer.store([value; 5]);
            }
        });
    }
}
