//! The committed parameter sets are plausible and complete, and `docs/vehicle-model.md` shows them.

#![allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]

#[path = "common/page.rs"]
mod page;

use std::fmt::Write as _;

use ipc_schema::traffic::VEHICLE_CLASSES;
use sim_core::{
    models::dynamic::GRAVITY_MPS2,
    models::parameters::{ParameterCatalogue, ParameterSet},
};

/// A row of the table: its name, its unit, and the value for a set.
type Row = (&'static str, &'static str, fn(&ParameterSet) -> String);

const ROWS: [Row; 22] = [
    ("longest", "m", |set| set.longest_m.to_string()),
    ("length × width × height", "m", |set| {
        format!("{} × {} × {}", set.length_m, set.width_m, set.height_m)
    }),
    ("wheelbase", "m", |set| set.wheelbase_m.to_string()),
    ("rear overhang", "m", |set| set.rear_overhang_m.to_string()),
    ("mass", "kg", |set| set.mass_kg.to_string()),
    ("yaw inertia", "kg m²", |set| set.yaw_inertia_kgm2.to_string()),
    ("load on the front axle", "", |set| set.front_load_share.to_string()),
    ("height of the centre of gravity", "m", |set| {
        set.cg_height_m.to_string()
    }),
    ("cornering stiffness by load, front / rear", "1/rad", |set| {
        format!(
            "{} / {}",
            set.cornering_stiffness_front_per_rad, set.cornering_stiffness_rear_per_rad
        )
    }),
    ("understeer gradient", "° per g", |set| {
        format!("{:.1}", understeer(set))
    }),
    ("friction, dry", "", |set| set.friction.to_string()),
    ("roll", "° per g", |set| degrees_per_g(set.roll_per_mps2_rad)),
    ("roll frequency, damping", "Hz", |set| {
        format!("{}, {}", set.roll_frequency_hz, set.roll_damping_ratio)
    }),
    ("pitch", "° per g", |set| degrees_per_g(set.pitch_per_mps2_rad)),
    ("pitch frequency, damping", "Hz", |set| {
        format!("{}, {}", set.pitch_frequency_hz, set.pitch_damping_ratio)
    }),
    ("power", "kW", |set| (set.max_power_w * 1e-3).to_string()),
    ("drive / brakes in front", "", |set| {
        format!("{} / {}", set.drive_share_front, set.brake_share_front)
    }),
    ("most acceleration / deceleration", "m/s²", |set| {
        format!("{} / {}", set.max_accel_mps2, set.max_decel_mps2)
    }),
    ("drag area", "m²", |set| set.drag_area_m2.to_string()),
    ("rolling resistance by weight", "", |set| {
        set.rolling_resistance.to_string()
    }),
    ("road-wheel angle, rate", "rad, rad/s", |set| {
        format!("{}, {}", set.max_road_wheel_angle_rad, set.max_road_wheel_rate_radps)
    }),
    ("steering ratio", "", |set| set.steering_ratio.to_string()),
];

fn understeer(set: &ParameterSet) -> f64 {
    (1.0 / set.cornering_stiffness_front_per_rad - 1.0 / set.cornering_stiffness_rear_per_rad).to_degrees()
}

fn degrees_per_g(gain: f64) -> String {
    format!("{:.1}", (gain * GRAVITY_MPS2).to_degrees())
}

fn table(sets: &[ParameterSet]) -> String {
    let cells =
        |cell: &dyn Fn(&ParameterSet) -> String| sets.iter().map(|set| format!(" {} |", cell(set))).collect::<String>();
    let mut table = format!("| | unit |{}\n", cells(&|set| format!("`{}`", set.name)));
    writeln!(table, "|---|---|{}", "---|".repeat(sets.len())).unwrap();
    for (name, unit, value) in ROWS {
        writeln!(table, "| {name} | {unit} |{}", cells(&value)).unwrap();
    }
    writeln!(table, "| classes | |{}", cells(&|set| set.classes.join(", "))).unwrap();
    table
}

#[test]
fn the_page_shows_the_sets() {
    page::shows("sets", &table(ParameterCatalogue::new().unwrap().sets()));
}

#[test]
fn every_class_of_sumo_has_a_set_at_any_length() {
    let catalogue = ParameterCatalogue::new().unwrap();
    for class in VEHICLE_CLASSES {
        for length_m in [0.2, 4.0, 5.0, 12.0, 200.0] {
            assert!(catalogue.choose(class.as_bytes(), length_m).known, "{class}");
        }
    }
}

#[test]
fn nothing_oversteers_and_brakes_stay_within_the_friction_of_both_axles() {
    for set in ParameterCatalogue::new().unwrap().sets() {
        assert!(understeer(set) >= 0.0, "{}", set.name);
        // On rails the wheelbase is half the distance of the bogies.
        let apart_m = if set.kinematic { 2.0 } else { 1.0 } * set.wheelbase_m;
        let transfer = set.max_decel_mps2 * set.cg_height_m / apart_m;
        let front = set.friction * (GRAVITY_MPS2 * set.front_load_share + transfer);
        let rear = set.friction * (GRAVITY_MPS2 * (1.0 - set.front_load_share) - transfer);
        let braking = [set.brake_share_front, 1.0 - set.brake_share_front].map(|share| share * set.max_decel_mps2);
        assert!(
            braking[0] <= front && braking[1] <= rear,
            "{}: {braking:?} {front} {rear}",
            set.name
        );
    }
}

#[test]
fn every_set_is_possible() {
    for set in ParameterCatalogue::new().unwrap().sets() {
        let front_overhang_m = set.length_m - set.wheelbase_m - set.rear_overhang_m;
        // A tractor's body is its cab, which ends before the axle.
        let long_m = set.length_m.max(set.length_m - set.rear_overhang_m);
        assert!(front_overhang_m > 0.0 && long_m > set.wheelbase_m, "{}", set.name);
        // The radius of gyration lies within the body.
        let gyration_m = (set.yaw_inertia_kgm2 / set.mass_kg).sqrt();
        assert!(gyration_m > 0.1 * long_m && gyration_m < 0.5 * long_m, "{}", set.name);
        for share in [set.front_load_share, set.drive_share_front, set.brake_share_front] {
            assert!((0.0..=1.0).contains(&share), "{}", set.name);
        }
        for ratio in [set.roll_damping_ratio, set.pitch_damping_ratio] {
            assert!(ratio > 0.0 && ratio < 1.0, "{}", set.name);
        }
        assert!(set.source.len() > 200, "{}: name the sources", set.name);
    }
}
