//! What a run leaves behind: maps, pictures, figures.
//!
//! Uses [`crate::solve`], [`crate::sky`] and, for coverage, [`crate::ground`].

mod autos;
mod channel;
mod config;
mod coverage;
mod error;
pub mod pictures;
mod provenance;
mod publisher;
mod summary;
mod truth;

pub use autos::{AutoSummary, summarise, write_autos};
pub use channel::{draw_comparison, draw_relative_error};
pub use config::{ProductsConfig, ProductsConfigError};
pub use coverage::draw_coverage;
pub use error::ProductsError;
pub use provenance::Provenance;
pub use publisher::Publisher;
pub use summary::{ChannelSummary, SnapshotSummary};
pub use truth::Truth;
