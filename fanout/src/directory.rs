//! The directory of road users, traffic lights and heroes' routes, kept up to date from a census each simulated second and the changes between.

use std::collections::BTreeMap;

use bytemuck::bytes_of;
use ipc_schema::{
    block::{BlockError, view},
    header::MessageHeader,
    traffic::{MetaEvent, RoutePoint, SignalMeta, TrafficMetaLayout, VehicleMeta},
};

/// A fact and the tick from which it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Dated<T> {
    tick: u64,
    fact: T,
}

/// Road users and traffic lights of the current episode.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RoadUserDirectory {
    header: MessageHeader,
    vehicles: BTreeMap<u32, Dated<VehicleMeta>>,
    signals: BTreeMap<u32, Dated<SignalMeta>>,
    /// Points of each hero's route. A census has none, so that a restarted fan-out learns of a route when its hero departs next.
    routes: BTreeMap<u32, Vec<RoutePoint>>,
    /// The tick at which each road user left, of those that left since the last census.
    gone: BTreeMap<u32, u64>,
    signals_changed: bool,
    routes_changed: bool,
}

impl RoadUserDirectory {
    /// Applies a `traffic-meta` message: the changes of its tick.
    ///
    /// # Errors
    /// The payload does not hold what its header promises.
    pub fn apply_changes(&mut self, header: &MessageHeader, payload: &[u8]) -> Result<(), BlockError> {
        if !self.is_current(header) {
            return Ok(());
        }
        let (vehicles, signals) = rows(header, payload)?;
        for fact in vehicles {
            if fact.event == MetaEvent::Departed as u32 {
                let dated = Dated {
                    tick: header.tick,
                    fact: *fact,
                };
                self.vehicles.insert(fact.vehicle, dated);
            } else if fact.event == MetaEvent::Arrived as u32 {
                self.vehicles.remove(&fact.vehicle);
                self.routes_changed |= self.routes.remove(&fact.vehicle).is_some();
                self.gone.insert(fact.vehicle, header.tick);
            }
        }
        self.enter_signals(header, signals);
        self.enter_routes(view(payload, TrafficMetaLayout::of(header).route)?);
        Ok(())
    }

    /// Applies a `census` message, which lists every road user and traffic light. Facts of a later tick stay.
    ///
    /// # Errors
    /// As [`RoadUserDirectory::apply_changes`].
    pub fn apply_census(&mut self, header: &MessageHeader, payload: &[u8]) -> Result<(), BlockError> {
        if !self.is_current(header) {
            return Ok(());
        }
        let (vehicles, signals) = rows(header, payload)?;
        self.gone.retain(|_, tick| *tick > header.tick);
        self.vehicles.retain(|_, dated| dated.tick > header.tick);
        for fact in vehicles {
            if !self.gone.contains_key(&fact.vehicle) {
                self.vehicles.entry(fact.vehicle).or_insert(Dated {
                    tick: header.tick,
                    fact: *fact,
                });
            }
        }
        self.enter_signals(header, signals);
        Ok(())
    }

    /// False for a message of an old episode. A new episode empties the directory.
    fn is_current(&mut self, header: &MessageHeader) -> bool {
        if header.episode < self.header.episode {
            return false;
        }
        if header.episode > self.header.episode {
            *self = Self::default();
        }
        if header.tick >= self.header.tick {
            self.header = *header;
        }
        true
    }

    /// Replaces what is known of each traffic light, unless that is newer.
    fn enter_signals(&mut self, header: &MessageHeader, signals: &[SignalMeta]) {
        for fact in signals {
            let dated = Dated {
                tick: header.tick,
                fact: *fact,
            };
            let known = self.signals.entry(fact.signal).or_insert(dated);
            if known.tick <= header.tick {
                self.signals_changed |= known.fact != *fact || known.tick == header.tick;
                *known = dated;
            }
        }
    }

    /// Appends points to the routes of their heroes; the first point of a route replaces the hero's former one.
    fn enter_routes(&mut self, points: &[RoutePoint]) {
        for point in points {
            let route = self.routes.entry(point.vehicle).or_default();
            if point.index == 0 {
                route.clear();
            }
            route.push(*point);
        }
        self.routes_changed |= !points.is_empty();
    }

    /// Header of the newest message applied.
    #[must_use]
    pub fn header(&self) -> &MessageHeader {
        &self.header
    }

    /// The road user with this index, if it is known.
    #[must_use]
    pub fn vehicle(&self, index: u32) -> Option<&VehicleMeta> {
        self.vehicles.get(&index).map(|dated| &dated.fact)
    }

    /// Number of known road users.
    #[must_use]
    pub fn len(&self) -> usize {
        self.vehicles.len()
    }

    /// True if no road user is known.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.vehicles.is_empty()
    }

    /// All road users as bytes, in rows by ascending index.
    #[must_use]
    pub fn vehicle_rows(&self) -> Vec<u8> {
        self.vehicles
            .values()
            .flat_map(|dated| bytes_of(&dated.fact))
            .copied()
            .collect()
    }

    /// All points of heroes' routes as bytes, hero by hero, if one has changed since the last call.
    pub fn take_route_rows(&mut self) -> Option<Vec<u8>> {
        std::mem::take(&mut self.routes_changed)
            .then(|| self.routes.values().flatten().flat_map(bytes_of).copied().collect())
    }

    /// All traffic lights as bytes, in rows by ascending index, if one has changed since the last call.
    pub fn take_signal_rows(&mut self) -> Option<Vec<u8>> {
        std::mem::take(&mut self.signals_changed).then(|| {
            self.signals
                .values()
                .flat_map(|dated| bytes_of(&dated.fact))
                .copied()
                .collect()
        })
    }
}

