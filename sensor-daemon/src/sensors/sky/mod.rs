//! The sky of a GNSS receiver between buildings: which satellites it receives, how well they fix a position, and how far
//! reflections displace the fix.
//!
//! It is a pure function of scene, place of the map, seed of the episode, position and time. The horizon of a place and the satellites
//! of a time are computed at first use and kept; no result depends on whether or when that was.

use std::{
    fmt,
    sync::{
        Arc, OnceLock,
        atomic::{AtomicUsize, Ordering},
    },
};

use sim_core::{geodesy::Geodetic, scene::Scene};

use crate::{
    noise::philox4x32,
    sensors::gnss::{SatelliteSky, SkyView},
};

pub mod constellation;
pub mod horizon;
pub mod position;

use constellation::{SIDEREAL_DAY_S, SkyObserver};
use horizon::{PlacedSatellite, Skyline};
use position::{NormalEquations, PositionSolution};

/// Smallest cell of the map of horizons, metres; a cell has one horizon.
const CELL_M: f64 = 4.0;
/// Most cells: larger maps get larger cells. 24 bytes each.
const MOST_CELLS: f64 = 1e6;
/// Most horizons that are kept, 0.5 kB each; those of further places are computed each time.
const MOST_HORIZONS: usize = 150_000;
/// Places tried along each side of a cell whose middle is inside a building.
const TRIES: i32 = 5;
/// Antenna above the ground, metres: the roof of a car.
pub const ANTENNA_M: f64 = 1.5;
/// Steps of the satellites in a sidereal day, 10 s each: they turn by less than 0.1°.
const STEPS: usize = 8616;
/// Weight of a reflected signal in the position: a wall of concrete returns half the amplitude, a quarter of the power (Groves, section 9.3.4).
pub const REFLECTED_WEIGHT: f64 = 0.25;
/// Longest extra path of a reflected signal in use, metres: a longer one disagrees with the other signals, and the receiver excludes
/// it (RAIM).
pub const MOST_EXTRA_PATH_M: f64 = 60.0;
/// Fewest satellites for a fix: three coordinates and the clock.
pub const LEAST_SATELLITES: u32 = 4;
/// Largest horizontal dilution of precision of a fix (a usual mask of receivers).
pub const MOST_HDOP: f64 = 20.0;
/// Longest displacement of a fix by reflections, metres.
pub const MOST_OFFSET_M: f64 = 50.0;

fn without_fix(satellites: u32) -> SkyView {
    SkyView {
        satellites,
        noise_factor: 1.0,
        offset_m: [0.0; 3],
        has_fix: false,
    }
}

/// The sky at one step.
#[derive(Debug, Clone, PartialEq)]
struct ConstellationEpoch {
    satellites: Vec<PlacedSatellite>,
    /// Under an open sky.
    hdop: f64,
}

/// The sky over a map.
pub struct SkyMap {
    scene: Arc<Scene>,
    skyline: Skyline,
    observer: SkyObserver,
    /// Time of the constellation at the start of the episode, seconds.
    start_s: f64,
    min_m: [f64; 2],
    cell_m: f64,
    columns: usize,
    rows: usize,
    /// By cell.
    skies: Vec<OnceLock<horizon::CellSky>>,
    kept: AtomicUsize,
    /// By step of the sidereal day.
    epochs: Vec<OnceLock<ConstellationEpoch>>,
}

impl fmt::Debug for SkyMap {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kept = self.kept.load(Ordering::Relaxed);
        write!(
            formatter,
            "SkyMap({} × {} cells of {} m, {kept} horizons)",
            self.columns, self.rows, self.cell_m
        )
    }
}

