//! Size of a vehicle and the place of its axles.

/// Size of a vehicle and the place of its axles.
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
    /// Rear axle to rear bumper, metres.
    pub rear_overhang_m: f64,
}

impl VehicleDimensions {
    /// Rear axle to front bumper, metres.
    #[must_use]
    pub fn front_m(&self) -> f64 {
        self.length_m - self.rear_overhang_m
    }
}
