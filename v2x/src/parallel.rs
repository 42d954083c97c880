//! Work on many items by several threads. Each item is a function of itself alone, so the result does not depend on the number of threads.

use std::sync::{Mutex, PoisonError};

/// Items that a thread takes at once.
const RUN: usize = 32;

/// Calls `work` for each item with its place. Threads take runs of items as they become free, because items differ in their work.
pub fn for_each<T: Send>(threads: usize, items: &mut [T], work: impl Fn(usize, &mut T) + Sync) {
    for_each_with(threads, items, || (), |(), place, item| work(place, item));
}

/// The same with a room for each thread, which `room` makes: memory that items use one after the other.
pub fn for_each_with<T: Send, R>(
    threads: usize,
    items: &mut [T],
    room: impl Fn() -> R + Sync,
    work: impl Fn(&mut R, usize, &mut T) + Sync,
) {
    if threads <= 1 || items.len() <= RUN {
        let mut own = room();
        items
            .iter_mut()
            .enumerate()
            .for_each(|(place, item)| work(&mut own, place, item));
        return;
    }
    let threads = threads.min(items.len().div_ceil(RUN));
    let runs = Mutex::new(items.chunks_mut(RUN).enumerate());
    let next = || runs.lock().unwrap_or_else(PoisonError::into_inner).next();
    let take_runs = || {
        let mut own = room();
        while let Some((number, items)) = next() {
            for (place, item) in items.iter_mut().enumerate() {
                work(&mut own, number * RUN + place, item);
            }
        }
    };
    std::thread::scope(|scope| {
        // This thread works too.
        for _ in 1..threads {
            scope.spawn(take_runs);
        }
        take_runs();
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_item_is_worked_on_once_at_its_place() {
        for (threads, count) in [(1, 0), (1, 5), (2, 5), (4, 3), (3, 9), (2, 33), (8, 100), (3, 1000)] {
            let mut items = vec![0_usize; count];
            for_each(threads, &mut items, |place, item| *item += place + 1);
            assert_eq!(items, (1..=count).collect::<Vec<_>>(), "{threads} threads");
        }
    }
}
