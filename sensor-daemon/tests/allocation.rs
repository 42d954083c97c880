//! Once all road users have appeared, a tick of the sensors allocates no memory, for any number of them.

#![allow(
    unsafe_code,
    clippy::unwrap_used,
    reason = "counting allocations needs an allocator; tests assert by unwrapping"
)]

mod common;

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
    sync::Arc,
};

use ipc_schema::{
    header::{FIRST_OF_EPISODE, MessageHeader},
    observation::ObservationLayout,
    world::SubStep,
};
use sensor_daemon::{
    sensing::{Sensing, WorldTick},
    sensors::ultrasonic::UltrasonicSampling,
};
use sim_core::scene::{Prism, Scene, SolidClass};

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

/// The system's allocator, which counts the allocations of this thread.
struct Counting;

// SAFETY: all calls are forwarded unchanged to the system's allocator; the counter neither allocates nor unwinds.
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

const SUB_STEPS: usize = 10;

#[test]
fn a_tick_allocates_nothing() {
    let mut config = common::config();
    config.observation.history = 2;
    config.gnss.correlated_std_m = [1.0; 3];
    config.imu.period_s = 0.01;
    config.ultrasonic.vehicles = 100;
    let corners = vec![[40.0, 81.0], [160.0, 81.0], [160.0, 90.0], [40.0, 90.0]];
    let house = Prism::new("house".into(), SolidClass::Building, corners, 0.0, 6.0).unwrap();
    let scene = Arc::new(Scene::new(Default::default(), vec![house], Vec::new()));
    let mut ultrasonic = UltrasonicSampling::new(&config, &[scene]);
    let mut sensing = Sensing::new(&config, &common::map()).unwrap();
    let states = common::cavs(300);
    let sub_steps = vec![SubStep::default(); states.len() * SUB_STEPS];
    let world = WorldTick {
        states: &states,
        bodies: &states,
        sub_steps: &sub_steps,
        views: &[],
    };
    let mut payload = Vec::new();
    for tick in 0..20_u64 {
        let header = MessageHeader {
            flags: if tick == 0 { FIRST_OF_EPISODE } else { 0 },
            tick,
            sim_time_ns: (tick + 1) * 100_000_000,
            ..MessageHeader::default()
        };
        let layout = ObservationLayout::new(states.len(), sensing.width(), sensing.imu_samples());
        payload.clear();
        payload.resize(layout.len.div_ceil(8), 0_u64);
        let before = ALLOCATIONS.get();
        sensing.assign(&header, &states).unwrap();
        ultrasonic.sample(&header, &states, &mut sensing);
        sensing
            .observe(&header, &world, bytemuck::cast_slice_mut(&mut payload))
            .unwrap();
        let allocated = ALLOCATIONS.get() - before;
        // The first ticks may grow buffers.
        assert!(tick < 2 || allocated == 0, "tick {tick}: {allocated}");
    }
    assert!(ALLOCATIONS.get() > 0, "nothing was counted");
}
