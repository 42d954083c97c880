//! Boards, credits, wake-ups and the roster under `loom`: every interleaving of a few operations, and every value that the memory orders
//! let a load return.
//!
//! The lock-free part is iceoryx2's (`iceoryx2-bb-lock-free`, `spmc/unrestricted_atomic.rs`). [`BlackboardCell`] repeats it word by word,
//! because `loom` has to see each access. [`flow::has_credit`] is the program's own. As in `protocol_model.rs`, a further test takes one
//! guard away at a time and requires a counterexample; it runs the others in a process of its own, since a deadlock that `loom` finds
//! ends the process.
//!
//! `make model` allows more preemptions (`CARAWARE_LOOM_PREEMPTIONS`) than the two of CI.

#![allow(clippy::panic, clippy::unwrap_used, reason = "tests assert by panicking")]

use std::process::Command;

use ipc_schema::{board::Progress, flow};
use loom::{
    cell::UnsafeCell,
    model::Builder,
    sync::{
        Arc, Notify,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
};

/// Ticks that a producer may be ahead. With one, each wake-up counts: no later one makes up for it.
const WINDOWS: [u64; 2] = [1, 2];
/// Ticks of the credit model: a slot is used again.
const TICKS: u64 = 3;
/// Words of a value on a board; more than one, so that it can be torn.
const WORDS: usize = 2;

/// What keeps the protocol right; a test takes one away.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Guard {
    /// A reader looks again whether its cell is still the newest one.
    SecondLook,
    /// The writer releases what it has written.
    Release,
    /// The reader acquires it.
    Acquire,
    /// Two cells: the writer never writes to the newest value.
    SecondCell,
    /// The producer waits for credit.
    Credit,
    /// No more ticks are under way than there are slots.
    Window,
    /// Credit is returned after the tick has been read.
    ReadBeforeCredit,
    /// A process is woken after its condition has come true.
    WakeAfterChange,
    /// A board exists before the roster names it.
    BoardBeforeRoster,
}

impl Guard {
    /// Each test with the guards that it needs.
    const BY_TEST: [(&str, &[Self]); 3] = [
        (
            "a_board_is_never_torn_and_never_older_than_before",
            &[Self::SecondLook, Self::Release, Self::Acquire, Self::SecondCell],
        ),
        (
            "a_slot_is_never_written_while_it_may_be_read_and_no_wake_up_is_lost",
            &[
                Self::Credit,
                Self::Window,
                Self::ReadBeforeCredit,
                Self::WakeAfterChange,
                Self::Release,
                Self::Acquire,
            ],
        ),
        (
            "a_board_exists_when_the_roster_names_it",
            // The second look acquires too, before anything else is read.
            &[Self::BoardBeforeRoster, Self::Release],
        ),
    ];
}

/// Name of the variable with the missing guard.
const MISSING: &str = "CARAWARE_LOOM_WITHOUT";

/// The guards that hold: all, or all but one.
#[derive(Debug, Clone, Copy)]
struct Guards {
    missing: Option<Guard>,
}

impl Guards {
    fn of_environment() -> Self {
        let name = std::env::var(MISSING);
        let missing = name.map(|name| {
            let all = Guard::BY_TEST.into_iter().flat_map(|(_, guards)| guards.iter());
            let mut named = all.filter(|guard| format!("{guard:?}") == name);
            *named.next().unwrap()
        });
        Self { missing: missing.ok() }
    }

    fn hold(self, guard: Guard) -> bool {
        self.missing != Some(guard)
    }

    /// `order`, or none if `guard` is missing.
    fn order(self, guard: Guard, order: Ordering) -> Ordering {
        if self.hold(guard) { order } else { Ordering::Relaxed }
    }
}

/// iceoryx2's value of a blackboard: one writer, many readers, two cells of which the writer fills the older one.
struct BlackboardCell {
    write_cell: AtomicU64,
    data: [[AtomicU64; WORDS]; 2],
    guards: Guards,
}

impl BlackboardCell {
    fn new(value: u64, guards: Guards) -> Self {
        let cell = |value: u64| std::array::from_fn(|_| AtomicU64::new(value));
        Self {
            write_cell: AtomicU64::new(1),
            // The second cell is uninitialised memory.
            data: [cell(value), cell(u64::MAX)],
            guards,
        }
    }

