//! Closest points and signed distances of a triangle mesh, through a tree of boxes. The sign is that of the pseudonormal at the closest
//! point (Bærentzen and Aanæs 2005), which is exact for closed meshes.

use diorama_geom::Mesh;
use glam::Vec3;
use std::collections::HashMap;

/// Triangles per leaf.
const LEAF: usize = 4;

/// A point of the mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Closest {
    pub point: [f32; 3],
    pub face: u32,
    /// Barycentric coordinates; exactly 0 for corners that do not count.
    pub weights: [f32; 3],
    pub squared_distance: f32,
}

/// Closest-point queries of a mesh.
pub struct TriangleTree {
    triangles: Vec<[Vec3; 3]>,
    /// Order of the triangles in the tree.
    order: Vec<u32>,
    nodes: Vec<Node>,
}

/// Signed distances of a closed mesh.
pub struct SignedDistance {
    tree: TriangleTree,
    normals: Pseudonormals,
}

struct Node {
    lowest: Vec3,
    highest: Vec3,
    /// Triangles `first..end` of the order.
    first: u32,
    end: u32,
    /// The second child; the first follows its parent. 0 for leaves.
    second: u32,
}

/// Normals of faces, edges (k runs from corner k to k + 1) and corners.
struct Pseudonormals {
    faces: Vec<Vec3>,
    edges: Vec<[Vec3; 3]>,
    corners: Vec<[Vec3; 3]>,
}

impl TriangleTree {
    /// Builds the tree.
    ///
    /// # Panics
    /// When the mesh has no faces.
    pub fn new(mesh: &Mesh) -> TriangleTree {
        assert!(!mesh.faces.is_empty(), "closest point: a mesh without faces");
        let triangles: Vec<[Vec3; 3]> = mesh.faces.iter().map(|f| f.map(|i| Vec3::from(mesh.positions[i as usize]))).collect();
        let mut order: Vec<u32> = (0..triangles.len() as u32).collect();
        let mut nodes = Vec::with_capacity(triangles.len());
        build(&triangles, &mut order, 0, &mut nodes);
        TriangleTree { triangles, order, nodes }
    }

    /// The mesh's point closest to `p`.
    pub fn nearest(&self, p: [f32; 3]) -> Closest {
        let p = Vec3::from(p);
        let mut best = Closest { point: [0.0; 3], face: 0, weights: [1.0, 0.0, 0.0], squared_distance: f32::INFINITY };
        let mut stack = vec![(0usize, 0.0f32)];
        while let Some((i, bound)) = stack.pop() {
            if bound >= best.squared_distance {
                continue;
            }
            let node = &self.nodes[i];
            if node.second == 0 {
                for face in &self.order[node.first as usize..node.end as usize] {
                    let triangle = self.triangles[*face as usize];
                    let weights = closest_weights(p, triangle);
                    let point = triangle[0] * weights[0] + triangle[1] * weights[1] + triangle[2] * weights[2];
                    let squared_distance = point.distance_squared(p);
                    if squared_distance < best.squared_distance {
                        best = Closest { point: point.to_array(), face: *face, weights, squared_distance };
                    }
                }
                continue;
            }
            let children = [i + 1, node.second as usize].map(|c| (c, box_distance(p, &self.nodes[c])));
            let near_last = if children[0].1 < children[1].1 { [children[1], children[0]] } else { children };
            stack.extend(near_last);
        }
        best
    }
}

impl SignedDistance {
    /// Builds the tree and the normals.
    ///
    /// # Panics
    /// When the mesh has no faces.
    pub fn new(mesh: &Mesh) -> SignedDistance {
        let tree = TriangleTree::new(mesh);
        SignedDistance { normals: pseudonormals(mesh, &tree.triangles), tree }
    }

    /// The mesh's point closest to `p`.
    pub fn nearest(&self, p: [f32; 3]) -> Closest {
        self.tree.nearest(p)
    }

