//! Directions of a LIDAR's rays in the sensor's frame.
//!
//! Rays form groups of sixteen that fire together. A column is all lasers of one azimuth; in a table it is up to sixteen rays in the
//! order of the file. A named pattern has the elevations of the unit's manual. The small azimuth offsets between the lasers of real
//! units are left out; a table can hold them.

use std::path::Path;

use ipc_schema::config::{self, LidarPattern};

use super::{
    error::LidarError,
    simd::{Floats, WIDTH, Words},
};

/// Rays that fire together. A direction is `alpha` along the azimuth of the column, `beta` to its left, `gamma` up the sensor's axis.
#[derive(Debug, Clone)]
pub(super) struct RayGroup {
    pub(super) alpha: Floats,
    pub(super) beta: Floats,
    pub(super) gamma: Floats,
    /// Tangent and cotangent of the elevation, for columns in one plane.
    pub(super) tan: Floats,
    pub(super) cot: Floats,
    /// 1 / cosine of the elevation.
    pub(super) inv_cos: Floats,
    /// Laser, in the upper half of the word.
    pub(super) channel: Words,
    /// Bits of the elements that are rays; the others are padding.
    pub(super) live: u32,
}

/// The rays of a rotation.
#[derive(Debug, Clone)]
pub(super) struct RayPattern {
    /// The groups of every column, or, of a table, one group for each column.
    pub(super) groups: Vec<RayGroup>,
    /// Groups in a column.
    pub(super) per_column: usize,
    /// Rays in a full column.
    pub(super) lasers: usize,
    /// `alpha` and `gamma` of the lowest and the highest laser.
    pub(super) ends: [[f32; 2]; 2],
    /// The pattern is a table of the rays of a rotation; their azimuths are in `alpha` and `beta`.
    pub(super) is_table: bool,
}

/// Longest time over which the rays of a table count as fired together, seconds: 1 mm at 20 m/s.
const TOGETHER_S: f64 = 50e-6;

impl RayPattern {
    pub(super) fn new(lidar: &config::LidarConfig) -> Result<Self, LidarError> {
        let Some(elevations) = elevations_deg(lidar) else {
            let path = lidar.ray_table.as_deref().ok_or(LidarError::NoTable)?;
            return table(path, lidar.rotation_hz);
        };
        let rays: Vec<Ray> = (0_u32..)
            .zip(&elevations)
            .map(|(channel, elevation_deg)| Ray {
                azimuth_deg: 0.0,
                elevation_deg: *elevation_deg,
                channel,
            })
            .collect();
        let groups: Vec<RayGroup> = rays.chunks(WIDTH).map(RayGroup::new).collect();
        Ok(Self {
            per_column: groups.len(),
            ends: [&rays[0], &rays[rays.len() - 1]].map(|ray| {
                let (sine, cosine) = libm::sincos(ray.elevation_deg.to_radians());
                [cosine as f32, sine as f32]
            }),
            groups,
            lasers: rays.len(),
            is_table: false,
        })
    }

    /// The groups of a column of the rotation.
    #[inline(always)]
    pub(super) fn column(&self, column: usize) -> &[RayGroup] {
        if self.is_table {
            &self.groups[column..=column]
        } else {
            &self.groups
        }
    }
}

/// One ray.
#[derive(Debug, Clone, Copy)]
struct Ray {
    azimuth_deg: f64,
    elevation_deg: f64,
    channel: u32,
}

impl RayGroup {
    fn new(rays: &[Ray]) -> Self {
        let element = |value: &dyn Fn(&Ray) -> f64| {
            Floats(std::array::from_fn(|i| {
                let ray = rays.get(i).or(rays.last());
                ray.map_or(0.0, value) as f32
            }))
        };
        let sin_cos = |degrees: f64| libm::sincos(degrees.to_radians());
        Self {
            alpha: element(&|ray| sin_cos(ray.elevation_deg).1 * sin_cos(ray.azimuth_deg).1),
            beta: element(&|ray| sin_cos(ray.elevation_deg).1 * sin_cos(ray.azimuth_deg).0),
            gamma: element(&|ray| sin_cos(ray.elevation_deg).0),
            tan: element(&|ray| sin_cos(ray.elevation_deg).0 / sin_cos(ray.elevation_deg).1),
            cot: element(&|ray| sin_cos(ray.elevation_deg).1 / sin_cos(ray.elevation_deg).0),
            inv_cos: element(&|ray| 1.0 / sin_cos(ray.elevation_deg).1),
            channel: Words(std::array::from_fn(|i| rays.get(i).map_or(0, |ray| ray.channel << 16))),
            live: (1_u32 << rays.len()) - 1,
        }
    }
}

