//! Triangles of a scene and where rays meet them: parts that stand once share one hierarchy, parts that stand several times have one each
//! with a transform per copy.

use super::vector::{V3, cross, mix, sub, transform_direction, transform_normal, transform_point, unit};
use crate::ops::ray_triangles::{Bvh, Hit, Ray};
use crate::tasks::prefetch;
use diorama_geom::glam::DAffine3;
use diorama_geom::model::{Model, Opacity};

/// Affine transform, rows `[axis][x, y, z, 1]`.
pub type Affine = [[f32; 4]; 3];

const IDENTITY: Affine = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// Triangles with one hierarchy.
#[derive(Clone, Debug)]
pub struct Mesh {
    pub bvh: Bvh,
    pub vertices: Vec<Vertex>,
    pub faces: Vec<Face>,
}

/// What is interpolated between the corners of a triangle; together, because a hit reads all of it.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub struct Vertex {
    pub position: V3,
    pub normal: V3,
    /// Along u, with the sign of the direction against v; zero where there is none.
    pub tangent: [f32; 4],
    pub uv: [f32; 2],
    /// Linear factor of the base color.
    pub color: V3,
}

/// A triangle.
#[derive(Clone, Copy, Debug)]
pub struct Face {
    pub corners: [u32; 3],
    pub material: u32,
    /// The instance that it belongs to, in meshes that stand once.
    pub instance: u32,
}

/// A mesh where it stands.
#[derive(Clone, Debug)]
pub struct Placed {
    pub mesh: usize,
    /// Index of the instance, for meshes that stand several times.
    pub instance: u32,
    pub is_moved: bool,
    pub world_from_mesh: Affine,
    pub mesh_from_world: Affine,
    pub low: V3,
    pub high: V3,
}

/// A node of the tree of placed meshes: `low`, `high`, and either two children or one mesh.
#[derive(Clone, Debug)]
struct Node {
    low: V3,
    high: V3,
    /// Index of the first of two adjacent children, or the placed mesh with [`LEAF`] set.
    content: u32,
}

const LEAF: u32 = 1 << 31;

/// All triangles of a scene.
#[derive(Clone, Debug)]
pub struct Geometry {
    pub meshes: Vec<Mesh>,
    /// Those that light cannot pass, and those that it can pass in places.
    pub solid: Tree,
    pub porous: Tree,
    pub triangles: usize,
}

/// Placed meshes and the tree over them.
#[derive(Clone, Debug, Default)]
pub struct Tree {
    pub placed: Vec<Placed>,
    nodes: Vec<Node>,
}

/// A place on a surface.
#[derive(Clone, Copy, Debug)]
pub struct Found {
    pub hit: Hit,
    is_porous: bool,
    placed: u32,
}

/// Properties of a surface at a point, interpolated; directions are in the world and of length 1.
#[derive(Clone, Copy, Debug)]
pub struct Point {
    pub position: V3,
    /// Of the triangle.
    pub flat_normal: V3,
    pub normal: V3,
    /// As [`diorama_geom::Mesh::tangents`]; zero without texture coordinates.
    pub tangent: [f32; 4],
    pub uv: [f32; 2],
    pub color: V3,
    pub material: u32,
    pub instance: u32,
}

/// Triangles of copies that are stored one by one in the world, because one hierarchy is faster than one per copy; more stay shared.
const SPREAD_OUT: usize = 1 << 21;

impl Geometry {
    /// # Panics
    /// When a part, material or vertex that is referred to does not exist.
    pub fn new(model: &Model) -> Geometry {
        Geometry::with_copies(model, SPREAD_OUT)
    }

