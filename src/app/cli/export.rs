//! `lunarray export`: results in formats that other software reads.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

use clap::{Args, Subcommand, ValueEnum};

use super::arguments::{
    ArrayArgs, MapFileArgs, frame, input_path, is_standard, output_or_standard, output_path, time_s,
};
use super::log::system_utc_text;
use super::output::{
    CommandError, CommandResult, Completion, cannot_write, print_config_notes, print_json_line, print_notes,
    print_text, stdout_error,
};
use crate::array::{Array, OemExport};
use crate::files::{ProtectedInputs, write_atomically};
use crate::products::pictures::Scaling;
use crate::products::{Hips, HipsReport, RunFigures, VisibilityTable, spectra_csv};
use crate::runtime::Cancel;
use crate::sky::Frame;
use crate::sky::fits::{Card, read_map_file, read_whole_map, write_alm};
use crate::sky::harmonics::AnalysisOptions;
use crate::units::ChannelId;
use crate::units::time_scales::{Tai, TimeScale, utc_text};

/// Export visibilities, spectra, harmonic coefficients or tiles for other software.
///
/// Visibilities as UVH5 and Parquet are written by the Python package: lunarray.open(FILE).write_uvh5(..), .write_parquet(..).
///
/// Example: lunarray export visibilities out/quicklook/downlink.ccsds --channel 1 --out visibilities.csv
#[derive(Debug, Args)]
pub(super) struct ExportArgs {
    #[command(subcommand)]
    what: ExportKind,
}

#[derive(Debug, Subcommand)]
enum ExportKind {
    /// Visibilities of one channel of a downlink file as CSV: times, baselines and positions (m), values (K sr and Jy), weights.
    Visibilities(VisibilityArgs),
    /// C_l, rho_l and SNR_l of the maps of runs as CSV.
    Spectra(SpectraArgs),
    /// Harmonic coefficients of a map as FITS, which healpy's read_alm reads.
    Alm(AlmArgs),
    Hips(HipsArgs),
    Orbits(OrbitArgs),
}

#[derive(Debug, Args)]
struct VisibilityArgs {
    /// Downlink file.
    #[arg(value_name = "FILE", value_parser = input_path())]
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

/// A map as HiPS, a folder of tiles, which Aladin and Aladin Lite show.
///
/// Tiles are FITS (K, single precision) and PNG, of orders 0 to 3, or higher for maps beyond nside 4096, with `properties` and
/// Norder3/Allsky. Pixels of the highest order take the value of the map's pixel at their centre, without interpolation; those
/// of lower orders are means of the next one. The highest order is at least as fine as the map, and no coarser than nside 512.
///
/// Aladin opens the folder as a file; Aladin Lite reads it from a web server.
///
/// Example: lunarray export hips out/quicklook/3.000MHz/map.fits --out hips
#[derive(Debug, Args)]
struct HipsArgs {
    /// HEALPix map, K (FITS).
    #[arg(value_name = "MAP.fits")]
    map: PathBuf,
    #[command(flatten)]
    maps: MapFileArgs,
    /// Frame of the tiles: galactic or equatorial; ecliptic, which Aladin Lite does not know, keeps the pixels of an ecliptic map.
    #[arg(long, value_name = "FRAME", default_value = "galactic", value_parser = frame)]
    hips_frame: Frame,
    /// Colours of the PNG tiles: log or linear, over 99 % of the map's values.
    #[arg(long, value_enum, default_value_t = Colours::Log, value_name = "log|linear", hide_possible_values = true)]
    colours: Colours,
    /// Title; the file's name and frequency if not given.
    #[arg(long)]
    title: Option<String>,
    /// Identifier in the Virtual Observatory, for tiles that are to be published.
    #[arg(long, value_name = "ivo://AUTHORITY/NAME", default_value = "ivo://UNK.AUTH/P/lunarray")]
    id: String,
    /// New or empty folder.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: PathBuf,
    /// Print one JSON object instead of text: folder, order, tile_width, frame, tiles.
    #[arg(long)]
    json: bool,
}

/// Orbits of an array as CCSDS OEM files, DIR/sat1.oem, sat2.oem, .., which `array.oem` and other software read.
///
/// Positions in km and velocities in km/s on the axes of EME2000, centre MOON, dates UTC, Hermite's interpolation of degree 7. Read again,
/// positions are the same to 1 mm. Orbits of tables (`array.oem`, `array.propagate`) are written at their own states, as long as they last.
///
/// Example: lunarray export orbits --set array.propagate.days=475 --out oem
#[derive(Debug, Args)]
struct OrbitArgs {
    #[command(flatten)]
    array: ArrayArgs,
    /// How long, with an optional unit s, h or d; the mission's `spacecraft.duration_s` if not given.
    #[arg(long, value_name = "TIME", value_parser = time_s)]
    duration: Option<f64>,
    /// Maximum time between states, with an optional unit s, h or d.
    #[arg(long, value_name = "TIME", value_parser = time_s, default_value = "120s")]
    step: f64,
    /// First epoch, UTC, such as 2030-01-31T12:00:00; spacecraft.epoch_tai_s if not given. Orbits of array.oem have their own dates.
    #[arg(long)]
    epoch: Option<String>,
    /// Folder for the files.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: PathBuf,
    /// Print one JSON object instead of text: folder, files, states.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Colours {
    Log,
    Linear,
}

#[derive(Debug, Args)]
struct Destination {
    /// File to be written; - for a table on standard output.
    #[arg(short, long, value_name = "FILE", value_parser = output_or_standard())]
    out: PathBuf,
    /// Print one JSON object instead of text: file, rows. Not with a table on standard output.
    #[arg(long)]
    json: bool,
}

impl ExportArgs {
    fn inputs(&self) -> Vec<PathBuf> {
        match &self.what {
            ExportKind::Visibilities(args) => vec![args.file.clone()],
            ExportKind::Spectra(args) => args.runs.iter().map(|run| run.join("summary.json")).collect(),
            ExportKind::Alm(args) => vec![args.map.clone()],
            ExportKind::Hips(args) => vec![args.map.clone()],
            ExportKind::Orbits(args) => args.array.inputs(),
        }
    }