/// Elevations from the lowest laser up, degrees; `None`: a table holds them.
fn elevations_deg(lidar: &config::LidarConfig) -> Option<Vec<f64>> {
    let between = |lower: f64, upper: f64, count: u32| -> Vec<f64> {
        if count == 1 {
            return vec![0.5 * (lower + upper)];
        }
        let step = (upper - lower) / f64::from(count - 1);
        (0..count).map(|i| lower + f64::from(i) * step).collect()
    };
    Some(match lidar.pattern {
        LidarPattern::Uniform => between(lidar.lower_fov_deg, lidar.upper_fov_deg, lidar.channels),
        // Velodyne VLP-16 user manual (63-9243): every 2°.
        LidarPattern::Vlp16 => between(-15.0, 15.0, 16),
        // Velodyne HDL-32E user manual (63-9113): 4/3° from −30.67° to 10.67°.
        LidarPattern::Hdl32e => between(-92.0 / 3.0, 32.0 / 3.0, 32),
        // Velodyne HDL-64E S3 manual: a lower block in steps of 1/2°, an upper one in steps of 1/3°.
        LidarPattern::Hdl64e => [between(-24.33, -8.83, 32), between(-8.33, 2.0, 32)].concat(),
        LidarPattern::Pandar40p => pandar40p(),
        // Ouster OS1 data sheets: evenly over 45° (revisions 6 and 7: ±21.2° with 128).
        LidarPattern::Os1_32 | LidarPattern::Os1_64 => between(-22.5, 22.5, lidar.lasers()),
        LidarPattern::Os1_128 => between(-21.2, 21.2, 128),
        LidarPattern::Vls128 => vls128(),
        LidarPattern::Table => return None,
    })
}

/// Hesai Pandar40P user manual, appendix I: 1/3° between −6° and 2°, sparser outside.
fn pandar40p() -> Vec<f64> {
    let below = [-25.0, -19.0, -14.0, -13.0, -12.0, -11.0, -10.0, -9.0, -8.0, -7.0];
    let fine = (0..25).map(|i| -6.0 + f64::from(i) / 3.0);
    below
        .into_iter()
        .chain(fine)
        .chain([3.0, 5.0, 8.0, 11.0, 15.0])
        .collect()
}

/// Velodyne VLS-128 (Alpha Prime) user manual (63-9483): 0.11° apart about the horizon, from −25° to 15°. The angles below the
/// fine part are the manual's; those above it widen as the ones below do.
fn vls128() -> Vec<f64> {
    let below = [
        -25.0, -19.582, -16.042, -13.565, -11.742, -10.346, -9.244, -8.352, -7.65, -7.15, -6.85, -6.65, -6.5,
    ];
    let fine = (0..104).map(|i| -6.39 + 0.11 * f64::from(i));
    let above = [
        5.09, 5.29, 5.59, 6.09, 6.792, 7.684, 8.786, 10.182, 11.582, 13.182, 15.0,
    ];
    below.into_iter().chain(fine).chain(above).collect()
}

/// A line of a ray table.
#[derive(serde::Deserialize)]
struct TableLine {
    azimuth_deg: f64,
    elevation_deg: f64,
}

fn table(path: &Path, rotation_hz: f64) -> Result<RayPattern, LidarError> {
    let lines = lines(path)?;
    let mut distinct: Vec<f64> = lines.iter().map(|line| line.elevation_deg).collect();
    distinct.sort_by(f64::total_cmp);
    distinct.dedup();
    let rays: Vec<Ray> = lines
        .iter()
        .map(|line| Ray {
            azimuth_deg: line.azimuth_deg,
            elevation_deg: line.elevation_deg,
            channel: distinct.partition_point(|known| *known < line.elevation_deg) as u32 & 0xFFFF,
        })
        .collect();
    let apart_s = 1.0 / (rotation_hz * rays.len() as f64);
    let together = (TOGETHER_S / apart_s).clamp(1.0, WIDTH as f64) as usize;
    Ok(RayPattern {
        groups: rays.chunks(together).map(RayGroup::new).collect(),
        per_column: 1,
        lasers: together,
        ends: [[0.0; 2]; 2],
        is_table: true,
    })
}

fn lines(path: &Path) -> Result<Vec<TableLine>, LidarError> {
    let bytes = std::fs::read(path).map_err(|source| LidarError::Unreadable {
        path: path.into(),
        source,
    })?;
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .comment(Some(b'#'))
        .from_reader(bytes.as_slice());
    let wrong = |line: u64, reason: String| LidarError::Table {
        path: path.into(),
        line,
        reason,
    };
    let headers = reader.headers().map_err(|error| wrong(1, error.to_string()))?.clone();
    let mut lines = Vec::new();
    for record in reader.records() {
        let place = |error: &csv::Error| error.position().map_or(0, csv::Position::line);
        let record = record.map_err(|error| wrong(place(&error), error.to_string()))?;
        let number = record.position().map_or(0, csv::Position::line);
        let line: TableLine = record
            .deserialize(Some(&headers))
            .map_err(|error| wrong(number, reason(&error)))?;
        if !line.azimuth_deg.is_finite() || !(-90.0..=90.0).contains(&line.elevation_deg) {
            let said = format!(
                "azimuth_deg {} and elevation_deg {} are no direction: the elevation lies within −90 … 90",
                line.azimuth_deg, line.elevation_deg
            );
            return Err(wrong(number, said));
        }
        lines.push(line);
    }
    if lines.is_empty() {
        return Err(LidarError::NoRays { path: path.into() });
    }
    Ok(lines)
}

/// The fault in a line, without its place, which the message already names.
fn reason(error: &csv::Error) -> String {
    match error.kind() {
        csv::ErrorKind::Deserialize { err, .. } => match err.field() {
            Some(field) => format!("column {}: {}", field + 1, err.kind()),
            None => err.kind().to_string(),
        },
        _ => error.to_string(),
    }
}
