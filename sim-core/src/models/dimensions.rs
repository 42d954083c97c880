//! Size of a vehicle and the place of its axles.

/// Size of a vehicle and the place of its axles. Of an articulated vehicle: of its leading body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VehicleDimensions {
    /// Bumper to bumper, metres.
    pub length_m: f64,
    /// Metres.
    pub width_m: f64,
    /// Metres.
    pub height_m: f64,
    /// Rear axle to front axle, metres.
    pub wheelbase_m: f64,
    /// Rear axle to the rear end of the body, metres; negative if the body ends before the axle.
    pub rear_overhang_m: f64,
    /// From the front to the end of the last body in a straight line, metres: SUMO's length.
    pub whole_length_m: f64,
}

impl VehicleDimensions {
    /// Rear axle to front bumper, metres.
    #[must_use]
    pub fn front_m(&self) -> f64 {
        self.length_m - self.rear_overhang_m
    }
}
