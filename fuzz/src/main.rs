//! Mutates accepted inputs without coverage guidance, on any toolchain: `cargo run --release -p diorama-fuzz -- RUNS [PARSER…]`. For
//! coverage-guided runs see TESTING.md.

use diorama_fuzz::{PARSERS, Parser, clean_up};
use diorama_geom::rng::Rng;
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Time limit of one input.
const LONGEST: Duration = Duration::from_secs(5);
/// Time limit of one parser.
const BUDGET: Duration = Duration::from_secs(600);

/// The parser and input at work, for the report of a crash.
static INPUT: Mutex<Vec<u8>> = Mutex::new(Vec::new());

fn main() {
    let mut arguments = std::env::args().skip(1);
    let runs: u64 = arguments.next().and_then(|n| n.parse().ok()).unwrap_or_else(|| {
        eprintln!("usage: diorama-fuzz RUNS [PARSER…]");
        std::process::exit(2);
    });
    let chosen: Vec<String> = arguments.collect();
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        hook(info);
        let crash = std::env::temp_dir().join("diorama-fuzz-crash");
        if let Ok(input) = INPUT.lock() {
            let _ = std::fs::write(&crash, &*input);
            eprintln!("the input is in {}", crash.display());
        }
        clean_up();
        std::process::exit(1);
    }));
    for p in PARSERS.iter().filter(|p| chosen.is_empty() || chosen.iter().any(|c| c == p.name)) {
        let (done, seconds) = fuzz(p, runs);
        println!("{:<18} {done:>8} inputs without a crash, {seconds:.0} s", p.name);
    }
    clean_up();
}

fn fuzz(p: &Parser, runs: u64) -> (u64, f64) {
    let seeds = (p.seeds)();
    seeds.iter().for_each(|s| (p.run)(s));
    let begin = Instant::now();
    for i in 0..runs {
        let input = mutated(&seeds, &Rng::new(i, 77));
        if let Ok(mut kept) = INPUT.lock() {
            kept.clone_from(&input);
        }
        let start = Instant::now();
        (p.run)(&input);
        assert!(start.elapsed() < LONGEST, "{}: an input took {:?}", p.name, start.elapsed());
        if begin.elapsed() > BUDGET {
            return (i + 1, begin.elapsed().as_secs_f64());
        }
    }
    (runs, begin.elapsed().as_secs_f64())
}

/// A seed with up to eight changes: flipped bits, extreme bytes, numbers, and parts that are cut, doubled, moved or swapped.
fn mutated(seeds: &[Vec<u8>], rng: &Rng) -> Vec<u8> {
    let mut counter = 0u64;
    let mut next = |n: usize| {
        counter += 1;
        rng.below(counter, n.max(1) as u64) as usize
    };
    let mut v = seeds[next(seeds.len())].clone();
    for _ in 0..1 + next(8) {
        if v.is_empty() {
            v.push(0);
        }
        let at = next(v.len());
        let end = (at + 1 + next(32)).min(v.len());
        match next(10) {
            0 => v[at] ^= 1 << next(8),
            1 => v[at] = [0, 1, 0x7f, 0x80, 0xff, b'"', b'{', b'[', b'-', b'/'][next(10)],
            2 => v.truncate(at),
            3 => drop(v.drain(at..end)),
            4 => {
                let part = v[at..end].to_vec();
                v.splice(at..at, part);
            }
            5 => {
                let huge = [u64::MAX, u64::MAX / 2, 1 << 32, 1 << 62, 0][next(5)].to_le_bytes();
                let end = (at + 8).min(v.len());
                v[at..end].copy_from_slice(&huge[..end - at]);
            }
            6 => {
                let text: &[u8] =
                    [&b"1e39"[..], b"-1", b"1e400", b"nan", b"null", b"[[[[", b"../..", b"\xff\xfe", b"\0", b"99999999999999999999"]
                        [next(10)];
                v.splice(at..end, text.iter().copied());
            }
            7 => v[at..end].reverse(),
            8 => v[at] = next(256) as u8,
            _ => {
                let other = &seeds[next(seeds.len())];
                let from = next(other.len());
                let to = (from + 1 + next(64)).min(other.len());
                v.splice(at..at, other[from..to].iter().copied());
            }
        }
    }
    v
}
