//! The cost of the exchange.

use std::time::Instant;

use ipc_schema::{config::Config, usage};

use crate::street::{BIN_M, DeliveredShare, NeighboursBlock, StreetRun, count};

/// Simulated seconds that are measured, after one that is not.
const SECONDS: u64 = 5;

/// FNV-1a over bytes.
fn hash(before: u64, bytes: &[u8]) -> u64 {
    bytes.iter().fold(before, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01B3)
    })
}

fn measure(stations: usize, perception_range_m: f64, threads: u32) {
    let mut config = Config::from_json(include_str!("../../../../ipc-schema/tests/town.json")).unwrap();
    config.v2x.share = 1.0;
    config.v2x.threads = threads;
    config.v2x.perception_range_m = perception_range_m;
    let mut run = StreetRun::new(stations, &config);
    let mut obstacles = run.obstacles();
    let mut bins = [[DeliveredShare::default(); 10]; 3];
    let (mut work_s, mut wall_s, mut load, mut age_s, mut known) = (0.0, 0.0, 0.0, Vec::new(), 0_u64);
    let mut blocks = 0xCBF2_9CE4_8422_2325;
    let mut before = run.exchange.counts();
    for tick in 0..(SECONDS + 1) * 10 {
        let mut street = run.tick(tick, |_| [0.0; 2], 1.0);
        let (start_s, start) = (usage::processor_time_s(), Instant::now());
        run.exchange(&mut street);
        let took_s = usage::processor_time_s() - start_s;
        let passed_s = start.elapsed().as_secs_f64();
        let NeighboursBlock {
            objects,
            ids,
            radio,
            channel_load,
            ..
        } = &street.block;
        blocks = hash(blocks, bytemuck::cast_slice(objects));
        blocks = hash(blocks, bytemuck::cast_slice(ids));
        blocks = hash(blocks, bytemuck::cast_slice(radio));
        blocks = hash(blocks, bytemuck::cast_slice(channel_load));
        if tick < 10 {
            before = run.exchange.counts();
            continue;
        }
        work_s += took_s;
        wall_s += passed_s;
        load += channel_load.iter().map(|load| f64::from(*load)).sum::<f64>() / stations as f64;
        let rows = objects.iter().zip(ids).filter(|(_, ids)| ids[2] != 0);
        age_s.extend(rows.map(|(numbers, _)| numbers[7]));
        known += radio.iter().map(|radio| u64::from(radio[1])).sum::<u64>();
        // Delivery is counted outside the measured time.
        if tick % 10 == 0 {
            obstacles.update(&street.states);
            count(&run.exchange, &obstacles, &street.states, &mut bins);
        }
    }
    let counts = run.exchange.counts();
    let per_s = |count: u64| count as f64 / SECONDS as f64;
    let links = counts.links - before.links;
    age_s.sort_unstable_by(f32::total_cmp);
    let share = |share: f64| age_s[((age_s.len() - 1) as f64 * share) as usize];
    println!(
        "{stations} stations, {} with {threads} thread(s): {:.2} ms of processor time and {:.2} ms per simulated second ({:.1} x real time), {:.0} links/s, {:.0} ns a link; hash {blocks:016x}",
        if perception_range_m > 0.0 { "CAM and CPM" } else { "CAM" },
        1e3 * work_s / SECONDS as f64,
        1e3 * wall_s / SECONDS as f64,
        SECONDS as f64 / wall_s,
        per_s(links),
        1e9 * work_s / links as f64,
    );
    println!(
        "  {:.1} CAM/s and {:.1} CPM/s a station, {:.0} bytes a message, {} dropped; channel busy ratio {:.3}; age of a listed object \
         median {:.2} s, 95 % {:.2} s; {:.1} objects known",
        per_s(counts.cams - before.cams) / stations as f64,
        per_s(counts.cpms - before.cpms) / stations as f64,
        (counts.bytes - before.bytes) as f64 / (counts.cams + counts.cpms - before.cams - before.cpms) as f64,
        counts.dropped - before.dropped,
        load / (SECONDS * 10) as f64,
        share(0.5),
        share(0.95),
        known as f64 / (SECONDS * 10) as f64 / stations as f64,
    );
    for (name, bins) in ["line of sight", "behind vehicles", "behind houses"].iter().zip(bins) {
        let shares: Vec<String> = bins
            .iter()
            .map(|bin| match bin.sent {
                0 => "-".into(),
                sent => format!("{:.3}", bin.received as f64 / sent as f64),
            })
            .collect();
        println!("  delivery by {BIN_M} m, {name}: {}", shares.join(" "));
    }
}

/// Measures the cost that the arguments ask for.
pub fn measure_all(arguments: &[String]) {
    let counts: Vec<usize> = arguments.iter().filter_map(|argument| argument.parse().ok()).collect();
    let counts = if counts.is_empty() { vec![250, 1000] } else { counts };
    let threads = arguments
        .iter()
        .find_map(|argument| argument.strip_prefix("--threads="));
    let threads = threads.map_or(1, |count| count.parse().unwrap());
    for stations in counts {
        if !arguments.iter().any(|argument| argument == "--cpm") {
            measure(stations, 0.0, threads);
        }
        if !arguments.iter().any(|argument| argument == "--cam") {
            measure(stations, 80.0, threads);
        }
    }
}
