//! Links between the radios of a tick. Both directions of a link are the same, so each pair of radios is computed once.

use ipc_schema::config::V2xConfig;
use sim_core::scene::{Grid, shape::Bounds};

use super::{
    fading,
    medium::{Medium, MediumLink},
    milliwatts,
    obstruction::{Antenna, LinkObstruction, Obstacles},
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

/// A building that was between two slots when they were last looked at: it is tried first, because it mostly still is.
#[derive(Debug, Clone, Copy)]
struct Witness {
    /// The later slot.
    slot: usize,
    building: u32,
}

/// The waves of shadowing at a radio, as either end of a link, in and out of a clear line of sight.
struct RadioShadows {
    clear: [ShadowingEnd; 2],
    obstructed: [ShadowingEnd; 2],
}

impl RadioShadows {
    fn new(field: &ShadowingField, config: &V2xConfig, position_m: [f64; 2]) -> Self {
        let ends = |state| {
            let decorrelation = decorrelation_m(config.path_loss, state);
            [
                field.first_end(position_m, decorrelation),
                field.second_end(position_m, decorrelation),
            ]
        };
        Self {
            clear: ends(LinkState::Clear),
            obstructed: ends(LinkState::Building),
        }
    }

    /// A standard normal number for the link from this first radio to a second one.
    fn normal(&self, second: &Self, state: LinkState) -> f64 {
        match state {
            LinkState::Clear => self.clear[0].normal(&second.clear[1]),
            LinkState::Vehicles | LinkState::Building => self.obstructed[0].normal(&second.obstructed[1]),
        }
    }
}

/// Computes the links of an episode, tick by tick.
pub struct LinkComputer {
    config: V2xConfig,
    random: RadioRandom,
    field: ShadowingField,
    /// Power below which a link does not count, dBm.
    least_dbm: f64,
    /// By slot, ascending by the later slot.
    witnesses: Vec<Vec<Witness>>,
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
            witnesses: Vec::new(),
        }
    }

    /// Links of every radio that sends, ascending by receiver; none of the others.
    pub fn links(&mut self, tick: RadioTick) -> Vec<Vec<MediumLink>> {
        let RadioTick { radios, sends, .. } = tick;
        let most = radios.last().map_or(0, |radio| radio.slot + 1);
        self.witnesses.resize_with(self.witnesses.len().max(most), Vec::new);
        let mut turns: Vec<PairTurn> = radios
            .iter()
            .map(|radio| PairTurn {
                links: Vec::new(),
                witnesses: std::mem::take(&mut self.witnesses[radio.slot]),
            })
            .collect();
        let shadows = self.shadows(radios);
        let bounds: Vec<Bounds> = radios
            .iter()
            .map(|radio| Bounds::about(radio.antenna.position_m, 0.0))
            .collect();
        let index = Grid::new(&bounds, 0.5 * self.config.range_m);
        let this = &*self;
        parallel::for_each(this.config.threads as usize, &mut turns, |first, turn| {
            let near = Bounds::about(radios[first].antenna.position_m, this.config.range_m);
            let seconds = ascending_after(first, radios.len(), |visit| index.visit_near(&near, visit));
            this.pairs(&tick, &shadows, first, seconds, turn);
        });
        // By radio: first those before it, then those after it.
        let mut links: Vec<Vec<MediumLink>> = vec![Vec::new(); radios.len()];
        for (first, turn) in turns.into_iter().enumerate() {
            for link in &turn.links {
                if sends[link.radio as usize] {
                    links[link.radio as usize].push(MediumLink {
                        radio: first as u32,
                        ..*link
                    });
                }
            }
            if sends[first] {
                links[first].extend(turn.links);
            }
            self.witnesses[radios[first].slot] = turn.witnesses;
        }
        links
    }

    /// The waves at every radio; none if the channel does not fade.
    fn shadows(&self, radios: &[Radio]) -> Vec<RadioShadows> {
        if !self.config.fading {
            return Vec::new();
        }
        let shadows = radios.iter().map(|radio| radio.antenna.position_m);
        shadows
            .map(|position_m| RadioShadows::new(&self.field, &self.config, position_m))
            .collect()
    }

    /// Pairs of the radio `first` with `seconds`, ascending.
    fn pairs(
        &self,
        tick: &RadioTick,
        shadows: &[RadioShadows],
        first: usize,
        seconds: impl Iterator<Item = usize>,
        turn: &mut PairTurn,
    ) {
        let before = std::mem::take(&mut turn.witnesses);
        let mut before = before.iter().peekable();
        let a = &tick.radios[first];
        for second in seconds {
            let b = &tick.radios[second];
            while before.next_if(|witness| witness.slot < b.slot).is_some() {}
            let known = before.next_if(|witness| witness.slot == b.slot);
            if !tick.sends[first] && !tick.sends[second] {
                turn.witnesses.extend(known);
                continue;
            }
            let [dx, dy] = [0, 1].map(|axis: usize| b.antenna.position_m[axis] - a.antenna.position_m[axis]);
            if dx * dx + dy * dy > self.config.range_m * self.config.range_m {
                continue;
            }
            let building = known
                .map(|witness| witness.building)
                .filter(|building| tick.obstacles.building_meets(*building, &a.antenna, &b.antenna))
                .or_else(|| tick.obstacles.building_between(&a.antenna, &b.antenna));
            let between = match building {
                Some(building) => {
                    turn.witnesses.push(Witness { slot: b.slot, building });
                    LinkObstruction {
                        state: LinkState::Building,
                        above: [true; 2],
                    }
                }
                None => tick.obstacles.vehicles_between(&a.antenna, &b.antenna),
            };
            let distance_m = (dx * dx + dy * dy + (b.antenna.z_m - a.antenna.z_m).powi(2)).sqrt();
            let normal = || shadows[first].normal(&shadows[second], between.state);
            if let Some(power_dbm) = self.power_dbm([a, b], between, distance_m, normal) {
                turn.links.push(MediumLink {
                    radio: second as u32,
                    power_mw: milliwatts(power_dbm) as f32,
                    twice_shape: if self.config.fading {
                        fading::twice_shape(distance_m)
                    } else {
                        0
                    },
                });
            }
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
            let key = LinkKey {
                sender: a.station,
                receiver: b.station,
                message: 0,
            };
            let normal = match self.config.fading {
                true => f64::from(self.random.normals(key, RadioDraw::Blocking, 0)[0]),
                false => 0.0,
            };
            power_dbm -= (mean_db + std_db * normal).max(0.0);
        }
        (power_dbm >= self.least_dbm).then_some(power_dbm)
    }
}

