//! The leaves of a RAD where the model had them.

use glam::DVec3;
use scene::{CodecError, GeoOrigin, column, rad};
use serde::Deserialize;

use super::imported::Imported;

/// What `plat export` says in the file's comment; other programs say other things.
#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
struct Comment {
    /// What was subtracted from all places, metres.
    origin: DVec3,
    antialiased: bool,
    geo_origin: Option<GeoOrigin>,
}

pub(super) fn read(bytes: &[u8]) -> Result<Imported, CodecError> {
    let file = rad::read(bytes)?;
    let comment = file.comment.as_deref().and_then(|text| serde_json::from_str(text).ok());
    let Comment { origin, antialiased, geo_origin } = comment.unwrap_or_default();
    let mut splats = file.leaves();
    drop(file);
    for (column, shift) in splats.columns_mut()[column::MEAN..].iter_mut().zip(origin.to_array()) {
        column.iter_mut().for_each(|value| *value = (f64::from(*value) + shift) as f32);
    }
    match (0..splats.len()).all(|row| splats.is_finite(row)) {
        true => Ok(Imported { splats, antialiased, geo_origin }),
        false => Err(CodecError::new("the origin in the comment moves splats out of what numbers can hold")),
    }
}