    fn cell(&self, number: u64) -> &[AtomicU64; WORDS] {
        let cells = if self.guards.hold(Guard::SecondCell) { 2 } else { 1 };
        &self.data[number as usize % cells]
    }

    /// Replaces the value; only one thread may.
    fn store(&self, value: u64) {
        let write_cell = self.write_cell.load(Ordering::Relaxed);
        for word in self.cell(write_cell) {
            word.store(value, Ordering::Relaxed);
        }
        let release = self.guards.order(Guard::Release, Ordering::Release);
        self.write_cell.fetch_add(1, release);
    }

    /// The newest value. Panics if it is torn.
    fn load(&self) -> u64 {
        let acquire = self.guards.order(Guard::Acquire, Ordering::Acquire);
        let mut write_cell = self.write_cell.load(acquire);
        loop {
            let words: [u64; WORDS] =
                std::array::from_fn(|word| self.cell(write_cell - 1)[word].load(Ordering::Relaxed));
            let second_look = match self.guards.hold(Guard::SecondLook) {
                true => self
                    .write_cell
                    .compare_exchange(write_cell, write_cell, Ordering::AcqRel, Ordering::SeqCst),
                false => Ok(write_cell),
            };
            match second_look {
                Ok(_) => {
                    assert!(words.iter().all(|word| *word == words[0]), "torn: {words:?}");
                    return words[0];
                }
                Err(newer) => write_cell = newer,
            }
        }
    }
}

fn checked(model: impl Fn() + Sync + Send + 'static) {
    let preemptions = std::env::var("CARAWARE_LOOM_PREEMPTIONS");
    let mut builder = Builder::new();
    builder.preemption_bound = Some(preemptions.map_or(2, |text| text.parse().unwrap()));
    builder.check(model);
}

/// Three values are written, while two readers look: one twice, one once.
#[test]
fn a_board_is_never_torn_and_never_older_than_before() {
    let guards = Guards::of_environment();
    checked(move || {
        let board = Arc::new(BlackboardCell::new(0, guards));
        let readers = [2, 1].map(|looks| {
            let board = Arc::clone(&board);
            thread::spawn(move || {
                let mut newest = 0;
                for _ in 0..looks {
                    let value = board.load();
                    assert!(value >= newest && value <= 3, "{value} after {newest}");
                    newest = value;
                }
            })
        });
        for value in 1..=3 {
            board.store(value);
        }
        assert_eq!(board.load(), 3, "the writer sees its own value");
        for reader in readers {
            reader.join().unwrap();
        }
    });
}

/// Slots that a producer fills and a consumer reads in place.
struct CreditedQueue {
    slots: Vec<UnsafeCell<u64>>,
    /// Ticks that have been sent.
    sent: AtomicU64,
    /// The consumer's board: ticks that it has consumed.
    consumed: BlackboardCell,
    producer_wake: Notify,
    consumer_wake: Notify,
}

impl CreditedQueue {
    fn new(window: u64, guards: Guards) -> Self {
        Self {
            slots: (0..window).map(|_| UnsafeCell::new(0)).collect(),
            sent: AtomicU64::new(0),
            consumed: BlackboardCell::new(0, guards),
            producer_wake: Notify::new(),
            consumer_wake: Notify::new(),
        }
    }

    fn slot(&self, tick: u64) -> &UnsafeCell<u64> {
        &self.slots[tick as usize % self.slots.len()]
    }

    /// Makes all ticks, each when it has credit.
    fn produce(&self, guards: Guards) {
        let window = self.slots.len() as u64 + u64::from(!guards.hold(Guard::Window));
        for tick in 0..TICKS {
            let has_credit = || {
                let consumer = Progress {
                    consumed_ticks: self.consumed.load(),
                    attached: 1,
                    ..Progress::default()
                };
                flow::has_credit(tick, &consumer, window)
            };
            while guards.hold(Guard::Credit) && !has_credit() {
                self.producer_wake.wait();
            }
            // `loom` panics if the consumer reads the slot, or may still do.
            self.slot(tick).with_mut(|slot| write(slot, tick));
            self.sent.store(tick + 1, Ordering::Release);
            self.consumer_wake.notify();
        }
    }

