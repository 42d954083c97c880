//! Work on many items by several threads. Each item is a function of itself alone, so the result does not depend on the number of threads.

/// Calls `work` for each item with its place. Items are dealt out in equal runs.
pub fn for_each<T: Send>(threads: usize, items: &mut [T], work: impl Fn(usize, &mut T) + Sync) {
    let run = items.len().div_ceil(threads.max(1)).max(1);
    if threads <= 1 || items.len() <= run {
        items.iter_mut().enumerate().for_each(|(place, item)| work(place, item));
        return;
    }
    let work = &work;
    std::thread::scope(|scope| {
        for (number, items) in items.chunks_mut(run).enumerate() {
            scope.spawn(move || {
                for (place, item) in items.iter_mut().enumerate() {
                    work(number * run + place, item);
                }
            });
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_item_is_worked_on_once_at_its_place() {
        for (threads, count) in [(1, 0), (1, 5), (2, 5), (4, 3), (3, 9), (8, 100)] {
            let mut items = vec![0_usize; count];
            for_each(threads, &mut items, |place, item| *item += place + 1);
            assert_eq!(items, (1..=count).collect::<Vec<_>>(), "{threads} threads");
        }
    }
}
