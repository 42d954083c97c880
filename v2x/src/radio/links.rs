//! Links between the radios of a tick. Both directions of a link are the same, so each pair of radios is computed once.

use ipc_schema::config::V2xConfig;
use sensor_daemon::wide::{VectorPath, VectorWork};
use sim_core::scene::{Grid, shape::Bounds};

use super::{
    link_power::{LinkPowers, LinkTerms},
    medium::{Medium, MediumLink, RadioLinks},
    milliwatts,
    obstruction::{Antenna, LinkObstruction, Obstacles},
    open_strips::OpenStrips,
    path_loss::{LinkState, decorrelation_m, path_loss_db, shadowing_std_db, vehicle_loss_db},
    shadowing::{ShadowingEnd, ShadowingField},
};
use crate::{
    parallel,
    random::{LinkKey, RadioDraw, RadioRandom},
};

/// A radio of a tick.
#[derive(Debug, Clone, Copy)]
pub struct Radio {
    /// Slot of its vehicle.
    pub slot: usize,
    /// Id of its station.
    pub station: u32,
    /// Where its antenna is.
    pub antenna: Antenna,
}

/// A wall that was between two slots when they were last looked at: it is tried first, because it mostly still is.
#[derive(Debug, Clone, Copy)]
struct Witness {
    /// The later slot.
    slot: u32,
    wall: u32,
}

/// The waves of shadowing at all radios, as either end of a link, in and out of a clear line of sight.
#[derive(Default)]
struct RadioShadows {
    clear: [Vec<ShadowingEnd>; 2],
    obstructed: [Vec<ShadowingEnd>; 2],
}

impl RadioShadows {
    fn fill(&mut self, field: &ShadowingField, config: &V2xConfig, radios: &[Radio]) {
        let Self { clear, obstructed } = self;
        for (state, ends) in [(LinkState::Clear, clear), (LinkState::Building, obstructed)] {
            let decorrelation = decorrelation_m(config.path_loss, state);
            for (end, ends) in ends.iter_mut().enumerate() {
                ends.resize_with(radios.len(), ShadowingEnd::default);
                parallel::for_each(config.threads as usize, ends, |radio, at| {
                    let position_m = radios[radio].antenna.position_m;
                    *at = match end {
                        0 => field.first_end(position_m, decorrelation),
                        _ => field.second_end(position_m, decorrelation),
                    };
                });
            }
        }
    }
}

/// Standard normal numbers for the links from a first radio to those after it.
struct ShadowedPairs<'a> {
    shadows: &'a RadioShadows,
    first: usize,
    pairs: &'a [RadioPair],
    normals: &'a mut Vec<f64>,
}

impl VectorWork for ShadowedPairs<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let [clear_first, clear_second] = &self.shadows.clear;
        let [obstructed_first, obstructed_second] = &self.shadows.obstructed;
        for pair in self.pairs {
            let second = pair.second as usize;
            self.normals.push(match pair.between.state {
                LinkState::Clear => clear_first[self.first].normal(&clear_second[second]),
                LinkState::Vehicles | LinkState::Building => {
                    obstructed_first[self.first].normal(&obstructed_second[second])
                }
            });
        }
    }
}

/// A pair of radios within range.
#[derive(Debug, Clone, Copy)]
struct RadioPair {
    second: u32,
    between: LinkObstruction,
}

impl RadioPair {
    const NONE: Self = Self {
        second: 0,
        between: LinkObstruction::CLEAR,
    };
}

/// What a thread uses for one radio after the other.
#[derive(Default)]
struct PairRoom {
    near: Vec<u64>,
    pairs: Vec<RadioPair>,
    /// Of `pairs`.
    terms: LinkTerms,
    /// Of pairs of which none sends.
    kept: Vec<Witness>,
    found: Vec<Witness>,
}

/// Computes the links of an episode, tick by tick.
pub struct LinkComputer {
    config: V2xConfig,
    random: RadioRandom,
    field: ShadowingField,
    /// Power below which a link does not count, dBm.
    least_dbm: f64,
    /// By state of the link: power less the loss at 1 m, dBm; loss for each decade of distance, and standard deviation of shadowing, dB.
    terms_of_states: [[f64; 3]; 3],
    path: VectorPath,
    /// By slot, ascending by the later slot.
    witnesses: Vec<Vec<Witness>>,
    /// By radio: links to those after it. Kept for its memory.
    to_later: Vec<Vec<MediumLink>>,
    shadows: RadioShadows,
    /// x, y and height of the radios of the tick, metres.
    places_m: [Vec<f64>; 3],
    strips: OpenStrips,
}

