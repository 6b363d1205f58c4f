//! Where pixels come from: the one thing that training asks of the world outside.

use std::sync::Arc;

use scene::{Pixels, Rect};

/// Gives windows of views. Implemented over the store by `dataset`, over memory by tests.
pub trait WindowSource: Sync {
    /// The pixels of `rect`, in pixels of that mip, of a view of the capture.
    ///
    /// # Errors
    /// A line that says which view could not be read and why.
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String>;

    /// Says that this window will be asked for in a few steps: whoever has it far away may fetch it meanwhile. What is wrong with
    /// it is said when it is asked for.
    fn expect(&self, _view: u32, _mip: u8, _rect: Rect) {}
}

/// Windows ahead of which a source hears what will be asked for.
pub(crate) const AHEAD: usize = 8;

/// The pixels of some windows (view, mip and rectangle), one after the other; the source hears of those to come. The errors are the
/// source's.
pub fn each<'a>(
    source: &'a dyn WindowSource,
    windows: impl Iterator<Item = (u32, u8, Rect)> + Clone + 'a,
) -> impl Iterator<Item = Result<Arc<Pixels>, String>> + 'a {
    let (mut ahead, mut first) = (windows.clone(), true);
    windows.map(move |(view, mip, rect)| {
        let count = if std::mem::take(&mut first) { AHEAD + 1 } else { 1 };
        ahead.by_ref().take(count).for_each(|(view, mip, rect)| source.expect(view, mip, rect));
        source.window(view, mip, rect)
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    /// Keeps what it was told to expect and asked for.
    #[derive(Default)]
    struct Listener(Mutex<[Vec<u32>; 2]>);

    impl WindowSource for Listener {
        fn window(&self, view: u32, _: u8, _: Rect) -> Result<Arc<Pixels>, String> {
            self.0.lock().unwrap()[1].push(view);
            if view == 20 {
                Err("gone".into())
            } else {
                Ok(Arc::new(Pixels { width: 0, height: 0, rgb: Vec::new(), mask: None }))
            }
        }

        fn expect(&self, view: u32, _: u8, _: Rect) {
            self.0.lock().unwrap()[0].push(view);
        }
    }

    #[test]
    fn windows_are_expected_a_few_ahead_each_once_and_in_order() {
        let rect = Rect { x: 0, y: 0, width: 1, height: 1 };
        let source = Listener::default();
        for (n, found) in each(&source, (0..30).map(|view| (view, 0, rect))).enumerate() {
            assert_eq!(found.is_err(), n == 20);
            let [expected, asked] = &*source.0.lock().unwrap();
            let ahead = (n + 1 + AHEAD).min(30) as u32;
            assert_eq!((expected, asked), (&(0..ahead).collect(), &(0..=n as u32).collect()));
        }
    }
}
