//! Tests of the GPU backend.
//!
//! Without an adapter they print "skipped"; with `PLAT_GPU=required` they fail.

#![cfg(feature = "gpu")]

mod agreement;
mod common;
mod determinism;
mod edge_cases;
mod memory;
mod paths;
#[path = "../reference/mod.rs"]
mod reference;