/// The radios of a tick and what is between them.
#[derive(Clone, Copy)]
pub struct RadioTick<'a> {
    /// Radios, ascending by slot.
    pub radios: &'a [Radio],
    /// By radio: it sends in this tick.
    pub sends: &'a [bool],
    /// Buildings and vehicles.
    pub obstacles: &'a Obstacles,
}

/// The pairs of one radio with those after it.
struct PairTurn {
    links: Vec<MediumLink>,
    witnesses: Vec<Witness>,
    /// The farthest pair without a building between, of those that share no strip.
    apart: Option<(f64, u32)>,
}

impl LinkComputer {
    /// Links of an episode with this configuration, on this medium.
    #[must_use]
    pub fn new(config: &V2xConfig, medium: &Medium, random: RadioRandom) -> Self {
        Self {
            config: config.clone(),
            random,
            field: ShadowingField::new(&random),
            least_dbm: medium.irrelevant_dbm(),
            terms_of_states: [0, 1, 2].map(|term: usize| {
                [LinkState::Clear, LinkState::Vehicles, LinkState::Building].map(|state| {
                    let [near, far] = [1.0, 10.0].map(|distance_m| path_loss_db(config.path_loss, state, distance_m));
                    let shadowing_db = if config.fading { shadowing_std_db(state) } else { 0.0 };
                    [config.power_dbm - near, far - near, shadowing_db][term]
                })
            }),
            path: VectorPath::widest(),
            witnesses: Vec::new(),
            to_later: Vec::new(),
            shadows: RadioShadows::default(),
            places_m: [const { Vec::new() }; 3],
            strips: OpenStrips::default(),
        }
    }

    /// Finds the strips that the radios of a tick are in.
    pub fn enter(&mut self, obstacles: &Obstacles, radios: &[Radio]) {
        self.strips.enter(obstacles, radios);
    }

    /// The strips of the radios that [`LinkComputer::enter`] took last.
    #[must_use]
    pub fn strips(&self) -> &OpenStrips {
        &self.strips
    }

    /// The links of a tick of which one radio sends, into `links`. Call it after [`LinkComputer::enter`].
    pub fn links(&mut self, tick: RadioTick, links: &mut RadioLinks) {
        let radios = tick.radios;
        let most = radios.last().map_or(0, |radio| radio.slot + 1);
        self.witnesses.resize_with(self.witnesses.len().max(most), Vec::new);
        self.to_later.resize_with(radios.len(), Vec::new);
        let mut turns: Vec<PairTurn> = radios
            .iter()
            .zip(&mut self.to_later)
            .map(|(radio, links)| PairTurn {
                links: std::mem::take(links),
                witnesses: std::mem::take(&mut self.witnesses[radio.slot]),
                apart: None,
            })
            .collect();
        if self.config.fading {
            self.shadows.fill(&self.field, &self.config, radios);
        }
        let bounds: Vec<Bounds> = radios
            .iter()
            .map(|radio| Bounds::about(radio.antenna.position_m, 0.0))
            .collect();
        let index = Grid::new(&bounds, 0.25 * self.config.range_m);
        for (axis, column) in self.places_m.iter_mut().enumerate() {
            column.clear();
            column.extend(radios.iter().map(|Radio { antenna, .. }| match axis {
                2 => antenna.z_m,
                _ => antenna.position_m[axis],
            }));
        }
        let this = &*self;
        let threads = this.config.threads as usize;
        parallel::for_each_with(threads, &mut turns, PairRoom::default, |room, first, turn| {
            this.near(&tick, &index, first, turn, room);
            this.obstruct(&tick, first, turn, room);
            if this.config.fading {
                this.path.run(ShadowedPairs {
                    shadows: &this.shadows,
                    first,
                    pairs: &room.pairs,
                    normals: &mut room.terms.normal,
                });
            } else {
                room.terms.normal.resize(room.pairs.len(), 0.0);
            }
            this.link(&tick, first, turn, room);
        });
        let apart = (0..).zip(&turns).filter_map(|(first, turn): (usize, &PairTurn)| {
            let place = |radio: usize| radios[radio].antenna.position_m;
            turn.apart.map(|(_, second)| [place(first), place(second as usize)])
        });
        self.strips.grow(tick.obstacles, apart);
        for ((turn, links), radio) in turns.into_iter().zip(&mut self.to_later).zip(radios) {
            *links = turn.links;
            self.witnesses[radio.slot] = turn.witnesses;
        }
        links.fill(&self.to_later);
    }

