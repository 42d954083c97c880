//! A uniform grid over static objects: which of them are near a position. Answers come in ascending order of their number.

use std::ops::ControlFlow;

use super::shape::{Bounds, Point, from_to};

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

    /// Visits the things of each cell that the segment passes, in its order, until `visit` breaks. A thing in several cells comes several
    /// times (Amanatides and Woo, "A fast voxel traversal algorithm", Eurographics 1987).
    pub fn along(&self, from: Point, to: Point, mut visit: impl FnMut(&[u32]) -> ControlFlow<()>) {
        // In cells.
        let in_cells = |point: Point| [0, 1].map(|axis: usize| (point[axis] - self.min_m[axis]) * self.cells_per_m);
        let (start, count) = (in_cells(from), [self.columns, self.rows]);
        let way = from_to(start, in_cells(to));
        let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
        for axis in 0..2 {
            let last = count[axis] as f64;
            if way[axis] == 0.0 {
                if !(0.0..=last).contains(&start[axis]) {
                    return;
                }
                continue;
            }
            let (near, far) = (-start[axis] / way[axis], (last - start[axis]) / way[axis]);
            enter = enter.max(near.min(far));
            leave = leave.min(near.max(far));
        }
        if self.starts.is_empty() || enter > leave {
            return;
        }
        let mut cell = [0, 1].map(|axis: usize| {
            let at = (start[axis] + enter * way[axis]).max(0.0) as usize;
            at.min(count[axis].saturating_sub(1))
        });
        // Share of the segment at which it enters the next cell along each axis.
        let border = |cell: usize, axis: usize| {
            let next = if way[axis] > 0.0 { cell + 1 } else { cell };
            match way[axis] {
                0.0 => f64::INFINITY,
                along => (next as f64 - start[axis]) / along,
            }
        };
        let mut next = [border(cell[0], 0), border(cell[1], 1)];
        while visit(self.cell(cell[1] * self.columns + cell[0])).is_continue() {
            let axis = usize::from(next[1] < next[0]);
            let moved = match way[axis] > 0.0 {
                true => cell[axis] + 1,
                false => cell[axis].wrapping_sub(1),
            };
            if next[axis] > leave || moved >= count[axis] {
                return;
            }
            cell[axis] = moved;
            next[axis] = border(moved, axis);
        }
    }

    /// Visits the things of each cell that `bounds` meets. A thing in several cells comes several times.
    pub fn visit_near(&self, bounds: &Bounds, visit: impl FnMut(&[u32])) {
        if !self.starts.is_empty() {
            self.cells(bounds).map(|cell| self.cell(cell)).for_each(visit);
        }
    }

    /// Things whose bounds may meet `bounds`, into `found` (emptied first), each once.
    pub fn near(&self, bounds: &Bounds, found: &mut Vec<u32>) {
        found.clear();
        self.visit_near(bounds, |cell| found.extend_from_slice(cell));
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

    proptest! {
        #[test]
        fn nothing_along_a_segment_is_missed(
            things in prop::collection::vec((prop::array::uniform2(-500.0_f64..500.0), 0.1_f64..60.0), 1..60),
            from in prop::array::uniform2(-700.0_f64..700.0), to in prop::array::uniform2(-700.0_f64..700.0), cell in 1.0_f64..100.0,
        ) {
            let bounds: Vec<Bounds> = things.iter().map(|(centre, reach)| Bounds::about(*centre, *reach)).collect();
            let grid = Grid::new(&bounds, cell);
            let mut along = Vec::new();
            grid.along(from, to, |found| {
                along.extend_from_slice(found);
                ControlFlow::Continue(())
            });
            // Points of the segment that are well inside a thing.
            for share in (0..=400).map(|i| f64::from(i) / 400.0) {
                let point = [0, 1].map(|axis: usize| from[axis] + share * (to[axis] - from[axis]));
                for (number, thing) in (0_u32..).zip(&bounds) {
                    prop_assert!(!thing.grown(-1e-6).holds(point) || along.contains(&number));
                }
            }
            // It ends where it is to end.
            let mut visited = 0;
            grid.along(from, to, |_| {
                visited += 1;
                ControlFlow::Break(())
            });
            prop_assert!(visited <= 1);
        }
    }

    #[test]
    fn an_empty_grid_answers_nothing() {
        let mut found = vec![1];
        Grid::default().along([0.0; 2], [1.0; 2], |_| panic!("a cell of nothing"));
        Grid::new(&[], 10.0).near(&Bounds::about([0.0; 2], 5.0), &mut found);
        assert!(found.is_empty() && Grid::default().at([0.0; 2]).is_empty());
    }
}
