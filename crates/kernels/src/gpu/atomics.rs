//! Concurrent addition of f32 by many units.

use cubecl::prelude::*;

/// Two adjacent numbers, which some devices add at once.
pub type Pair = Vector<f32, Const<2>>;

/// A cell that f32 can be added to.
#[cube]
pub trait Accumulate: 'static + Send + Sync {
    type Cell: CubePrimitive;

    fn add(cell: &Atomic<Self::Cell>, value: f32);
}

/// The device's own addition.
pub struct Native;

/// Addition by exchange of bits, an atomic operation that every device has.
pub struct Swap;

#[cube]
impl Accumulate for Native {
    type Cell = f32;

    fn add(cell: &Atomic<f32>, value: f32) {
        cell.fetch_add(value);
    }
}

#[cube]
impl Accumulate for Swap {
    type Cell = u32;

    fn add(cell: &Atomic<u32>, value: f32) {
        // Takes the cell's number out, adds to it and writes the sum. If another unit wrote a number meanwhile, the exchange returns it,
        // and it is added in the next round.
        let mut carry = value;
        while carry != 0.0 {
            let sum = f32::reinterpret(cell.exchange(0u32)) + carry;
            carry = f32::reinterpret(cell.exchange(u32::reinterpret(sum)));
        }
    }
}
