//! The products of a run: maps, pictures, tables and summaries in an output folder.
//!
//! [`Publisher`] is the sink that writes every [`crate::imaging::Solution`]; [`write_autos`] writes the
//! auto-correlations. [`pictures`] draws. A [`MapViewer`] sees maps as they are published.
//!
//! May use [`crate::imaging::solver`], [`crate::ground`], [`crate::downlink`], [`crate::sky`], [`crate::frames`] and [`crate::runtime`]. Equal data give
//! equal bytes, and every map carries its provenance: configuration hashes, seed, program version and data span.

mod autos;
mod beam;
mod channel;
mod config;
mod epsilons;
mod error;
mod hips;
mod latitudes;
pub mod pictures;
mod point_beams;
mod provenance;
mod publisher;
mod runs;
mod summary;
mod time_coverage;
mod truth;
mod viewer;
mod visibility_table;

pub use autos::{AutoSummary, summarise, write_autos};
pub use beam::EffectiveBeam;
pub use channel::{draw_comparison, draw_relative_error};
pub use config::{PostProcessing, ProductsConfig};
pub use epsilons::{
    EpsilonChoice, EpsilonChoices, EpsilonPoint, draw_epsilons, epsilon_choices, epsilons_csv,
};
pub use error::ProductsError;
pub use hips::{Hips, HipsReport};
pub use latitudes::LatitudeError;
pub use point_beams::{BeamWidths, PointBeamSummary};
pub use provenance::Provenance;
pub use publisher::Publisher;
pub use runs::{
    BeamFigures, ChannelFigures, Crossing, DiagnosticFigures, EstimateFigures, FitFigures, PowerFigures,
    RunFigures, TraceFigures, crossings, draw_runs, runs_csv, spectra_csv,
};
pub use summary::{ChannelSummary, PowerSpectra, SnapshotSummary};
pub use time_coverage::draw_coverage;
pub use truth::{MapShape, Truth};
pub use viewer::{MapViewer, MapWatch, PublishedMap};
pub use visibility_table::{VisibilityRow, VisibilityTable, jansky_per_k_sr};
