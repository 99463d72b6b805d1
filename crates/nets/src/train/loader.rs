//! Samples made on background threads, in an order and with content that depend on the seed alone.
//!
//! Sample `i` of epoch `e` is a function of `(seed, e, i)`; worker `w` of `n` makes the batches `w, w + n, …` and hands them over
//! through a bounded queue of its own, from which the consumer takes them in turn. So neither the number of workers nor their speed
//! changes what arrives.

use diorama_geom::rng::Rng;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

/// Streams of random numbers of one seed.
const ORDER: u64 = 0x10ad;
const CONTENT: u64 = 0xa06;

/// Which sample to make.
#[derive(Clone, Copy, Debug)]
pub struct SampleKey {
    pub epoch: u64,
    /// Place in the epoch's order.
    pub place: usize,
    /// Which of the data set's items.
    pub item: usize,
    /// Random numbers of this sample alone.
    pub rng: Rng,
}

/// How samples are loaded.
#[derive(Clone, Copy, Debug)]
pub struct LoaderSettings {
    pub seed: u64,
    /// Items of the data set.
    pub items: usize,
    pub batch: usize,
    /// Whether each epoch has an order of its own.
    pub shuffle: bool,
    pub workers: usize,
    /// Batches that each worker makes ahead.
    pub ahead: usize,
}

impl LoaderSettings {
    /// Whole batches of an epoch; what is left over falls to other epochs' orders.
    pub fn batches_per_epoch(&self) -> u64 {
        (self.items / self.batch) as u64
    }

    /// The items of an epoch in its order.
    fn order(&self, epoch: u64) -> Vec<u32> {
        let mut order: Vec<u32> = (0..self.items as u32).collect();
        if self.shuffle {
            let rng = Rng::new(self.seed, ORDER ^ epoch << 16);
            for i in (1..order.len()).rev() {
                order.swap(i, rng.below(i as u64, i as u64 + 1) as usize);
            }
        }
        order
    }

    /// The sample at a place of an epoch whose order is known.
    fn key(&self, epoch: u64, place: usize, order: &[u32]) -> SampleKey {
        let stream = CONTENT ^ (epoch << 32 | place as u64) << 16;
        SampleKey { epoch, place, item: order[place] as usize, rng: Rng::new(self.seed, stream) }
    }
}

/// Endless batches, in order.
pub struct Loader<T> {
    queues: Vec<Receiver<Result<Vec<T>, String>>>,
    workers: Vec<JoinHandle<()>>,
    next: u64,
}

impl<T: Send + 'static> Loader<T> {
    /// Starts the workers; the first batch is number `from`, so that a resumed run goes on where it was.
    ///
    /// # Panics
    /// When there are fewer items than one batch needs, or no workers.
    pub fn start(settings: LoaderSettings, from: u64, make: impl Fn(&SampleKey) -> T + Send + Sync + 'static) -> Loader<T> {
        let s = settings;
        assert!(s.batch > 0 && s.items >= s.batch && s.workers > 0, "a loader of {} items in batches of {}", s.items, s.batch);
        assert!(u32::try_from(s.items).is_ok(), "at most 2^32 items");
        let make = Arc::new(make);
        let (mut queues, mut workers) = (Vec::new(), Vec::new());
        for w in 0..s.workers as u64 {
            let (send, receive) = sync_channel(s.ahead.max(1));
            let make = make.clone();
            // Worker w makes the batches whose number leaves w.
            let first = from + (w + s.workers as u64 - from % s.workers as u64) % s.workers as u64;
            workers.push(std::thread::spawn(move || work(&s, first, &*make, &send)));
            queues.push(receive);
        }
        Loader { queues, workers, next: from }
    }

    /// The next batch.
    ///
    /// # Errors
    /// What a worker said when it panicked.
    pub fn next_batch(&mut self) -> Result<Vec<T>, String> {
        let queue = (self.next % self.queues.len() as u64) as usize;
        let batch = self.queues[queue].recv().map_err(|_| "a worker of the loader is gone".to_string())??;
        self.next += 1;
        Ok(batch)
    }

    /// Number of the next batch, to resume at.
    pub fn position(&self) -> u64 {
        self.next
    }
}

fn work<T>(s: &LoaderSettings, first: u64, make: &dyn Fn(&SampleKey) -> T, send: &SyncSender<Result<Vec<T>, String>>) {
    let mut order = (u64::MAX, Vec::new());
    let mut number = first;
    loop {
        let (epoch, batch) = (number / s.batches_per_epoch(), number % s.batches_per_epoch());
        if order.0 != epoch {
            order = (epoch, s.order(epoch));
        }
        let places = batch as usize * s.batch..(batch as usize + 1) * s.batch;
        let made = catch_unwind(AssertUnwindSafe(|| places.map(|p| make(&s.key(epoch, p, &order.1))).collect()));
        let failed = made.is_err();
        let said = |e: Box<dyn std::any::Any + Send>| {
            let text = e.downcast_ref::<String>().cloned().or_else(|| e.downcast_ref::<&str>().map(|s| s.to_string()));
            format!("a worker of the loader failed: {}", text.unwrap_or_default())
        };
        // The consumer is gone, or there is nothing more to make.
        if send.send(made.map_err(said)).is_err() || failed {
            return;
        }
        number += s.workers as u64;
    }
}

impl<T> Drop for Loader<T> {
    fn drop(&mut self) {
        self.queues.clear();
        for w in self.workers.drain(..) {
            let _ = w.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    fn settings(workers: usize) -> LoaderSettings {
        LoaderSettings { seed: 7, items: 10, batch: 3, shuffle: true, workers, ahead: 2 }
    }

    fn taken(workers: usize, from: u64, n: usize) -> Vec<Vec<(u64, usize, usize, u64)>> {
        let mut loader = Loader::start(settings(workers), from, |k| (k.epoch, k.place, k.item, k.rng.bits(0)));
        (0..n).map(|_| loader.next_batch().unwrap()).collect()
    }

    #[test]
    fn workers_and_resuming_change_nothing() {
        let one = taken(1, 0, 8);
        assert_eq!(one, taken(3, 0, 8));
        assert_eq!(one[5..], taken(2, 5, 3));
        // Three batches an epoch, each item at most once, and another order in the next.
        let items = |e: usize| one[e * 3..e * 3 + 3].iter().flatten().map(|k| k.2).collect::<Vec<_>>();
        let mut first = items(0);
        assert_ne!(first, items(1));
        first.sort_unstable();
        first.dedup();
        assert_eq!(first.len(), 9);
        assert!(one.iter().flatten().all(|k| k.3 != one[0][0].3 || k == &one[0][0]), "each sample has random numbers of its own");
    }

    #[test]
    fn no_more_is_made_than_the_queue_holds() {
        let made = Arc::new(AtomicUsize::new(0));
        let count = made.clone();
        let loader = Loader::start(settings(1), 0, move |_| count.fetch_add(1, Ordering::SeqCst));
        std::thread::sleep(std::time::Duration::from_millis(200));
        // Two batches wait in the queue, and one more for room.
        assert!(made.load(Ordering::SeqCst) <= 9, "{made:?}");
        drop(loader);
    }

    #[test]
    fn a_failing_sample_is_an_error_not_a_hang() {
        let mut loader = Loader::start(settings(2), 0, |k| assert!(k.epoch == 0, "item {} is broken", k.item));
        for _ in 0..3 {
            loader.next_batch().unwrap();
        }
        let e = loader.next_batch().unwrap_err();
        assert!(e.contains("is broken"), "{e}");
    }
}
