//! The undistorter of photos, kept from one to the next.

use scene::{BadInput, CameraModel, Pinhole};

use crate::open::Photo;
use crate::undistortion::Undistorter;

/// The undistorter of the last photo, by lens and size. Consecutive photos mostly share a lens.
pub(crate) type LastUndistorter = Option<((CameraModel, u32, u32), Undistorter)>;

/// The undistorter of a photo, whose pinhole has to be the camera of its view.
pub(crate) fn undistorter<'a>(
    photo: &Photo,
    pinhole: Pinhole,
    last: &'a mut LastUndistorter,
) -> Result<&'a Undistorter, BadInput> {
    let key = (photo.model, photo.width, photo.height);
    let cached = last.take().filter(|(of, _)| *of == key).map(|(_, undistorter)| undistorter);
    let undistorter = cached.or_else(|| Undistorter::new(&photo.model, photo.width, photo.height));
    match undistorter.filter(|undistorter| undistorter.pinhole() == pinhole) {
        Some(undistorter) => Ok(&last.insert((key, undistorter)).1),
        None => {
            let advice = "check the parameters of its camera";
            Err(BadInput::new(photo.shown(), "was taken with a lens whose distortion cannot be inverted", advice))
        }
    }
}
