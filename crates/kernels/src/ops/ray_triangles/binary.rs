//! The hierarchy with two children per node, as words for devices: each node of eight children becomes a small tree of them.

use super::{Bvh, LEAF as PACKET, WIDTH};

/// Words of a node: lowest and highest corner of the first and of the second child's box, the children, and two that are unused.
pub const NODE: usize = 16;
/// Words of a triangle: its corners and its index.
pub const TRIANGLE: usize = 10;
/// Marks a child of up to eight triangles: index of the first, times eight, and how many follow it.
pub const LEAF: u32 = 1 << 31;
/// Marks a child that is another tree under a transform.
pub const PLACED: u32 = 1 << 30;
/// No child at all.
pub const NOTHING: u32 = u32::MAX;
/// Most triangles of all trees.
const MOST: usize = 1 << 28;

/// A child: a box and what is in it.
#[derive(Clone, Copy, Debug)]
pub struct Child {
    pub low: [f32; 3],
    pub high: [f32; 3],
    /// Index of a node, or triangles with [`LEAF`] set, or a tree with [`PLACED`] set.
    pub content: u32,
    /// Triangles below.
    pub triangles: usize,
    /// Nodes on the longest way down.
    pub depth: usize,
}

/// Nodes and triangles of any number of trees.
#[derive(Clone, Debug, Default)]
pub struct Forest {
    /// `[nodes, 16]`
    pub nodes: Vec<u32>,
    /// `[T, 10]`
    pub triangles: Vec<u32>,
}

impl Forest {
    /// Adds a hierarchy, whose triangles are counted from `first` on; none without triangles.
    ///
    /// # Panics
    /// When there are 2²⁸ triangles or more.
    pub fn add(&mut self, bvh: &Bvh, first: u32) -> Option<Child> {
        (!bvh.nodes.is_empty()).then(|| self.add_node(bvh, 0, first))
    }

    fn add_node(&mut self, bvh: &Bvh, at: usize, first: u32) -> Child {
        let node = &bvh.nodes[at];
        let mut children = Vec::with_capacity(WIDTH);
        for i in (0..WIDTH).filter(|i| node.bounds[0][0][*i] <= node.bounds[0][1][*i]) {
            let (low, high) = ([0, 1, 2].map(|k| node.bounds[k][0][i]), [0, 1, 2].map(|k| node.bounds[k][1][i]));
            children.push(if node.content[i] & PACKET != 0 {
                let (content, triangles) = self.add_packet(bvh, (node.content[i] & !PACKET) as usize, first);
                Child { low, high, content, triangles, depth: 0 }
            } else {
                Child { low, high, ..self.add_node(bvh, node.content[i] as usize, first) }
            });
        }
        self.join(&mut children)
    }

    fn add_packet(&mut self, bvh: &Bvh, packet: usize, first: u32) -> (u32, usize) {
        let (packet, start) = (&bvh.packets[packet], self.triangles.len() / TRIANGLE);
        for i in (0..WIDTH).filter(|i| packet.ids[*i] != u32::MAX) {
            self.triangles.extend(packet.corners.iter().flat_map(|c| c.map(|axis| axis[i].to_bits())));
            self.triangles.push(first + packet.ids[i]);
        }
        let n = self.triangles.len() / TRIANGLE - start;
        assert!(start + n < MOST, "a device traces fewer than {MOST} triangles");
        (LEAF | (start as u32) << 3 | (n as u32 - 1), n)
    }

    /// A tree of children: few are divided where it costs least by the surface area heuristic, many in the middle.
    ///
    /// # Panics
    /// When there are no children.
    pub fn join(&mut self, children: &mut [Child]) -> Child {
        if let [only] = children {
            return *only;
        }
        let middle = if children.len() <= WIDTH { cheapest(children) } else { halved(children) };
        let at = self.nodes.len() / NODE;
        self.nodes.resize(self.nodes.len() + NODE, 0);
        let (left, right) = children.split_at_mut(middle);
        let two = [self.join(left), self.join(right)];
        let node = &mut self.nodes[at * NODE..][..NODE];
        for (i, child) in two.iter().enumerate() {
            for k in 0..3 {
                (node[i * 6 + k], node[i * 6 + 3 + k]) = (child.low[k].to_bits(), child.high[k].to_bits());
            }
            node[12 + i] = child.content;
        }
        Child { content: at as u32, depth: 1 + two[0].depth.max(two[1].depth), ..enclosing(&two) }
    }
}

