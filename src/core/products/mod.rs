//! The products of a run: maps, pictures, tables and summaries in an output folder.
//!
//! [`Publisher`] is the sink that writes every [`crate::imaging::Solution`]; [`write_autos`] writes the
//! auto-correlations; [`pictures`] draws. A [`MapViewer`] gets every map when it is published.
//!
//! Uses [`crate::imaging`], [`crate::ground`], [`crate::downlink`], [`crate::sky`], [`crate::frames`] and [`crate::runtime`]. Equal data give
//! equal bytes, and every map carries its provenance: configuration hashes, seed, program version and data span.

mod autos;
mod beam;
mod burst_events;
mod channel;
mod comparison_pictures;
mod config;
mod epsilons;
mod error;
mod error_maps;
mod hips;
mod joint;
mod latitudes;
pub mod pictures;
mod point_beams;
mod provenance;
mod publisher;
mod run_pictures;
mod runs;
mod sheet_maps;
mod summary;
mod time_coverage;
mod truth;
mod viewer;
mod visibility_table;
mod zoom;

#[doc(hidden)]
pub use autos::{AutoSummary, summarise, write_autos};
#[doc(hidden)]
pub use beam::EffectiveBeam;
#[doc(hidden)]
pub use burst_events::{remove_event, write_event};
#[doc(hidden)]
pub use comparison_pictures::{draw_comparison, draw_relative_error};
#[doc(hidden)]
pub use config::{PostProcessing, ProductsConfig};
#[doc(hidden)]
pub use epsilons::{
    EpsilonChoice, EpsilonChoices, EpsilonPoint, draw_epsilons, epsilon_choices, epsilons_csv,
};
#[doc(hidden)]
pub use error::ProductsError;
#[doc(hidden)]
pub use error::{create_folder, write_product};
#[doc(hidden)]
pub use error_maps::{ErrorMap, own_power_csv, told_vector};
#[doc(hidden)]
pub use hips::{Hips, HipsReport};
#[doc(hidden)]
pub use joint::{JOINT, JointMapReport, JointReport, sigma_uncertainty, uncertainty_line, write_joint};
#[doc(hidden)]
pub use latitudes::LatitudeError;
#[doc(hidden)]
pub use point_beams::{BeamWidths, PointBeamSummary};
#[doc(hidden)]
pub use provenance::Provenance;
#[doc(hidden)]
pub use publisher::{ProductsReport, ProductsWatch, Publisher, WrittenProducts};
#[doc(hidden)]
pub use run_pictures::draw_runs;
#[doc(hidden)]
pub use runs::{
    BeamFigures, ChannelFigures, Crossing, DiagnosticFigures, MeasuredModes, PowerFigures, RunFigures,
    TraceFigures, crossings, runs_csv, spectra_csv,
};
pub use summary::ChannelSummary;
#[doc(hidden)]
pub use summary::{PowerSpectra, SnapshotSummary};
#[doc(hidden)]
pub use time_coverage::draw_coverage;
#[doc(hidden)]
pub use truth::{MapShape, Truth};
#[doc(hidden)]
pub use viewer::{MapViewer, MapWatch, PublishedMap};
#[doc(hidden)]
pub use visibility_table::{VisibilityRow, VisibilityTable, jansky_per_k_sr};
#[doc(hidden)]
pub use zoom::{ListedSource, SourceEntry, ZoomSummary, write_zoom};
