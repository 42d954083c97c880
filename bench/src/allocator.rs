//! The allocator that bare SUMO runs with in a comparison: its own, or that of `traffic-bridge`.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use caraware::failure::Exit;

/// mimalloc as a shared library, from the sources that `traffic-bridge` links (build.rs).
const MIMALLOC: &[u8] = include_bytes!(env!("CARAWARE_MIMALLOC"));

/// mimalloc in a file, for programs to be started with.
#[derive(Debug)]
pub struct SharedMimalloc {
    path: PathBuf,
}

impl SharedMimalloc {
    /// Writes the library into `directory`, and makes sure that `program` allocates with it.
    ///
    /// # Errors
    /// The directory is not writable, or `program` does not take the allocator.
    pub fn new(directory: &Path, program: &Path) -> Result<Self, Exit> {
        let path = directory.join("libcaraware-mimalloc.so");
        std::fs::write(&path, MIMALLOC).map_err(|error| Exit::io("write", &path, &error))?;
        let preloaded = Self { path };
        let mut command = Command::new(program);
        preloaded.preload(&mut command);
        // With this variable mimalloc writes to the standard error output when a process starts.
        command.arg("--version").env("MIMALLOC_VERBOSE", "1");
        let output = command.output().map_err(|error| Exit::io("start", program, &error))?;
        if !output.status.success() || !String::from_utf8_lossy(&output.stderr).contains("mimalloc") {
            return Err(Exit::run(
                format!("{} does not run with mimalloc: {}", program.display(), output.status),
                "the comparison with the same allocator needs a program that LD_PRELOAD acts on",
            ));
        }
        Ok(preloaded)
    }

    /// Makes `command` allocate with mimalloc.
    pub fn preload(&self, command: &mut Command) {
        command.env("LD_PRELOAD", &self.path);
    }
}
