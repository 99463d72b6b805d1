//! Parallel over chunks of edges, tetrahedra and vertices; gradients are gathered, so no two threads write the same number.

use super::{MIN_GAP, Surface, Topology, case_table};
use rayon::prelude::*;

/// Elements per task.
const CHUNK: usize = 1 << 14;

/// Share of the way from the inside end to the outside end at which the distance is zero; the middle if the values overflow.
#[inline]
fn crossing(inside: f32, outside: f32) -> f32 {
    let t = inside / (inside - outside);
    if t.is_finite() { t } else { 0.5 }
}

/// Extracts the surface into `out`.
///
/// # Shapes
/// s: `[V]`; positions: `[V, 3]`.
///
/// # Panics
/// When the shapes differ from the topology's.
pub fn extract(topology: &Topology, s: &[f32], positions: &[[f32; 3]], out: &mut Surface) {
    let vertices = topology.vertices();
    assert!(s.len() == vertices && positions.len() == vertices, "tetrahedral surface: {} values for {vertices} vertices", s.len());
    out.inside.clear();
    out.inside.par_extend(s.par_iter().map(|s| *s > 0.0));
    number_cut_edges(topology, out);
    let (inside, edges) = (&out.inside, topology.edges());
    let vertex = |e: &u32| {
        let [a, b] = edges[*e as usize].map(|i| i as usize);
        let [a, b] = if inside[a] { [a, b] } else { [b, a] };
        let (t, p, q) = (crossing(s[a], s[b]), positions[a], positions[b]);
        std::array::from_fn(|k| p[k] + t * (q[k] - p[k]))
    };
    out.positions.clear();
    out.positions.par_extend(out.cut_edges.par_iter().with_min_len(1024).map(vertex));
    connect(topology, out);
}

/// Numbers the surface vertices in the order of their edges, and lists the ends of those edges.
fn number_cut_edges(topology: &Topology, out: &mut Surface) {
    let (inside, edges) = (&out.inside, topology.edges());
    let is_cut = |e: &[u32; 2]| inside[e[0] as usize] != inside[e[1] as usize];
    let found: Vec<Vec<u32>> = edges
        .par_chunks(CHUNK)
        .enumerate()
        .map(|(c, part)| (0..part.len()).filter(|i| is_cut(&part[*i])).map(|i| (c * CHUNK + i) as u32).collect())
        .collect();
    out.cut_edges.clear();
    found.iter().for_each(|part| out.cut_edges.extend_from_slice(part));
    out.vertex_of_edge.resize(edges.len(), 0);
    let mut is_active = vec![false; inside.len()];
    for (i, e) in out.cut_edges.iter().enumerate() {
        out.vertex_of_edge[*e as usize] = i as u32;
        edges[*e as usize].iter().for_each(|i| is_active[*i as usize] = true);
    }
    out.active.clear();
    out.active.extend((0..is_active.len()).filter(|i| is_active[*i]).map(|i| i as u32));
}

fn connect(topology: &Topology, out: &mut Surface) {
    let (table, inside, vertex_of_edge) = (case_table(), &out.inside, &out.vertex_of_edge);
    let parts = topology.cells().par_chunks(CHUNK).zip(topology.cell_edges().par_chunks(CHUNK));
    let found: Vec<Vec<[u32; 3]>> = parts
        .map(|(cells, cell_edges)| {
            let mut faces = Vec::new();
            for (cell, edges) in cells.iter().zip(cell_edges) {
                let case = (0..4).fold(0, |case, k| case | (inside[cell[k] as usize] as usize) << k);
                if case != 0 && case != 15 {
                    faces.extend(table[case].iter().map(|t| t.map(|e| vertex_of_edge[edges[e as usize] as usize])));
                }
            }
            faces
        })
        .collect();
    out.faces.clear();
    found.iter().for_each(|part| out.faces.extend_from_slice(part));
}

/// Adds the gradients of the surface's vertices to those of the distances and the grid's positions.
///
/// # Shapes
/// s, d_s: `[V]`; positions, d_positions: `[V, 3]`; d_vertices: `[N, 3]`. `surface` is what [`extract`] made of the same values.
///
/// # Panics
/// When the shapes differ.
pub fn backward(
    topology: &Topology,
    surface: &Surface,
    (s, positions): (&[f32], &[[f32; 3]]),
    d_vertices: &[[f32; 3]],
    (d_s, d_positions): (&mut [f32], &mut [[f32; 3]]),
) {
    let vertices = topology.vertices();
    let shapes = [s.len(), positions.len(), d_s.len(), d_positions.len(), surface.inside.len()];
    assert!(shapes == [vertices; 5] && d_vertices.len() == surface.cut_edges.len(), "tetrahedral surface: shapes of the gradients");
    gather(surface, d_s, d_positions, &|i, d_s, d_position| {
        let own = surface.inside[i];
        for e in topology.edges_at(i) {
            let [a, b] = topology.edges()[*e as usize];
            let other = (if a as usize == i { b } else { a }) as usize;
            if surface.inside[other] == own {
                continue;
            }
            let d = d_vertices[surface.vertex_of_edge[*e as usize] as usize];
            let gap = (s[i] - s[other]).abs();
            // Along the edge from here, the crossing is at `s_i / (s_i − s_o)`.
            let t = if own { crossing(s[i], s[other]) } else { 1.0 - crossing(s[other], s[i]) };
            let along: f32 = (0..3).map(|k| d[k] * (positions[other][k] - positions[i][k])).sum();
            let slope = along * (1.0 - t) / gap.max(MIN_GAP);
            *d_s += if own { slope } else { -slope };
            (0..3).for_each(|k| d_position[k] += (1.0 - t) * d[k]);
        }
    });
}

/// Calls `f(vertex, its d_s, its d_position)` for each end of a cut edge.
fn gather(surface: &Surface, d_s: &mut [f32], d_positions: &mut [[f32; 3]], f: &(impl Fn(usize, &mut f32, &mut [f32; 3]) + Sync)) {
    let chunks = d_s.par_chunks_mut(CHUNK).zip(d_positions.par_chunks_mut(CHUNK)).enumerate();
    chunks.for_each(|(c, (d_s, d_positions))| {
        for i in active_in(&surface.active, c * CHUNK..c * CHUNK + d_s.len()) {
            let own = *i as usize - c * CHUNK;
            f(*i as usize, &mut d_s[own], &mut d_positions[own]);
        }
    });
}

/// The active vertices with numbers in `range`.
pub(crate) fn active_in(active: &[u32], range: std::ops::Range<usize>) -> &[u32] {
    let at = |n: usize| active.partition_point(|i| (*i as usize) < n);
    &active[at(range.start)..at(range.end)]
}