    /// Pairs of the radio `first` with those after it that are in range and of which one sends, ascending.
    fn near(&self, tick: &RadioTick, index: &Grid, first: usize, turn: &PairTurn, room: &mut PairRoom) {
        let (sends, a) = (tick.sends[first], &tick.radios[first].antenna);
        // A bit for each radio is cheaper than sorting.
        room.near.clear();
        room.near.resize(tick.radios.len().div_ceil(64), 0);
        index.visit_near(&Bounds::about(a.position_m, self.config.range_m), |numbers| {
            for number in numbers.iter().map(|number| *number as usize) {
                room.near[number / 64] |= u64::from(number > first) << (number % 64);
            }
        });
        room.terms.clear();
        room.kept.clear();
        // Each radio nearby is written, and stays if it is in range: one in four is not, so a branch would often be wrong.
        let most = room.near.iter().map(|word| word.count_ones() as usize).sum();
        room.pairs.resize(most, RadioPair::NONE);
        room.terms.flat2_m2.resize(most, 0.0);
        room.terms.height_m.resize(most, 0.0);
        let [xs, ys, zs] = &self.places_m;
        let (x, y, z) = (a.position_m[0], a.position_m[1], a.z_m);
        let range2_m2 = self.config.range_m * self.config.range_m;
        let mut count = 0;
        let mut before = turn.witnesses.iter().peekable();
        for (place, mut word) in room.near.iter().copied().enumerate() {
            while word != 0 {
                let second = 64 * place + word.trailing_zeros() as usize;
                word &= word - 1;
                if !sends && !tick.sends[second] {
                    // What is known of it is kept.
                    let slot = tick.radios[second].slot;
                    while before.next_if(|witness| (witness.slot as usize) < slot).is_some() {}
                    room.kept
                        .extend(before.next_if(|witness| witness.slot as usize == slot));
                    continue;
                }
                let [dx, dy] = [xs[second] - x, ys[second] - y];
                let flat2_m2 = dx * dx + dy * dy;
                room.pairs[count] = RadioPair {
                    second: second as u32,
                    between: LinkObstruction::CLEAR,
                };
                room.terms.flat2_m2[count] = flat2_m2;
                room.terms.height_m[count] = zs[second] - z;
                count += usize::from(flat2_m2 <= range2_m2);
            }
        }
        room.pairs.truncate(count);
        room.terms.flat2_m2.truncate(count);
        room.terms.height_m.truncate(count);
    }

    /// Finds what is between the radios of each pair.
    fn obstruct(&self, tick: &RadioTick, first: usize, turn: &mut PairTurn, room: &mut PairRoom) {
        let a = &tick.radios[first].antenna;
        let mut before = turn.witnesses.iter().peekable();
        let PairRoom {
            pairs,
            terms,
            kept,
            found,
            ..
        } = room;
        let mut kept = kept.iter().peekable();
        found.clear();
        for (pair, flat2_m2) in pairs.iter_mut().zip(&terms.flat2_m2) {
            let Radio { slot, antenna: b, .. } = &tick.radios[pair.second as usize];
            while let Some(witness) = kept.next_if(|witness| (witness.slot as usize) < *slot) {
                found.push(*witness);
            }
            while before.next_if(|witness| (witness.slot as usize) < *slot).is_some() {}
            if let Some(shared) = self.strips.shared(first, pair.second as usize) {
                let top_m = self.strips.highest_vehicle_m(&shared, tick.obstacles, a, b);
                pair.between = LinkObstruction::behind(top_m, a, b);
                continue;
            }
            let known = before.next_if(|witness| witness.slot as usize == *slot);
            let wall = known
                .and_then(|witness| tick.obstacles.wall_beside(witness.wall, a, b))
                .or_else(|| tick.obstacles.wall_between(a, b));
            pair.between = match wall {
                Some(wall) => {
                    found.push(Witness {
                        slot: *slot as u32,
                        wall,
                    });
                    LinkObstruction {
                        state: LinkState::Building,
                        above: [true; 2],
                    }
                }
                None => {
                    if turn.apart.is_none_or(|(farthest2_m2, _)| *flat2_m2 > farthest2_m2) {
                        turn.apart = Some((*flat2_m2, pair.second));
                    }
                    tick.obstacles.vehicles_between(a, b)
                }
            };
        }
        found.extend(kept);
        std::mem::swap(&mut turn.witnesses, found);
    }

