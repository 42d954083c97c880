//! Geodesy: the map's own projection, forward and inverse, between net coordinates and latitude and longitude.
//!
//! Net coordinates are SUMO's: `net = projected + net_offset`, metres, x east, y north. The projection is the PROJ string of
//! the net's `<location>`; a net without one gets a transverse Mercator about the origin of the configuration. The implementation is
//! `proj4rs`: for transverse Mercator and UTM the Poder–Engsager series, which agrees with PROJ to nanometres.

pub mod displacement;

use ipc_schema::run::MapInfo;
use proj4rs::{Proj, transform::transform};

/// A position on the WGS 84 ellipsoid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Geodetic {
    /// Degrees, north positive.
    pub latitude_deg: f64,
    /// Degrees, east positive.
    pub longitude_deg: f64,
}

/// A position in net coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct NetPosition {
    /// East, metres.
    pub x_m: f64,
    /// North, metres.
    pub y_m: f64,
}

/// A position cannot be projected, or the projection cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GeodesyError {
    /// The net has no projection.
    #[error(
        "the net has no projection (projParameter=\"{0}\"): set `map.origin_latitude_deg` and `map.origin_longitude_deg`"
    )]
    NoProjection(String),
    /// The program does not support this projection.
    #[error("the projection \"{definition}\" cannot be used: {reason}")]
    Unsupported {
        /// PROJ string.
        definition: String,
        /// Why.
        reason: String,
    },
    /// Outside the domain of the projection.
    #[error("({first}, {second}) is outside the domain of the projection: {reason}")]
    OutsideDomain {
        /// x in metres, or longitude in degrees.
        first: f64,
        /// y in metres, or latitude in degrees.
        second: f64,
        /// Why.
        reason: String,
    },
}

/// The projection of a map, both ways, with the net's offset.
#[derive(Debug, Clone)]
pub struct Projection {
    net: Proj,
    geodetic: Proj,
    net_offset_m: [f64; 2],
}

impl Projection {
    /// The projection of `map`.
    ///
    /// # Errors
    /// No projection, an unknown one, or one that is not in metres on a plane or has no inverse.
    pub fn new(map: &MapInfo) -> Result<Self, GeodesyError> {
        let definition = map.projection.trim();
        if matches!(definition, "" | "!" | "." | "-") {
            return Err(GeodesyError::NoProjection(definition.into()));
        }
        let unsupported = |reason: String| GeodesyError::Unsupported {
            definition: definition.into(),
            reason,
        };
        let net = Proj::from_proj_string(definition).map_err(|e| unsupported(e.to_string()))?;
        if net.is_latlong() || net.is_geocent() {
            return Err(unsupported("its coordinates are not metres on a plane".into()));
        }
        if !net.has_inverse() || !net.has_forward() {
            return Err(unsupported("it has no inverse".into()));
        }
        let geodetic =
            Proj::from_proj_string("+proj=longlat +datum=WGS84 +no_defs").map_err(|e| unsupported(e.to_string()))?;
        Ok(Self {
            net,
            geodetic,
            net_offset_m: map.net_offset_m,
        })
    }

    /// Latitude and longitude of a net position (inverse projection).
    ///
    /// # Errors
    /// Outside the domain of the projection.
    pub fn geodetic_from_net(&self, net: NetPosition) -> Result<Geodetic, GeodesyError> {
        let mut point = (net.x_m - self.net_offset_m[0], net.y_m - self.net_offset_m[1], 0.0);
        convert(&self.net, &self.geodetic, &mut point, [net.x_m, net.y_m])?;
        Ok(Geodetic {
            latitude_deg: point.1.to_degrees(),
            longitude_deg: point.0.to_degrees(),
        })
    }

    /// Net position of a latitude and longitude (forward projection).
    ///
    /// # Errors
    /// Outside the domain of the projection.
    pub fn net_from_geodetic(&self, geodetic: Geodetic) -> Result<NetPosition, GeodesyError> {
        let Geodetic {
            latitude_deg,
            longitude_deg,
        } = geodetic;
        let mut point = (longitude_deg.to_radians(), latitude_deg.to_radians(), 0.0);
        convert(&self.geodetic, &self.net, &mut point, [longitude_deg, latitude_deg])?;
        Ok(NetPosition {
            x_m: point.0 + self.net_offset_m[0],
            y_m: point.1 + self.net_offset_m[1],
        })
    }
}

fn convert(from: &Proj, to: &Proj, point: &mut (f64, f64, f64), given: [f64; 2]) -> Result<(), GeodesyError> {
    let outside = |reason: String| GeodesyError::OutsideDomain {
        first: given[0],
        second: given[1],
        reason,
    };
    transform(from, to, point).map_err(|e| outside(e.to_string()))?;
    if point.0.is_finite() && point.1.is_finite() {
        Ok(())
    } else {
        Err(outside("the result is not finite".into()))
    }
}