impl SkyMap {
    /// The sky over `bounds_m` (x_min, y_min, x_max, y_max, metres), whose middle lies at `middle`. The map's y axis is taken for
    /// north: a grid's convergence of a degree or two turns the whole sky.
    #[must_use]
    pub fn new(scene: Arc<Scene>, middle: Geodetic, bounds_m: [f64; 4], episode_seed: u64) -> Self {
        let [width_m, height_m] = [bounds_m[2] - bounds_m[0], bounds_m[3] - bounds_m[1]].map(|side| side.max(0.0));
        let cell_m = CELL_M
            .max((width_m * height_m / MOST_CELLS).sqrt())
            .max((width_m + height_m) / MOST_CELLS);
        let count = |length_m: f64| (length_m / cell_m) as usize + 1;
        let (columns, rows) = (count(width_m), count(height_m));
        let mut map = Self {
            skyline: Skyline::new(scene.buildings()),
            scene,
            observer: SkyObserver::at(middle),
            start_s: 0.0,
            min_m: [bounds_m[0], bounds_m[1]],
            cell_m,
            columns,
            rows,
            skies: (0..columns * rows).map(|_| OnceLock::new()).collect(),
            kept: AtomicUsize::new(0),
            epochs: (0..STEPS).map(|_| OnceLock::new()).collect(),
        };
        map.start(episode_seed);
        map
    }

    /// Sets the time of the sidereal day at which an episode begins, from its seed. Horizons are kept.
    fn start(&mut self, episode_seed: u64) {
        let key = [episode_seed as u32, (episode_seed >> 32) as u32];
        // No sensor uses this counter: a sensor's second word is its noise stream.
        let [random, ..] = philox4x32([0, u32::MAX, 0, 0], key);
        self.start_s = SIDEREAL_DAY_S * f64::from(random) / 4_294_967_296.0;
    }

    /// The satellites at a time, computed at first use.
    fn epoch(&self, time_s: f64) -> &ConstellationEpoch {
        let turns = (self.start_s + time_s) / SIDEREAL_DAY_S;
        let step = (((turns - turns.floor()) * STEPS as f64) as usize).min(STEPS - 1);
        self.epochs[step].get_or_init(|| self.epoch_of(step))
    }

    fn epoch_of(&self, step: usize) -> ConstellationEpoch {
        let satellites = self
            .observer
            .satellites(SIDEREAL_DAY_S * (step as f64 + 0.5) / STEPS as f64);
        let satellites: Vec<PlacedSatellite> = satellites.into_iter().map(PlacedSatellite::from).collect();
        let mut equations = NormalEquations::default();
        for placed in &satellites {
            equations.add(placed.satellite.line_of_sight, 1.0, 0.0);
        }
        let hdop = equations.solve().map_or(f64::INFINITY, |solution| solution.hdop());
        ConstellationEpoch { satellites, hdop }
    }

    /// The sky of a cell, if it is on the map and there is room to keep it.
    fn kept_sky(&self, [column, row]: [f64; 2]) -> Option<&horizon::CellSky> {
        if !(column >= 0.0 && row >= 0.0 && column < self.columns as f64 && row < self.rows as f64) {
            return None;
        }
        let place = &self.skies[row as usize * self.columns + column as usize];
        if let Some(sky) = place.get() {
            return Some(sky);
        }
        if self.kept.load(Ordering::Relaxed) >= MOST_HORIZONS {
            return None;
        }
        Some(place.get_or_init(|| {
            let sky = self.sky_of([column, row]);
            let is_large = matches!(sky, horizon::CellSky::Walled(_));
            self.kept.fetch_add(usize::from(is_large), Ordering::Relaxed);
            sky
        }))
    }

    /// The sky of a cell: from its middle or, if that is inside a building, from the free place nearest to it.
    fn sky_of(&self, [column, row]: [f64; 2]) -> horizon::CellSky {
        let middle = [
            self.min_m[0] + (column + 0.5) * self.cell_m,
            self.min_m[1] + (row + 0.5) * self.cell_m,
        ];
        let sky = self.sky_from(middle);
        if sky != horizon::CellSky::Inside {
            return sky;
        }
        let mut places: Vec<[i32; 2]> = (0..TRIES * TRIES)
            .map(|i| [i % TRIES - TRIES / 2, i / TRIES - TRIES / 2])
            .collect();
        places.sort_by_key(|[across, up]| across * across + up * up);
        let step_m = self.cell_m / f64::from(TRIES);
        places
            .iter()
            .map(|[across, up]| {
                self.sky_from([
                    middle[0] + f64::from(*across) * step_m,
                    middle[1] + f64::from(*up) * step_m,
                ])
            })
            .find(|sky| *sky != horizon::CellSky::Inside)
            .unwrap_or(horizon::CellSky::Inside)
    }