    /// Makes links of the pairs that count.
    fn link(&self, tick: &RadioTick, first: usize, turn: &mut PairTurn, room: &mut PairRoom) {
        let a = &tick.radios[first];
        let PairRoom { pairs, terms, .. } = room;
        let state = |pair: &RadioPair| pair.between.state as usize;
        let [at_1_m_dbm, decade_db, shadowing_db] = &self.terms_of_states;
        terms
            .at_1_m_dbm
            .extend(pairs.iter().map(|pair| at_1_m_dbm[state(pair)]));
        terms.decade_db.extend(pairs.iter().map(|pair| decade_db[state(pair)]));
        terms
            .shadowing_db
            .extend(pairs.iter().map(|pair| shadowing_db[state(pair)]));
        terms.vehicles_db.resize(pairs.len(), 0.0);
        terms.behind.resize(pairs.len(), 0.0);
        for (place, pair) in pairs.iter().enumerate() {
            if pair.between.state == LinkState::Vehicles {
                let b = &tick.radios[pair.second as usize];
                [terms.vehicles_db[place], terms.behind[place]] = self.behind_vehicles(a, b, pair.between);
            }
        }
        self.path.run(LinkPowers {
            terms,
            least_dbm: self.least_dbm,
        });
        // As above: two of three pairs do not count.
        turn.links.resize(pairs.len(), MediumLink::NONE);
        let mut count = 0;
        for (place, (pair, power_mw)) in pairs.iter().zip(&terms.power_mw).enumerate() {
            let mut power_mw = *power_mw;
            if power_mw.is_nan() {
                let b = &tick.radios[pair.second as usize];
                let distance_m = (terms.flat2_m2[place] + terms.height_m[place].powi(2)).sqrt();
                let power_dbm = self.power_dbm([a, b], pair.between, distance_m, || terms.normal[place]);
                power_mw = power_dbm.map_or(0.0, |power_dbm| milliwatts(power_dbm) as f32);
            }
            let twice_shape = match self.config.fading {
                true => terms.twice_shape[place],
                false => 0,
            };
            turn.links[count] = MediumLink {
                radio: pair.second,
                power_mw,
                twice_shape,
            };
            count += usize::from(power_mw != 0.0);
        }
        turn.links.truncate(count);
    }

    /// Loss of a link behind vehicles with its random part, without what distance adds, dB; and 1 if distance adds to it, else 0.
    fn behind_vehicles(&self, a: &Radio, b: &Radio, between: LinkObstruction) -> [f64; 2] {
        let [mean_db, std_db] = vehicle_loss_db(between.above, 1.0);
        let behind = if std_db > 0.0 { 1.0 } else { 0.0 };
        [mean_db + std_db * self.blocking(a, b), behind]
    }

    /// Standard normal number of the loss of a link behind vehicles.
    fn blocking(&self, a: &Radio, b: &Radio) -> f64 {
        let key = LinkKey {
            sender: a.station,
            receiver: b.station,
            message: 0,
        };
        match self.config.fading {
            true => f64::from(self.random.normals(key, RadioDraw::Blocking, 0)[0]),
            false => 0.0,
        }
    }

    /// Power of a link, dBm, if it counts. `shadowing` is its standard normal number.
    fn power_dbm(
        &self,
        [a, b]: [&Radio; 2],
        between: LinkObstruction,
        distance_m: f64,
        shadowing: impl FnOnce() -> f64,
    ) -> Option<f64> {
        let mut power_dbm = self.config.power_dbm - path_loss_db(self.config.path_loss, between.state, distance_m);
        if self.config.fading {
            // What four standard deviations of shadowing cannot lift above it does not count.
            let std_db = shadowing_std_db(between.state);
            if power_dbm + 4.0 * std_db < self.least_dbm {
                return None;
            }
            power_dbm += std_db * shadowing();
        }
        if between.state == LinkState::Vehicles {
            let [mean_db, std_db] = vehicle_loss_db(between.above, distance_m);
            power_dbm -= (mean_db + std_db * self.blocking(a, b)).max(0.0);
        }
        (power_dbm >= self.least_dbm).then_some(power_dbm)
    }
}

#[cfg(test)]
mod tests {
    use ipc_schema::{config::Config, world::VehicleState};
    use sim_core::scene::{Prism, Road, Scene, SolidClass};

    use super::*;
    use crate::radio::noise_dbm;

    fn house(x_m: f64, y_m: f64) -> Prism {
        let outline = vec![
            [x_m, y_m],
            [x_m + 30.0, y_m],
            [x_m + 30.0, y_m + 30.0],
            [x_m, y_m + 30.0],
        ];
        Prism::new("house".into(), SolidClass::Building, outline, 0.0, 9.0).unwrap()
    }