/// The two tables of a message.
fn rows<'a>(header: &MessageHeader, payload: &'a [u8]) -> Result<(&'a [VehicleMeta], &'a [SignalMeta]), BlockError> {
    let layout = TrafficMetaLayout::of(header);
    Ok((view(payload, layout.vehicles)?, view(payload, layout.signals)?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::{Zeroable as _, cast_slice_mut};
    use ipc_schema::block::view_mut;

    fn vehicle(vehicle: u32, event: MetaEvent) -> VehicleMeta {
        VehicleMeta {
            vehicle,
            event: event as u32,
            ..VehicleMeta::zeroed()
        }
    }

    fn signal(signal: u32, letter: u8) -> SignalMeta {
        let mut meta = SignalMeta {
            signal,
            links: 1,
            ..SignalMeta::zeroed()
        };
        meta.state[0] = letter;
        meta
    }

    fn message(episode: u64, tick: u64, vehicles: &[VehicleMeta], signals: &[SignalMeta]) -> (MessageHeader, Vec<u64>) {
        let layout = TrafficMetaLayout::new(vehicles.len(), signals.len());
        let mut words = vec![0_u64; layout.len / 8];
        let bytes: &mut [u8] = cast_slice_mut(&mut words);
        view_mut(bytes, layout.vehicles).unwrap().copy_from_slice(vehicles);
        if !signals.is_empty() {
            view_mut(bytes, layout.signals).unwrap().copy_from_slice(signals);
        }
        let header = MessageHeader {
            episode,
            tick,
            shape: layout.shape,
            ..MessageHeader::default()
        };
        (header, words)
    }

    fn known(directory: &RoadUserDirectory) -> Vec<u32> {
        directory.vehicles.keys().copied().collect()
    }

    #[test]
    fn a_route_is_kept_until_its_hero_leaves_or_gets_another() {
        let mut directory = RoadUserDirectory::default();
        let mut drive = |tick, hero: u32, indices: std::ops::Range<u32>| {
            let points: Vec<RoutePoint> = indices
                .map(|index| RoutePoint {
                    vehicle: hero,
                    index,
                    ..RoutePoint::default()
                })
                .collect();
            let layout = TrafficMetaLayout::sized(0, 0, points.len());
            let header = MessageHeader {
                tick,
                shape: layout.shape,
                ..MessageHeader::default()
            };
            directory.apply_changes(&header, bytemuck::cast_slice(&points)).unwrap();
            directory
                .take_route_rows()
                .map(|rows| rows.len() / size_of::<RoutePoint>())
        };
        assert_eq!(drive(1, 3, 0..4), Some(4));
        assert_eq!(drive(2, 3, 4..6), Some(6));
        assert_eq!(drive(3, 8, 0..2), Some(8));
        assert_eq!(drive(4, 3, 0..1), Some(3));
        assert_eq!(drive(5, 3, 0..0), None);
        let (header, words) = message(0, 6, &[vehicle(3, MetaEvent::Arrived)], &[]);
        directory.apply_changes(&header, bytemuck::cast_slice(&words)).unwrap();
        assert_eq!(
            directory.take_route_rows().map(|rows| rows.len()),
            Some(2 * size_of::<RoutePoint>())
        );
    }

    #[test]
    fn a_census_fills_gaps_and_undoes_nothing_newer() {
        use MetaEvent::{Arrived, Departed};
        let mut directory = RoadUserDirectory::default();
        let change = |tick, vehicles: &[VehicleMeta], signals: &[SignalMeta], directory: &mut RoadUserDirectory| {
            let (header, words) = message(0, tick, vehicles, signals);
            directory.apply_changes(&header, bytemuck::cast_slice(&words)).unwrap();
        };
        change(
            5,
            &[vehicle(0, Departed), vehicle(1, Departed)],
            &[signal(0, b'r')],
            &mut directory,
        );
        change(
            8,
            &[vehicle(1, Arrived), vehicle(3, Departed)],
            &[signal(0, b'G')],
            &mut directory,
        );
        // A census of tick 7: the departure of 0 and the arrival of 2 were missed; 1 had not left yet, and 3 had not come yet.
        let (header, words) = message(0, 7, &[vehicle(1, Departed), vehicle(2, Departed)], &[signal(0, b'y')]);
        directory.apply_census(&header, bytemuck::cast_slice(&words)).unwrap();
        assert_eq!(known(&directory), [2, 3]);
        assert_eq!(directory.signals[&0].fact.state[0], b'G');
        assert!(directory.take_signal_rows().is_some());
        assert!(directory.take_signal_rows().is_none());
        // The next episode empties the directory, and a late message of the old one changes nothing.
        let (header, words) = message(1, 9, &[vehicle(0, Departed)], &[]);
        directory.apply_census(&header, bytemuck::cast_slice(&words)).unwrap();
        change(8, &[vehicle(7, Departed)], &[], &mut directory);
        assert_eq!(known(&directory), [0]);
        assert_eq!(directory.vehicle_rows().len(), size_of::<VehicleMeta>());
    }

    #[test]
    fn a_message_that_promises_too_much_is_refused() {
        let header = MessageHeader {
            shape: [1000, 0, 0, 0],
            ..MessageHeader::default()
        };
        assert!(RoadUserDirectory::default().apply_census(&header, &[0; 64]).is_err());
    }
}
