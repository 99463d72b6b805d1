//! Choice of photographs: how many are enough, and which of a folder are sharp.

use super::PrepareOptions;
use crate::error::Result;
use diorama_data::video::Choice;
use diorama_data::{DataError, sharpness};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// How many photographs structure from motion is given.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wanted {
    /// Fewer are an error, and fewer than the second a note.
    pub least: usize,
    pub few: usize,
    pub usual: [usize; 2],
    /// What is counted.
    pub what: &'static str,
    /// How to get more.
    pub advice: &'static str,
}

impl Wanted {
    /// What poses need.
    pub const ANY: Wanted = Wanted { least: 3, few: 3, usual: [30, 150], what: "photographs", advice: "take more from other places" };
    /// What a scene with writing needs.
    pub const SHARP: Wanted = Wanted {
        least: 20,
        few: 50,
        usual: [50, 80],
        what: "sharp frames",
        advice: "film longer, more slowly and in better light, or give a larger --frames",
    };

    /// Checks how many were `found` in `input`.
    ///
    /// # Errors
    /// If they are fewer than the least.
    pub fn check(&self, input: &Path, found: usize, note: &mut dyn FnMut(&str)) -> Result<()> {
        let Wanted { least, usual: [low, high], what, advice, .. } = self;
        if found < *least {
            let text = format!("{found} {what} are not enough; at least {least} are needed, {low} to {high} are usual; {advice}");
            return Err(DataError::input(input, text).into());
        }
        if found < self.few {
            note(&format!("only {found} {what}, {low} to {high} are usual; {advice}"));
        }
        Ok(())
    }
}

/// The photographs of a folder that are to be taken: all, or with [`Choice::Sharp`] the sharp ones; none when interrupted. Those that cannot be
/// decoded are kept if they may be left out later.
///
/// # Errors
/// If a photograph cannot be decoded.
pub fn of_folder(
    all: Vec<PathBuf>,
    o: &PrepareOptions,
    interrupt: &AtomicBool,
    note: &mut dyn FnMut(&str),
) -> Result<Option<Vec<PathBuf>>> {
    let Choice::Sharp(windows) = o.choice else { return Ok(Some(all)) };
    note("choosing sharp photographs");
    let measure = |file: &PathBuf| match interrupt.load(Ordering::Relaxed) {
        true => Ok(None),
        false => sharpness::of_photograph(file).map(Some),
    };
    let measured: Vec<_> = all.par_iter().map(measure).collect();
    if interrupt.load(Ordering::Relaxed) {
        return Ok(None);
    }
    let (mut readable, mut values, mut is_taken) = (Vec::new(), Vec::new(), vec![false; all.len()]);
    for (k, found) in measured.into_iter().enumerate() {
        match found {
            Ok(value) => {
                readable.push(k);
                values.push(value.unwrap_or(0.0));
            }
            Err(e) if o.skip_broken && e.is_input() => is_taken[k] = true,
            Err(e) => return Err(e.into()),
        }
    }
    let sharp = sharpness::sharp(&values, windows);
    note(&format!("{} of {} photographs are taken: the sharpest of each of {windows} parts, without blurred ones", sharp.len(), all.len()));
    sharp.into_iter().for_each(|k| is_taken[readable[k]] = true);
    Ok(Some(all.into_iter().zip(is_taken).filter(|(_, taken)| *taken).map(|(file, _)| file).collect()))
}