    /// The same, with the number of triangles of copies up to which these are stored one by one.
    pub fn with_copies(model: &Model, spread_out: usize) -> Geometry {
        let mut uses = vec![0usize; model.parts.len()];
        model.instances.iter().for_each(|i| uses[i.part] += 1);
        let copied: usize = model.parts.iter().zip(&uses).filter(|(_, n)| **n > 1).map(|(p, n)| p.mesh.faces.len() * n).sum();
        if copied <= spread_out {
            uses.fill(1);
        }
        let is_porous = |part: usize| {
            let m = &model.materials[model.parts[part].material];
            m.opacity != Opacity::Opaque || m.transmission > 0.0
        };
        let mut geometry = Geometry { meshes: Vec::new(), solid: Tree::default(), porous: Tree::default(), triangles: model.face_count() };
        for porous in [false, true] {
            let mut once = Mesh::empty();
            let mut placed = Vec::new();
            let mut of_part = vec![None; model.parts.len()];
            for (i, instance) in model.instances.iter().enumerate() {
                let part = instance.part;
                if is_porous(part) != porous || model.parts[part].mesh.faces.is_empty() {
                    continue;
                }
                let world_from_mesh = rows(&instance.world_from_part);
                if uses[part] == 1 {
                    once.append(model, part, i as u32, &instance.world_from_part);
                    continue;
                }
                let mesh = *of_part[part].get_or_insert_with(|| {
                    let mut mesh = Mesh::empty();
                    mesh.append(model, part, 0, &DAffine3::IDENTITY);
                    geometry.meshes.push(mesh.finished());
                    geometry.meshes.len() - 1
                });
                let (low, high) = bounds(geometry.meshes[mesh].vertices.iter().map(|v| transform_point(&world_from_mesh, v.position)));
                let mesh_from_world = rows(&instance.world_from_part.inverse());
                placed.push(Placed { mesh, instance: i as u32, is_moved: true, world_from_mesh, mesh_from_world, low, high });
            }
            if !once.faces.is_empty() {
                let (low, high) = bounds(once.vertices.iter().map(|v| v.position));
                geometry.meshes.push(once.finished());
                let mesh = geometry.meshes.len() - 1;
                placed.push(Placed { mesh, instance: 0, is_moved: false, world_from_mesh: IDENTITY, mesh_from_world: IDENTITY, low, high });
            }
            *(if porous { &mut geometry.porous } else { &mut geometry.solid }) = Tree::new(placed);
        }
        geometry
    }

    /// The nearest surface, if any.
    pub fn nearest(&self, ray: &Ray) -> Option<Found> {
        let solid = self.solid.nearest(&self.meshes, ray, false);
        let mut range = ray.range;
        if let Some(found) = &solid {
            range[1] = found.hit.t;
        }
        self.nearest_porous(&Ray { range, ..*ray }).or(solid)
    }

    /// The nearest surface that each ray meets, if any; faster with `alike` where neighbors among the rays start and point alike.
    #[inline(always)]
    pub fn nearest_each(&self, rays: &[Ray], alike: bool, hits: &mut [Hit], found: &mut [Option<Found>]) {
        let Some(mesh) = self.solid.only(&self.meshes).filter(|_| self.porous.nodes.is_empty()) else {
            return found.iter_mut().zip(rays).for_each(|(found, ray)| *found = self.nearest(ray));
        };
        if alike {
            mesh.bvh.trace_neighbors(rays, hits);
        } else {
            mesh.bvh.trace_each(rays, false, hits);
        }
        for (found, hit) in found.iter_mut().zip(hits) {
            *found = hit.is_some().then_some(Found { hit: *hit, is_porous: false, placed: 0 });
        }
    }

    /// Some hit of each ray with what light cannot pass, or none.
    #[inline(always)]
    pub fn blocking_each(&self, rays: &[Ray], hits: &mut [Hit]) {
        match self.solid.only(&self.meshes) {
            Some(mesh) => mesh.bvh.trace_each(rays, true, hits),
            None => hits.iter_mut().zip(rays).for_each(|(hit, ray)| {
                *hit = self.solid.nearest(&self.meshes, ray, true).map_or(Hit::NONE, |f| f.hit);
            }),
        }
    }

