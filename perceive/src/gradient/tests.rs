//! Generated graphs against rten and finite differences, hostile files, and the networks in `shared/`.

mod graphs;
mod hostile;
mod operators;
mod photos;
