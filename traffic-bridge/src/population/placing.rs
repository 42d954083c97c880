//! Starts and destinations that commands assign to vehicles of the population.

use ipc_schema::control::{Refusal, RefusalKind};

use super::Population;
use crate::sumo::{Sumo, called, connected::HERO_PREFIX, error::SumoError};

/// The outcome of a command: a text that says what happens, or the reason why nothing does.
pub(crate) type PlacementOutcome = Result<String, Refusal>;

impl Population {
    /// Removes the vehicle `id` and adds another that starts from `edge`, with the same destination. A hero starts there when it
    /// departs next.
    ///
    /// # Errors
    /// SUMO refuses a call that should always succeed.
    pub(crate) fn place_start(
        &mut self,
        sumo: &mut Sumo,
        id: &str,
        edge: &str,
        step: u64,
    ) -> Result<PlacementOutcome, SumoError> {
        let (place, road) = match self.find(id, edge) {
            Ok(found) => found,
            Err(refusal) => return Ok(Err(refusal)),
        };
        if id.starts_with(HERO_PREFIX) {
            self.drivers[place].placed.start = Some(road);
            return Ok(Ok(format!("{id} starts from {edge} when it departs next")));
        }
        called("remove a vehicle", sumo.simulation_mut().remove_vehicle(id))?;
        let driver = &mut self.drivers[place];
        driver.placed.start = Some(road);
        driver.placed.goal = Some(driver.goal);
        self.fill(sumo, place, step)?;
        let replacement = &self.drivers[place].id;
        Ok(Ok(format!("{id} leaves, {replacement} starts from {edge}")))
    }

    /// Routes the vehicle `id` to `edge`. A hero goes there when it departs next.
    pub(crate) fn place_destination(&mut self, sumo: &mut Sumo, id: &str, edge: &str) -> PlacementOutcome {
        let (place, road) = self.find(id, edge)?;
        let driver = &mut self.drivers[place];
        if id.starts_with(HERO_PREFIX) {
            driver.placed.goal = Some(road);
            return Ok(format!("{id} goes to {edge} when it departs next"));
        }
        let route_edges = sumo
            .simulation_mut()
            .set_destination(id, edge)
            .map_err(|error| Refusal::new(RefusalKind::Sumo, error.what().trim()))?;
        (driver.goal, driver.route_edges) = (road, route_edges as usize);
        Ok(format!("{id} goes to {edge}"))
    }

    /// Place of the vehicle `id`, and the road that `edge` is for it.
    fn find(&self, id: &str, edge: &str) -> Result<(usize, usize), Refusal> {
        let Some(&place) = self.place_of.get(id) else {
            let message = format!("{id} is not a vehicle of the population: its ids look like cav.0 and other.0");
            return Err(Refusal::new(RefusalKind::UnknownVehicle, message));
        };
        let driver = &self.drivers[place];
        if driver.has_given_route() {
            let message = format!("{id} drives along `traffic.hero_route` of the configuration");
            return Err(Refusal::new(RefusalKind::Unsupported, message));
        }
        match driver.roads.find(edge) {
            Some(road) => Ok((place, road)),
            None => Err(Refusal::new(
                RefusalKind::UnknownEdge,
                format!("{edge} is not an edge from which {id} can drive to every other edge and back"),
            )),
        }
    }
}
