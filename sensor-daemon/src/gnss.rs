//! GNSS receiver: latitude and longitude with white noise and bias, and the position they give in the world frame.

use ipc_schema::config::Gnss as Params;
use sim_core::{
    displacement::{Arc, DisplacementMap},
    geodesy::NetPosition,
};

use crate::noise::{Sensor, Stream};

/// One fix.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Fix {
    /// Degrees, north positive.
    pub latitude_deg: f64,
    /// Degrees, east positive.
    pub longitude_deg: f64,
    /// World frame, metres.
    pub x_m: f64,
    /// World frame, metres.
    pub y_m: f64,
}

/// The fix of an antenna at `(x_m, y_m)` in the world frame.
///
/// Noise and bias are angles of arc on the ground, the same for both axes (5e-5° ≙ 5.57 m): latitude gets the angle itself,
/// longitude the angle divided by the cosine of the latitude. At the equator, where CARLA's towns lie, this is the paper's
/// noise in degrees; elsewhere the error stays the same in metres instead of shrinking with the parallels.
#[must_use]
pub fn sample(params: &Params, map: &DisplacementMap, x_m: f64, y_m: f64, stream: Stream, index: u32) -> Fix {
    debug_assert_eq!(stream.sensor, Sensor::Gnss);
    let [north, east] = stream.normal_pair(index);
    let arc = Arc {
        east_deg: params.bias_deg[1] + params.noise_std_deg[1] * east,
        north_deg: params.bias_deg[0] + params.noise_std_deg[0] * north,
    };
    let displaced = map.displaced(NetPosition { x_m, y_m }, arc);
    Fix {
        latitude_deg: displaced.geodetic.latitude_deg,
        longitude_deg: displaced.geodetic.longitude_deg,
        x_m: displaced.net.x_m,
        y_m: displaced.net.y_m,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::preset::town;
    use ipc_schema::run::MapInfo;
    use sim_core::geodesy::Projection;

    fn map() -> DisplacementMap {
        let map = MapInfo {
            projection: "+proj=tmerc +lat_0=52.26 +lon_0=10.52 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs"
                .into(),
            net_offset_m: [129.0, 126.0],
            bounds_m: [0.0, 0.0, 260.0, 260.0],
        };
        DisplacementMap::new(&Projection::new(&map).unwrap(), map.bounds_m).unwrap()
    }

    fn stream(id_hash: u64) -> Stream {
        Stream {
            episode_seed: 1,
            id_hash,
            sensor: Sensor::Gnss,
        }
    }

    #[test]
    fn without_noise_the_fix_is_the_truth_to_a_tenth_of_a_millimetre() {
        let params = Params {
            noise_std_deg: [0.0; 2],
            bias_deg: [0.0; 2],
            ..town().gnss
        };
        for (x, y) in [(20.0, 17.9), (129.0, 126.0), (239.0, 236.0)] {
            let fix = sample(&params, &map(), x, y, stream(1), 0);
            assert!((fix.x_m - x).hypot(fix.y_m - y) < 1e-4, "{fix:?}");
        }
    }

    /// σ = 5e-5° is 5.57 m on each axis, so the mean distance is σ √(π/2) = 6.98 m.
    #[test]
    fn the_papers_noise_is_seven_metres_on_average_and_equal_on_both_axes() {
        const N: u32 = 40_000;
        let params = Params {
            noise_std_deg: [5e-5; 2],
            bias_deg: [0.0; 2],
            ..town().gnss
        };
        let map = map();
        let errors: Vec<(f64, f64)> = (0..N)
            .map(|index| sample(&params, &map, 100.0, 50.0, stream(9), index))
            .map(|fix| (fix.x_m - 100.0, fix.y_m - 50.0))
            .collect();
        let mean = |of: &dyn Fn(&(f64, f64)) -> f64| errors.iter().map(of).sum::<f64>() / f64::from(N);
        let (std_x, std_y) = (mean(&|e| e.0 * e.0).sqrt(), mean(&|e| e.1 * e.1).sqrt());
        let sigma_m = 5e-5_f64.to_radians() * 6_371_000.0;
        // Five standard errors of a standard deviation, σ/√(2N), and the ellipsoid's 0.5 % against the sphere.
        let tolerance = 5.0 * sigma_m / (2.0 * f64::from(N)).sqrt() + 0.005 * sigma_m;
        assert!(
            (std_x - sigma_m).abs() < tolerance && (std_y - sigma_m).abs() < tolerance,
            "{std_x} {std_y}"
        );
        let distance = mean(&|e| e.0.hypot(e.1));
        assert!((distance - 6.98).abs() < 0.1, "{distance}");
    }

    #[test]
    fn a_bias_moves_the_mean_north_east() {
        let params = Params {
            noise_std_deg: [0.0; 2],
            bias_deg: [1e-5; 2],
            ..town().gnss
        };
        let fix = sample(&params, &map(), 100.0, 50.0, stream(1), 0);
        assert!(
            (fix.x_m - 101.11).abs() < 0.02 && (fix.y_m - 51.11).abs() < 0.02,
            "{fix:?}"
        );
    }
}