    fn car(number: u32, tick: u32) -> VehicleState {
        let [x, y, heading] = [37.0, 61.0, 1.7].map(|step| f64::from(number) * step);
        let moved = f64::from(tick) * 1.3;
        VehicleState {
            x_m: x.rem_euclid(400.0) + moved * heading.cos(),
            y_m: y.rem_euclid(400.0) + moved * heading.sin(),
            yaw_rad: heading,
            length_m: 9.5,
            width_m: 2.4,
            height_m: if number.is_multiple_of(5) { 3.5 } else { 1.5 },
            vehicle: number,
            ..VehicleState::default()
        }
    }

    /// A link by itself: from both of its ends, without memory, with the sum of waves of its own.
    fn oracle(computer: &LinkComputer, obstacles: &Obstacles, a: &Radio, b: &Radio) -> Option<f64> {
        let offset = [0, 1].map(|axis: usize| b.antenna.position_m[axis] - a.antenna.position_m[axis]);
        let flat2 = offset[0] * offset[0] + offset[1] * offset[1];
        if flat2 > computer.config.range_m * computer.config.range_m {
            return None;
        }
        let between = obstacles.between(&a.antenna, &b.antenna);
        let decorrelation = decorrelation_m(computer.config.path_loss, between.state);
        let distance_m = (flat2 + (b.antenna.z_m - a.antenna.z_m).powi(2)).sqrt();
        let normal = || {
            computer
                .field
                .normal(a.antenna.position_m, b.antenna.position_m, decorrelation)
        };
        computer.power_dbm([a, b], between, distance_m, normal)
    }

    #[test]
    fn links_are_those_of_each_pair_by_itself_for_any_number_of_threads() {
        let mut config = Config::from_json(include_str!("../../../ipc-schema/tests/town.json")).unwrap();
        config.v2x.range_m = 250.0;
        let houses = (0..36)
            .map(|place| house(f64::from(place % 6) * 70.0, f64::from(place / 6) * 70.0))
            .collect();
        let scene = Scene::new(Road::default(), houses, Vec::new());
        let mut obstacles = Obstacles::new(&scene);
        let medium = Medium::new(noise_dbm(9.0), -85.0, 100_000_000);
        let computer = |threads| {
            let mut config = config.v2x.clone();
            config.threads = threads;
            LinkComputer::new(&config, &medium, RadioRandom::new(4))
        };
        let (mut alone, mut together) = (computer(1), computer(3));
        let mut states = [0; 3];
        for tick in 0..40 {
            let cars: Vec<VehicleState> = (0..90).map(|number| car(number, tick)).collect();
            obstacles.update(&cars);
            // Stations without a radio come and go.
            let radios: Vec<Radio> = (0_u32..90)
                .filter(|number| !(number + tick).is_multiple_of(7))
                .map(|number| Radio {
                    slot: number as usize,
                    station: 1000 + number,
                    antenna: Antenna {
                        position_m: obstacles.bodies()[number as usize].centre_m,
                        z_m: 1.6,
                        row: number,
                    },
                })
                .collect();
            let sends: Vec<bool> = (0..radios.len())
                .map(|radio| !(radio + tick as usize).is_multiple_of(3))
                .collect();
            let radio_tick = RadioTick {
                radios: &radios,
                sends: &sends,
                obstacles: &obstacles,
            };
            let [mut found, mut same] = [RadioLinks::default(), RadioLinks::default()];
            alone.enter(&obstacles, &radios);
            together.enter(&obstacles, &radios);
            alone.links(radio_tick, &mut found);
            together.links(radio_tick, &mut same);
            assert_eq!(found, same);
            for sender in 0..radios.len() {
                let links = found.of(sender as u32);
                let expected: Vec<(u32, f64)> = (0..radios.len())
                    .filter(|receiver| (sends[sender] || sends[*receiver]) && *receiver != sender)
                    .filter_map(|receiver| {
                        let (low, high) = (&radios[sender.min(receiver)], &radios[sender.max(receiver)]);
                        let state = obstacles.between(&low.antenna, &high.antenna).state;
                        states[state as usize] += 1;
                        Some((receiver as u32, oracle(&alone, &obstacles, low, high)?))
                    })
                    .collect();
                let numbers: Vec<u32> = links.iter().map(|link| link.radio).collect();
                assert_eq!(numbers, expected.iter().map(|(radio, _)| *radio).collect::<Vec<_>>());
                for (link, (_, power_dbm)) in links.iter().zip(expected) {
                    assert_eq!(link.power_mw, milliwatts(power_dbm) as f32);
                }
            }
        }
        assert!(states.iter().all(|count| *count > 1000), "{states:?}");
    }
}
