//! Benchmarks of the chain at other sizes.

use serde::Serialize;

use super::chain;
use super::timing::{median, mission_s, samples_per_mission_s, timed};
use crate::pipeline::{Config, PipelineError, Plan};
use crate::sky::SkyMap;

/// The speed of the chain at one size.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GrowthRow {
    /// Number of channels.
    pub channels: usize,
    /// Number of daughters.
    pub daughters: usize,
    /// Samples per block.
    pub block_samples: usize,
    /// Complex samples per second, median over runs.
    pub samples_per_s: f64,
    /// Rates of the slowest and the fastest run.
    pub samples_per_s_range: [f64; 2],
    /// Mission time divided by median time.
    pub times_real_time: f64,
    /// Processor time per second of mission time at this size, s, median over runs.
    pub core_s_per_mission_s: Option<f64>,
}

const DAUGHTERS: [usize; 3] = [4, 8, 16];
const BLOCKS: [usize; 4] = [256, 1024, 4096, 16_384];

/// Runs the chain with a third, two thirds and all of the channels, and with other numbers of daughters and block sizes.
pub(super) fn rows(plan: &Plan, skies: &[SkyMap], runs: usize) -> Result<Vec<GrowthRow>, PipelineError> {
    let all = plan.config.spacecraft.channels_hz.len();
    let mut rows = Vec::new();
    for channels in [all.div_ceil(3), (2 * all).div_ceil(3), all] {
        let mut config = plan.config.clone();
        config.spacecraft.channels_hz.truncate(channels);
        // Lists of files and priors may now have more entries than channels; the chain does not use them.
        rows.push(row(config, plan, &skies[..channels], runs)?);
    }
    for daughters in DAUGHTERS {
        let mut config = plan.config.clone();
        config.array.satellites = daughters;
        rows.push(row(config, plan, skies, runs)?);
    }
    for block_samples in BLOCKS {
        let mut config = plan.config.clone();
        config.daughters.block_samples = block_samples;
        rows.push(row(config, plan, skies, runs)?);
    }
    Ok(rows)
}

fn row(config: Config, plan: &Plan, skies: &[SkyMap], runs: usize) -> Result<GrowthRow, PipelineError> {
    let sized = Plan::new(config)?;
    let windows = sized.windows.iter().take(plan.windows.len()).copied().collect();
    let sized = Plan { windows, ..sized };
    let mission_s = mission_s(&sized);
    let (mut rates, mut core_seconds) = (Vec::new(), Vec::new());
    for _ in 0..runs.max(1) {
        let (spent, run) = timed(|| chain::run(&sized, skies));
        let samples = run?.report.stage("sample").map_or(0, |stage| stage.units);
        rates.push(samples as f64 / spent.seconds);
        core_seconds.extend(spent.core_seconds);
    }
    let samples_per_s = median(&mut rates);
    let (channels, daughters) = (sized.instrument.channels.len(), sized.array.satellites());
    Ok(GrowthRow {
        channels,
        daughters,
        block_samples: sized.config.daughters.block_samples,
        samples_per_s,
        samples_per_s_range: [rates[0], rates[rates.len() - 1]],
        times_real_time: samples_per_s / samples_per_mission_s(&sized),
        core_s_per_mission_s: (!core_seconds.is_empty()).then(|| median(&mut core_seconds) / mission_s),
    })
}
