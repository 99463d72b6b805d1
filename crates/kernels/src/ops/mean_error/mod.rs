//! The mean over all elements of an error of `e = x − y`: squared `e²`, absolute `|e|`, or Huber's (1964), `e² / 2` up to δ and
//! `δ (|e| − δ / 2)` beyond.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// What is averaged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Error {
    Squared,
    Absolute,
    Huber(f32),
}
