//! Two algorithms on directed graphs whose nodes are numbers.

use std::{cmp::Reverse, collections::BinaryHeap};

/// The largest strongly connected component (of equally large ones, that of the lowest node), ascending.
/// Kosaraju's algorithm: in reverse order of leaving the graph, what reaches a node backwards is its component.
pub(crate) fn largest_component(successors: &[Vec<usize>]) -> Vec<usize> {
    let mut predecessors = vec![Vec::new(); successors.len()];
    for (from, next) in successors.iter().enumerate() {
        next.iter().for_each(|&to| predecessors[to].push(from));
    }
    let mut seen = vec![false; successors.len()];
    let mut order = Vec::with_capacity(successors.len());
    (0..successors.len()).for_each(|node| visit(node, successors, &mut seen, &mut order));
    seen.fill(false);
    let mut components = Vec::new();
    for &node in order.iter().rev() {
        let mut component = Vec::new();
        visit(node, &predecessors, &mut seen, &mut component);
        component.sort_unstable();
        components.push(component);
    }
    components
        .into_iter()
        .min_by_key(|c| (Reverse(c.len()), c.first().copied()))
        .unwrap_or_default()
}

/// Appends what can be reached from `root` and was not seen, each node after everything reached through it.
fn visit(root: usize, next: &[Vec<usize>], seen: &mut [bool], order: &mut Vec<usize>) {
    if std::mem::replace(&mut seen[root], true) {
        return;
    }
    let mut path = vec![(root, 0)];
    while let Some((node, tried)) = path.last_mut() {
        if let Some(&child) = next[*node].get(*tried) {
            *tried += 1;
            if !std::mem::replace(&mut seen[child], true) {
                path.push((child, 0));
            }
        } else {
            order.push(*node);
            path.pop();
        }
    }
}

/// The cheapest path between two nodes, both included; empty if there is none. Entering a node costs `cost[node]`, in
/// whole units so that sums are exact; the choice among equally cheap paths is deterministic. Dijkstra's algorithm.
pub(crate) fn cheapest_path(successors: &[Vec<usize>], cost: &[u64], from: usize, to: usize) -> Vec<usize> {
    let mut best = vec![u64::MAX; successors.len()];
    let mut previous = vec![usize::MAX; successors.len()];
    let mut open = BinaryHeap::from([Reverse((0, from))]);
    best[from] = 0;
    while let Some(Reverse((so_far, node))) = open.pop() {
        if node == to {
            return path_back(&previous, to);
        }
        if so_far > best[node] {
            continue;
        }
        for &next in &successors[node] {
            let total = so_far + cost[next];
            if total < best[next] {
                (best[next], previous[next]) = (total, node);
                open.push(Reverse((total, next)));
            }
        }
    }
    Vec::new()
}

fn path_back(previous: &[usize], to: usize) -> Vec<usize> {
    let mut path = vec![to];
    while let Some(&node) = path
        .last()
        .and_then(|&node| previous.get(node))
        .filter(|&&node| node != usize::MAX)
    {
        path.push(node);
    }
    path.reverse();
    path
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_ring_with_a_dead_end_is_the_ring() {
        assert_eq!(largest_component(&[vec![1], vec![2], vec![0, 3], vec![]]), [0, 1, 2]);
    }

    #[test]
    fn nothing_has_no_component() {
        assert_eq!(largest_component(&[]), [] as [usize; 0]);
    }

    fn reaches(successors: &[Vec<usize>], from: usize) -> Vec<bool> {
        let mut seen = vec![false; successors.len()];
        visit(from, successors, &mut seen, &mut Vec::new());
        seen
    }

    /// Costs of the cheapest ways from `from` to everywhere, by relaxing all links until nothing changes.
    fn distances(successors: &[Vec<usize>], cost: &[u64], from: usize) -> Vec<Option<u64>> {
        let mut best = vec![None; successors.len()];
        best[from] = Some(0);
        for _ in 0..successors.len() {
            for (node, next) in successors.iter().enumerate() {
                for &to in next {
                    let through = best[node].map(|so_far: u64| so_far + cost[to]);
                    best[to] = [best[to], through].into_iter().flatten().min();
                }
            }
        }
        best
    }

    proptest! {
        #[test]
        fn paths_are_paths_and_the_cheapest(
            links in prop::collection::vec((0_usize..9, 0_usize..9), 0..40),
            cost in prop::collection::vec(1_u64..100, 9), from in 0_usize..9, to in 0_usize..9,
        ) {
            let mut successors = vec![Vec::new(); 9];
            links.iter().for_each(|&(from, to)| successors[from].push(to));
            let path = cheapest_path(&successors, &cost, from, to);
            let total = (!path.is_empty()).then(|| path[1..].iter().map(|&node| cost[node]).sum());
            prop_assert_eq!(total, distances(&successors, &cost, from)[to]);
            prop_assert!(path.is_empty() || (path[0] == from && path[path.len() - 1] == to));
            prop_assert!(path.windows(2).all(|step| successors[step[0]].contains(&step[1])));
        }

        /// Everything in the component reaches everything in it, and no node has a larger one.
        #[test]
        fn the_component_is_the_largest(links in prop::collection::vec((0_usize..12, 0_usize..12), 0..40)) {
            let mut successors = vec![Vec::new(); 12];
            links.iter().for_each(|&(from, to)| successors[from].push(to));
            let reach: Vec<_> = (0..12).map(|node| reaches(&successors, node)).collect();
            let size = |node: usize| (0..12).filter(|&other| reach[node][other] && reach[other][node]).count();
            let component = largest_component(&successors);
            prop_assert!(component.iter().all(|&a| component.iter().all(|&b| reach[a][b])));
            prop_assert_eq!(component.len(), (0..12).map(size).max().unwrap_or(0));
        }
    }
}
