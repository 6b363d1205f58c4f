//! Captures: opened from the formats they come in, ingested into the store as mips, read back as windows, or rehearsed
//! in a generated city.
//!
//! Architecture invariant: this is the only crate that opens a capture's files. What it hands out is plain data
//! (`scene`) and artefact ids; nothing above it knows where a photo came from or what its lens was like.

pub mod byte_lru;
pub mod ingest;
pub mod lens;
pub mod mips;
pub mod open;
mod photo;
pub mod synth;
pub mod windows;
