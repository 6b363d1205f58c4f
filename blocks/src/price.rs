//! What a step of training costs: the one price by which work is shared out (`allot`), foretold (`worker`'s estimate) and placed
//! on workers (`coordinator`).

use crate::ground::HALO_SCALE;
use crate::plan::Task;

/// What a splat that the window shows costs, in pixels: it is projected, sorted, blended over its pixels and moved.
const PER_SHOWN: f64 = 1.0;
/// What a frozen splat that the window shows costs: coarser than those under training, it covers more of their pixels, and there
/// are more than the sparse points foretell.
const PER_FROZEN: f64 = 6.0;
/// What a splat under training costs, shown or not.
const PER_TRAINED: f64 = 0.5;
/// Splats of core and halo, against the core's: as their areas.
pub(crate) const HALO_AREA: f64 = HALO_SCALE * HALO_SCALE;

/// What one step of a task costs, by what it is spent on, in pixels of its windows at the mean resolution and number of splats of
/// its schedule. Fitted to the 127 tasks of three cities of 0.3, 0.6 and 1.2 km² at ten steps a view on one thread: of each city, a
/// level's steps took 0.86 to 1.10 of this.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Price {
    /// The window's pixels.
    pub pixels: f64,
    /// Splats of core and halo that are shown, of whenever there are most.
    pub shown: f64,
    /// Splats under training, shown or not.
    pub trained: f64,
    /// Frozen splats that are shown.
    pub context: f64,
}

impl Price {
    /// CPU seconds of one pixel of the price, on a core with AVX2 (an EPYC of 2021; one with AVX-512 took half).
    pub const CPU_SECONDS: f64 = 0.26e-6;

    /// Of a step of this task.
    pub fn of(task: &Task) -> Self {
        let splats = f64::from(task.budget) * if task.block.level == 0 { 1.0 } else { HALO_AREA };
        Self {
            pixels: task.window_pixels() as f64 / task.views.len().max(1) as f64,
            shown: PER_SHOWN * f64::from(task.drawn),
            trained: PER_TRAINED * splats,
            context: PER_FROZEN * f64::from(task.context_drawn),
        }
    }

    /// All of it.
    pub fn total(&self) -> f64 {
        self.pixels + self.shown + self.trained + self.context
    }
}
