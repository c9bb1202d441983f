//! `lunarray export`: results in formats that other software reads.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};

use super::arguments::MapFileArgs;
use super::output::{CommandError, CommandResult, Completion, print_json_line, print_notes, print_text};
use crate::files::write_atomically;
use crate::products::{RunFigures, VisibilityTable, spectra_csv};
use crate::runtime::Cancel;
use crate::sky::fits::{Card, read_whole_map, write_alm};
use crate::sky::harmonics::AnalysisOptions;
use crate::units::ChannelId;

/// Export visibilities, spectra or harmonic coefficients for other software.
///
/// Visibilities as UVH5 are written by the Python package: lunarray.open(FILE).write_uvh5(..).
///
/// Example: lunarray export visibilities out/quicklook/downlink.ccsds --channel 1 --out visibilities.csv
#[derive(Debug, Args)]
pub(super) struct ExportArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Visibilities of one channel of a downlink file as CSV: times, baselines and positions (m), values (K sr and Jy), weights.
    Visibilities(VisibilityArgs),
    /// C_l, rho_l and SNR_l of the maps of runs as CSV.
    Spectra(SpectraArgs),
    /// Harmonic coefficients of a map as FITS, which healpy's read_alm reads.
    Alm(AlmArgs),
}

#[derive(Debug, Args)]
struct VisibilityArgs {
    /// Downlink file.
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Channel, from 0.
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    channel: u16,
    #[command(flatten)]
    to: Destination,
}

#[derive(Debug, Args)]
struct SpectraArgs {
    /// Output folders of runs.
    #[arg(value_name = "RUN", num_args = 1.., required = true)]
    runs: Vec<PathBuf>,
    #[command(flatten)]
    to: Destination,
}

#[derive(Debug, Args)]
struct AlmArgs {
    /// HEALPix map, K (FITS).
    #[arg(value_name = "MAP.fits")]
    map: PathBuf,
    #[command(flatten)]
    maps: MapFileArgs,
    /// Maximum degree; 3 nside - 1 if not given.
    #[arg(long)]
    l_max: Option<usize>,
    #[command(flatten)]
    to: Destination,
}

#[derive(Debug, Args)]
struct Destination {
    /// File to be written.
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
    /// Print one JSON object instead of text: file, rows.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &ExportArgs) -> CommandResult {
    let (to, rows, of) = match &args.what {
        What::Visibilities(args) => (&args.to, visibilities(args)?, "visibilities"),
        What::Spectra(args) => (&args.to, spectra(args)?, "degrees"),
        What::Alm(args) => (&args.to, alm(args)?, "coefficients"),
    };
    if to.json {
        print_json_line(&serde_json::json!({ "file": to.out, "rows": rows }))?;
    } else {
        print_text(&format!("{rows} {of} are in {}", to.out.display()))?;
    }
    Ok(Completion::Done)
}

fn visibilities(args: &VisibilityArgs) -> Result<usize, CommandError> {
    let table = VisibilityTable::read(&args.file, &Cancel::new())?;
    let channels = table.instrument().channels.len();
    if usize::from(args.channel) >= channels {
        return Err(format!(
            "--channel {}: expected one of the file's {channels} channels, from 0",
            args.channel
        )
        .into());
    }
    let rows = table.write_csv(ChannelId(args.channel), &args.to.out)?;
    if rows == 0 {
        print_notes([format!("{}: no visibility of channel {}", args.file.display(), args.channel)]);
    }
    Ok(rows)
}

fn spectra(args: &SpectraArgs) -> Result<usize, CommandError> {
    let read = |folder: &PathBuf| -> Result<RunFigures, CommandError> {
        let label = folder.display().to_string();
        Ok(RunFigures { label, ..RunFigures::read(folder)? })
    };
    let runs = args.runs.iter().map(read).collect::<Result<Vec<_>, _>>()?;
    let text = spectra_csv(&runs.iter().collect::<Vec<_>>());
    write(&args.to.out, text.as_bytes())?;
    Ok(text.lines().count().saturating_sub(1))
}

fn alm(args: &AlmArgs) -> Result<usize, CommandError> {
    let map = read_whole_map(&args.map, &args.maps.options())?;
    let l_max = args.l_max.unwrap_or(3 * map.nside() - 1);
    let alm = map.harmonics(l_max, &AnalysisOptions::default())?;
    let frame = Card::text(
        "COORDSYS",
        &map.frame().letter().to_string(),
        "Ecliptic, Galactic or Celestial (equatorial)",
    );
    write_alm(&args.to.out, &alm, &[frame])?;
    Ok(alm.values().len())
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), CommandError> {
    write_atomically(path, bytes).map_err(|error| format!("cannot write {}: {error}", path.display()).into())
}