    /// Refuses binary files and JSON reports on a standard output that holds the table.
    fn check_standard_output(&self) -> Result<(), CommandError> {
        let (to, is_table) = match &self.what {
            ExportKind::Visibilities(args) => (&args.to, true),
            ExportKind::Spectra(args) => (&args.to, true),
            ExportKind::Alm(args) => (&args.to, false),
            ExportKind::Hips(_) | ExportKind::Orbits(_) => return Ok(()),
        };
        match is_standard(&to.out) {
            true if !is_table => Err("--out -: a FITS file needs a name; ./- is a file of that name".into()),
            true if to.json => {
                Err("--json with --out -: standard output holds the table; expected one of them".into())
            }
            _ => Ok(()),
        }
    }
}

pub(super) fn execute(args: &ExportArgs) -> CommandResult {
    args.check_standard_output()?;
    let _inputs = ProtectedInputs::of(args.inputs());
    let (to, rows, unit) = match &args.what {
        ExportKind::Hips(args) => return hips(args),
        ExportKind::Orbits(args) => return orbits(args),
        ExportKind::Visibilities(args) => (&args.to, visibilities(args)?, "visibilities"),
        ExportKind::Spectra(args) => (&args.to, spectra(args)?, "degrees"),
        ExportKind::Alm(args) => (&args.to, alm(args)?, "coefficients"),
    };
    if is_standard(&to.out) {
        // Standard output holds the table.
    } else if to.json {
        print_json_line(&serde_json::json!({ "file": to.out, "rows": rows }))?;
    } else {
        print_text(&format!("{rows} {unit} are in {}", to.out.display()))?;
    }
    Ok(Completion::Done)
}

fn visibilities(args: &VisibilityArgs) -> Result<usize, CommandError> {
    // CSV under the extension of another format would only fail later, in the program that reads it.
    for other in ["parquet", "uvh5"] {
        if args.to.out.extension().is_some_and(|extension| extension.eq_ignore_ascii_case(other)) {
            return Err(format!(
                "--out {}: this command writes CSV; expected lunarray.open({:?}).write_{other}(..) of the Python package",
                args.to.out.display(),
                args.file.display().to_string()
            )
            .into());
        }
    }
    let table = VisibilityTable::read(&args.file, &Cancel::new())?;
    let channels = table.instrument().channels.len();
    if usize::from(args.channel) >= channels {
        return Err(format!(
            "--channel {}: expected one of the file's {channels} channels, from 0",
            args.channel
        )
        .into());
    }
    let channel = ChannelId(args.channel);
    let rows = match is_standard(&args.to.out) {
        true => table.write_csv_to(channel, &mut std::io::stdout().lock()).map_err(stdout_error)?,
        false => table.write_csv(channel, &args.to.out)?,
    };
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
    match is_standard(&args.to.out) {
        true => print_text(text.trim_end())?,
        false => write(&args.to.out, text.as_bytes())?,
    }
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

fn hips(args: &HipsArgs) -> CommandResult {
    let file = read_map_file(&args.map, &args.maps.options())?;
    let frequency_hz = file.frequency_hz;
    let name = args.map.display();
    let title = args.title.clone().unwrap_or_else(|| match frequency_hz {
        Some(hz) => format!("{name}, {} MHz", hz / 1e6),
        None => name.to_string(),
    });
    let hips = Hips {
        frame: args.hips_frame,
        scaling: match args.colours {
            Colours::Log => Scaling::Log,
            Colours::Linear => Scaling::Linear,
        },
        title,
        id: args.id.clone(),
        date: written_at(&args.map),
        frequency_hz,
    };
    let report = hips.write(&file.map, &args.out)?;
    if args.json {
        let mut object = serde_json::to_value(&report)?;
        object["folder"] = serde_json::json!(args.out);
        print_json_line(&object)?;
    } else {
        let HipsReport { order, tile_width, tiles, .. } = report;
        print_text(&format!(
            "{tiles} tiles up to order {order} of {tile_width} by {tile_width} pixels are in {}",
            args.out.display()
        ))?;
    }
    Ok(Completion::Done)
}

fn orbits(args: &OrbitArgs) -> CommandResult {
    let config = args.array.source().load()?;
    print_config_notes(&config);
    let until_s = args.duration.unwrap_or(config.spacecraft.duration_s);
    let _inputs = ProtectedInputs::of(config.input_files());
    let array = Array::new(&config.array)?;
    print_notes(array.notes());
    let epoch_tai_s = match (&args.epoch, array.epoch_tai_s()) {
        (None, _) => config.epoch_tai_s(&array),
        (Some(_), Some(tai_s)) => {
            let first_date = utc_text(tai_s);
            return Err(format!(
                "--epoch: the orbits have dates of their own, from {first_date} UTC on; expected none"
            )
            .into());
        }
        (Some(date), None) => match Tai::parse(date, TimeScale::Utc) {
            Some(time) => time.seconds_since_1958(),
            None => {
                return Err(
                    format!("--epoch {date}: expected a date, UTC, such as 2030-01-31T12:00:00").into()
                );
            }
        },
    };
    let export = OemExport::new(epoch_tai_s, until_s, args.step)?;
    let mut states = 0;
    for satellite in 0..array.satellites() {
        let (text, count) = export.text(&array, satellite);
        write(&args.out.join(format!("sat{}.oem", satellite + 1)), text.as_bytes())?;
        states += count;
    }
    let files = array.satellites();
    if args.json {
        print_json_line(&serde_json::json!({ "folder": args.out, "files": files, "states": states }))?;
    } else {
        print_text(&format!("{states} states of {files} satellites are in {}", args.out.display()))?;
    }
    Ok(Completion::Done)
}

/// Modification time of a file, UTC to the minute. It dates the export, so that repeated exports of a file are identical.
fn written_at(path: &Path) -> String {
    let modified = std::fs::metadata(path).and_then(|found| found.modified());
    let text = system_utc_text(modified.unwrap_or(SystemTime::UNIX_EPOCH));
    format!("{}Z", text.get(..16).unwrap_or(&text))
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), CommandError> {
    write_atomically(path, bytes).map_err(cannot_write(path))
}