    fn sky_from(&self, [x_m, y_m]: [f64; 2]) -> horizon::CellSky {
        let ground_m = self.scene.ground_height_m(x_m, y_m);
        self.skyline.sky(&self.scene, [x_m, y_m, ground_m + ANTENNA_M])
    }
}

impl SatelliteSky for SkyMap {
    /// The sky of a road user on the ground at `(x_m, y_m, z_m)` (world, metres), its antenna [`ANTENNA_M`] above, at `time_s` of the
    /// episode.
    fn at(&self, x_m: f64, y_m: f64, z_m: f64, time_s: f64) -> SkyView {
        let epoch = self.epoch(time_s);
        let cell = [(x_m - self.min_m[0]) / self.cell_m, (y_m - self.min_m[1]) / self.cell_m].map(f64::floor);
        let antenna_m = [x_m, y_m, z_m + ANTENNA_M];
        match self.kept_sky(cell) {
            Some(sky) => view(sky, epoch, antenna_m),
            None => view(&self.sky_of(cell), epoch, antenna_m),
        }
    }

    fn begin_episode(&mut self, episode_seed: u64) {
        self.start(episode_seed);
    }
}

fn view(sky: &horizon::CellSky, epoch: &ConstellationEpoch, antenna_m: [f64; 3]) -> SkyView {
    match sky {
        horizon::CellSky::Open => open_view(epoch),
        horizon::CellSky::Inside => without_fix(0),
        horizon::CellSky::Walled(horizon) => {
            // The usual case along wide roads.
            if epoch
                .satellites
                .iter()
                .all(|placed| horizon.is_in_sight(placed, antenna_m))
            {
                return open_view(epoch);
            }
            let (satellites, solution) = received(horizon, epoch, antenna_m);
            fix(satellites, solution, epoch.hdop)
        }
    }
}

fn open_view(epoch: &ConstellationEpoch) -> SkyView {
    SkyView {
        satellites: epoch.satellites.len() as u32,
        noise_factor: 1.0,
        offset_m: [0.0; 3],
        has_fix: epoch.hdop <= MOST_HDOP,
    }
}

/// Satellites in use, and what they make of it.
fn received(
    horizon: &horizon::Horizon,
    epoch: &ConstellationEpoch,
    antenna_m: [f64; 3],
) -> (u32, Option<PositionSolution>) {
    let (mut equations, mut satellites) = (NormalEquations::default(), 0);
    let mirrors = horizon.mirrors(antenna_m);
    for placed in &epoch.satellites {
        let (weight, extra_m) = if horizon.is_in_sight(placed, antenna_m) {
            (1.0, 0.0)
        } else {
            match mirrors.extra_path_m(placed) {
                Some(extra_m) if extra_m <= MOST_EXTRA_PATH_M => (REFLECTED_WEIGHT, extra_m),
                _ => continue,
            }
        };
        satellites += 1;
        equations.add(placed.satellite.line_of_sight, weight, extra_m);
    }
    let solution = (satellites >= LEAST_SATELLITES).then(|| equations.solve());
    (satellites, solution.flatten())
}

fn fix(satellites: u32, solution: Option<PositionSolution>, open_hdop: f64) -> SkyView {
    let Some(solution) = solution.filter(|solution| solution.hdop() <= MOST_HDOP) else {
        return without_fix(satellites);
    };
    let [e, n, u] = solution.offset_m;
    let length_m = (e * e + n * n + u * u).sqrt();
    let share = if length_m > MOST_OFFSET_M {
        MOST_OFFSET_M / length_m
    } else {
        1.0
    };
    SkyView {
        satellites,
        // Fewer satellites are never better; rounding may say so.
        noise_factor: (solution.hdop() / open_hdop).max(1.0),
        offset_m: [e * share, n * share, u * share],
        has_fix: true,
    }
}

#[cfg(test)]
mod tests;
