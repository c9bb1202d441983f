//! `lunarray sample`: maps of a state's sums that are as likely as its map.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::arguments::{StateMapArgs, output_path};
use super::output::{CommandResult, Completion, print_json_line, print_text};
use super::progress::while_solving;
use crate::imaging::{RegulariserChoice, Solution, SolveWatch};
use crate::pipeline::{sample_state, use_threads};
use crate::sky::fits::{WriteOptions, write_map};
use crate::sky::{Frame, SkyMap};

/// Most samples: each is a map in memory.
const COUNT_MAX: u64 = 10_000;

/// Draw maps that are as likely as the map of a state, given its data.
///
/// They differ from the map by what the data leave open, noise and unseen scales alike: whatever is computed from each of them scatters
/// by its error. Needs R from the data (map.regulariser = "data"). Leaves in the output folder, for each channel, the map, each sample and
/// sigma.fits, their standard deviation around the map, pixel by pixel. No visibility is read again, and the state stays as it is.
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
    mean_k: f64,
    /// Standard deviation of the samples' means.
    mean_sigma_k: f64,
    /// Root mean square of the pixels' standard deviations.
    sigma_rms_k: f64,
    folder: String,
}

pub(super) fn execute(args: &SampleArgs) -> CommandResult {
    let config = args.map.source(&args.state)?.load_ground()?;
    let regulariser = config.map.regulariser();
    if regulariser != RegulariserChoice::Data {
        return Err(format!(
            "{}: samples are drawn with R from the data, and with these settings R is another (map.regulariser, map.epsilon, map.refine, \
             map.matrix, or pixels beyond nside 32): expected --set map.regulariser=data, or settings that allow it",
            args.state.display()
        )
        .into());
    }
    use_threads(&config.runtime)?;
    let mut written = Vec::new();
    let mut take = |solution: Solution| written.push(write(args, &solution));
    let watch = SolveWatch::default();
    while_solving(&watch, || sample_state(&args.state, &config, args.count as usize, &watch, &mut take))?;
    let mut all = Vec::new();
    for sampled in written {
        all.push(sampled?);
    }
    if args.json {
        print_json_line(&all)?;
        return Ok(Completion::Done);
    }
    let line = |sampled: &SampledChannel| {
        format!(
            "{:>8.3} MHz  {} samples in {}: mean ({:.4e} +- {:.1e}) K, pixels +- {:.2e} K rms",
            sampled.frequency_hz / 1e6,
            sampled.samples,
            sampled.folder,
            sampled.mean_k,
            sampled.mean_sigma_k,
            sampled.sigma_rms_k
        )
    };
    print_text(&all.iter().map(line).collect::<Vec<_>>().join("\n"))?;
    Ok(Completion::Done)
}

fn write(
    args: &SampleArgs,
    solution: &Solution,
) -> Result<SampledChannel, Box<dyn std::error::Error + Send + Sync>> {
    let channel = usize::from(solution.channel.0);
    let frequency_hz = solution.instrument.channels.get(channel).map_or(0.0, |channel| channel.frequency_hz);
    let errors = solution.uncertainty.as_ref().ok_or("this map has no posterior to draw from")?;
    let folder = args.out.join(format!("{:.3}MHz", frequency_hz / 1e6));
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
    let (count, pixels) = (errors.samples_k.len() as f64, solution.map_k.len() as f64);
    let mut variance = vec![0.0; solution.map_k.len()];
    let mut mean_variance = 0.0;
    let mean_k = solution.map_k.iter().sum::<f64>() / pixels;
    for (number, sample) in errors.samples_k.iter().enumerate() {
        save(&format!("sample-{:04}.fits", number + 1), sample)?;
        for ((sum, sample), map) in variance.iter_mut().zip(sample).zip(&solution.map_k) {
            *sum += (sample - map).powi(2) / count;
        }
        mean_variance += (sample.iter().sum::<f64>() / pixels - mean_k).powi(2) / count;
    }
    let sigma_k: Vec<f64> = variance.iter().map(|variance| variance.sqrt()).collect();
    save("sigma.fits", &sigma_k)?;
    Ok(SampledChannel {
        frequency_hz,
        samples: errors.samples_k.len(),
        mean_k,
        mean_sigma_k: mean_variance.sqrt(),
        sigma_rms_k: (variance.iter().sum::<f64>() / pixels).sqrt(),
        folder: folder.display().to_string(),
    })
}