/// The numbers after `first` that `visit_all` visits, ascending, each once. All are below `count`. A bit for each is cheaper than sorting.
fn ascending_after(
    first: usize,
    count: usize,
    visit_all: impl FnOnce(&mut dyn FnMut(&[u32])),
) -> impl Iterator<Item = usize> {
    let mut words = vec![0_u64; count.div_ceil(64)];
    visit_all(&mut |numbers| {
        for number in numbers.iter().map(|number| *number as usize) {
            words[number / 64] |= u64::from(number > first) << (number % 64);
        }
    });
    words.into_iter().enumerate().flat_map(|(place, mut word)| {
        std::iter::from_fn(move || {
            let bit = word.trailing_zeros();
            // Takes the lowest bit away; a word without bits has none left.
            word &= word.checked_sub(1)?;
            Some(64 * place + bit as usize)
        })
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

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
        let mut config: Config = serde_json::from_str(include_str!("../../../ipc-schema/tests/town.json")).unwrap();
        config.v2x.range_m = 250.0;
        let houses = (0..36)
            .map(|place| house(f64::from(place % 6) * 70.0, f64::from(place / 6) * 70.0))
            .collect();
        let scene = Arc::new(Scene::new(Road::default(), houses, Vec::new()));
        let mut obstacles = Obstacles::new(scene);
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
            let found = alone.links(radio_tick);
            assert_eq!(found, together.links(radio_tick));
            for (sender, links) in found.iter().enumerate() {
                let expected: Vec<(u32, f64)> = (0..radios.len())
                    .filter(|receiver| sends[sender] && *receiver != sender)
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
