//! GNSS receiver: white noise, correlated noise and bias east, north and up, in degrees or metres, and the position with these errors.

use ipc_schema::{config::GnssConfig as Params, sensor::NoiseStream, world::VehicleState};
use sim_core::geodesy::{
    GeodesyError, NetPosition, Projection,
    displacement::{DisplacementMap, GroundArc},
};

use crate::{
    noise::{DrawnNormals, NormalDraws, RandomStream, normals::NormalBlock},
    sensors::lidar::sensor::{rotation, turned},
    tick::TickMotion,
};

/// One fix.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GnssFix {
    /// Degrees, north positive.
    pub latitude_deg: f64,
    /// Degrees, east positive.
    pub longitude_deg: f64,
    /// Height in the world frame, metres.
    pub altitude_m: f64,
    /// World frame, east, metres.
    pub x_m: f64,
    /// World frame, north, metres.
    pub y_m: f64,
    /// World frame, up, metres.
    pub z_m: f64,
    /// The receiver's own estimate of its horizontal error, 1σ of the distance, metres.
    pub accuracy_m: f64,
    /// Satellites in use.
    pub satellites: u32,
}

/// Effect of the sky on a receiver at a place and time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SkyView {
    /// Satellites in use.
    pub satellites: u32,
    /// Factor on the white and the correlated error, at least 1.
    pub noise_factor: f64,
    /// Error from reflections east, north and up, metres.
    pub offset_m: [f64; 3],
    /// Enough satellites for a fix.
    pub has_fix: bool,
}

impl Default for SkyView {
    /// The open sky.
    fn default() -> Self {
        Self {
            satellites: 12,
            noise_factor: 1.0,
            offset_m: [0.0; 3],
            has_fix: true,
        }
    }
}

/// The satellites in the sky, and the buildings that block and reflect their signals.
pub trait SatelliteSky {
    /// The sky of an antenna of a road user on the ground at this place (world frame, metres) and time of the episode (seconds).
    fn at(&self, x_m: f64, y_m: f64, z_m: f64, time_s: f64) -> SkyView;

    /// Begins an episode with this seed.
    fn begin_episode(&mut self, episode_seed: u64) {
        let _ = episode_seed;
    }
}

/// Degrees of [`GroundArc`] for a metre on the ground, as a function of y.
///
/// A metre north is 1/M radians, a metre east 1/N radians of the arc that [`GroundArc`] divides by the cosine of the latitude; M and N are
/// the radii of curvature of the ellipsoid of WGS 84 in the meridian and in the prime vertical (NIMA TR8350.2, 1997, section 4).
/// Between the southern and the northern border of the map both change linearly with y: to 1e-7 of themselves over 50 km.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Ground {
    y_m: f64,
    /// Degrees per metre at `y_m`, and their change for a metre of y: east, north.
    arc_deg: [[f64; 2]; 2],
}

impl Ground {
    fn new(projection: &Projection, bounds_m: [f64; 4]) -> Result<Self, GeodesyError> {
        let [x_min, y_min, x_max, y_max] = bounds_m;
        let x_m = 0.5 * (x_min + x_max);
        let at = |y_m: f64| -> Result<[f64; 2], GeodesyError> {
            let place = projection.geodetic_from_net(NetPosition { x_m, y_m })?;
            Ok(arc_deg_per_m(place.latitude_deg))
        };
        let height_m = (y_max - y_min).max(1.0);
        let (south, north) = (at(y_min)?, at(y_min + height_m)?);
        let change = [0, 1].map(|axis: usize| (north[axis] - south[axis]) / height_m);
        Ok(Self {
            y_m: y_min,
            arc_deg: [south, change],
        })
    }

    fn arc(&self, y_m: f64, [east_m, north_m]: [f64; 2]) -> GroundArc {
        let at = |axis: usize| self.arc_deg[0][axis] + self.arc_deg[1][axis] * (y_m - self.y_m);
        GroundArc {
            east_deg: east_m * at(0),
            north_deg: north_m * at(1),
        }
    }
}

/// Degrees of arc for a metre to the east and to the north at a latitude.
fn arc_deg_per_m(latitude_deg: f64) -> [f64; 2] {
    const SEMI_MAJOR_M: f64 = 6_378_137.0;
    const FLATTENING: f64 = 1.0 / 298.257_223_563;
    const SQUARE: f64 = FLATTENING * (2.0 - FLATTENING);
    let sin = libm::sin(latitude_deg.to_radians());
    let w = 1.0 - SQUARE * sin * sin;
    let prime_vertical_m = SEMI_MAJOR_M / w.sqrt();
    let meridian_m = prime_vertical_m * (1.0 - SQUARE) / w;
    [(1.0 / prime_vertical_m).to_degrees(), (1.0 / meridian_m).to_degrees()]
}

