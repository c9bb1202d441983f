//! (to come)

mod legendre;
mod pattern;
mod quadrature;
mod real;
mod ring;
mod trigonometry;

pub use pattern::{NodeGrid, PatternGeometry, PatternTable, degrees};
pub use real::Real;
