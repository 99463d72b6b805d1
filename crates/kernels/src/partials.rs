//! Sums that tasks scatter into any place of a slice: each task adds to a copy of its own, and the copies are added in order, so that the
//! result does not depend on the number of threads.

use crate::math::multiversion;
use crate::tasks::{self, Parts};

/// Elements per task that adds copies.
const CHUNK: usize = 1 << 12;
/// Copies at most.
const MOST: usize = 32;

/// Tasks per group for `items` that scatter into `n` places: copies must not cost more than the items.
pub(crate) fn tasks_for(groups: usize, items: usize, n: usize) -> usize {
    (items / (2 * n).max(1)).clamp(1, (MOST / groups.max(1)).max(1))
}

multiversion! {
    fn add(from: &[f32], to: &mut [f32]) {
        to.iter_mut().zip(from).for_each(|(t, f)| *t += f);
    }
}

/// Overwrites each of the `groups` parts of `into` with the sum of what `work(group, task, copy)` adds to copies of zeros.
///
/// `elements` is the work's size, by which other threads are woken.
pub(crate) fn scatter(groups: usize, tasks: usize, elements: usize, into: &mut [f32], work: impl Fn(usize, usize, &mut [f32]) + Sync) {
    into.fill(0.0);
    let n = into.len() / groups.max(1);
    let mut copies = vec![0.0; groups * (tasks - 1) * n];
    let (firsts, others) = (Parts::new(into), Parts::new(&mut copies));
    tasks::run(groups * tasks, elements, |i| {
        let (group, task) = (i / tasks, i % tasks);
        // SAFETY: each task has a chunk of its own; the first one adds to the result.
        let copy = unsafe { if task == 0 { firsts.chunk(group, n) } else { others.chunk(group * (tasks - 1) + task - 1, n) } };
        work(group, task, copy);
    });
    let chunks = n.div_ceil(CHUNK);
    tasks::run(groups * chunks, copies.len(), |i| {
        let (group, start) = (i / chunks, i % chunks * CHUNK);
        let end = (start + CHUNK).min(n);
        // SAFETY: each task has a range of its own, and the tasks above are done.
        let to = unsafe { firsts.range(group * n + start..group * n + end) };
        for task in 0..tasks - 1 {
            let copy = (group * (tasks - 1) + task) * n;
            add(&copies[copy + start..copy + end], to);
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_add_up() {
        for (groups, tasks) in [(1, 1), (1, 5), (3, 4)] {
            let mut into = vec![9.0; groups * 5000];
            scatter(groups, tasks, 1 << 20, &mut into, |group, task, copy| {
                assert_eq!(copy.len(), 5000);
                copy[17 * group + 1] += (task + 1) as f32;
            });
            let want = (tasks * (tasks + 1) / 2) as f32;
            assert!((0..groups).all(|g| into[g * 5000 + 17 * g + 1] == want));
            assert_eq!(into.iter().sum::<f32>(), groups as f32 * want);
        }
        let calls = std::sync::atomic::AtomicUsize::new(0);
        scatter(2, 3, 0, &mut [], |_, _, copy| {
            assert!(copy.is_empty());
            calls.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        });
        assert_eq!(calls.into_inner(), 6, "work may have results of its own");
    }
}
