//! A parallel stable counting sort.
//!
//! The input is split into parts, one per thread. Each part counts its items per bucket, [`offsets`] turns the counts
//! into output positions, and each part scatters its items to positions that no other part writes. The result does not
//! depend on the number of parts.

use std::marker::PhantomData;

/// Smallest part that is worth a thread, items.
const MIN_PART: usize = 4096;

/// Number of parts for so many items.
pub(crate) fn parts(items: usize) -> usize {
    (items / MIN_PART).clamp(1, rayon::current_num_threads())
}

/// Replaces the count of each part and bucket by the position of its first item: ordered by bucket, then by part. Calls
/// `bucket_start` with the start of each bucket and with the end of the last.
pub(crate) fn offsets(counts: &mut [Vec<u32>], buckets: usize, mut bucket_start: impl FnMut(u32)) {
    let mut sum = 0;
    bucket_start(sum);
    for bucket in 0..buckets {
        for counts in counts.iter_mut() {
            sum += std::mem::replace(&mut counts[bucket], sum);
        }
        bucket_start(sum);
    }
}

/// A slice that several threads write to, each position by at most one thread.
pub(crate) struct ScatterWriter<'a, T> {
    first: *mut T,
    len: usize,
    slice: PhantomData<&'a mut [T]>,
}

// Safety: it never reads, and the contract of `write` rules out two writes to one position.
unsafe impl<T: Send> Sync for ScatterWriter<'_, T> {}

impl<'a, T: Copy> ScatterWriter<'a, T> {
    pub(crate) fn new(slice: &'a mut [T]) -> Self {
        Self { first: slice.as_mut_ptr(), len: slice.len(), slice: PhantomData }
    }

    /// Writes a value at a position.
    ///
    /// # Safety
    /// No other thread writes to this position of the slice.
    pub(crate) unsafe fn write(&self, position: usize, value: T) {
        assert!(position < self.len, "a position within the slice");
        // Safety: the position is within the slice, which is borrowed mutably, and the caller rules out a second
        // writer.
        unsafe { self.first.add(position).write(value) }
    }
}
