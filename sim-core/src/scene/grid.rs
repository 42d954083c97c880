//! A uniform grid over static objects: which of them are near a position. Answers come in ascending order of their number.

use super::shape::{Bounds, Point};

/// Most cells of one grid: a very large map gets larger cells instead of more memory.
const MAX_CELLS: f64 = 4e6;

/// Numbers of things by cell.
#[derive(Debug, Clone, Default)]
pub struct Grid {
    min_m: Point,
    cells_per_m: f64,
    columns: usize,
    rows: usize,
    /// First entry of each cell in `entries`, and one past the last.
    starts: Vec<u32>,
    entries: Vec<u32>,
}

impl Grid {
    /// A grid over `things`, with cells of about `cell_m`.
    #[must_use]
    pub fn new(things: &[Bounds], cell_m: f64) -> Self {
        let all = things
            .iter()
            .fold(Bounds::EMPTY, |all, one| all.with(one.min_m).with(one.max_m));
        if things.is_empty() {
            return Self::default();
        }
        let [width, height] = [all.max_m[0] - all.min_m[0], all.max_m[1] - all.min_m[1]];
        let cell_m = cell_m
            .max((width * height / MAX_CELLS).sqrt())
            .max((width + height) / MAX_CELLS);
        let count = |length_m: f64| (length_m / cell_m) as usize + 1;
        let mut grid = Self {
            min_m: all.min_m,
            cells_per_m: 1.0 / cell_m,
            columns: count(width),
            rows: count(height),
            ..Self::default()
        };
        grid.fill(things);
        grid
    }

    /// Counts, then places: entries of a cell are in ascending order.
    fn fill(&mut self, things: &[Bounds]) {
        let mut starts = vec![0_u32; self.columns * self.rows + 1];
        for thing in things {
            self.cells(thing).for_each(|cell| starts[cell + 1] += 1);
        }
        for cell in 1..starts.len() {
            starts[cell] += starts[cell - 1];
        }
        let mut next = starts.clone();
        self.entries = vec![0; starts.last().map_or(0, |&last| last as usize)];
        for (number, thing) in (0_u32..).zip(things) {
            for cell in self.cells(thing) {
                self.entries[next[cell] as usize] = number;
                next[cell] += 1;
            }
        }
        self.starts = starts;
    }

    fn place(&self, value_m: f64, axis: usize, count: usize) -> usize {
        (((value_m - self.min_m[axis]) * self.cells_per_m).max(0.0) as usize).min(count.saturating_sub(1))
    }

    /// Cells that `bounds` meets; those outside the grid are taken to its border.
    fn cells(&self, bounds: &Bounds) -> impl Iterator<Item = usize> + use<> {
        let columns = self.columns;
        let across = self.place(bounds.min_m[0], 0, columns)..=self.place(bounds.max_m[0], 0, columns);
        let up = self.place(bounds.min_m[1], 1, self.rows)..=self.place(bounds.max_m[1], 1, self.rows);
        up.flat_map(move |row| across.clone().map(move |column| row * columns + column))
    }

    /// Things whose bounds may hold `point`.
    #[must_use]
    pub fn at(&self, [x, y]: Point) -> &[u32] {
        let (across, up) = (
            (x - self.min_m[0]) * self.cells_per_m,
            (y - self.min_m[1]) * self.cells_per_m,
        );
        if !(across >= 0.0 && up >= 0.0) || across as usize >= self.columns || up as usize >= self.rows {
            return &[];
        }
        self.cell(up as usize * self.columns + across as usize)
    }

    fn cell(&self, cell: usize) -> &[u32] {
        match self.starts.get(cell..cell + 2) {
            Some(&[from, to]) => &self.entries[from as usize..to as usize],
            _ => &[],
        }
    }

    /// Things whose bounds may meet `bounds`, into `found` (emptied first), each once.
    pub fn near(&self, bounds: &Bounds, found: &mut Vec<u32>) {
        found.clear();
        if self.starts.is_empty() {
            return;
        }
        self.cells(bounds)
            .for_each(|cell| found.extend_from_slice(self.cell(cell)));
        found.sort_unstable();
        found.dedup();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn nothing_near_is_missed(
            things in prop::collection::vec((prop::array::uniform2(-500.0_f64..500.0), 0.0_f64..60.0), 0..60),
            x in -600.0_f64..600.0, y in -600.0_f64..600.0, reach in 0.0_f64..200.0, cell in 1.0_f64..100.0,
        ) {
            let bounds: Vec<Bounds> = things.iter().map(|(centre, reach)| Bounds::about(*centre, *reach)).collect();
            let grid = Grid::new(&bounds, cell);
            let at = grid.at([x, y]);
            prop_assert!(at.is_sorted());
            let wanted = Bounds::about([x, y], reach);
            let mut near = vec![7];
            grid.near(&wanted, &mut near);
            for (number, thing) in (0_u32..).zip(&bounds) {
                prop_assert!(!thing.holds([x, y]) || at.contains(&number));
                prop_assert!(!thing.meets(&wanted) || near.contains(&number));
            }
        }
    }

    #[test]
    fn an_empty_grid_answers_nothing() {
        let mut found = vec![1];
        Grid::new(&[], 10.0).near(&Bounds::about([0.0; 2], 5.0), &mut found);
        assert!(found.is_empty() && Grid::default().at([0.0; 2]).is_empty());
    }
}
