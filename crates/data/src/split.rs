//! Rules that split a capture into training and held-out views.

use diorama_geom::capture::{Frame, Split};
use diorama_geom::rng::Rng;

/// How frames are split.
#[derive(Clone, Debug, PartialEq)]
pub enum SplitRule {
    /// As the capture's own files say; every eighth frame is held out if they say nothing.
    File,
    /// Frames 0, n, 2n, … are held out.
    Every(usize),
    /// Shares of training, validation and test in percent, drawn by seed.
    Shares(u32, u32, u32),
    /// All frames are used for training.
    All,
}

impl std::str::FromStr for SplitRule {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        let bad = || format!("split {s:?}: expected every:N, A:B:C (percent), file, or all");
        if let Some(n) = s.strip_prefix("every:") {
            return n.parse().ok().filter(|n| *n >= 2).map(SplitRule::Every).ok_or_else(bad);
        }
        match s {
            "file" => return Ok(SplitRule::File),
            "all" => return Ok(SplitRule::All),
            _ => {}
        }
        let parts: Vec<u32> = s.split(':').map(|p| p.parse().map_err(|_| bad())).collect::<Result<_, _>>()?;
        match parts[..] {
            [a, b, c] if a > 0 && a + b + c == 100 => Ok(SplitRule::Shares(a, b, c)),
            _ => Err(bad()),
        }
    }
}

impl std::fmt::Display for SplitRule {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            SplitRule::File => write!(f, "file"),
            SplitRule::All => write!(f, "all"),
            SplitRule::Every(n) => write!(f, "every:{n}"),
            SplitRule::Shares(a, b, c) => write!(f, "{a}:{b}:{c}"),
        }
    }
}

/// Applies a rule; `has_own` says whether the frames already have a split from the capture's files.
pub fn apply(rule: &SplitRule, frames: &mut [Frame], has_own: bool, seed: u64) {
    match *rule {
        SplitRule::File if has_own => {}
        SplitRule::File => apply(&SplitRule::Every(8), frames, has_own, seed),
        SplitRule::All => frames.iter_mut().for_each(|f| f.split = Split::Train),
        SplitRule::Every(n) => {
            for (i, f) in frames.iter_mut().enumerate() {
                f.split = if i % n == 0 { Split::Test } else { Split::Train };
            }
        }
        SplitRule::Shares(train, val, _) => {
            let rng = Rng::new(seed, 0x5917);
            let mut order: Vec<usize> = (0..frames.len()).collect();
            order.sort_by_key(|&i| rng.bits(i as u64));
            let (n, share) = (frames.len(), |p: u32| frames.len() * p as usize / 100);
            let (a, b) = (share(train).max(1).min(n), share(train + val).max(1).min(n));
            for (rank, i) in order.into_iter().enumerate() {
                frames[i].split = if rank < a {
                    Split::Train
                } else if rank < b {
                    Split::Val
                } else {
                    Split::Test
                };
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::{Camera, Pose};

    fn frames(n: usize) -> Vec<Frame> {
        (0..n).map(|i| Frame::new(i.to_string(), "x", Camera::pinhole(4, 4, 1.0), Pose::IDENTITY)).collect()
    }

    #[test]
    fn every_eighth_of_fifty_holds_out_seven() {
        let mut f = frames(50);
        apply(&"every:8".parse().unwrap(), &mut f, false, 0);
        assert_eq!(f.iter().filter(|f| f.split == Split::Test).count(), 7);
        assert_eq!(f[0].split, Split::Test);
    }

    #[test]
    fn shares_divide_and_repeat() {
        let (mut a, mut b) = (frames(100), frames(100));
        apply(&"70:15:15".parse().unwrap(), &mut a, false, 3);
        apply(&"70:15:15".parse().unwrap(), &mut b, false, 3);
        let count = |s| a.iter().filter(|f| f.split == s).count();
        assert_eq!((count(Split::Train), count(Split::Val), count(Split::Test)), (70, 15, 15));
        assert_eq!(a, b);
    }

    #[test]
    fn nonsense_is_refused_and_rules_print_as_they_parse() {
        for bad in ["every:1", "every:x", "50:50", "70:20:20", "0:50:50", ""] {
            assert!(bad.parse::<SplitRule>().is_err(), "{bad}");
        }
        for good in ["every:8", "70:15:15", "file", "all"] {
            assert_eq!(good.parse::<SplitRule>().unwrap().to_string(), good);
        }
    }
}
