//! Memory of the CPU's tensors: buffers go back to a pool when the last tensor that uses them is gone, so that a training step
//! whose shapes are known allocates none.
//!
//! The pool holds a reference to every buffer that it gave out; a buffer whose only reference is the pool's is free.

use burn::backend::flex::{FlexTensor, Layout};
use burn::tensor::{Bytes, DType, Shape};
use std::collections::HashMap;
use std::fmt;
use std::ops::{Deref, DerefMut};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard};

/// A free buffer is given back to the system when it was not used during so many steps.
const IDLE_STEPS: u64 = 2;

/// What the pool did since the program began, and what it holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PoolFigures {
    /// Buffers that had to be allocated.
    pub fresh: u64,
    /// Buffers that were used again.
    pub reused: u64,
    /// Bytes of all buffers, free or in use.
    pub bytes: usize,
    /// Most bytes at any time.
    pub peak_bytes: usize,
}

struct Entry {
    memory: Arc<Bytes>,
    /// Step of its last use.
    used: u64,
}

#[derive(Default)]
struct Pool {
    /// Buffers by their exact size in bytes: shapes recur from step to step.
    by_size: HashMap<usize, Vec<Entry>>,
    step: u64,
    figures: PoolFigures,
}

static POOL: LazyLock<Mutex<Pool>> = LazyLock::new(Mutex::default);

fn pool() -> MutexGuard<'static, Pool> {
    // The pool is whole after each of its methods, whatever panicked meanwhile.
    POOL.lock().unwrap_or_else(|e| e.into_inner())
}

impl Pool {
    /// A buffer that nothing else refers to; its content is whatever it held last.
    fn take(&mut self, bytes: usize) -> Arc<Bytes> {
        let free = self.by_size.get_mut(&bytes).and_then(|entries| {
            // The one freed last is the likeliest to be in cache.
            let i = entries.iter().rposition(|e| Arc::strong_count(&e.memory) == 1)?;
            Some(entries.remove(i).memory)
        });
        match free {
            Some(memory) => {
                self.figures.reused += 1;
                memory
            }
            None => {
                self.figures.fresh += 1;
                self.figures.bytes += bytes;
                self.figures.peak_bytes = self.figures.peak_bytes.max(self.figures.bytes);
                Arc::new(Bytes::from_elems(vec![0f32; bytes / size_of::<f32>()]))
            }
        }
    }

    fn keep(&mut self, memory: Arc<Bytes>) {
        let used = self.step;
        self.by_size.entry(memory.len()).or_default().push(Entry { memory, used });
    }

    /// Drops free buffers whose last use lies at least `age` steps back.
    fn release(&mut self, age: u64) {
        let (step, mut released) = (self.step, 0);
        for (bytes, entries) in &mut self.by_size {
            let before = entries.len();
            entries.retain(|e| Arc::strong_count(&e.memory) > 1 || step - e.used < age);
            released += bytes * (before - entries.len());
        }
        self.by_size.retain(|_, entries| !entries.is_empty());
        self.figures.bytes -= released;
    }
}

/// Figures of the pool.
pub fn figures() -> PoolFigures {
    pool().figures
}

/// Ends a training step: buffers that no recent step needed are given back. The optimizers call it.
pub fn end_step() {
    let mut p = pool();
    p.step += 1;
    p.release(IDLE_STEPS + 1);
}

/// Gives all free buffers back.
pub fn release() {
    pool().release(0);
}

macro_rules! buffers {
    ($values:ident, $values_mut:ident, $number:ty, $dtype:expr, $what:literal) => {
        #[doc = concat!("Row-major ", $what, " with a shape, on the CPU; clones share the memory.")]
        #[derive(Clone)]
        pub struct $values(FlexTensor);

        #[doc = concat!("Row-major ", $what, " of the pool that nothing else refers to yet.")]
        pub struct $values_mut(FlexTensor);

        impl $values_mut {
            /// Memory of the pool, holding anything.
            pub fn any(shape: &[usize]) -> Self {
                let count: usize = shape.iter().product();
                let memory = pool().take(count * size_of::<$number>());
                Self(FlexTensor::from_arc(memory, Layout::contiguous(Shape::from(shape.to_vec())), $dtype))
            }

            /// Memory of the pool, filled with zeros.
            pub fn zeros(shape: &[usize]) -> Self {
                let mut out = Self::any(shape);
                out.fill(<$number>::default());
                out
            }

            /// Ends writing.
            pub fn freeze(self) -> $values {
                $values(self.0.clone())
            }
        }

        impl Drop for $values_mut {
            /// Leaves a reference with the pool.
            fn drop(&mut self) {
                pool().keep(self.0.data_arc());
            }
        }

        impl Deref for $values_mut {
            type Target = [$number];
            fn deref(&self) -> &[$number] {
                self.0.storage()
            }
        }

        impl DerefMut for $values_mut {
            fn deref_mut(&mut self) -> &mut [$number] {
                self.0.storage_mut()
            }
        }

        impl $values {
            pub fn shape(&self) -> &[usize] {
                self.0.layout().shape()
            }

            /// The same numbers in another shape.
            ///
            /// # Panics
            /// When the shape asks for another count of numbers.
            pub fn reshaped(&self, shape: &[usize]) -> Self {
                assert_eq!(self.len(), shape.iter().product::<usize>(), "a shape of as many numbers");
                let layout = self.0.layout();
                let strides = Layout::contiguous(Shape::from(shape.to_vec())).strides().to_vec();
                Self(self.0.clone().with_layout(Layout::new(Shape::from(shape.to_vec()), strides, layout.start_offset())))
            }
        }

        impl Deref for $values {
            type Target = [$number];
            fn deref(&self) -> &[$number] {
                self.0.as_slice().expect("contiguous since it was made")
            }
        }

        impl fmt::Debug for $values {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "{:?} numbers", self.shape())
            }
        }
    };
}