/// Sorts a few children such that the first so many, which are returned, are one half of the cheapest two.
fn cheapest(children: &mut [Child]) -> usize {
    let mut best = (f32::INFINITY, 0, 1);
    for axis in 0..3 {
        sort(children, axis);
        for middle in 1..children.len() {
            let cost = |part: &[Child]| area(&enclosing(part)) * enclosing(part).triangles as f32;
            let total = cost(&children[..middle]) + cost(&children[middle..]);
            if total < best.0 {
                best = (total, axis, middle);
            }
        }
    }
    sort(children, best.1);
    best.2
}

/// Sorts children along the axis on which their centers are farthest apart, and returns half their number.
fn halved(children: &mut [Child]) -> usize {
    let spread = |k: usize| {
        let (a, b) = children.iter().fold((f32::MAX, f32::MIN), |(a, b), c| (a.min(c.low[k] + c.high[k]), b.max(c.low[k] + c.high[k])));
        b - a
    };
    let axis = (0..3).max_by(|a, b| spread(*a).total_cmp(&spread(*b))).expect("three axes");
    sort(children, axis);
    children.len() / 2
}

/// By the centers of their boxes.
fn sort(children: &mut [Child], axis: usize) {
    children.sort_by(|a, b| (a.low[axis] + a.high[axis]).total_cmp(&(b.low[axis] + b.high[axis])).then(a.content.cmp(&b.content)));
}

/// The box around children, with their triangles.
fn enclosing(children: &[Child]) -> Child {
    let mut all = children[0];
    for c in &children[1..] {
        (0..3).for_each(|k| (all.low[k], all.high[k]) = (all.low[k].min(c.low[k]), all.high[k].max(c.high[k])));
        all.triangles += c.triangles;
    }
    all
}

/// Half of the surface area.
fn area(c: &Child) -> f32 {
    let [x, y, z]: [f32; 3] = std::array::from_fn(|k| c.high[k] - c.low[k]);
    x * y + y * z + z * x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_triangle_is_in_the_boxes_above_it_once() {
        let vertices: Vec<[f32; 3]> = diorama_testkit::random(900, 4).chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
        let faces: Vec<[u32; 3]> = (0..300).map(|i| [i, (i * 7 + 1) % 300, (i * 13 + 5) % 300]).collect();
        let mut forest = Forest::default();
        let root = forest.add(&Bvh::build(&vertices, &faces), 1000).unwrap();
        assert!(forest.add(&Bvh::build(&[], &[]), 0).is_none());
        let mut seen = vec![0; faces.len()];
        let mut open = vec![(root, 0)];
        while let Some((c, depth)) = open.pop() {
            assert!(depth <= root.depth);
            if c.content & LEAF == 0 {
                let node = &forest.nodes[c.content as usize * NODE..][..NODE];
                for i in 0..2 {
                    let corner = |at: usize| [0, 1, 2].map(|k| f32::from_bits(node[i * 6 + at + k]));
                    let child = Child { low: corner(0), high: corner(3), content: node[12 + i], ..c };
                    assert!((0..3).all(|k| child.low[k] >= c.low[k] && child.high[k] <= c.high[k]));
                    open.push((child, depth + 1));
                }
                continue;
            }
            let first = ((c.content & !LEAF) >> 3) as usize;
            for t in forest.triangles[first * TRIANGLE..].chunks_exact(TRIANGLE).take((c.content & 7) as usize + 1) {
                let id = t[9] as usize - 1000;
                seen[id] += 1;
                for (corner, v) in faces[id].iter().enumerate() {
                    let p = [0, 1, 2].map(|k| f32::from_bits(t[3 * corner + k]));
                    assert!(p == vertices[*v as usize] && (0..3).all(|k| p[k] >= c.low[k] && p[k] <= c.high[k]));
                }
            }
        }
        assert!(seen.iter().all(|n| *n == 1));
    }
}
