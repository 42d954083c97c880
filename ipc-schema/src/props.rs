//! The catalogue of props, and the obstacles made of them.

use std::{fmt, str::FromStr};

use crate::config::text::{finite_numbers, serde_as_text};

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

impl PropKind {
    /// The prop of this name.
    #[must_use]
    pub fn by_name(name: &str) -> Option<&'static Self> {
        PROPS.iter().find(|prop| prop.name == name)
    }
}

/// A prop that a configuration or run file refers to by its name.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PropName(pub &'static PropKind);

/// A text is not the name of a prop.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" names no known prop")]
pub struct PropNameError(pub String);

/// An obstacle: a prop and its place. Configurations and run files write it as "name x y heading"; the heading may be left out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Obstacle {
    /// Kind of prop.
    pub kind: &'static PropKind,
    /// x and y of its centre, world, metres.
    pub centre_m: [f64; 2],
    /// Heading, counter-clockwise from east, degrees.
    pub heading_deg: f64,
}

/// A text is not an obstacle.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ObstacleError {
    /// The prop is unknown.
    #[error("\"{text}\" names no known prop (\"{name}\")")]
    Unknown {
        /// The text.
        text: String,
        /// The name in it.
        name: String,
    },
    /// The text is not a name and two or three numbers.
    #[error("\"{text}\" is not \"name x y\" or \"name x y heading\" with plain numbers")]
    Malformed {
        /// The text.
        text: String,
    },
}

serde_as_text!(PropName, Obstacle);

impl FromStr for PropName {
    type Err = PropNameError;

    fn from_str(text: &str) -> Result<Self, PropNameError> {
        let kind = PropKind::by_name(text).ok_or_else(|| PropNameError(text.to_owned()))?;
        Ok(Self(kind))
    }
}

impl fmt::Display for PropName {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.0.name)
    }
}

impl FromStr for Obstacle {
    type Err = ObstacleError;

    fn from_str(text: &str) -> Result<Self, ObstacleError> {
        let malformed = || ObstacleError::Malformed { text: text.into() };
        let mut words = text.split_whitespace();
        let name = words.next().ok_or_else(malformed)?;
        let kind = PropKind::by_name(name).ok_or_else(|| ObstacleError::Unknown {
            text: text.into(),
            name: name.into(),
        })?;
        let (centre_m, heading_deg) = match finite_numbers(words).as_deref() {
            Some([x_m, y_m]) => ([*x_m, *y_m], 0.0),
            Some([x_m, y_m, heading_deg]) => ([*x_m, *y_m], *heading_deg),
            _ => return Err(malformed()),
        };
        Ok(Self {
            kind,
            centre_m,
            heading_deg,
        })
    }
}

impl fmt::Display for Obstacle {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (name, [x_m, y_m], heading_deg) = (self.kind.name, self.centre_m, self.heading_deg);
        write!(formatter, "{name} {x_m} {y_m} {heading_deg}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_obstacle_is_a_name_a_position_and_an_optional_heading() {
        let cone: Obstacle = serde_json::from_str("\"  cone 1.5 -2e1 \"").unwrap();
        assert_eq!(
            (cone.kind.name, cone.centre_m, cone.heading_deg),
            ("cone", [1.5, -20.0], 0.0)
        );
        let car: Obstacle = "parked_car 0 0.1 -90".parse().unwrap();
        let text = serde_json::to_string(&car).unwrap();
        assert_eq!(text, "\"parked_car 0 0.1 -90\"");
        assert_eq!(serde_json::from_str::<Obstacle>(&text).unwrap(), car);
    }

    #[test]
    fn the_error_on_a_wrong_obstacle_names_it() {
        let error = "cnoe 1 2".parse::<Obstacle>().unwrap_err();
        assert_eq!(error.to_string(), "\"cnoe 1 2\" names no known prop (\"cnoe\")");
        for text in [
            "",
            "cone",
            "cone 1",
            "cone 1 x",
            "cone 1 2 3 4",
            "cone NaN 2",
            "cone inf 2",
        ] {
            let malformed = ObstacleError::Malformed { text: text.into() };
            assert_eq!(text.parse::<Obstacle>(), Err(malformed));
        }
        assert_eq!("unicorn".parse::<PropName>(), Err(PropNameError("unicorn".into())));
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