    /// Distance to the mesh, negative inside.
    pub fn at(&self, p: [f32; 3]) -> f32 {
        let c = self.nearest(p);
        let (face, used) = (c.face as usize, c.weights.map(|w| w > 0.0));
        let normal = match used {
            [true, true, true] => self.normals.faces[face],
            [true, true, false] => self.normals.edges[face][0],
            [false, true, true] => self.normals.edges[face][1],
            [true, false, true] => self.normals.edges[face][2],
            _ => self.normals.corners[face][used.iter().position(|u| *u).unwrap_or(0)],
        };
        let side = (Vec3::from(p) - Vec3::from(c.point)).dot(normal);
        if side < 0.0 { -c.squared_distance.sqrt() } else { c.squared_distance.sqrt() }
    }
}

/// Adds the node of `order`, whose first place is `first`, and all below it.
fn build(triangles: &[[Vec3; 3]], order: &mut [u32], first: usize, nodes: &mut Vec<Node>) {
    let empty = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    let corners = order.iter().flat_map(|i| triangles[*i as usize]);
    let (lowest, highest) = corners.fold(empty, |(lo, hi), p| (lo.min(p), hi.max(p)));
    let own = nodes.len();
    nodes.push(Node { lowest, highest, first: first as u32, end: (first + order.len()) as u32, second: 0 });
    if order.len() <= LEAF {
        return;
    }
    let size = (highest - lowest).to_array();
    let axis = (0..3).max_by(|a, b| size[*a].total_cmp(&size[*b])).unwrap_or(0);
    let center = |i: u32| triangles[i as usize].iter().map(|p| p[axis]).sum::<f32>();
    let half = order.len() / 2;
    order.select_nth_unstable_by(half, |a, b| center(*a).total_cmp(&center(*b)));
    let (low, high) = order.split_at_mut(half);
    build(triangles, low, first, nodes);
    nodes[own].second = nodes.len() as u32;
    build(triangles, high, first + half, nodes);
}

fn box_distance(p: Vec3, node: &Node) -> f32 {
    (node.lowest - p).max(p - node.highest).max(Vec3::ZERO).length_squared()
}

/// Barycentric coordinates of the point of a triangle closest to `p`: the foot on its plane if that lies inside, else the closest point of
/// its sides.
fn closest_weights(p: Vec3, [a, b, c]: [Vec3; 3]) -> [f32; 3] {
    let (u, v, w) = (b - a, c - a, p - a);
    let n = u.cross(v);
    let square = n.length_squared();
    if square > 0.0 {
        let (of_b, of_c) = (w.cross(v).dot(n) / square, u.cross(w).dot(n) / square);
        if of_b > 0.0 && of_c > 0.0 && of_b + of_c < 1.0 {
            return [1.0 - of_b - of_c, of_b, of_c];
        }
    }
    let corners = [a, b, c];
    let mut best = (f32::INFINITY, [1.0, 0.0, 0.0]);
    for k in 0..3 {
        let (from, side) = (corners[k], corners[(k + 1) % 3] - corners[k]);
        let length = side.length_squared();
        let t = if length > 0.0 { ((p - from).dot(side) / length).clamp(0.0, 1.0) } else { 0.0 };
        let distance = (from + side * t).distance_squared(p);
        if distance < best.0 {
            let mut weights = [0.0; 3];
            (weights[k], weights[(k + 1) % 3]) = (1.0 - t, t);
            best = (distance, weights);
        }
    }
    best.1
}

