//! The part of the map in which vehicles are sensed.

use ipc_schema::config;

/// The region, in metres of the world frame.
#[derive(Debug, Clone, PartialEq)]
pub enum SensedRegion {
    /// The whole map.
    All,
    /// Within a distance of a point.
    Circle {
        /// x and y of the centre.
        centre_m: [f64; 2],
        /// Its radius.
        radius_m: f64,
    },
    /// Inside a polygon, convex or not, by the even-odd rule.
    Polygon(Vec<[f64; 2]>),
}

impl SensedRegion {
    /// The region of a validated configuration.
    #[must_use]
    pub fn new(config: &config::RegionConfig) -> Self {
        if !config.polygon_m.is_empty() {
            return Self::Polygon(config.polygon_m.iter().map(|corner| corner.0).collect());
        }
        if config.radius_m > 0.0 {
            return Self::Circle {
                centre_m: config.centre_m,
                radius_m: config.radius_m,
            };
        }
        Self::All
    }

    /// True if (`x_m`, `y_m`) is inside.
    #[must_use]
    #[inline]
    pub fn contains(&self, x_m: f64, y_m: f64) -> bool {
        matches!(self, Self::All) || self.encloses(x_m, y_m)
    }

    fn encloses(&self, x_m: f64, y_m: f64) -> bool {
        match self {
            Self::All => true,
            Self::Circle { centre_m, radius_m } => (x_m - centre_m[0]).hypot(y_m - centre_m[1]) <= *radius_m,
            Self::Polygon(corners) => {
                let ends = corners.iter().zip(corners.iter().cycle().skip(1));
                // Counts the edges that a ray to the east crosses.
                let crossed = ends.filter(|([ax, ay], [bx, by])| {
                    (*ay > y_m) != (*by > y_m) && x_m < ax + (y_m - ay) / (by - ay) * (bx - ax)
                });
                crossed.count() % 2 == 1
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn polygon(corners: &[&str]) -> SensedRegion {
        SensedRegion::new(&config::RegionConfig {
            polygon_m: corners.iter().map(|corner| corner.parse().unwrap()).collect(),
            ..config::RegionConfig::default()
        })
    }

    #[test]
    fn without_a_region_everything_is_inside() {
        assert_eq!(SensedRegion::new(&config::RegionConfig::default()), SensedRegion::All);
        assert!(SensedRegion::All.contains(1e9, -1e9));
    }

    #[test]
    fn a_bay_of_a_polygon_is_outside() {
        // An L: the upper right quarter is missing.
        let region = polygon(&["0 0", "10 0", "10 5", "5 5", "5 10", "0 10"]);
        for (x, y, inside) in [
            (2.0, 2.0, true),
            (8.0, 2.0, true),
            (2.0, 8.0, true),
            (8.0, 8.0, false),
            (-1.0, 5.0, false),
            (11.0, 2.0, false),
        ] {
            assert_eq!(region.contains(x, y), inside, "{x} {y}");
        }
    }

    proptest! {
        /// A rectangle contains the points between its sides, for either order and any first corner.
        #[test]
        fn a_rectangle_is_its_sides(
            x in -50.0..50.0_f64, y in -50.0..50.0_f64, turn in 0..4_usize, reverse: bool,
        ) {
            let mut corners = vec!["-20 -10", "30 -10", "30 25", "-20 25"];
            corners.rotate_left(turn);
            if reverse {
                corners.reverse();
            }
            let inside = (-20.0..30.0).contains(&x) && (-10.0..25.0).contains(&y);
            prop_assert_eq!(polygon(&corners).contains(x, y), inside);
        }

        /// A circle contains the points nearer to its centre than its radius.
        #[test]
        fn a_circle_is_its_radius(x in -50.0..50.0_f64, y in -50.0..50.0_f64) {
            let region = SensedRegion::new(&config::RegionConfig { centre_m: [3.0, -4.0], radius_m: 20.0, ..config::RegionConfig::default() });
            prop_assert_eq!(region.contains(x, y), (x - 3.0).powi(2) + (y + 4.0).powi(2) <= 400.0);
        }
    }
}
