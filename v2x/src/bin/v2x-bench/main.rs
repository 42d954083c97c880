//! Delivery over distance, channel load, age of information and awareness in a grid of streets with houses between them; and its cost.
//!
//! `v2x-bench --help` lists the options. The hash of a cost is over every block of neighbours: what is computed in another way has the
//! same.

#![expect(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    reason = "a measurement asserts by unwrapping, and its counts are small"
)]

mod cost;
mod curves;
mod street;

const USAGE: &str = "\
usage: v2x-bench [--quick] [--json FILE]
       v2x-bench cost [STATIONS …] [--threads=N] [--cam | --cpm]

Measures messages between vehicles in streets with houses; `caraware bench v2x` starts it. `cost` measures what
the exchange costs: CAMs alone, then CAMs and CPMs.

  --quick      a small measurement, whose figures say nothing
  --json FILE  where the figures go
  --threads=N  of the exchange
  --cam        leaves CPMs out
  --cpm        leaves the run without CPMs out";

fn main() {
    ipc_schema::process_main::answer_help(USAGE);
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
