//! The one place where kernels are launched: [`launch!`](crate::gpu::launch).

use super::{Buffer, CUBE, Pair};
use cubecl::prelude::*;

/// Most cubes along one axis that every API allows.
const MAX_CUBES: u32 = 65_535;

/// Number and shape of a launch's cubes; `None` launches nothing.
pub(crate) trait Grid {
    fn cubes(self) -> Option<(CubeCount, CubeDim)>;
}

/// One unit per element. Kernels stop the units past the last element.
impl Grid for usize {
    fn cubes(self) -> Option<(CubeCount, CubeDim)> {
        let cubes = u32::try_from(self.div_ceil(CUBE as usize)).expect("fewer than 2^32 cubes");
        let count = CubeCount::Static(cubes.min(MAX_CUBES), cubes.div_ceil(MAX_CUBES), 1);
        (self > 0).then_some((count, CubeDim::new_1d(CUBE)))
    }
}

/// Number of cubes along each axis, and the shape of a cube.
impl Grid for ([usize; 3], CubeDim) {
    fn cubes(self) -> Option<(CubeCount, CubeDim)> {
        let [x, y, z] = self.0.map(|n| u32::try_from(n).expect("fewer than 2^32 cubes"));
        assert!(x.max(y).max(z) <= MAX_CUBES, "{x} x {y} x {z} cubes");
        (x * y * z > 0).then_some((CubeCount::Static(x, y, z), self.1))
    }
}

/// A kernel's parameter `P` to which a buffer may be bound.
pub(crate) trait Binds<P> {}

impl<T> Binds<&'static [T]> for Buffer<T> {}
impl<T> Binds<&'static mut [T]> for Buffer<T> {}
impl Binds<&'static [Atomic<f32>]> for Buffer<f32> {}
/// [`crate::gpu::Swap`] exchanges bits.
impl Binds<&'static [Atomic<u32>]> for Buffer<f32> {}
impl Binds<&'static [Atomic<u32>]> for Buffer<u32> {}
impl Binds<&'static [Pair]> for Buffer<[f32; 2]> {}
impl Binds<&'static mut [Pair]> for Buffer<[f32; 2]> {}
impl Binds<&'static [Atomic<Pair>]> for Buffer<[f32; 2]> {}

/// Stand-in for a bound buffer in code that the compiler checks and nobody runs.
pub(crate) fn stand_in<T, P>(_: &Buffer<T>) -> P
where
    Buffer<T>: Binds<P>,
{
    unreachable!("only types are checked")
}

/// Stand-in for a number in the same code.
pub(crate) fn number<P>() -> P {
    unreachable!("only types are checked")
}

/// Launches a kernel: `launch!(gpu, kernel, units, [buffer => length, …], number, …)`.
///
/// `units` is a number of elements with one unit each, or `([x, y, z], cube)`; 0 units launch nothing. Each buffer is followed by the
/// length up to which the kernel indexes it. `kernel::<Adder>` stands for a kernel generic over [`Accumulate`](crate::gpu::Accumulate)
/// with the device's way of adding.
///
/// # Panics
/// When a buffer is shorter than that.
macro_rules! launch {
    ($gpu:expr, $kernel:ident::<Adder>, $($rest:tt)*) => {
        if $gpu.has_native_atomics() {
            $crate::gpu::launch!($gpu, $kernel::<$crate::gpu::Native>, $($rest)*)
        } else {
            $crate::gpu::launch!($gpu, $kernel::<$crate::gpu::Swap>, $($rest)*)
        }
    };
    ($gpu:expr, $kernel:ident $(::<$generic:ty>)?, $units:expr, [$($buffer:expr => $len:expr),* $(,)?] $(, $number:expr)* $(,)?) => {
        if let Some((cubes, cube)) = $crate::gpu::launch::Grid::cubes($units) {
            if false {
                // Checks arguments against the kernel's signature, which `launch_unchecked` does not.
                $kernel $(::<$generic>)? (
                    $($crate::gpu::launch::stand_in(&$buffer),)*
                    $({
                        let _ = stringify!($number);
                        $crate::gpu::launch::number()
                    }),*
                );
            }
            // SAFETY: kernels stop the units past their elements and index each buffer below the length that is given here, which it is
            // checked to have. What they read as indices (offsets of rays, counts of rows, rows of a table) was bounded by what wrote it.
            unsafe {
                $kernel::launch_unchecked $(::<$generic>)? (
                    &$gpu.client,
                    cubes,
                    cube,
                    $($buffer.arg($len, stringify!($kernel), stringify!($buffer)),)*
                    $($number),*
                );
            }
        }
    };
}
pub(crate) use launch;

#[cfg(test)]
mod tests {
    use super::*;

    fn count(units: impl Grid) -> Option<[u32; 3]> {
        units.cubes().map(|(count, _)| match count {
            CubeCount::Static(x, y, z) => [x, y, z],
            _ => unreachable!("counts are static"),
        })
    }

    #[test]
    fn every_element_has_a_unit_and_none_needs_none() {
        assert_eq!(count(0), None);
        assert_eq!(count(1), Some([1, 1, 1]));
        assert_eq!(count(257), Some([2, 1, 1]));
        for n in [CUBE as usize * 65_535, CUBE as usize * 65_536, 123_456_789] {
            let [x, y, z] = count(n).unwrap();
            assert!(z == 1 && x <= MAX_CUBES && y <= MAX_CUBES && (x * y * CUBE) as usize >= n);
        }
    }

    #[test]
    fn counts_of_cubes_are_bounded() {
        assert_eq!(count(([3, 0, 1], CubeDim::new_1d(1))), None);
        let too_many = std::panic::catch_unwind(|| count(([1, 65_536, 1], CubeDim::new_1d(1))));
        assert!(too_many.is_err());
    }
}
