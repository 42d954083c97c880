//! A process of peers that a benchmark compares with: for each line with a peer's name it answers a line of numbers.

#![allow(clippy::unwrap_used, reason = "a benchmark that cannot run panics with the reason")]

use std::{
    io::{BufRead as _, BufReader, Write as _},
    path::Path,
    process::{Child, ChildStdout, Command, Stdio},
};

use ipc_schema::world::VehicleState;

/// The process of the peers. Dropping it ends it.
pub struct Peers {
    process: Child,
    answers: BufReader<ChildStdout>,
    pub names: Vec<String>,
}

impl Peers {
    /// Starts a script of `benches/` on the files of a directory.
    pub fn start(python: &Path, script: &str, directory: &Path) -> Self {
        let mut process = Command::new(python)
            .arg(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/benches")).join(script))
            .arg(directory)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap_or_else(|error| panic!("{}: {error}", python.display()));
        let answers = BufReader::new(process.stdout.take().unwrap());
        let mut peers = Self {
            process,
            answers,
            names: Vec::new(),
        };
        peers.names = peers.answer().split_whitespace().map(str::to_owned).collect();
        peers
    }

    fn answer(&mut self) -> String {
        let mut line = String::new();
        self.answers.read_line(&mut line).unwrap();
        line
    }

    /// The numbers of one round of a peer.
    pub fn round<const N: usize>(&mut self, name: &str) -> [f64; N] {
        writeln!(self.process.stdin.as_mut().unwrap(), "{name}").unwrap();
        let answer = self.answer();
        let numbers: Vec<f64> = answer.split_whitespace().map(|word| word.parse().unwrap()).collect();
        numbers
            .try_into()
            .unwrap_or_else(|_| panic!("{name} answers {answer:?}, not {N} numbers"))
    }
}

impl Drop for Peers {
    fn drop(&mut self) {
        drop(self.process.stdin.take());
        let _ = self.process.wait();
    }
}

/// Writes numbers to a file of the directory.
pub fn write_raw<T: bytemuck::NoUninit>(directory: &Path, name: &str, numbers: &[T]) {
    std::fs::write(directory.join(name), bytemuck::cast_slice(numbers)).unwrap();
}

/// Corners and triangles of a part of a vehicle: from the first to the second share of its length, counted from the rear, and of its
/// height.
pub fn box_of(
    state: &VehicleState,
    [from, to, low, high]: [f64; 4],
    vertices: &mut Vec<[f64; 3]>,
    faces: &mut Vec<[u32; 3]>,
) {
    let first = vertices.len() as u32;
    let (sin, cos) = state.yaw_rad.sin_cos();
    let [length, width, height, rear] =
        [state.length_m, state.width_m, state.height_m, state.rear_overhang_m].map(f64::from);
    let [behind, ahead] = [from, to].map(|share| share * length - rear);
    for z in [low, high].map(|share| state.z_m + share * height) {
        for [a, b] in [[ahead, 0.5], [behind, 0.5], [behind, -0.5], [ahead, -0.5]] {
            let left = b * width;
            vertices.push([state.x_m + a * cos - left * sin, state.y_m + a * sin + left * cos, z]);
        }
    }
    for i in 0..4 {
        let (a, b) = (first + i, first + (i + 1) % 4);
        faces.extend([[a, b, b + 4], [a, b + 4, a + 4]]);
    }
    faces.extend([[4, 5, 6], [4, 6, 7], [0, 2, 1], [0, 3, 2]].map(|face| face.map(|corner| first + corner)));
}

/// A temporary directory, removed when it is dropped.
pub struct Scratch(pub std::path::PathBuf);

impl Scratch {
    /// Named after the benchmark.
    pub fn new(name: &str) -> Self {
        let directory = std::env::temp_dir().join(format!("{name}-{}", std::process::id()));
        std::fs::create_dir_all(&directory).unwrap();
        Self(directory)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
