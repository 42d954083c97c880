//! The catalogue of props, and the entries of `scene.obstacles`.

/// Class of a prop, for sensors that distinguish classes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum PropClass {
    /// Cones, bollards, barriers: objects that close a road.
    Barrier = 0,
    /// Benches, bins, boxes, shelters.
    Furniture = 1,
    /// Lamp posts and signs.
    Pole = 2,
    /// Trees.
    Vegetation = 3,
    /// A vehicle that never moves.
    Vehicle = 4,
    /// Loads that fell off a lorry.
    Load = 5,
}

/// A kind of prop: a box that stands on the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PropKind {
    /// Its name in `scene.obstacles`.
    pub name: &'static str,
    /// Its class.
    pub class: PropClass,
    /// Length along its heading, metres.
    pub length_m: f64,
    /// Width across its heading, metres.
    pub width_m: f64,
    /// Height, metres.
    pub height_m: f64,
}

const fn prop(name: &'static str, class: PropClass, length_m: f64, width_m: f64, height_m: f64) -> PropKind {
    PropKind {
        name,
        class,
        length_m,
        width_m,
        height_m,
    }
}

/// All props. Sizes are those of common products: a 750 mm road cone, a 3 m concrete step barrier, a Euro pallet box, a 120 l bin.
pub const PROPS: [PropKind; 16] = [
    prop("cone", PropClass::Barrier, 0.40, 0.40, 0.75),
    prop("bollard", PropClass::Barrier, 0.15, 0.15, 1.00),
    prop("barrier", PropClass::Barrier, 0.30, 2.00, 1.00),
    prop("jersey_barrier", PropClass::Barrier, 3.00, 0.60, 0.80),
    prop("bin", PropClass::Furniture, 0.55, 0.48, 0.94),
    prop("bench", PropClass::Furniture, 0.60, 1.80, 0.85),
    prop("bus_shelter", PropClass::Furniture, 1.50, 4.00, 2.50),
    prop("advertising_column", PropClass::Furniture, 1.20, 1.20, 3.00),
    prop("cabinet", PropClass::Furniture, 0.40, 1.20, 1.20),
    prop("lamp_post", PropClass::Pole, 0.20, 0.20, 8.00),
    prop("sign", PropClass::Pole, 0.10, 0.60, 2.60),
    prop("tree", PropClass::Vegetation, 0.40, 0.40, 6.00),
    prop("parked_car", PropClass::Vehicle, 4.30, 1.80, 1.50),
    prop("parked_van", PropClass::Vehicle, 5.93, 2.02, 2.70),
    prop("crate", PropClass::Load, 1.20, 0.80, 1.00),
    prop("tyre", PropClass::Load, 0.65, 0.65, 0.22),
];

/// One entry of `scene.obstacles`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Obstacle {
    /// Kind of prop.
    pub kind: &'static PropKind,
    /// Its centre, x, world, metres.
    pub x_m: f64,
    /// Its centre, y, world, metres.
    pub y_m: f64,
    /// Heading, counter-clockwise from east, radians.
    pub yaw_rad: f64,
}

/// An entry of `scene.obstacles` cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ObstacleError {
    /// The prop is unknown.
    #[error("`scene.obstacles`: \"{text}\" names no known prop (\"{name}\")")]
    Unknown {
        /// The entry.
        text: String,
        /// The name in it.
        name: String,
    },
    /// The entry is not a name and two or three numbers.
    #[error("`scene.obstacles`: \"{text}\" is not \"name x y\" or \"name x y heading\" with plain numbers")]
    Malformed {
        /// The entry.
        text: String,
    },
}

impl ObstacleError {
    /// The form of an entry, and the known props.
    #[must_use]
    pub fn help(&self) -> String {
        let names: Vec<_> = PROPS.iter().map(|prop| prop.name).collect();
        format!(
            "write \"cone 120.5 80 90\": x and y in metres (world), heading in degrees counter-clockwise from east; props: {}",
            names.join(", ")
        )
    }
}

impl Obstacle {
    /// Reads "name x y heading"; the heading is in degrees and may be left out.
    ///
    /// # Errors
    /// The name is unknown, or a value is not a number.
    pub fn parse(text: &str) -> Result<Self, ObstacleError> {
        let malformed = || ObstacleError::Malformed { text: text.into() };
        let mut words = text.split_whitespace();
        let name = words.next().ok_or_else(malformed)?;
        let kind = PROPS.iter().find(|prop| prop.name == name);
        let kind = kind.ok_or_else(|| ObstacleError::Unknown {
            text: text.into(),
            name: name.into(),
        })?;
        let numbers: Option<Vec<f64>> = words
            .map(|word| word.parse().ok().filter(|number: &f64| number.is_finite()))
            .collect();
        let (x_m, y_m, heading_deg) = match numbers.as_deref() {
            Some([x, y]) => (*x, *y, 0.0),
            Some([x, y, heading]) => (*x, *y, *heading),
            _ => return Err(malformed()),
        };
        Ok(Self {
            kind,
            x_m,
            y_m,
            yaw_rad: heading_deg.to_radians(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_entry_is_a_name_a_position_and_an_optional_heading() {
        let obstacle = Obstacle::parse("  cone 1.5 -2e1 ").unwrap();
        assert_eq!(
            (obstacle.kind.name, obstacle.x_m, obstacle.y_m, obstacle.yaw_rad),
            ("cone", 1.5, -20.0, 0.0)
        );
        let turned = Obstacle::parse("parked_car 0 0 -90").unwrap();
        assert!((turned.yaw_rad + std::f64::consts::FRAC_PI_2).abs() < 1e-12);
    }

    #[test]
    fn a_wrong_entry_is_named_with_the_known_props() {
        let error = Obstacle::parse("cnoe 1 2").unwrap_err();
        assert_eq!(
            error.to_string(),
            "`scene.obstacles`: \"cnoe 1 2\" names no known prop (\"cnoe\")"
        );
        assert!(error.help().contains("cone, bollard, barrier"));
        for text in [
            "",
            "cone",
            "cone 1",
            "cone 1 x",
            "cone 1 2 3 4",
            "cone NaN 2",
            "cone inf 2",
        ] {
            assert!(
                matches!(Obstacle::parse(text), Err(ObstacleError::Malformed { .. })),
                "{text}"
            );
        }
    }

    #[test]
    fn names_are_unique_and_sizes_positive() {
        for (place, prop) in PROPS.iter().enumerate() {
            assert!(
                PROPS[..place].iter().all(|other| other.name != prop.name),
                "{}",
                prop.name
            );
            assert!(prop.length_m > 0.0 && prop.width_m > 0.0 && prop.height_m > 0.0);
        }
    }
}
