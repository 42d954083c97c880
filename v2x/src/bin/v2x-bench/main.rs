//! Delivery over distance, channel load, age of information and awareness in a grid of streets with houses between them; and its cost.
//!
//! `v2x-bench [--quick] [--json FILE]` writes the figures of `caraware bench v2x`. `v2x-bench cost [STATIONS …] [--threads=N] [--cam]` measures
//! the cost of the exchange: CAMs alone, then CAMs and CPMs (not with `--cam`). Its hash is over every block of neighbours: what is computed
//! in another way has the same.

#![expect(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    reason = "a measurement asserts by unwrapping, and its counts are small"
)]

mod cost;
mod curves;
mod street;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.first().map(String::as_str) {
        Some("cost") => cost::measure_all(&arguments[1..]),
        _ => {
            let is_quick = arguments.iter().any(|argument| argument == "--quick");
            let file = arguments.iter().skip_while(|argument| *argument != "--json").nth(1);
            curves::measure_all(is_quick, file.map(String::as_str));
        }
    }
}
