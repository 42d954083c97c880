//! What SUMO's road users do about heroes that stand: vehicles pass them, people wait beside them.

use super::{passing::HeroPassing, standing::StandingHeroes, waiting::WaitingPeople};
use crate::sumo::{Sumo, error::SumoError, frame::TrafficFrame};

/// All of it in one episode. Without heroes that stand no call is made.
#[derive(Debug, Default)]
pub struct AroundHeroes {
    standing: StandingHeroes,
    passing: HeroPassing,
    waiting: WaitingPeople,
}

impl AroundHeroes {
    /// Looks at a step, and changes what SUMO's road users do in the next.
    ///
    /// # Errors
    /// SUMO refuses.
    pub fn update(&mut self, sumo: &mut Sumo, frame: &TrafficFrame) -> Result<(), SumoError> {
        self.standing.update(frame);
        self.passing.update(sumo, frame, &self.standing)?;
        self.waiting.update(sumo, frame, &self.standing)
    }
}
