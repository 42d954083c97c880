//! Once all road users have appeared, a tick of the mirror allocates nothing, however many there are.

#![allow(
    unsafe_code,
    clippy::unwrap_used,
    reason = "counting allocations takes an allocator; tests assert by unwrapping"
)]

#[path = "common/preset.rs"]
mod preset;

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
};

use ipc_schema::{
    config,
    header::MessageHeader,
    traffic::{Kind, MetaEvent, TrafficState, VehicleMeta},
};
use sim_core::mirror::{Mirror, MirrorSettings};

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

/// The system's allocator, counting the allocations of this thread.
struct Counting;

// SAFETY: all calls go to the system's allocator unchanged; the counter neither allocates nor unwinds.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const VEHICLES: u32 = 300;
const STEP_S: f64 = 0.3;

fn meta(vehicle: u32) -> VehicleMeta {
    let mut meta: VehicleMeta = bytemuck::Zeroable::zeroed();
    let kind = [Kind::Cav, Kind::Other, Kind::Person][vehicle as usize % 3];
    (meta.vehicle, meta.kind, meta.event) = (vehicle, kind as u32, MetaEvent::Departed as u32);
    meta.vehicle_class[..9].copy_from_slice(b"passenger");
    (meta.length_m, meta.width_m, meta.height_m) = (4.5, 1.8, 1.5);
    meta.set_id(&vehicle.to_string());
    meta
}

fn state(vehicle: u32, step: u32) -> TrafficState {
    TrafficState {
        front_x_m: 12.0 * STEP_S * f64::from(step),
        front_y_m: 5.0 * f64::from(vehicle),
        speed_mps: 12.0,
        vehicle,
        kind: meta(vehicle).kind,
        ..TrafficState::default()
    }
}

#[test]
fn a_tick_allocates_nothing() {
    let settings = MirrorSettings {
        vehicle: preset::town().vehicle,
        surface: config::Surface::Dry,
        tick_s: 0.1,
        sub_steps: 10,
        ticks_per_step: 3,
        hero_driver: config::HeroDriver::Actions,
        suites: None,
        wheel_slip: false,
        most_trailing: 100,
    };
    let mut mirror = Mirror::new(settings).unwrap();
    let metas: Vec<VehicleMeta> = (0..VEHICLES).map(meta).collect();
    mirror.apply_meta(&MessageHeader::default(), &metas).unwrap();
    let mut payload = Vec::new();
    for step in 0..20 {
        let states: Vec<TrafficState> = (0..VEHICLES).map(|vehicle| state(vehicle, step)).collect();
        let before = ALLOCATIONS.get();
        mirror.accept(&MessageHeader::default(), &states).unwrap();
        let accepted = ALLOCATIONS.get() - before;
        for tick in 0..3 {
            payload.clear();
            payload.resize(mirror.layout(tick).len.div_ceil(16), 0_u128);
            let before = ALLOCATIONS.get();
            mirror.write_tick(tick, bytemuck::cast_slice_mut(&mut payload)).unwrap();
            let written = ALLOCATIONS.get() - before;
            // The first steps grow the buffers.
            assert!(
                step < 2 || accepted + written == 0,
                "step {step}: {accepted} + {written}"
            );
        }
    }
    assert!(ALLOCATIONS.get() > 0, "nothing was counted");
}
