//! What the readers of models of other programs return.

use scene::{GeoOrigin, Splats};

/// A model as one set of splats.
#[derive(Debug)]
pub(crate) struct Imported {
    pub(crate) splats: Splats,
    /// Whether they are rendered anti-aliased.
    pub(crate) antialiased: bool,
    /// Where on Earth their origin lies, if the file says it.
    pub(crate) geo_origin: Option<GeoOrigin>,
}
