//! The sensors of a connected road user, one module each.
//!
//! A point sensor has the same four functions as its neighbours: `new` reads its configuration, `plan` plans the random numbers of a
//! tick, `begin` gives the state that a road user's sensor keeps from tick to tick, and `sample` measures.
//! [`crate::suite::SensorSuite`] calls them. How a curriculum scales its noise is `scale_noise` of its configuration
//! (`ipc_schema::config`). The [`lidar`] scans whole ticks (`crate::scanning`), and the [`ultrasonic`]
//! sensors measure distances; `crate::surroundings` samples both. The [`sky`] belongs to the GNSS receiver.

pub mod camera;
pub mod gnss;
pub mod imu;
pub mod lidar;
pub mod radar;
pub mod sky;
pub mod speed_steering;
pub mod ultrasonic;