/// A receiver as configured, on a map.
#[derive(Debug, Clone)]
pub struct GnssReceiver {
    map: DisplacementMap,
    ground: Ground,
    /// Standard deviation of the white noise east, north and up, metres: angles and metres together.
    white_m: [f64; 3],
    correlated_m: [f64; 3],
    bias: GroundArc,
    bias_m: [f64; 3],
    /// Standard deviation over receivers of a constant error, metres.
    unit_bias_std_m: [f64; 3],
    /// Factor on the correlated error after a period, and standard deviation of the noise added to it (unit variance).
    decay: [f32; 2],
    /// Variance of the horizontal distance from white and correlated noise, and square of the horizontal bias, m².
    horizontal_m2: [f64; 2],
    /// Factor on the errors of a person's receiver.
    pedestrian_factor: f64,
}

/// State of one road user's receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GnssState {
    /// Correlated error, unit variance: east, north, up.
    pub correlated: [f32; 3],
    /// Constant error of this receiver east, north and up, metres.
    pub unit_bias_m: [f64; 3],
    /// Factor on all errors but reflections.
    pub factor: f64,
    /// The receiver had enough satellites at its last sample.
    pub has_fix: bool,
}

/// Components of the error of one fix.
#[derive(Debug, Clone, Copy)]
pub struct GnssErrors<'a> {
    /// Standard normal numbers: east, north, up.
    pub white: &'a NormalBlock,
    /// State of the correlated error, unit variance: east, north, up.
    pub correlated: &'a [f32; 3],
    /// Constant error of this receiver east, north and up, metres.
    pub unit_bias_m: &'a [f64; 3],
    /// Effect of the sky.
    pub view: &'a SkyView,
    /// Factor on all errors but reflections.
    pub factor: f64,
}

impl GnssReceiver {
    /// A receiver on a map with these bounds (x_min, y_min, x_max, y_max, metres).
    ///
    /// # Errors
    /// The map is outside the domain of its projection.
    pub fn new(params: &Params, projection: &Projection, bounds_m: [f64; 4]) -> Result<Self, GeodesyError> {
        let ground = Ground::new(projection, bounds_m)?;
        let middle_m = 0.5 * (bounds_m[1] + bounds_m[3]);
        let metre = ground.arc(middle_m, [1.0, 1.0]);
        let [north_deg, east_deg] = params.noise_std_deg;
        let [east_m, north_m, up_m] = params.noise_std_m;
        let white_m = [
            libm::hypot(east_deg / metre.east_deg, east_m),
            libm::hypot(north_deg / metre.north_deg, north_m),
            up_m,
        ];
        let correlated_m = params.correlated_std_m;
        let bias = GroundArc {
            east_deg: params.bias_deg[1],
            north_deg: params.bias_deg[0],
        };
        let bias_east_m = bias.east_deg / metre.east_deg + params.bias_m[0];
        let bias_north_m = bias.north_deg / metre.north_deg + params.bias_m[1];
        let phi = libm::exp(-params.period_s / params.correlation_time_s);
        let horizontal = |m: &[f64; 3]| m[0] * m[0] + m[1] * m[1];
        Ok(Self {
            map: DisplacementMap::new(projection, bounds_m)?,
            ground,
            white_m,
            correlated_m,
            bias,
            bias_m: params.bias_m,
            unit_bias_std_m: params.unit_bias_std_m,
            pedestrian_factor: params.pedestrian_noise_factor,
            decay: [phi as f32, (1.0 - phi * phi).sqrt() as f32],
            horizontal_m2: [
                horizontal(&white_m) + horizontal(&correlated_m) + horizontal(&params.unit_bias_std_m),
                bias_east_m * bias_east_m + bias_north_m * bias_north_m,
            ],
        })
    }

    /// Plans the white noise and the noise that joins the correlated error at a tick, each if the fixes have it.
    pub fn plan(&self, draws: &mut NormalDraws, tick: u32) {
        if self.has_white_noise() {
            draws.plan(NoiseStream::Gnss, tick);
        }
        if self.has_correlated_noise() {
            draws.plan(NoiseStream::GnssCorrelated, tick);
        }
    }

    /// Takes the numbers that [`GnssReceiver::plan`] planned, in the same order: white noise, noise of the correlated error.
    #[inline(always)]
    pub fn take(&self, drawn: &mut DrawnNormals) -> [NormalBlock; 2] {
        let white = drawn.take(self.has_white_noise());
        [white, drawn.take(self.has_correlated_noise())]
    }

    /// State of the receiver of a road user that begins a trajectory.
    #[must_use]
    pub fn begin(&self, is_person: bool, episode_seed: u64, id_hash: u64) -> GnssState {
        let mut unit_bias_m = [0.0; 3];
        if self.unit_bias_std_m != [0.0; 3] {
            let stream = RandomStream {
                episode_seed,
                id_hash,
                sensor: NoiseStream::GnssUnit,
            };
            let normals = stream.normals(0);
            unit_bias_m = [0, 1, 2].map(|axis: usize| self.unit_bias_std_m[axis] * f64::from(normals[axis]));
        }
        GnssState {
            correlated: [0.0; 3],
            unit_bias_m,
            factor: if is_person { self.pedestrian_factor } else { 1.0 },
            has_fix: true,
        }
    }

