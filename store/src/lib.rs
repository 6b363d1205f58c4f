//! Content-addressed artefacts and small named records on an object store: a folder, an S3 bucket or memory.
//!
//! A store is a URL. Below it lie `artefacts/ab/<64 hex digits>` (the BLAKE3 hash of the bytes; `ab` are its first two
//! digits, which bounds the size of folders) and `names/<name>`. An artefact is written once and never changed, so
//! writers need no lock and a reader can verify what it read. A record is replaced as a whole.
//!
//! Architecture invariant: nothing here knows what the bytes mean.

mod artefacts;
mod blocking;
pub mod doctor;
mod error;
pub mod file;
mod open;
mod paths;
mod records;

pub use artefacts::{Store, Traffic};
pub use blocking::BlockingStore;
pub use error::StoreError;
pub use paths::MAX_RECORD_NAME_BYTES;

#[cfg(test)]
mod tests;
