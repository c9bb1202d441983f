//! Tests of the whole runtime: order, bounds and ends of runs.

mod endings;
mod flow;
mod parts;
mod stress;