    /// The nearest surface among those that light may pass.
    pub fn nearest_porous(&self, ray: &Ray) -> Option<Found> {
        if self.porous.nodes.is_empty() {
            None
        } else {
            self.porous.nearest(&self.meshes, ray, false).map(|f| Found { is_porous: true, ..f })
        }
    }

    /// Whether something that light cannot pass is in the way.
    pub fn is_blocked(&self, ray: &Ray) -> bool {
        self.solid.nearest(&self.meshes, ray, true).is_some()
    }

    /// Starts to fetch what [`Geometry::prefetch_vertices`] reads.
    #[inline(always)]
    pub fn prefetch_face(&self, found: &Found) {
        prefetch(&self.mesh(found).1.faces[found.hit.triangle as usize]);
    }

    /// Starts to fetch what [`Geometry::point`] reads.
    #[inline(always)]
    pub fn prefetch_vertices(&self, found: &Found) {
        let mesh = self.mesh(found).1;
        mesh.faces[found.hit.triangle as usize].corners.iter().for_each(|v| prefetch(&mesh.vertices[*v as usize]));
    }

    #[inline(always)]
    fn mesh(&self, found: &Found) -> (&Placed, &Mesh) {
        let tree = if found.is_porous { &self.porous } else { &self.solid };
        let placed = &tree.placed[found.placed as usize];
        (placed, &self.meshes[placed.mesh])
    }

    /// Properties of a surface that was found; the tangent only where `needs_tangent` says so of a material, else it is zero.
    #[inline(always)]
    pub fn point(&self, found: &Found, needs_tangent: impl Fn(u32) -> bool) -> Point {
        let (placed, mesh) = self.mesh(found);
        let (face, w) = (&mesh.faces[found.hit.triangle as usize], found.hit.weights);
        let corners = face.corners.map(|v| &mesh.vertices[v as usize]);
        let p = corners.map(|v| v.position);
        let flat = cross(sub(p[1], p[0]), sub(p[2], p[0]));
        let mut tangent = [0.0; 4];
        if needs_tangent(face.material) {
            tangent = mix(corners.map(|v| v.tangent), w);
            if tangent[3] == 0.0 {
                tangent = tangent_of(p, corners.map(|v| v.uv));
            }
        }
        let mut point = Point {
            position: mix(p, w),
            flat_normal: unit(flat),
            normal: mix(corners.map(|v| v.normal), w),
            tangent,
            uv: mix(corners.map(|v| v.uv), w),
            color: mix(corners.map(|v| v.color), w),
            material: face.material,
            instance: if placed.is_moved { placed.instance } else { face.instance },
        };
        if placed.is_moved {
            let t = [tangent[0], tangent[1], tangent[2]];
            let [x, y, z] = transform_direction(&placed.world_from_mesh, t);
            point.position = transform_point(&placed.world_from_mesh, point.position);
            point.flat_normal = unit(transform_normal(&placed.mesh_from_world, flat));
            point.normal = transform_normal(&placed.mesh_from_world, point.normal);
            point.tangent = [x, y, z, tangent[3]];
        }
        point.normal = unit(point.normal);
        point
    }
}

/// Direction of u across a triangle, and the sign of the direction against v; zero where texture coordinates do not span it.
#[inline(always)]
fn tangent_of(p: [V3; 3], uv: [[f32; 2]; 3]) -> [f32; 4] {
    let (e, f) = (sub(p[1], p[0]), sub(p[2], p[0]));
    let (a, b) = ([uv[1][0] - uv[0][0], uv[1][1] - uv[0][1]], [uv[2][0] - uv[0][0], uv[2][1] - uv[0][1]]);
    let det = a[0] * b[1] - b[0] * a[1];
    if det == 0.0 {
        return [0.0; 4];
    }
    let t = unit(std::array::from_fn(|k| (e[k] * b[1] - f[k] * a[1]) / det));
    // Normal × tangent points along +v where u, v turn clockwise, seen from outside: v grows downwards.
    [t[0], t[1], t[2], if det < 0.0 { 1.0 } else { -1.0 }]
}

