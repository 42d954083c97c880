//! Places that commands give: where a vehicle of the population starts anew, and where it goes.

use ipc_schema::control::{Refusal, RefusalKind};

use crate::{
    error::SumoError,
    fleet::HERO_PREFIX,
    population::Population,
    session::{Session, called},
};

/// What became of a command: in words what happens, or why nothing does.
pub(crate) type Outcome = Result<String, Refusal>;

impl Population {
    /// Lets the vehicle `id` leave and a successor start from `edge`, to the same destination; a hero only does so next time.
    ///
    /// # Errors
    /// SUMO refuses what it cannot refuse.
    pub(crate) fn place_start(
        &mut self,
        session: &mut Session,
        id: &str,
        edge: &str,
        step: u64,
    ) -> Result<Outcome, SumoError> {
        let (place, road) = match self.find(id, edge) {
            Ok(found) => found,
            Err(refusal) => return Ok(Err(refusal)),
        };
        if id.starts_with(HERO_PREFIX) {
            self.drivers[place].placed.start = Some(road);
            return Ok(Ok(format!("{id} starts from {edge} when it departs next")));
        }
        called("remove a vehicle", session.sumo_mut().remove_vehicle(id))?;
        let driver = &mut self.drivers[place];
        driver.placed.start = Some(road);
        driver.placed.goal = Some(driver.goal);
        self.fill(session, place, step)?;
        let successor = &self.drivers[place].id;
        Ok(Ok(format!("{id} leaves, {successor} starts from {edge}")))
    }

    /// Leads the vehicle `id` to `edge`; a hero only goes there next time.
    pub(crate) fn place_destination(&mut self, session: &mut Session, id: &str, edge: &str) -> Outcome {
        let (place, road) = self.find(id, edge)?;
        let driver = &mut self.drivers[place];
        if id.starts_with(HERO_PREFIX) {
            driver.placed.goal = Some(road);
            return Ok(format!("{id} goes to {edge} when it departs next"));
        }
        let route_edges = session
            .sumo_mut()
            .set_destination(id, edge)
            .map_err(|error| Refusal::new(RefusalKind::Sumo, error.what().trim()))?;
        (driver.goal, driver.route_edges) = (road, route_edges as usize);
        Ok(format!("{id} goes to {edge}"))
    }

    /// Place of the vehicle `id`, and the road that `edge` is for it.
    fn find(&self, id: &str, edge: &str) -> Result<(usize, usize), Refusal> {
        let Some(&place) = self.place_of.get(id) else {
            let message = format!("{id} is no vehicle of the population: its ids look like cav.0 and other.0");
            return Err(Refusal::new(RefusalKind::UnknownVehicle, message));
        };
        let driver = &self.drivers[place];
        if driver.is_on_a_given_way() {
            let message = format!("{id} drives along traffic.hero_route, which the configuration gives");
            return Err(Refusal::new(RefusalKind::Unsupported, message));
        }
        match driver.roads.find(edge) {
            Some(road) => Ok((place, road)),
            None => Err(Refusal::new(
                RefusalKind::UnknownEdge,
                format!("{edge} is no edge from which {id} can drive everywhere and back"),
            )),
        }
    }
}
