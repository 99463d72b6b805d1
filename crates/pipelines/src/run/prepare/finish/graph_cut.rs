//! Minimum cut of an 8-connected pixel grid (Boykov and Kolmogorov, "An experimental comparison of min-cut/max-flow algorithms for energy
//! minimization in vision", 2004).

use std::collections::VecDeque;

/// Offsets of the eight neighbors; the opposite of direction `d` is `7 - d`.
pub const NEIGHBOURS: [(i32, i32); 8] = [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)];

/// Values of `parents` that are not directions.
const TERMINAL: u8 = 8;
const ORPHAN: u8 = 9;
const FREE: u8 = 10;

/// Flow network of a pixel grid with a source and a sink.
pub struct GridCut {
    width: usize,
    height: usize,
    /// Residual capacity from a pixel to each neighbor.
    edges: Vec<[i32; 8]>,
    /// Residual capacity from the source (positive) or to the sink (negative).
    terminals: Vec<i32>,
    parents: Vec<u8>,
    in_sink_tree: Vec<bool>,
    /// Steps to the root, valid as of the time in `stamps`.
    distances: Vec<u32>,
    stamps: Vec<u32>,
    time: u32,
    active: VecDeque<u32>,
    orphans: VecDeque<u32>,
}

impl GridCut {
    /// `edges[i][d]` is the cost of separating pixel `i` from its neighbor `d`: symmetric, and 0 across the image border;
    /// `terminals[i]` is the cost of assigning `i` to the sink minus that of assigning it to the source.
    pub fn new(width: usize, height: usize, edges: Vec<[i32; 8]>, terminals: Vec<i32>) -> GridCut {
        let n = width * height;
        GridCut {
            width,
            height,
            edges,
            terminals,
            parents: vec![FREE; n],
            in_sink_tree: vec![false; n],
            distances: vec![0; n],
            stamps: vec![0; n],
            time: 0,
            active: VecDeque::new(),
            orphans: VecDeque::new(),
        }
    }

    /// Whether each pixel lies on the source's side of a minimum cut.
    pub fn solve(mut self) -> Vec<bool> {
        for i in 0..self.terminals.len() {
            if self.terminals[i] != 0 {
                self.parents[i] = TERMINAL;
                self.in_sink_tree[i] = self.terminals[i] < 0;
                self.distances[i] = 1;
                self.active.push_back(i as u32);
            }
        }
        while let Some(&i) = self.active.front() {
            let i = i as usize;
            // A pixel stays active as long as it meets the other tree.
            match (self.parents[i] != FREE).then(|| self.grow(i)).flatten() {
                Some(meeting) => {
                    self.time += 1;
                    self.augment(meeting);
                    self.adopt();
                }
                None => {
                    self.active.pop_front();
                }
            }
        }
        (0..self.terminals.len()).map(|i| self.parents[i] != FREE && !self.in_sink_tree[i]).collect()
    }

    fn neighbour(&self, i: usize, d: usize) -> Option<usize> {
        let (x, y) = ((i % self.width) as i32 + NEIGHBOURS[d].0, (i / self.width) as i32 + NEIGHBOURS[d].1);
        (x >= 0 && y >= 0 && x < self.width as i32 && y < self.height as i32).then(|| y as usize * self.width + x as usize)
    }

    /// Whether a tree can grow from pixel `i` to its neighbor `j`: the edge has residual capacity away from the source or towards the sink.
    fn carries(&self, i: usize, d: usize, j: usize, sink_tree: bool) -> bool {
        if sink_tree { self.edges[j][7 - d] > 0 } else { self.edges[i][d] > 0 }
    }

    /// Adds free neighbors to the pixel's tree; returns the edge (pixel on the source's side, direction) where both trees meet, if any.
    fn grow(&mut self, i: usize) -> Option<(usize, usize)> {
        let sink_tree = self.in_sink_tree[i];
        for d in 0..8 {
            let Some(j) = self.neighbour(i, d) else { continue };
            if !self.carries(i, d, j, sink_tree) {
                continue;
            }
            if self.parents[j] == FREE {
                self.parents[j] = 7 - d as u8;
                self.in_sink_tree[j] = sink_tree;
                (self.distances[j], self.stamps[j]) = (self.distances[i] + 1, self.stamps[i]);
                self.active.push_back(j as u32);
            } else if self.in_sink_tree[j] != sink_tree {
                return Some(if sink_tree { (j, 7 - d) } else { (i, d) });
            } else if self.stamps[j] <= self.stamps[i] && self.distances[j] > self.distances[i] + 1 {
                self.parents[j] = 7 - d as u8;
                (self.distances[j], self.stamps[j]) = (self.distances[i] + 1, self.stamps[i]);
            }
        }
        None
    }