fn rows(m: &DAffine3) -> Affine {
    let (x, y, z, t) = (m.matrix3.x_axis, m.matrix3.y_axis, m.matrix3.z_axis, m.translation);
    std::array::from_fn(|i| [x[i] as f32, y[i] as f32, z[i] as f32, t[i] as f32])
}

fn bounds(points: impl Iterator<Item = V3>) -> (V3, V3) {
    points.fold(([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]), |(low, high), p| union((low, high), (p, p)))
}

fn union(a: (V3, V3), b: (V3, V3)) -> (V3, V3) {
    (std::array::from_fn(|k| a.0[k].min(b.0[k])), std::array::from_fn(|k| a.1[k].max(b.1[k])))
}

impl Mesh {
    fn empty() -> Mesh {
        Mesh { bvh: Bvh::build(&[], &[]), vertices: Vec::new(), faces: Vec::new() }
    }

    fn append(&mut self, model: &Model, part: usize, instance: u32, world_from_part: &DAffine3) {
        let (part, first) = (&model.parts[part], self.vertices.len() as u32);
        let (mesh, n) = (&part.mesh, part.mesh.positions.len());
        assert!(part.material < model.materials.len(), "part {} has a material that does not exist", part.name);
        let (there, back) = (rows(world_from_part), rows(&world_from_part.inverse()));
        let mut normals = mesh.normals.clone();
        if normals.len() != n {
            let mut shaded = diorama_geom::Mesh { positions: mesh.positions.clone(), faces: mesh.faces.clone(), ..Default::default() };
            shaded.compute_normals();
            normals = shaded.normals;
        }
        let linear = |c: &V3| c.map(diorama_geom::color::linear_from_srgb);
        self.vertices.extend((0..n).map(|i| Vertex {
            position: transform_point(&there, mesh.positions[i]),
            normal: transform_normal(&back, normals[i]),
            tangent: mesh.tangents.get(i).map_or([0.0; 4], |t| {
                let [x, y, z] = transform_direction(&there, [t[0], t[1], t[2]]);
                [x, y, z, t[3]]
            }),
            uv: mesh.uvs.get(i).copied().unwrap_or([0.0; 2]),
            color: mesh.colors_srgb.get(i).map_or([1.0; 3], linear),
        }));
        // A reflection turns triangles inside out.
        let is_mirrored = world_from_part.matrix3.determinant() < 0.0;
        let turned = |f: &[u32; 3]| if is_mirrored { [f[0], f[2], f[1]] } else { *f }.map(|v| first + v);
        let material = part.material as u32;
        self.faces.extend(mesh.faces.iter().map(|f| Face { corners: turned(f), material, instance }));
    }

    fn finished(mut self) -> Mesh {
        let positions: Vec<V3> = self.vertices.iter().map(|v| v.position).collect();
        let triangles: Vec<[u32; 3]> = self.faces.iter().map(|f| f.corners).collect();
        self.bvh = Bvh::build(&positions, &triangles);
        self
    }
}

impl Tree {
    fn new(mut placed: Vec<Placed>) -> Tree {
        let mut nodes = Vec::new();
        if !placed.is_empty() {
            let mut order: Vec<u32> = (0..placed.len() as u32).collect();
            nodes.push(Node { low: [0.0; 3], high: [0.0; 3], content: 0 });
            split(&placed, &mut order, 0, &mut nodes);
        }
        placed.shrink_to_fit();
        Tree { placed, nodes }
    }

