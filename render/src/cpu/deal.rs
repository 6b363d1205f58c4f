//! What the stable counting sorts of `sort` and `bin` share: the input is divided into parts, one a thread, whose buckets are counted
//! side by side; then each part writes to places that are its own. How many parts there are changes nothing of what comes out.

use std::marker::PhantomData;

/// Fewer items are not worth a thread.
const LEAST: usize = 4096;

/// Into how many parts so many items are divided.
pub(crate) fn parts(items: usize) -> usize {
    (items / LEAST).clamp(1, rayon::current_num_threads())
}

/// Turns each part's counts of the buckets into the places where its first items go: buckets follow each other, and within a bucket
/// parts do. `begins` is told where each bucket does, and where the last ends.
pub(crate) fn first_places(counts: &mut [Vec<u32>], buckets: usize, mut begins: impl FnMut(u32)) {
    let mut sum = 0;
    begins(sum);
    for bucket in 0..buckets {
        for counts in counts.iter_mut() {
            sum += std::mem::replace(&mut counts[bucket], sum);
        }
        begins(sum);
    }
}

/// A slice that threads write to in any order, each place by one of them.
pub(crate) struct Places<'a, T> {
    first: *mut T,
    len: usize,
    slice: PhantomData<&'a mut [T]>,
}

// Safety: it reads nothing, and whoever writes promises (`put`) that nobody else writes there.
unsafe impl<T: Send> Sync for Places<'_, T> {}

impl<'a, T: Copy> Places<'a, T> {
    pub(crate) fn new(slice: &'a mut [T]) -> Self {
        Self { first: slice.as_mut_ptr(), len: slice.len(), slice: PhantomData }
    }

    /// Writes to a place.
    ///
    /// # Safety
    /// No other thread writes to this place of the slice.
    pub(crate) unsafe fn put(&self, place: usize, value: T) {
        assert!(place < self.len, "a place within the slice");
        // Safety: it lies within the slice, which is borrowed, and by the caller's promise nobody else writes there.
        unsafe { self.first.add(place).write(value) }
    }
}