    /// The fix of an antenna at `arm_m` (x, y, z from the centre of the rear axle) at the end of the tick; `None` while the receiver is not awake or has too few satellites. The correlated error continues
    /// to evolve meanwhile.
    #[inline]
    pub fn sample(
        &self,
        state: &mut GnssState,
        motion: &TickMotion,
        arm_m: [f64; 3],
        is_awake: bool,
        [white, fresh]: [&NormalBlock; 2],
        view: impl FnOnce([f64; 3]) -> SkyView,
    ) -> Option<GnssFix> {
        state.correlated = if motion.step == 0 {
            [fresh[0], fresh[1], fresh[2]]
        } else {
            self.correlated(state.correlated, fresh)
        };
        if !is_awake {
            return None;
        }
        let place_m = antenna_m(motion.state, arm_m);
        let view = view(place_m);
        state.has_fix = view.has_fix;
        view.has_fix.then(|| {
            self.fix(
                place_m,
                &GnssErrors {
                    white,
                    correlated: &state.correlated,
                    unit_bias_m: &state.unit_bias_m,
                    view: &view,
                    factor: state.factor,
                },
            )
        })
    }

    fn has_white_noise(&self) -> bool {
        self.white_m != [0.0; 3]
    }

    fn has_correlated_noise(&self) -> bool {
        self.correlated_m != [0.0; 3]
    }

    /// The correlated error one period later, from its state (unit variance) and standard normal numbers.
    ///
    /// First-order Gauss–Markov process, x′ = φ x + √(1 − φ²) w with φ = exp(−Δt/τ): exact for any Δt (Brown and Hwang,
    /// "Introduction to Random Signals and Applied Kalman Filtering", 4th ed., section 3.6). It starts as `w` itself, in its
    /// stationary distribution.
    #[must_use]
    #[inline(always)]
    pub fn correlated(&self, state: [f32; 3], normals: &NormalBlock) -> [f32; 3] {
        [0, 1, 2].map(|axis: usize| self.decay[0] * state[axis] + self.decay[1] * normals[axis])
    }

    /// The fix of an antenna at `place_m` in the world frame.
    ///
    /// Angles of arc on the ground are the same for both axes (5e-5° ≙ 5.57 m): latitude gets the angle itself, longitude the angle
    /// divided by the cosine of the latitude. At the equator, where CARLA's towns lie, this is the paper's noise in degrees; elsewhere
    /// the error stays the same in metres instead of shrinking with the parallels. Metres are metres on the ellipsoid, true east and
    /// north. The receiver estimates its horizontal error from all components: 1σ of the distance is √(σ_east² + σ_north² + bias²).
    #[must_use]
    #[inline(always)]
    pub fn fix(&self, [x_m, y_m, z_m]: [f64; 3], errors: &GnssErrors) -> GnssFix {
        let (view, factor) = (errors.view, errors.factor);
        let noisy = factor * view.noise_factor;
        let along = |axis: usize| {
            let white = self.white_m[axis] * f64::from(errors.white[axis]);
            let correlated = self.correlated_m[axis] * f64::from(errors.correlated[axis]);
            noisy * (white + correlated) + factor * (self.bias_m[axis] + errors.unit_bias_m[axis]) + view.offset_m[axis]
        };
        let error_m = [along(0), along(1), along(2)];
        let arc = self.ground.arc(y_m, [error_m[0], error_m[1]]);
        let displaced = self.map.displaced(
            NetPosition { x_m, y_m },
            GroundArc {
                east_deg: arc.east_deg + factor * self.bias.east_deg,
                north_deg: arc.north_deg + factor * self.bias.north_deg,
            },
        );
        let [noise_m2, bias_m2] = self.horizontal_m2;
        GnssFix {
            latitude_deg: displaced.geodetic.latitude_deg,
            longitude_deg: displaced.geodetic.longitude_deg,
            altitude_m: z_m + error_m[2],
            x_m: displaced.net.x_m,
            y_m: displaced.net.y_m,
            z_m: z_m + error_m[2],
            accuracy_m: (noisy * noisy * noise_m2 + factor * factor * bias_m2).sqrt(),
            satellites: view.satellites,
        }
    }
}

/// Place of the antenna of a vehicle in this state.
#[inline(always)]
fn antenna_m(state: &VehicleState, arm_m: [f64; 3]) -> [f64; 3] {
    let origin_m = [state.x_m, state.y_m, state.z_m];
    if arm_m == [0.0; 3] {
        return origin_m;
    }
    let world_from_body = rotation([state.roll_rad.into(), state.pitch_rad.into(), state.yaw_rad]);
    let arm = turned(&world_from_body, arm_m);
    std::array::from_fn(|axis| origin_m[axis] + arm[axis])
}

#[cfg(test)]
mod tests;
