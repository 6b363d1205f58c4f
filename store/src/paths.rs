//! Paths of objects below a store's URL.

use object_store::path::Path;
use scene::ArtefactId;

/// The longest name of a record, in bytes.
pub const MAX_RECORD_NAME_BYTES: usize = 200;

/// `artefacts/ab/<64 hex digits>`.
pub(crate) fn artefact_path(id: ArtefactId) -> Path {
    let hex = id.to_string();
    Path::from_iter(["artefacts", &hex[..2], &hex])
}

/// The folder of all records.
pub(crate) fn records_path() -> Path {
    Path::from("names")
}

/// `names/<name>`; `None` for a name that [`is_plain_segment`] refuses a part of, so that no name leaves the folder, or one
/// that is too long.
pub(crate) fn record_path(name: &str) -> Option<Path> {
    let is_valid = name.len() <= MAX_RECORD_NAME_BYTES && name.split('/').all(is_plain_segment);
    is_valid.then(|| Path::from_iter(std::iter::once("names").chain(name.split('/'))))
}

/// The name of a record at this path below the store's URL; `None` for any other object.
pub(crate) fn record_name(path: &Path) -> Option<&str> {
    path.as_ref().strip_prefix("names/")
}

/// Whether a path segment consists of ASCII letters, digits and `._-`, and is neither empty nor hidden.
pub(crate) fn is_plain_segment(segment: &str) -> bool {
    !segment.is_empty()
        && !segment.starts_with('.')
        && segment.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-'))
}
