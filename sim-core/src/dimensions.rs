//! From SUMO's length and vehicle class to where the axles are.

/// Where a class of vehicle has its axles, as shares of its length.
struct Proportions {
    classes: &'static [&'static str],
    wheelbase: f64,
    rear_overhang: f64,
}

/// Shares from the dimensional drawings of one common vehicle for each row; the front overhang is what remains.
/// A vehicle with trailer moves as one body whose rear axle is the middle of the trailer's axles.
const PROPORTIONS: [Proportions; 8] = [
    // Volkswagen Golf VII: 4.255 m, wheelbase 2.637 m, overhangs 0.840 m and 0.778 m.
    Proportions {
        classes: &[
            "passenger",
            "private",
            "taxi",
            "evehicle",
            "hov",
            "vip",
            "custom1",
            "custom2",
        ],
        wheelbase: 0.620,
        rear_overhang: 0.183,
    },
    // Mercedes-Benz Sprinter L2: 5.932 m, wheelbase 3.665 m, rear overhang 1.263 m.
    Proportions {
        classes: &["delivery", "emergency", "authority", "army"],
        wheelbase: 0.618,
        rear_overhang: 0.213,
    },
    // MAN TGL 12 t with box body: 8.0 m, wheelbase 4.425 m, front overhang 1.275 m.
    Proportions {
        classes: &["truck"],
        wheelbase: 0.553,
        rear_overhang: 0.288,
    },
    // Semi-trailer combination: 16.5 m, front axle at 1.4 m, middle of the trailer's three axles at 12.3 m.
    Proportions {
        classes: &["trailer"],
        wheelbase: 0.660,
        rear_overhang: 0.255,
    },
    // Mercedes-Benz Citaro: 12.135 m, wheelbase 5.900 m, overhangs 2.805 m and 3.430 m.
    Proportions {
        classes: &["bus", "coach"],
        wheelbase: 0.486,
        rear_overhang: 0.283,
    },
    // BMW R 1200 GS: 2.207 m, wheelbase 1.507 m, wheels of 0.33 m radius.
    Proportions {
        classes: &["motorcycle", "moped"],
        wheelbase: 0.683,
        rear_overhang: 0.160,
    },
    // Trekking bicycle: 1.80 m, wheelbase 1.07 m, wheels of 0.35 m radius.
    Proportions {
        classes: &["bicycle", "scooter"],
        wheelbase: 0.594,
        rear_overhang: 0.203,
    },
    // Tram and rail cars: distance of the bogies in a low-floor car of 30 m is 18 m.
    Proportions {
        classes: &[
            "tram",
            "rail_urban",
            "rail",
            "rail_electric",
            "rail_fast",
            "subway",
            "cable_car",
        ],
        wheelbase: 0.600,
        rear_overhang: 0.200,
    },
];

/// Shortest body that is taken seriously, metres: SUMO lets a user write any length.
const SHORTEST_M: f64 = 0.5;

/// Size of a vehicle and the place of its axles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dimensions {
    /// Bumper to bumper, metres.
    pub length_m: f64,
    /// Metres.
    pub width_m: f64,
    /// Metres.
    pub height_m: f64,
    /// Rear axle to front axle, metres.
    pub wheelbase_m: f64,
    /// Rear axle to rear bumper, metres.
    pub rear_overhang_m: f64,
}

impl Dimensions {
    /// Dimensions of a vehicle of SUMO class `class` (text, zero padded); an unknown class is taken for a passenger car.
    #[must_use]
    pub fn new(class: &[u8], length_m: f64, width_m: f64, height_m: f64) -> Self {
        let end = class.iter().position(|&b| b == 0).unwrap_or(class.len());
        let name = &class[..end];
        let row = PROPORTIONS
            .iter()
            .find(|row| row.classes.iter().any(|known| known.as_bytes() == name));
        let row = row.unwrap_or(&PROPORTIONS[0]);
        let length_m = length_m.max(SHORTEST_M);
        Self {
            length_m,
            width_m,
            height_m,
            wheelbase_m: row.wheelbase * length_m,
            rear_overhang_m: row.rear_overhang * length_m,
        }
    }

    /// Rear axle to front bumper, metres.
    #[must_use]
    pub fn front_m(&self) -> f64 {
        self.length_m - self.rear_overhang_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axles_lie_within_every_body() {
        for row in &PROPORTIONS {
            for class in row.classes {
                let body = Dimensions::new(class.as_bytes(), 10.0, 2.0, 3.0);
                assert!(body.wheelbase_m > 0.0 && body.rear_overhang_m > 0.0, "{class}");
                assert!(body.wheelbase_m < body.front_m() && body.front_m() < 10.0, "{class}");
            }
        }
    }

    #[test]
    fn a_class_is_read_up_to_its_padding() {
        let bus = Dimensions::new(b"bus\0\0\0\0", 12.0, 2.5, 3.4);
        assert!((bus.wheelbase_m - 5.832).abs() < 1e-9);
        let unknown = Dimensions::new(b"hovercraft", 4.0, 2.0, 1.0);
        assert!((unknown.wheelbase_m - 2.48).abs() < 1e-9);
    }
}
