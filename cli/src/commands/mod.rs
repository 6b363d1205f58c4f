//! One file for each command; each takes its arguments and says its result through [`crate::output::Output`].

pub(crate) mod ablate;
pub(crate) mod bench;
pub(crate) mod coordinator;
pub(crate) mod demo;
pub(crate) mod doctor;
pub(crate) mod eval;
pub(crate) mod export;
pub(crate) mod garage;
pub(crate) mod import;
pub(crate) mod inspect;
mod inspect_objects;
pub(crate) mod jobs;
pub(crate) mod kernels;
pub(crate) mod object_poses;
pub(crate) mod pareto;
pub(crate) mod plan;
pub(crate) mod prune;
pub(crate) mod prune_orders;
pub(crate) mod render;
pub(crate) mod scale;
pub(crate) mod serve;
pub(crate) mod stability;
pub(crate) mod submit;
pub(crate) mod synth;
pub(crate) mod train;
pub(crate) mod update;
pub(crate) mod worker;
