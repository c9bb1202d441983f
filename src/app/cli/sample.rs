//! `lunarray sample`: maps of a state's sums that are as likely as its map.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use serde::Serialize;

use super::arguments::{StateMapArgs, output_path};
use super::interrupt::Interrupt;
use super::output::{CommandError, CommandResult, print_json_line, print_notes, print_text};
use super::progress::{LINE_EVERY, while_solving};
use crate::files::write_atomically;
use crate::imaging::{RegulariserChoice, Sample, Samples, Solution, SolveError, SolveWatch};
use crate::pipeline::{PipelineError, sample_state, use_threads};
use crate::products::{ErrorMap, own_power_csv, sigma_uncertainty, told_vector, uncertainty_line};
use crate::sky::fits::{WriteOptions, write_map};
use crate::sky::{Frame, SkyMap};
use crate::units::frequency_folder;

/// Most samples: each is a map in memory.
const COUNT_MAX: u64 = 10_000;

/// Draw posterior samples of the map of a state.
///
/// They scatter around the map by its errors, from noise and from scales that the data do not measure: so does whatever is computed from
/// each of them. Needs R from the data (map.regulariser = "data"). Leaves in the output folder, for each channel, the map, each sample,
/// sigma.fits (standard deviation of each pixel), mask.fits and resolution.fits as of maps, and spectrum.csv, the sky's angular power with
/// its 68 % interval. No visibility is read again, and the state stays as it is. Ctrl-C ends it with the channels that are finished.
///
/// Example: lunarray sample state/ --count 100 --out samples/
#[derive(Debug, Args)]
pub(super) struct SampleArgs {
    /// State folder of `lunarray replay --state`.
    #[arg(value_name = "DIR")]
    state: PathBuf,
    /// Number of samples.
    #[arg(long, value_name = "NUMBER", default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..=COUNT_MAX))]
    count: u64,
    /// Draw the sky's angular power with each map (Gibbs sampling), in place of the most likely one: samples then include its uncertainty. Takes some four times as long.
    #[arg(long)]
    gibbs: bool,
    /// Output folder.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: PathBuf,
    #[command(flatten)]
    map: StateMapArgs,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

/// Statistics of the posterior samples of a channel.
#[derive(Debug, Serialize)]
struct SampledChannel {
    frequency_hz: f64,
    samples: usize,
    /// Relative standard deviation of a standard deviation of samples: 1 / sqrt(2 samples).
    sigma_uncertainty: f64,
    mean_k: f64,
    /// Standard deviation of the samples' means.
    mean_sigma_k: f64,
    /// Dipole of the map along the ecliptic's x, y and z.
    dipole_k: [f64; 3],
    /// Standard deviation of the samples' dipoles.
    dipole_sigma_k: [f64; 3],
    /// Root mean square of the pixels' standard deviations.
    sigma_rms_k: f64,
    folder: String,
}

pub(super) fn execute(args: &SampleArgs) -> CommandResult {
    // How earlier maps were made does not bind samples.
    let config = args.map.source_of_sums(&args.state)?.load_ground()?;
    let _inputs = args.map.protect(&config);
    let regulariser = config.map.regulariser();
    if regulariser != RegulariserChoice::Data {
        return Err(format!(
            "{}: samples need R from the data, and these settings choose another R (map.regulariser or \
             map.epsilon): expected --set map.regulariser=data",
            args.state.display()
        )
        .into());
    }
    if args.gibbs && config.map.refine.is_on() {
        return Err(
            "--gibbs with map.refine: each turn would be a refined map; expected samples without --gibbs"
                .into(),
        );
    }
    use_threads(&config.runtime)?;
    let mut written = Vec::new();
    let interrupt = Interrupt::default();
    interrupt.arm_or_note();
    let watch = SolveWatch::new(interrupt.cancel().clone()).with_grace(Duration::ZERO);
    let mut take = |solution: Solution| written.push(write(args, &solution));
    let samples = Samples { count: args.count as usize, gibbs: args.gibbs };
    let found = while_solving(&watch, || sample_state(&args.state, &config, samples, &watch, &mut take));
    let is_cut_short = matches!(&found, Err(PipelineError::Solve(SolveError::Interrupted)));
    if !is_cut_short {
        found?;
    }
    let mut all = Vec::new();
    for sampled in written {
        all.push(sampled?);
    }
    if is_cut_short {
        print_notes([format!(
            "ended early: samples of {} channels are in {}, others are not made; the state is as it was",
            all.len(),
            args.out.display()
        )]);
    }
    interrupt.completion(is_cut_short).after(args.print(&all))
}

impl SampleArgs {
    fn print(&self, all: &[SampledChannel]) -> Result<(), CommandError> {
        if self.json {
            return print_json_line(&all);
        }
        if all.is_empty() {
            return Ok(());
        }
        let mut lines: Vec<String> = all.iter().map(line).collect();
        lines.push(uncertainty_line("mean, dipole and pixels", self.count as usize));
        print_text(&lines.join("\n"))
    }
}

fn line(sampled: &SampledChannel) -> String {
    format!(
        "{:>8.3} MHz  {} samples in {}: mean ({:.4e} +- {:.1e}) K, dipole {} K, pixels +- {:.2e} K rms",
        sampled.frequency_hz / 1e6,
        sampled.samples,
        sampled.folder,
        sampled.mean_k,
        sampled.mean_sigma_k,
        told_vector(sampled.dipole_k, sampled.dipole_sigma_k),
        sampled.sigma_rms_k
    )
}

fn write(
    args: &SampleArgs,
    solution: &Solution,
) -> Result<SampledChannel, Box<dyn std::error::Error + Send + Sync>> {
    let channel = usize::from(solution.channel.0);
    let frequency_hz = solution.instrument.channels.get(channel).map_or(0.0, |channel| channel.frequency_hz);
    let errors = solution.uncertainty.as_ref().ok_or("this map has no posterior to draw from")?;
    let folder = args.out.join(frequency_folder(frequency_hz));
    std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let save = |name: &str, map_k: &[f64]| {
        write_map(
            &folder.join(name),
            &SkyMap::new(Frame::Ecliptic, map_k.to_vec())?,
            &WriteOptions::default(),
        )
        .map_err(Box::<dyn std::error::Error + Send + Sync>::from)
    };
    save("map.fits", &solution.map_k)?;
    let mut said = Instant::now();
    for (number, sample) in errors.samples.iter().enumerate() {
        if said.elapsed() >= LINE_EVERY {
            said = Instant::now();
            print_notes([format!("writing sample {} of {}", number + 1, errors.samples.len())]);
        }
        save(&format!("sample-{:04}.fits", number + 1), &sample.map_k)?;
    }
    let pixels = solution.map_k.len() as f64;
    let mean_of = |map_k: &[f64]| map_k.iter().sum::<f64>() / pixels;
    let mean_k = mean_of(&solution.map_k);
    let scatter = |of: &dyn Fn(&Sample) -> f64, around: f64| {
        let squares = errors.samples.iter().map(|sample| (of(sample) - around).powi(2));
        squares.sum::<f64>() / errors.samples.len() as f64
    };
    let of_pixel = |(pixel, around): (usize, &f64)| scatter(&|sample| sample.map_k[pixel], *around);
    let variance: Vec<f64> = solution.map_k.iter().enumerate().map(of_pixel).collect();
    save("sigma.fits", &variance.iter().map(|variance| variance.sqrt()).collect::<Vec<f64>>())?;
    for map in ErrorMap::coverage(errors) {
        map.write(&folder, &WriteOptions::default())?;
    }
    let spectrum = folder.join("spectrum.csv");
    write_atomically(&spectrum, own_power_csv(&errors.samples).as_bytes())
        .map_err(|error| format!("{}: {error}", spectrum.display()))?;
    let dipole_k = errors.dipole_k;
    let dipole_sigma_k = [0, 1, 2].map(|k| scatter(&|sample| sample.dipole_k[k], dipole_k[k]).sqrt());
    Ok(SampledChannel {
        frequency_hz,
        samples: errors.samples.len(),
        sigma_uncertainty: sigma_uncertainty(errors.samples.len()),
        mean_k,
        mean_sigma_k: scatter(&|sample| mean_of(&sample.map_k), mean_k).sqrt(),
        dipole_k,
        dipole_sigma_k,
        sigma_rms_k: (variance.iter().sum::<f64>() / pixels).sqrt(),
        folder: folder.display().to_string(),
    })
}