/// Unit normals of faces, sums of them at edges, and sums weighted by angle at corners.
fn pseudonormals(mesh: &Mesh, triangles: &[[Vec3; 3]]) -> Pseudonormals {
    let faces: Vec<Vec3> = triangles.iter().map(|[a, b, c]| (b - a).cross(c - a).normalize_or_zero()).collect();
    let key = |a: u32, b: u32| (a.min(b), a.max(b));
    let mut of_edges: HashMap<(u32, u32), Vec3> = HashMap::new();
    let mut of_vertices = vec![Vec3::ZERO; mesh.positions.len()];
    for ((f, t), n) in mesh.faces.iter().zip(triangles).zip(&faces) {
        for k in 0..3 {
            let (to, back) = (t[(k + 1) % 3] - t[k], t[(k + 2) % 3] - t[k]);
            *of_edges.entry(key(f[k], f[(k + 1) % 3])).or_default() += *n;
            of_vertices[f[k] as usize] += *n * to.cross(back).length().atan2(to.dot(back));
        }
    }
    Pseudonormals {
        edges: mesh.faces.iter().map(|f| [0, 1, 2].map(|k| of_edges[&key(f[k], f[(k + 1) % 3])])).collect(),
        corners: mesh.faces.iter().map(|f| f.map(|i| of_vertices[i as usize])).collect(),
        faces,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::rng::Rng;

    /// A box of half sizes 1, 0.5 and 0.1, outward.
    fn slab() -> Mesh {
        let corner = |c: usize| {
            [1.0, 0.5, 0.1].map(|h: f32| h).iter().enumerate().map(|(k, h)| if c >> k & 1 == 1 { *h } else { -h }).collect::<Vec<_>>()
        };
        let positions = (0..8).map(|c| corner(c).try_into().unwrap()).collect();
        let mut faces = Vec::new();
        for axis in 0..3usize {
            let (u, v) = (1 << ((axis + 1) % 3), 1 << ((axis + 2) % 3));
            let high = 1u32 << axis;
            faces.extend([[high, high | u, high | u | v], [high, high | u | v, high | v]]);
            faces.extend([[0, u | v, u], [0, v, u | v]]);
        }
        Mesh { positions, faces, ..Mesh::default() }
    }

    #[test]
    fn distances_of_a_box_are_exact() {
        let mesh = slab();
        assert!(mesh.is_watertight() && (mesh.volume() - 0.4).abs() < 1e-6);
        let (distance, rng) = (SignedDistance::new(&mesh), Rng::new(1, 1));
        for i in 0..2000 {
            let p: [f32; 3] = std::array::from_fn(|k| 4.0 * rng.uniform(i * 3 + k as u64) - 2.0).map(|v: f32| v * 0.7);
            let q: [f32; 3] = std::array::from_fn(|k| p[k].abs() - [1.0, 0.5, 0.1][k]);
            let out = q.map(|v| v.max(0.0));
            let want = (out[0] * out[0] + out[1] * out[1] + out[2] * out[2]).sqrt() + q[0].max(q[1]).max(q[2]).min(0.0);
            assert!((distance.at(p) - want).abs() < 1e-5, "{p:?}: {} {want}", distance.at(p));
        }
    }

    #[test]
    fn the_tree_finds_what_a_search_of_all_triangles_finds() {
        let rng = Rng::new(2, 2);
        let positions: Vec<[f32; 3]> = (0..600).map(|i| std::array::from_fn(|k| rng.uniform(i * 3 + k as u64))).collect();
        let faces: Vec<[u32; 3]> = (0..200).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        let mesh = Mesh { positions, faces, ..Mesh::default() };
        let tree = TriangleTree::new(&mesh);
        for i in 0..300u64 {
            let p: [f32; 3] = std::array::from_fn(|k| 2.0 * rng.uniform(9000 + i * 3 + k as u64) - 0.5);
            let got = tree.nearest(p);
            // Points of each triangle on a fine grid are no closer.
            let grid = (0..=20).flat_map(|a| (0..=20 - a).map(move |b| [a as f32 / 20.0, b as f32 / 20.0]));
            let least = grid
                .flat_map(|[a, b]| tree.triangles.iter().map(move |[x, y, z]| *x * (1.0 - a - b) + *y * a + *z * b))
                .map(|q| q.distance(Vec3::from(p)))
                .fold(f32::INFINITY, f32::min);
            let distance = got.squared_distance.sqrt();
            assert!(distance <= least + 1e-5 && distance > least - 0.1, "{distance} {least}");
            assert!((Vec3::from(got.point).distance(Vec3::from(p)) - distance).abs() < 1e-5);
        }
    }
}
