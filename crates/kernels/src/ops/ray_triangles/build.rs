//! Builds the hierarchy: first with two children per node, then nodes are merged to eight.

use super::{Bvh, LEAF, Node, Packet, WIDTH};

/// Bins per axis.
const BINS: usize = 16;
/// Depth from which on nodes are split in the middle, so that no arrangement of triangles makes the tree deep.
const DEEP: usize = 40;
/// Triangles of a node whose halves are built by two threads.
const PARALLEL: usize = 1 << 14;

#[derive(Clone, Copy)]
struct Bounds {
    low: [f32; 3],
    high: [f32; 3],
}

impl Bounds {
    const EMPTY: Bounds = Bounds { low: [f32::INFINITY; 3], high: [f32::NEG_INFINITY; 3] };

    fn union(self, other: Bounds) -> Bounds {
        Bounds {
            low: std::array::from_fn(|i| self.low[i].min(other.low[i])),
            high: std::array::from_fn(|i| self.high[i].max(other.high[i])),
        }
    }

    fn with(self, p: [f32; 3]) -> Bounds {
        self.union(Bounds { low: p, high: p })
    }

    /// Half of the surface area; 0 if empty.
    fn area(&self) -> f32 {
        let [x, y, z]: [f32; 3] = std::array::from_fn(|i| (self.high[i] - self.low[i]).max(0.0));
        x * y + y * z + z * x
    }
}

/// A triangle to be placed.
#[derive(Clone, Copy)]
struct Item {
    bounds: Bounds,
    center: [f32; 3],
    id: u32,
}

enum Tree {
    Leaf { items: Vec<u32>, bounds: Bounds },
    Inner { children: Box<[Tree; 2]>, bounds: Bounds },
}

impl Tree {
    fn bounds(&self) -> Bounds {
        match self {
            Tree::Leaf { bounds, .. } | Tree::Inner { bounds, .. } => *bounds,
        }
    }
}

impl Bvh {
    /// A hierarchy of triangles. Those with corners that are not finite are left out.
    ///
    /// # Shapes
    /// vertices `[V, 3]`, triangles `[T, 3]`.
    ///
    /// # Panics
    /// When a triangle names a vertex that does not exist, or there are 2³¹ triangles or more.
    pub fn build(vertices: &[[f32; 3]], triangles: &[[u32; 3]]) -> Bvh {
        assert!(triangles.len() < LEAF as usize, "{} triangles", triangles.len());
        let mut items: Vec<Item> = triangles
            .iter()
            .enumerate()
            .filter_map(|(id, triangle)| {
                let bounds = triangle.iter().fold(Bounds::EMPTY, |b, &v| b.with(vertices[v as usize]));
                let finite = triangle.iter().all(|&v| vertices[v as usize].iter().all(|x| x.is_finite()));
                let center = std::array::from_fn(|i| 0.5 * bounds.low[i] + 0.5 * bounds.high[i]);
                finite.then_some(Item { bounds, center, id: id as u32 })
            })
            .collect();
        let mut bvh = Bvh { nodes: Vec::new(), packets: Vec::new() };
        if !items.is_empty() {
            let tree = grow(&mut items, 0);
            let tree = match tree {
                Tree::Leaf { .. } => vec![tree],
                Tree::Inner { children, .. } => Vec::from(*children),
            };
            bvh.push(tree, &|id| triangles[id as usize].map(|v| vertices[v as usize]));
        }
        bvh
    }

    /// Appends a node of two children, of which the largest are replaced by their own children until there are eight.
    fn push(&mut self, mut children: Vec<Tree>, corners: &impl Fn(u32) -> [[f32; 3]; 3]) -> u32 {
        loop {
            let inner = children.iter().enumerate().filter(|(_, c)| matches!(c, Tree::Inner { .. }));
            let largest = inner.max_by(|(_, a), (_, b)| a.bounds().area().total_cmp(&b.bounds().area())).map(|(i, _)| i);
            match largest {
                Some(i) if children.len() < WIDTH => {
                    if let Tree::Inner { children: two, .. } = children.swap_remove(i) {
                        children.extend(*two);
                    }
                }
                _ => break,
            }
        }
        let at = self.nodes.len();
        self.nodes.push(Node { bounds: [[[f32::INFINITY; WIDTH], [f32::NEG_INFINITY; WIDTH]]; 3], content: [LEAF; WIDTH] });
        for (i, child) in children.into_iter().enumerate() {
            let bounds = child.bounds();
            let content = match child {
                Tree::Leaf { items, .. } => {
                    let mut packet = Packet { corners: [[[f32::NAN; WIDTH]; 3]; 3], ids: [u32::MAX; WIDTH] };
                    for (slot, &id) in items.iter().enumerate() {
                        packet.ids[slot] = id;
                        for (corner, p) in corners(id).iter().enumerate() {
                            (0..3).for_each(|axis| packet.corners[corner][axis][slot] = p[axis]);
                        }
                    }
                    self.packets.push(packet);
                    LEAF | (self.packets.len() - 1) as u32
                }
                Tree::Inner { children, .. } => self.push(Vec::from(*children), corners),
            };
            let node = &mut self.nodes[at];
            node.content[i] = content;
            for axis in 0..3 {
                node.bounds[axis][0][i] = bounds.low[axis];
                node.bounds[axis][1][i] = bounds.high[axis];
            }
        }
        at as u32
    }
}

