//! The runner as a whole: order, bounds, endings.

mod endings;
mod flow;
mod parts;
mod stress;
