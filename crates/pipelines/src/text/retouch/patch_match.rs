//! Exemplar inpainting: a hole is filled with patches of its surroundings, coarse to fine, so that every patch in it looks like one outside
//! (Wexler, Shechtman, Irani 2007; the search is PatchMatch, Barnes et al. 2009).
//!
//! All views share one correspondence field, whose distances are summed over views: they get the same content, each in its own colors.

use super::CannotFill;
use super::patch_field::{Match, Patches, SIDE, Sweep};
use super::view_stack::{ViewStack, rim_distances};
use diorama_geom::Image;
use diorama_geom::rng::Rng;
use rayon::prelude::*;

/// Rounds of search and vote at the finest level, more per level above it, and at the coarsest level, where the content is decided.
const ROUNDS: usize = 2;
const ROUNDS_PER_LEVEL: usize = 1;
const ROUNDS_COARSEST: usize = 12;
/// Sweeps of the search in a round, one half in scan order, the other against it.
const SWEEPS: usize = 2;
/// Reach of random search below the coarsest level, which the level above has brought near.
const REACH: usize = 32;
/// Weight of a patch over that of one a pixel nearer to the hole's rim.
const TRUST: f32 = 1.0 / 1.3;
/// Distance from the rim beyond which weights no longer fall.
const DEEPEST: u32 = 150;
/// Share of the distances below the one at which a vote's weight is `exp(−1/2)`.
const TYPICAL: f64 = 0.75;
/// The same for the last vote, which keeps details sharp.
const TYPICAL_LAST: f64 = 0.25;
/// Thickness of a hole from its rim that needs no coarser level.
const THIN: u32 = 2;
/// Shortest side of the coarsest level.
const COARSEST: usize = 3 * SIDE;

/// The views with the pixels of the mask filled; others keep their values, and a seed gives the same result each time.
///
/// Views may be linear or sRGB-encoded; encoded ones weigh differences as they are seen. Shading that varies strongly should be divided
/// out before.
///
/// # Shapes
/// N views `[H, W, C]` of one size; `mask` `[H, W]`.
///
/// # Errors
/// When sizes differ, or no patch of 7x7 pixels is free of the mask.
pub fn fill(views: &[Image], mask: &[bool], seed: u64) -> Result<Vec<Image>, CannotFill> {
    let first = views.first().ok_or(CannotFill::NoViews)?;
    let size = |v: &Image| (v.width, v.height, v.channels);
    if mask.len() != first.width * first.height || views.iter().any(|v| size(v) != size(first)) {
        return Err(CannotFill::Sizes { mask: mask.len(), width: first.width, height: first.height });
    }
    let mut filled = views.to_vec();
    if mask.contains(&true) {
        filled_stack(ViewStack::new(views, mask), seed)?.copy_hole_into(&mut filled);
    }
    Ok(filled)
}

/// A stack with its hole filled.
fn filled_stack(stack: ViewStack, seed: u64) -> Result<ViewStack, CannotFill> {
    let finest = Patches::of(&stack).ok_or(CannotFill::NothingToCopy(SIDE))?;
    let mut levels = vec![(stack, finest)];
    while let Some(coarser) = levels.last().and_then(|(stack, _)| coarser(stack)) {
        levels.push(coarser);
    }
    let mut above: Option<(ViewStack, Patches, Vec<Match>)> = None;
    for (level, (mut stack, patches)) in levels.into_iter().enumerate().rev() {
        let rng = |k: u64| Rng::new(seed, (level as u64) << 32 | k);
        let (mut field, rounds, reach) = match &above {
            None => {
                stack.fill_smoothly();
                (patches.random_field(rng(0)), ROUNDS_COARSEST, usize::MAX)
            }
            Some((half, half_patches, field)) => {
                stack.fill_from_half(half);
                (patches.doubled_field(half_patches, field, rng(0)), ROUNDS + level * ROUNDS_PER_LEVEL, REACH)
            }
        };
        let trust = trust(&stack, &patches);
        for round in 0..rounds {
            patches.measure(&stack, &mut field);
            for sweep in 0..SWEEPS {
                let stream = 1 + (round * SWEEPS + sweep) as u64;
                patches.sweep(&stack, &mut field, Sweep { forward: sweep % 2 == 0, reach, rng: rng(stream) });
            }
            let is_last = level == 0 && round + 1 == rounds;
            vote(&mut stack, &patches, &field, &trust, if is_last { TYPICAL_LAST } else { TYPICAL });
        }
        above = Some((stack, patches, field));
    }
    Ok(above.expect("there is a finest level").0)
}

/// The level of half the size, while it has holes too thick for patches, and patches to copy.
fn coarser(stack: &ViewStack) -> Option<(ViewStack, Patches)> {
    let thickest = rim_distances(&stack.hole, stack.width, stack.height).into_iter().max()?;
    if thickest <= THIN || stack.width.min(stack.height) < 2 * COARSEST {
        return None;
    }
    let half = stack.halved();
    let patches = Patches::of(&half)?;
    patches.targets.contains(&true).then_some((half, patches))
}

/// Weight of each patch by the distance of its center from the hole's rim.
fn trust(stack: &ViewStack, patches: &Patches) -> Vec<f32> {
    let distances = rim_distances(&stack.hole, stack.width, stack.height);
    let center = |i: usize| (i / patches.width + SIDE / 2) * stack.width + i % patches.width + SIDE / 2;
    (0..patches.targets.len()).map(|i| TRUST.powi(distances[center(i)].min(DEEPEST) as i32)).collect()
}

/// Gives each pixel of the hole the weighted mean of what the sources of all patches over it have in its place.
fn vote(stack: &mut ViewStack, patches: &Patches, field: &[Match], trust: &[f32], typical: f64) {
    let mut distances: Vec<f32> = (0..field.len()).filter(|i| patches.targets[*i]).map(|i| field[i].distance).collect();
    let k = ((distances.len() - 1) as f64 * typical) as usize;
    let scale = distances.select_nth_unstable_by(k, f32::total_cmp).1.max(1e-9);
    // Far below the rest's weights, but above 0 for pixels that no better patch covers.
    let weight = |i: usize| trust[i] * ((-0.5 * field[i].distance / scale).exp() + 1e-12);
    let weights: Vec<f32> = (0..field.len()).map(|i| if patches.targets[i] { weight(i) } else { 0.0 }).collect();
    let mut voted = stack.colors.clone();
    let (width, depth) = (stack.width, stack.depth);
    voted.par_chunks_mut(width * depth).enumerate().for_each(|(y, row)| {
        for x in (0..width).filter(|x| stack.hole[y * width + *x]) {
            let color = &mut row[x * depth..][..depth];
            color.fill(0.0);
            let mut total = 0.0;
            for py in (y + 1).saturating_sub(SIDE)..(y + 1).min(patches.height) {
                for px in (x + 1).saturating_sub(SIDE)..(x + 1).min(patches.width) {
                    let i = py * patches.width + px;
                    let source = field[i].source as usize;
                    let pixel = (source / patches.width + y - py) * width + source % patches.width + x - px;
                    color.iter_mut().zip(stack.color(pixel)).for_each(|(c, s)| *c += weights[i] * s);
                    total += weights[i];
                }
            }
            color.iter_mut().for_each(|c| *c /= total);
        }
    });
    stack.colors = voted;
}
