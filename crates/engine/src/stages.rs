//! Time that each stage of a step takes.

use std::time::Instant;

/// A clock that books the time since its last reading on a named stage.
#[derive(Clone, Debug)]
pub struct Stages {
    last: Instant,
    /// Seconds per stage, in the order of first use.
    pub seconds: Vec<(&'static str, f64)>,
}

impl Default for Stages {
    fn default() -> Self {
        Stages { last: Instant::now(), seconds: Vec::new() }
    }
}

impl Stages {
    /// Books the time since the last call on `stage`.
    pub fn done(&mut self, stage: &'static str) {
        self.done_at(stage, Instant::now());
    }

    fn done_at(&mut self, stage: &'static str, now: Instant) {
        let spent = (now - self.last).as_secs_f64();
        self.last = now;
        match self.seconds.iter_mut().find(|s| s.0 == stage) {
            Some(s) => s.1 += spent,
            None => self.seconds.push((stage, spent)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn time_is_booked_once() {
        let mut s = Stages::default();
        let mut now = s.last;
        for (name, ms) in [("a", 2), ("b", 3), ("a", 4)] {
            now += Duration::from_millis(ms);
            s.done_at(name, now);
        }
        let booked: Vec<_> = s.seconds.iter().map(|s| (s.0, (s.1 * 1e6).round())).collect();
        assert_eq!(booked, [("a", 6000.0), ("b", 3000.0)]);
        let begin = Instant::now();
        let mut s = Stages { last: begin, seconds: Vec::new() };
        s.done("c");
        assert!(s.last >= begin && s.last <= Instant::now());
        assert_eq!(s.seconds, [("c", (s.last - begin).as_secs_f64())]);
    }
}
