//! Figures of an array and its beam matrix that need no map: baselines, coverage, and the effects of pixels.
//!
//! Each consists of a picture, a table and a few numbers, computed from a [`Plan`]; figures of the paper are among them. Maps and
//! their spectra are in [`crate::products`], series of maps in studies ([`crate::pipeline::Study`]).

mod baselines;
mod coverage;
mod error;
mod exposure;
mod output;
mod pair_time;
mod proposal;
mod request;
mod rows;
mod spacing;
mod sub_pixel;
mod uvw;
mod waterfall;

use std::path::Path;

pub use error::FigureError;
pub use output::FigureFiles;
pub use proposal::{
    ProposalColumn, ProposalValue, ValueSource, proposal, proposal_csv, proposal_latex, proposal_markdown,
};
pub use request::{FIGURES, FigureRequest};

use crate::pipeline::Plan;

/// Makes a figure and writes `NAME.png`, `NAME.csv` and `NAME.json` into `folder`.
///
/// # Errors
/// An unknown name, a pair that the array does not have, a figure that this array does not have, or a file that cannot be
/// written.
pub fn make_figure(request: &FigureRequest, plan: &Plan, folder: &Path) -> Result<FigureFiles, FigureError> {
    let made = match request.name.as_str() {
        "spacing" => spacing::make(plan)?,
        "baselines" => baselines::make(plan)?,
        "pair-time" => pair_time::make(plan)?,
        "uvw" => uvw::make(plan)?,
        "coverage" => coverage::make(plan, folder)?,
        "rows" => rows::make(plan, request)?,
        "waterfall" => waterfall::make(plan, request)?,
        "sub-pixel" => sub_pixel::make(plan, folder)?,
        _ => return Err(FigureError::Unknown { name: request.name.clone() }),
    };
    made.write(&request.name, folder)
}