fn grow(items: &mut [Item], depth: usize) -> Tree {
    let bounds = items.iter().fold(Bounds::EMPTY, |b, i| b.union(i.bounds));
    if items.len() <= WIDTH {
        return Tree::Leaf { items: items.iter().map(|i| i.id).collect(), bounds };
    }
    let centers = items.iter().fold(Bounds::EMPTY, |b, i| b.with(i.center));
    let middle = match (depth < DEEP).then(|| split(items, &centers)).flatten() {
        Some(middle) => middle,
        None => halve(items, &centers),
    };
    let count = items.len();
    let (left, right) = items.split_at_mut(middle);
    let two = if count >= PARALLEL {
        rayon::join(|| grow(left, depth + 1), || grow(right, depth + 1))
    } else {
        (grow(left, depth + 1), grow(right, depth + 1))
    };
    Tree::Inner { children: Box::new([two.0, two.1]), bounds }
}

/// Half of the triangles, by the longest axis of their centers.
fn halve(items: &mut [Item], centers: &Bounds) -> usize {
    let extent = |i: usize| centers.high[i] - centers.low[i];
    let axis = (0..3).max_by(|a, b| extent(*a).total_cmp(&extent(*b))).unwrap_or(0);
    let middle = items.len() / 2;
    items.select_nth_unstable_by(middle, |a, b| a.center[axis].total_cmp(&b.center[axis]).then(a.id.cmp(&b.id)));
    middle
}

/// Partitions triangles at the border of bins that costs least; none if all centers are one point.
fn split(items: &mut [Item], centers: &Bounds) -> Option<usize> {
    let mut best: Option<(f32, usize, usize)> = None;
    for axis in 0..3 {
        let Some(bin) = binning(centers, axis) else { continue };
        let mut bins = [(Bounds::EMPTY, 0usize); BINS];
        for item in items.iter() {
            let (bounds, count) = &mut bins[bin(item)];
            (*bounds, *count) = (bounds.union(item.bounds), *count + 1);
        }
        let cost = |bounds: &Bounds, count: usize| bounds.area() * count.div_ceil(WIDTH) as f32;
        let mut right = [0.0f32; BINS];
        let (mut bounds, mut count) = (Bounds::EMPTY, 0);
        for i in (1..BINS).rev() {
            (bounds, count) = (bounds.union(bins[i].0), count + bins[i].1);
            right[i] = cost(&bounds, count);
        }
        (bounds, count) = (Bounds::EMPTY, 0);
        for i in 1..BINS {
            (bounds, count) = (bounds.union(bins[i - 1].0), count + bins[i - 1].1);
            let total = cost(&bounds, count) + right[i];
            if count > 0 && count < items.len() && best.is_none_or(|b| total < b.0) {
                best = Some((total, axis, i));
            }
        }
    }
    let (_, axis, border) = best?;
    let bin = binning(centers, axis)?;
    let mut middle = 0;
    for i in 0..items.len() {
        if bin(&items[i]) < border {
            items.swap(i, middle);
            middle += 1;
        }
    }
    Some(middle)
}

/// The bin of a triangle by its center; none if all centers have one coordinate.
fn binning(centers: &Bounds, axis: usize) -> Option<impl Fn(&Item) -> usize> {
    let (low, extent) = (centers.low[axis], centers.high[axis] - centers.low[axis]);
    let scale = BINS as f32 / extent;
    (extent > 0.0 && scale.is_finite()).then_some(move |item: &Item| (((item.center[axis] - low) * scale) as usize).min(BINS - 1))
}
