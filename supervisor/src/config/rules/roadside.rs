//! Rules of roadside units: each has a name of its own, a range where it perceives, and receivers.

use std::collections::BTreeSet;

use ipc_schema::config::{Config, RoadsideService};

use super::{ConfigError, LayeredSettings, conflict, conflict_in_entry};

const LIST: &str = "v2x.roadside";

pub(super) fn check(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    let units = &config.v2x.roadside;
    if units.is_empty() {
        return Ok(());
    }
    if !config.v2x.is_on() {
        let message = format!("`{LIST}` has {} units, but no road user has a radio", units.len());
        let help = "set v2x.share above 0, or leave the units out".into();
        return Err(conflict(settings, LIST, message, help));
    }
    if config.curriculum.maps.len() > 1 {
        let message = format!("`{LIST}` are places on one map, and `curriculum.maps` has several");
        let help = "leave the units out, or train on one map".into();
        return Err(conflict(settings, LIST, message, help));
    }
    let mut names = BTreeSet::new();
    for (index, unit) in units.iter().enumerate() {
        let number = index + 1;
        let refuse = |key: &str, message: String, help: &str| {
            let place = (LIST, index, key);
            Err(conflict_in_entry(settings, place, message, help.into()))
        };
        if unit.id.is_empty() || !names.insert(&unit.id) {
            let message = format!(
                "unit {number} of `{LIST}` has the id \"{}\", which is empty or taken",
                unit.id
            );
            return refuse("v2x.roadside.id", message, "give each unit an id of its own");
        }
        if unit.services.is_some() && unit.offers(RoadsideService::Cpm) && unit.range_m() == 0.0 {
            let message = format!(
                "unit {number} of `{LIST}`, \"{}\", sends CPMs, but perceives nothing",
                unit.id
            );
            return refuse(
                "v2x.roadside.services",
                message,
                "give it a `range_m`, or leave \"cpm\" out",
            );
        }
    }
    Ok(())
}