    /// Reads all ticks, each in its slot, and returns the credit.
    fn consume(&self, guards: Guards) {
        for tick in 0..TICKS {
            while self.sent.load(Ordering::Acquire) <= tick {
                self.consumer_wake.wait();
            }
            let read = || {
                self.slot(tick)
                    .with(|slot| assert_eq!(read(slot), tick, "another tick's slot"));
            };
            let give_credit = || match guards.hold(Guard::WakeAfterChange) {
                true => {
                    self.consumed.store(tick + 1);
                    self.producer_wake.notify();
                }
                false => {
                    self.producer_wake.notify();
                    self.consumed.store(tick + 1);
                }
            };
            match guards.hold(Guard::ReadBeforeCredit) {
                true => {
                    read();
                    give_credit();
                }
                false => {
                    give_credit();
                    read();
                }
            }
        }
    }
}

#[expect(unsafe_code, reason = "loom's cells give raw pointers")]
fn write(slot: *mut u64, value: u64) {
    // SAFETY: loom calls this with a pointer to a live cell, and panics first if any other access is not ordered with it.
    unsafe { *slot = value };
}

#[expect(unsafe_code, reason = "loom's cells give raw pointers")]
fn read(slot: *const u64) -> u64 {
    // SAFETY: as above.
    unsafe { *slot }
}

#[test]
fn a_slot_is_never_written_while_it_may_be_read_and_no_wake_up_is_lost() {
    let guards = Guards::of_environment();
    for window in WINDOWS {
        checked(move || {
            let queue = Arc::new(CreditedQueue::new(window, guards));
            let producer = {
                let queue = Arc::clone(&queue);
                thread::spawn(move || queue.produce(guards))
            };
            queue.consume(guards);
            producer.join().unwrap();
        });
    }
}

/// A supervisor adds the board of incarnation 1 and names it; a reader follows the roster.
#[test]
fn a_board_exists_when_the_roster_names_it() {
    let guards = Guards::of_environment();
    checked(move || {
        let roster = Arc::new(BlackboardCell::new(0, guards));
        let exists = Arc::new(AtomicBool::new(false));
        let supervisor = {
            let (roster, exists) = (Arc::clone(&roster), Arc::clone(&exists));
            thread::spawn(move || {
                if guards.hold(Guard::BoardBeforeRoster) {
                    exists.store(true, Ordering::Relaxed);
                    roster.store(1);
                } else {
                    roster.store(1);
                    exists.store(true, Ordering::Relaxed);
                }
            })
        };
        if roster.load() == 1 {
            assert!(
                exists.load(Ordering::Relaxed),
                "the roster names a board that is not there"
            );
        }
        supervisor.join().unwrap();
    });
}

/// A model that finds nothing proves nothing.
#[test]
fn each_guard_is_needed() {
    for (test, guards) in Guard::BY_TEST {
        for guard in guards {
            let mut model = Command::new(std::env::current_exe().unwrap());
            model
                .args(["--exact", test])
                .env(MISSING, format!("{guard:?}"))
                .env("RUST_BACKTRACE", "0");
            let output = model.output().unwrap();
            let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
            assert!(said.contains("running 1 test"), "{said}");
            assert!(!output.status.success(), "{test}: no counterexample without {guard:?}");
            let found = [
                "torn: ",
                " after ",
                "another tick's slot",
                "Causality violation",
                "deadlock",
                "not there",
            ];
            assert!(
                found.iter().any(|words| said.contains(words)),
                "{test} without {guard:?}: {said}"
            );
        }
    }
}

/// [`BlackboardCell`] repeats one version.
#[test]
fn the_model_is_of_the_version_in_use() {
    let lock = include_str!("../../Cargo.lock");
    assert!(
        lock.contains("name = \"iceoryx2-bb-lock-free\"\nversion = \"0.10.0\"\n"),
        "compare `BlackboardCell` with `spmc/unrestricted_atomic.rs` of the new version"
    );
}
