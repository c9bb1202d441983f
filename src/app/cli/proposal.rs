//! `lunarray proposal`: the table of a proposal.

use std::path::{Path, PathBuf};

use clap::Args;

use super::arguments::output_path;
use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::figures::{ProposalColumn, proposal, proposal_csv, proposal_latex, proposal_markdown};
use crate::files::ProtectedInputs;
use crate::products::write_product;

/// Print the table of a proposal: what designs measure, send and take.
///
/// A column is a channel of an output folder of `lunarray run`, or of a pipeline file that has not been run. Rows are the array, data volume
/// and downlink time of the whole mission, projected baselines, coverage, resolution, noise in K and in Jy per beam, and rho_l, SNR_l
/// and measured modes, Tr A (A + R)^-1, at chosen degrees. Each value says whether it was measured in the map, estimated, computed
/// from the orbits or set; what is not known says so.
///
/// Example: lunarray proposal out/six six-lower.toml --degrees 2,5,10 --out table.tex
#[derive(Debug, Args)]
pub(super) struct ProposalArgs {
    /// Output folders of runs, or pipeline files (TOML).
    #[arg(value_name = "RUN|PIPELINE.toml", required = true)]
    designs: Vec<PathBuf>,
    /// Degrees l, separated by commas; those without a map are estimated up to 18.
    #[arg(long, value_name = "L,..", value_delimiter = ',', default_value = "2,5,10,18")]
    degrees: Vec<usize>,
    /// Write the table to a file: LaTeX, CSV or Markdown, as its name ends in .tex, .csv or .md; may be repeated. Printed as Markdown if not given.
    #[arg(short, long, value_name = "FILE", value_parser = output_path())]
    out: Vec<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &ProposalArgs) -> CommandResult {
    let _inputs = ProtectedInputs::of(&args.designs);
    let formats: Result<Vec<_>, String> = args.out.iter().map(|path| format_of(path)).collect();
    let formats = formats?;
    let columns = proposal(&args.designs, &args.degrees)?;
    for (path, format) in args.out.iter().zip(formats) {
        write_product(path, format(&columns))?;
    }
    if args.json {
        print_json_line(&columns)?;
    } else if args.out.is_empty() {
        print_text(proposal_markdown(&columns).trim_end())?;
    } else {
        let files: Vec<String> = args.out.iter().map(|path| path.display().to_string()).collect();
        print_text(&files.join("\n"))?;
    }
    Ok(Completion::Done)
}

/// The format that the name of a file asks for.
fn format_of(path: &Path) -> Result<fn(&[ProposalColumn]) -> String, String> {
    match path.extension().and_then(|extension| extension.to_str()) {
        Some("tex") => Ok(proposal_latex),
        Some("csv") => Ok(proposal_csv),
        Some("md") => Ok(proposal_markdown),
        _ => Err(format!("--out {}: expected a name that ends in .tex, .csv or .md", path.display())),
    }
}