buffers!(Values, ValuesMut, f32, DType::F32, "numbers");
buffers!(Indices, IndicesMut, u32, DType::U32, "indices");

impl Values {
    /// The numbers of a tensor, gathered into memory of the pool where they do not lie row by row.
    ///
    /// # Panics
    /// When the tensor holds other numbers than f32.
    pub(crate) fn of(tensor: &FlexTensor) -> Self {
        assert_eq!(tensor.dtype(), DType::F32, "checked before the op runs");
        if tensor.is_contiguous() { Values(tensor.clone()) } else { gather(tensor) }
    }

    /// Numbers that were made outside of the pool.
    pub fn from_vec(values: Vec<f32>, shape: &[usize]) -> Self {
        assert_eq!(values.len(), shape.iter().product::<usize>(), "as many numbers as the shape says");
        Values(FlexTensor::new(Bytes::from_elems(values), Layout::contiguous(Shape::from(shape.to_vec())), DType::F32))
    }

    pub(crate) fn into_tensor(self) -> FlexTensor {
        self.0
    }
}

/// Copies a view with any strides row by row.
fn gather(tensor: &FlexTensor) -> Values {
    let layout = tensor.layout();
    let shape: &[usize] = layout.shape();
    let from: &[f32] = tensor.storage();
    let mut out = ValuesMut::any(shape);
    let (strides, inner) = (layout.strides(), shape.last().copied().unwrap_or(1));
    let step = strides.last().copied().unwrap_or(1);
    let mut index = vec![0usize; shape.len().saturating_sub(1)];
    let mut at = layout.start_offset() as isize;
    for row in out.chunks_exact_mut(inner.max(1)) {
        match step {
            0 => row.fill(from[at as usize]),
            1 => row.copy_from_slice(&from[at as usize..at as usize + inner]),
            _ => row.iter_mut().enumerate().for_each(|(i, v)| *v = from[(at + i as isize * step) as usize]),
        }
        for axis in (0..index.len()).rev() {
            index[axis] += 1;
            at += strides[axis];
            if index[axis] < shape[axis] {
                break;
            }
            at -= strides[axis] * shape[axis] as isize;
            index[axis] = 0;
        }
    }
    out.freeze()
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, Tensor, TensorData};

    #[test]
    fn a_buffer_is_free_when_its_last_tensor_is_gone() {
        // A size that no other test uses.
        let shape = [7, 1_001];
        let first = ValuesMut::any(&shape).freeze();
        let address = first.as_ptr();
        let copy = first.clone();
        drop(first);
        assert_ne!(ValuesMut::any(&shape).as_ptr(), address, "a copy is alive");
        drop(copy);
        let again = [ValuesMut::any(&shape), ValuesMut::any(&shape)];
        assert!(again.iter().any(|b| b.as_ptr() == address));
    }

    #[test]
    fn views_are_gathered_row_by_row() {
        let x = Tensor::<3>::from_data(TensorData::new((0..24).map(|v| v as f32).collect::<Vec<_>>(), [2, 3, 4]), &Device::flex());
        let flex = |t: Tensor<3>| t.try_into_primitive::<burn::backend::Flex>().unwrap();
        for view in
            [x.clone().permute([2, 0, 1]), x.clone().flip([1]), x.clone().slice([0..2, 1..2, 1..3]), x.narrow(0, 0, 1).expand([5, 3, 4])]
        {
            let want: Vec<f32> = view.clone().into_data().try_to_vec().unwrap();
            let got = Values::of(&flex(view.clone()));
            assert_eq!((&got[..], got.shape()), (&want[..], &view.dims()[..]));
        }
    }

    #[test]
    fn reshaping_shares_the_memory() {
        let v = Values::from_vec(vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0], &[2, 3]);
        let r = v.reshaped(&[3, 2]);
        assert_eq!((r.as_ptr(), r.shape()), (v.as_ptr(), &[3, 2][..]));
    }
}
