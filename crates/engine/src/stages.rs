//! Where a step's time goes.

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
        let now = Instant::now();
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

    #[test]
    fn time_is_booked_once() {
        let begin = Instant::now();
        let mut s = Stages::default();
        for name in ["a", "b", "a"] {
            std::thread::sleep(std::time::Duration::from_millis(2));
            s.done(name);
        }
        let sum: f64 = s.seconds.iter().map(|s| s.1).sum();
        assert_eq!(s.seconds.iter().map(|s| s.0).collect::<Vec<_>>(), ["a", "b"]);
        assert!(s.seconds[0].1 > s.seconds[1].1 && sum <= begin.elapsed().as_secs_f64());
    }
}
