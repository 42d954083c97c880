//! Semantic classes of an image, and their colours.

use std::sync::LazyLock;

use ipc_schema::{pointcloud::Tag, traffic::VEHICLE_CLASSES};

/// Class of a pixel: the label ids of the CityScapes data set (M. Cordts et al., *The Cityscapes Dataset for Semantic Urban Scene
/// Understanding*, CVPR 2016), and from 40 on classes that it counts as road.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum SemanticLabel {
    /// Furniture of the street and loads: CityScapes' "static".
    Static = 4,
    /// What moves and is no road vehicle, such as a ship or an aircraft: CityScapes' "dynamic".
    Dynamic = 5,
    /// The carriageway.
    Road = 7,
    /// Where pedestrians walk.
    Sidewalk = 8,
    /// Rails.
    RailTrack = 10,
    /// A building, a tower, a tank, a mesh.
    Building = 11,
    /// A wall.
    Wall = 12,
    /// Cones and barriers: CityScapes' "guard rail".
    Barrier = 14,
    /// Sides and underside of a bridge; its top has the classes of the road.
    Bridge = 15,
    /// Lamp posts and signs.
    Pole = 17,
    /// Trees.
    Vegetation = 21,
    /// Grass and verges.
    Terrain = 22,
    /// Sky.
    Sky = 23,
    /// A pedestrian.
    Person = 24,
    /// A car.
    Car = 26,
    /// A lorry.
    Truck = 27,
    /// A bus.
    Bus = 28,
    /// A tram or a train, with all its carriages.
    Train = 31,
    /// A motorcycle with its rider.
    Motorcycle = 32,
    /// A bicycle with its rider.
    Bicycle = 33,
    /// A line along a lane.
    LaneMarking = 40,
    /// A line across a lane at which vehicles stop.
    StopLine = 41,
    /// A stripe of a pedestrian crossing.
    Crossing = 42,
}

impl SemanticLabel {
    /// The class of a static solid.
    pub(super) fn of_tag(word: u32) -> Self {
        let is = |tag: Tag| word & 0xFF == tag as u32;
        if is(Tag::Wall) {
            Self::Wall
        } else if is(Tag::Barrier) {
            Self::Barrier
        } else if is(Tag::Furniture) || is(Tag::Load) {
            Self::Static
        } else if is(Tag::Pole) {
            Self::Pole
        } else if is(Tag::Vegetation) {
            Self::Vegetation
        } else if is(Tag::ParkedVehicle) {
            Self::Car
        } else if is(Tag::Ground) {
            // The sides and the underside of a deck.
            Self::Bridge
        } else {
            Self::Building
        }
    }

    /// The label of a vehicle of SUMO's class number `class`, with its length and height in metres. A class that vehicles of any kind have
    /// leaves it to the size.
    pub(super) fn of_vehicle(class: u16, is_two_wheeler: bool, length_m: f64, height_m: f64) -> Self {
        static OF_CLASS: LazyLock<[Option<SemanticLabel>; VEHICLE_CLASSES.len()]> =
            LazyLock::new(|| VEHICLE_CLASSES.map(SemanticLabel::of_class));
        let of_class = OF_CLASS.get(usize::from(class)).copied().flatten();
        of_class.unwrap_or_else(|| Self::of_size(is_two_wheeler, length_m, height_m))
    }

    /// The label of one of SUMO's vehicle classes, by the definitions of CityScapes, where trailers of lorries are lorries. `None` for
    /// classes of vehicles that may be cars or lorries there: vans, whose cab and load may share one body or not; "passenger", which is also
    /// the class of vehicles whose type names none; and classes that say who drives.
    fn of_class(class: &str) -> Option<Self> {
        Some(match class {
            "taxi" => Self::Car,
            "truck" | "trailer" => Self::Truck,
            "bus" | "coach" => Self::Bus,
            "tram" | "rail_urban" | "rail" | "rail_electric" | "rail_fast" | "subway" => Self::Train,
            "motorcycle" | "moped" => Self::Motorcycle,
            "bicycle" | "scooter" => Self::Bicycle,
            "pedestrian" | "wheelchair" => Self::Person,
            "ship" | "container" | "cable_car" | "aircraft" | "drone" => Self::Dynamic,
            _ => return None,
        })
    }

    /// The label of a vehicle of this size, metres, by the lengths and heights of SUMO's vehicle classes: bicycles are 1.6 m long and
    /// motorcycles 2.2 m, buses 12 m and longer, lorries above 2.1 m tall.
    fn of_size(is_two_wheeler: bool, length_m: f64, height_m: f64) -> Self {
        match is_two_wheeler {
            true if length_m < 1.9 => Self::Bicycle,
            true => Self::Motorcycle,
            false if length_m >= 10.0 && height_m < 3.7 => Self::Bus,
            false if length_m >= 6.0 || height_m > 2.1 => Self::Truck,
            false => Self::Car,
        }
    }

    /// Share of light that it reflects: red, green, blue. Colours are plausible, not measured.
    pub(super) fn albedo(self) -> [f32; 3] {
        match self {
            Self::Road => [0.22, 0.22, 0.23],
            Self::Sidewalk => [0.42, 0.41, 0.40],
            Self::RailTrack => [0.30, 0.27, 0.25],
            Self::Building => [0.58, 0.50, 0.43],
            Self::Bridge => [0.52, 0.51, 0.50],
            Self::Wall => [0.50, 0.48, 0.45],
            Self::Barrier => [0.80, 0.35, 0.15],
            Self::Static | Self::Dynamic => [0.35, 0.35, 0.30],
            Self::Pole => [0.45, 0.45, 0.47],
            Self::Vegetation => [0.16, 0.32, 0.12],
            Self::Terrain => [0.28, 0.38, 0.18],
            Self::Sky => [0.60, 0.75, 0.95],
            Self::Person => [0.55, 0.35, 0.30],
            Self::Car => [0.50, 0.50, 0.55],
            Self::Truck => [0.60, 0.58, 0.50],
            Self::Bus => [0.75, 0.55, 0.15],
            Self::Train => [0.65, 0.20, 0.18],
            Self::Motorcycle => [0.25, 0.25, 0.30],
            Self::Bicycle => [0.30, 0.20, 0.20],
            Self::LaneMarking | Self::StopLine | Self::Crossing => [0.85, 0.85, 0.85],
        }
    }

    /// Every class.
    pub const ALL: [Self; 23] = [
        Self::Static,
        Self::Dynamic,
        Self::Road,
        Self::Sidewalk,
        Self::RailTrack,
        Self::Building,
        Self::Wall,
        Self::Barrier,
        Self::Bridge,
        Self::Pole,
        Self::Vegetation,
        Self::Terrain,
        Self::Sky,
        Self::Person,
        Self::Car,
        Self::Truck,
        Self::Bus,
        Self::Train,
        Self::Motorcycle,
        Self::Bicycle,
        Self::LaneMarking,
        Self::StopLine,
        Self::Crossing,
    ];
}
