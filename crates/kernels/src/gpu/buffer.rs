//! Typed memory of a device, and matrices whose number of rows in use is known to the device alone.

use super::Gpu;
use cubecl::prelude::*;
use cubecl::server::Handle;
use std::marker::PhantomData;

/// Numbers in the memory of a device. Clones share the memory.
#[derive(Debug)]
pub struct Buffer<T = f32> {
    handle: Handle,
    len: usize,
    element: PhantomData<T>,
}

impl<T> Clone for Buffer<T> {
    fn clone(&self) -> Self {
        Buffer { handle: self.handle.clone(), len: self.len, element: PhantomData }
    }
}

impl<T> Buffer<T> {
    /// A buffer of `len` numbers in existing memory.
    ///
    /// # Panics
    /// When the memory holds fewer.
    pub fn of(handle: Handle, len: usize) -> Buffer<T> {
        assert!(handle.size_in_used() >= (size_of::<T>() * len) as u64, "{len} numbers in {} bytes", handle.size_in_used());
        Buffer { handle, len, element: PhantomData }
    }

    /// Memory of the buffer, to be shared with another library on the same device.
    pub fn handle(self) -> Handle {
        self.handle
    }

    /// The memory of this buffer and of its clones.
    pub(super) fn memory(&self) -> Handle {
        self.handle.clone()
    }

    pub fn len(&self) -> usize {
        self.len
    }

    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The last number, in the same memory.
    ///
    /// # Panics
    /// When there is none.
    pub fn last(&self) -> Buffer<T> {
        let before = self.len.checked_sub(1).expect("a number") * size_of::<T>();
        let after = self.handle.size_in_used() - (before + size_of::<T>()) as u64;
        let handle = self.handle.clone().offset_start(before as u64).offset_end(after);
        Buffer { handle, len: 1, element: PhantomData }
    }

    /// The same bits as numbers of another type, as many as the memory of these holds.
    pub fn cast<U>(&self) -> Buffer<U> {
        Buffer { handle: self.handle.clone(), len: self.len * size_of::<T>() / size_of::<U>(), element: PhantomData }
    }

    /// Argument of a launch whose kernel indexes up to `len` numbers.
    ///
    /// # Panics
    /// When there are fewer.
    #[track_caller]
    pub(crate) fn arg(&self, len: usize, kernel: &str, name: &str) -> BufferArg {
        assert!(self.len >= len, "{kernel}: {name} holds {} numbers, not {len}", self.len);
        // SAFETY: the handle was made with room for `self.len` numbers, and for one number at least.
        unsafe { BufferArg::from_raw_parts(self.handle.clone(), self.len.max(1)) }
    }
}

/// Rows of a matrix whose number in use is known to the device alone.
#[derive(Clone)]
pub struct Rows {
    /// Rows that there is memory for.
    pub most: usize,
    /// Counts of rows in use; that of these rows is `live[at]`, at most `most`.
    pub(crate) live: Buffer<u32>,
    pub(crate) at: usize,
}

impl Rows {
    /// All of `n` rows.
    pub fn all(gpu: &Gpu, n: usize) -> Rows {
        Rows { most: n, live: gpu.upload(&[n as u32]), at: 0 }
    }

    /// `live[at]` rows, at most `most`.
    ///
    /// # Panics
    /// When there is no such number.
    pub fn counted(most: usize, live: &Buffer<u32>, at: usize) -> Rows {
        assert!(at < live.len(), "rows: no number {at}");
        Rows { most, live: live.clone(), at }
    }

    /// Index of the count, as kernels take it.
    pub(crate) fn place(&self) -> u32 {
        self.at as u32
    }
}
