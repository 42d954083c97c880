//! Which suites of sensors a vehicle may carry, from what SUMO says of it at its departure.

use ipc_schema::{
    config::{Config, SuiteCandidate},
    run::RunFile,
    traffic::{Kind, VehicleMeta},
    world::SUITES_SHIFT,
};

/// The rules of a run's suites.
#[derive(Debug, Clone)]
pub struct SuiteRules {
    config: Box<Config>,
    seed: u64,
}

impl SuiteRules {
    /// The rules of a run; `None` without suites.
    #[must_use]
    pub fn of_run(run: &RunFile) -> Option<Self> {
        (!run.config.suites.is_empty()).then(|| Self {
            config: Box::new(run.config.clone()),
            seed: run.seed(),
        })
    }

    /// The bits of a road user in [`ipc_schema::world::VehicleState::flags`].
    #[must_use]
    pub fn flags_of(&self, meta: &VehicleMeta) -> u32 {
        if meta.kind != Kind::Cav as u32 && meta.kind != Kind::Hero as u32 {
            return 0;
        }
        let candidate = SuiteCandidate {
            id: &meta.id_text(),
            class: &meta.class_text(),
            vehicle_type: &meta.type_text(),
        };
        self.config.suites_of(self.seed, candidate) << SUITES_SHIFT
    }
}