    /// The mesh, if it is alone and where it stands in the world.
    #[inline(always)]
    fn only<'a>(&self, meshes: &'a [Mesh]) -> Option<&'a Mesh> {
        let [only] = &self.placed[..] else { return None };
        (!only.is_moved).then(|| &meshes[only.mesh])
    }

    fn nearest(&self, meshes: &[Mesh], ray: &Ray, any: bool) -> Option<Found> {
        if let Some(mesh) = self.only(meshes) {
            let hit = mesh.bvh.trace_one(ray, any);
            return hit.is_some().then_some(Found { hit, is_porous: false, placed: 0 });
        }
        let inverse = ray.direction.map(|d| 1.0 / if d.abs() < 1e-30 { 1e-30f32.copysign(d) } else { d });
        let mut best: Option<Found> = None;
        let mut range = ray.range;
        // Where the ray enters a node's box, unless it misses it or something nearer was found.
        let entry = |node: &Node, range: [f32; 2]| {
            let (mut near, mut far) = (range[0], range[1]);
            for k in 0..3 {
                let (a, b) = ((node.low[k] - ray.origin[k]) * inverse[k], (node.high[k] - ray.origin[k]) * inverse[k]);
                near = near.max(a.min(b));
                far = far.min(a.max(b) * 1.000_000_4);
            }
            (near <= far).then_some(near)
        };
        let mut stack = [(0u32, 0.0f32); 64];
        let mut size = self.nodes.first().and_then(|n| entry(n, range)).is_some() as usize;
        while size > 0 {
            size -= 1;
            let (at, near) = stack[size];
            if near > range[1] {
                continue;
            }
            let node = &self.nodes[at as usize];
            if node.content & LEAF == 0 {
                let mut children = [0, 1].map(|i| (node.content + i, entry(&self.nodes[(node.content + i) as usize], range)));
                if children[0].1 < children[1].1 {
                    children.swap(0, 1);
                }
                // The nearer one on top.
                for (child, near) in children {
                    if let Some(near) = near {
                        stack[size] = (child, near);
                        size += 1;
                    }
                }
                continue;
            }
            let index = node.content & !LEAF;
            let placed = &self.placed[index as usize];
            let mut local = Ray { range, ..*ray };
            if placed.is_moved {
                local.origin = transform_point(&placed.mesh_from_world, ray.origin);
                local.direction = transform_direction(&placed.mesh_from_world, ray.direction);
            }
            let hit = meshes[placed.mesh].bvh.trace_one(&local, any);
            if hit.is_some() {
                best = Some(Found { hit, is_porous: false, placed: index });
                range[1] = hit.t;
                if any {
                    break;
                }
            }
        }
        best
    }
}

/// Fills in node `at` and what is below it, halved by the centers of the boxes.
fn split(placed: &[Placed], order: &mut [u32], at: usize, nodes: &mut Vec<Node>) {
    let of = |i: u32| (placed[i as usize].low, placed[i as usize].high);
    let (low, high) = order.iter().map(|i| of(*i)).reduce(union).expect("at least one");
    (nodes[at].low, nodes[at].high) = (low, high);
    if let [only] = order {
        nodes[at].content = *only | LEAF;
        return;
    }
    let center = |i: u32, k: usize| of(i).0[k] + of(i).1[k];
    let spread = |k: usize| {
        let (a, b) = order.iter().fold((f32::MAX, f32::MIN), |(a, b), i| (a.min(center(*i, k)), b.max(center(*i, k))));
        b - a
    };
    let axis = (0..3).max_by(|a, b| spread(*a).total_cmp(&spread(*b))).expect("three axes");
    order.sort_by(|a, b| center(*a, axis).total_cmp(&center(*b, axis)).then(a.cmp(b)));
    let first = nodes.len();
    nodes[at].content = first as u32;
    nodes.extend([(); 2].map(|_| Node { low: [0.0; 3], high: [0.0; 3], content: 0 }));
    let (left, right) = order.split_at_mut(order.len() / 2);
    split(placed, left, first, nodes);
    split(placed, right, first + 1, nodes);
}
