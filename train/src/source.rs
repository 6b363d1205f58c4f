//! The interface through which training reads photos.

use std::sync::Arc;

use scene::{Pixels, Rect};

/// Reads windows of views. `dataset` implements it over the store, tests over memory.
pub trait WindowSource: Sync {
    /// The pixels of `rect` of a view of the capture. `rect` is in pixels of mip `mip`.
    ///
    /// # Errors
    /// One line that names the view and the cause.
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String>;

    /// Announces that this window will be read within a few steps, so that a remote source can download it meanwhile.
    /// A failure is reported by [`window`](Self::window), not here.
    fn prefetch(&self, _view: u32, _mip: u8, _rect: Rect) {}
}

/// How many windows ahead of the current one are announced to the source.
pub(crate) const AHEAD: usize = 8;

/// Reads windows (view, mip, rectangle) in order and announces the next [`AHEAD`] to the source.
pub fn each<'a>(
    source: &'a dyn WindowSource,
    windows: impl Iterator<Item = (u32, u8, Rect)> + Clone + 'a,
) -> impl Iterator<Item = Result<Arc<Pixels>, String>> + 'a {
    let (mut ahead, mut first) = (windows.clone(), true);
    windows.map(move |(view, mip, rect)| {
        let count = if std::mem::take(&mut first) { AHEAD + 1 } else { 1 };
        ahead.by_ref().take(count).for_each(|(view, mip, rect)| source.prefetch(view, mip, rect));
        source.window(view, mip, rect)
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    /// Records the views that were announced and those that were read.
    #[derive(Default)]
    struct Recorder(Mutex<[Vec<u32>; 2]>);

    impl WindowSource for Recorder {
        fn window(&self, view: u32, _: u8, _: Rect) -> Result<Arc<Pixels>, String> {
            self.0.lock().unwrap()[1].push(view);
            if view == 20 {
                Err("gone".into())
            } else {
                Ok(Arc::new(Pixels { width: 0, height: 0, rgb: Vec::new(), ..Pixels::default() }))
            }
        }

        fn prefetch(&self, view: u32, _: u8, _: Rect) {
            self.0.lock().unwrap()[0].push(view);
        }
    }

    #[test]
    fn windows_are_announced_a_few_ahead_once_and_in_order() {
        let rect = Rect { x: 0, y: 0, width: 1, height: 1 };
        let source = Recorder::default();
        for (n, window) in each(&source, (0..30).map(|view| (view, 0, rect))).enumerate() {
            assert_eq!(window.is_err(), n == 20);
            let [announced, read] = &*source.0.lock().unwrap();
            let ahead = (n + 1 + AHEAD).min(30) as u32;
            assert_eq!((announced, read), (&(0..ahead).collect(), &(0..=n as u32).collect()));
        }
    }
}