    /// Saturates the path from source to sink through an edge between the trees; pixels that lose their parent edge become orphans.
    fn augment(&mut self, (i, d): (usize, usize)) {
        let j = self.neighbour(i, d).expect("trees meet at neighbours");
        let mut flow = self.edges[i][d];
        for (mut at, sink_tree) in [(i, false), (j, true)] {
            while self.parents[at] != TERMINAL {
                let up = self.parents[at] as usize;
                let parent = self.neighbour(at, up).expect("parents are neighbours");
                flow = flow.min(if sink_tree { self.edges[at][up] } else { self.edges[parent][7 - up] });
                at = parent;
            }
            flow = flow.min(self.terminals[at].abs());
        }
        self.edges[i][d] -= flow;
        self.edges[j][7 - d] += flow;
        for (mut at, sink_tree) in [(i, false), (j, true)] {
            while self.parents[at] != TERMINAL {
                let up = self.parents[at] as usize;
                let parent = self.neighbour(at, up).expect("parents are neighbours");
                let (from, to, along) = if sink_tree { (at, parent, up) } else { (parent, at, 7 - up) };
                self.edges[from][along] -= flow;
                self.edges[to][7 - along] += flow;
                if self.edges[from][along] == 0 {
                    self.orphan(at);
                }
                at = parent;
            }
            self.terminals[at] -= if sink_tree { -flow } else { flow };
            if self.terminals[at] == 0 {
                self.orphan(at);
            }
        }
    }

    fn orphan(&mut self, i: usize) {
        self.parents[i] = ORPHAN;
        self.orphans.push_back(i as u32);
    }

    /// Finds new parents for orphans, or sets them free.
    fn adopt(&mut self) {
        while let Some(i) = self.orphans.pop_front() {
            let i = i as usize;
            let sink_tree = self.in_sink_tree[i];
            let mut best: Option<(u32, usize)> = None;
            for d in 0..8 {
                let Some(j) = self.neighbour(i, d) else { continue };
                // The edge must carry flow from the parent in the source's tree, to the parent in the sink's tree.
                let open = if sink_tree { self.edges[i][d] > 0 } else { self.edges[j][7 - d] > 0 };
                if open
                    && self.parents[j] < ORPHAN
                    && self.in_sink_tree[j] == sink_tree
                    && let Some(distance) = self.distance_to_root(j)
                    && best.is_none_or(|b| distance < b.0)
                {
                    best = Some((distance, d));
                }
            }
            if let Some((distance, d)) = best {
                self.parents[i] = d as u8;
                (self.distances[i], self.stamps[i]) = (distance + 1, self.time);
                continue;
            }
            self.parents[i] = FREE;
            for d in 0..8 {
                let Some(j) = self.neighbour(i, d) else { continue };
                if self.parents[j] == FREE || self.in_sink_tree[j] != sink_tree {
                    continue;
                }
                if self.carries(j, 7 - d, i, sink_tree) {
                    self.active.push_back(j as u32);
                }
                if self.parents[j] == 7 - d as u8 {
                    self.orphan(j);
                }
            }
        }
    }

    /// Steps from a pixel to its tree's root, none where the path ends at an orphan. Caches the distances along the path.
    fn distance_to_root(&mut self, from: usize) -> Option<u32> {
        let (mut at, mut steps) = (from, 0);
        let base = loop {
            if self.stamps[at] == self.time {
                break self.distances[at];
            }
            match self.parents[at] {
                TERMINAL => {
                    (self.distances[at], self.stamps[at]) = (1, self.time);
                    break 1;
                }
                ORPHAN | FREE => return None,
                up => at = self.neighbour(at, up as usize).expect("parents are neighbours"),
            }
            steps += 1;
        };
        let total = base + steps;
        let (mut at, mut left) = (from, total);
        while self.stamps[at] != self.time {
            (self.distances[at], self.stamps[at]) = (left, self.time);
            left -= 1;
            at = self.neighbour(at, self.parents[at] as usize).expect("parents are neighbours");
        }
        Some(total)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::rng::Rng;

    /// Energy of a labeling.
    fn cost(w: usize, h: usize, edges: &[[i32; 8]], terminals: &[i32], source: &[bool]) -> i64 {
        let cut = GridCut::new(w, h, edges.to_vec(), terminals.to_vec());
        let unary: i64 = (0..w * h).map(|i| if source[i] { (-terminals[i]).max(0) } else { terminals[i].max(0) } as i64).sum();
        let parted = |i: usize| {
            let apart = |d: &usize| cut.neighbour(i, *d).is_some_and(|j| source[i] && !source[j]);
            (0..8).filter(apart).map(|d| edges[i][d] as i64).sum::<i64>()
        };
        unary + (0..w * h).map(parted).sum::<i64>()
    }

    #[test]
    fn small_cuts_cost_what_the_best_of_all_labellings_costs() {
        let (w, h) = (4, 3);
        for seed in 0..300 {
            let rng = Rng::new(seed, 0);
            let terminals: Vec<i32> = (0..w * h).map(|i| rng.below(i as u64, 41) as i32 - 20).collect();
            let mut edges = vec![[0; 8]; w * h];
            let grid = GridCut::new(w, h, edges.clone(), terminals.clone());
            for i in 0..w * h {
                for d in 0..4 {
                    if let Some(j) = grid.neighbour(i, d) {
                        let v = rng.below(1000 + (i * 8 + d) as u64, 12) as i32;
                        (edges[i][d], edges[j][7 - d]) = (v, v);
                    }
                }
            }
            let found = GridCut::new(w, h, edges.clone(), terminals.clone()).solve();
            let labelling = |k: u32| (0..w * h).map(|i| k >> i & 1 == 1).collect::<Vec<bool>>();
            let best = (0..1u32 << (w * h)).map(|k| cost(w, h, &edges, &terminals, &labelling(k))).min().unwrap();
            assert_eq!(cost(w, h, &edges, &terminals, &found), best, "seed {seed}");
        }
    }
}
