//! The stages of the ground segment: from downlink bytes to normal equations, maps and products.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use super::live_gains::GainsWriter;
use crate::ground::{Ground, GroundConfig, GroundOutcome};
use crate::imaging::MapConfig;
use crate::imaging::Samples;
use crate::imaging::anywhere::RefineRule;
use crate::imaging::{
    KeptSums, Regulariser, RegulariserChoice, Solution, SolveWatch, Solver, SolverSetup, StoppingRule,
};
use crate::pipeline::config::{Config, PipelineError};
use crate::products::{
    MapShape, MapWatch, ProductsError, ProductsWatch, Provenance, Publisher, Truth, WrittenProducts,
};
use crate::runtime::{Graph, Link, Sink};
use crate::sky::fits::read_prior;

/// Name of the stage that decodes, calibrates and accumulates, and keeps the state.
pub(in crate::pipeline) const GROUND: &str = "ground";

pub(in crate::pipeline) const SOLVE: &str = "solve";

impl Config {
    /// Configuration of the ground segment, with a hold buffer of `wait_bytes`.
    #[must_use]
    pub fn ground(&self, wait_bytes: u64) -> GroundConfig {
        GroundConfig {
            calibration: self.calibration.clone(),
            calibrate: self.calibrate.clone(),
            map: self.map.clone(),
            wait_bytes,
            memory_max_bytes: None,
            group: None,
            part: None,
        }
    }

    /// Resolution and processing of the maps, for a comparison with the input sky.
    #[must_use]
    #[doc(hidden)]
    pub fn map_shape(&self) -> MapShape {
        let Self { map, products, .. } = self;
        let l_max = map.is_harmonic().then(|| map.degree());
        MapShape { nside: map.nside, l_max, processing: products.processing() }
    }

    /// Stopping rule of iterative solutions.
    pub(super) fn stopping_rule(&self) -> StoppingRule {
        StoppingRule { residual_max: self.map.residual_max, iterations_max: self.map.iterations_max }
    }

    /// Setup of the solver; `watch` reports its progress and ends it early.
    ///
    /// # Errors
    /// Prior maps, power spectra and files of antennas that cannot be read.
    #[doc(hidden)]
    pub fn solver(&self, watch: SolveWatch) -> Result<SolverSetup, PipelineError> {
        let map = &self.map;
        let (prior_maps, prior_hz) = prior_maps(self)?;
        Ok(SolverSetup {
            epsilon: map.epsilon(),
            regularisers: regularisers(map)?,
            beams_deg: map.beams_deg.clone(),
            moon_reflection: map.moon_reflection,
            prior_k: map.prior_k.clone(),
            prior_maps,
            prior_hz,
            rule: self.stopping_rule(),
            refine: RefineRule { passes_max: map.refine.passes_max, residual_max: map.refine.residual_max },
            assumed: map.assumed().map_err(|error| PipelineError::Antennas("map.antennas.files", error))?,
            iteration_folder: None,
            trace_probes: map.trace_probes,
            samples: Samples::default(),
            kept: None,
            watch,
        })
    }
}

/// Results of the ground segment in memory, beside its files.
#[derive(Clone, Debug)]
pub(in crate::pipeline) struct SegmentOutcome {
    pub(in crate::pipeline) ground: GroundOutcome,
    pub(in crate::pipeline) written: Arc<Mutex<WrittenProducts>>,
}

/// Destination, input sky and handles for the maps of the ground segment.
pub(in crate::pipeline) struct MappingContext<'a> {
    pub(in crate::pipeline) out: &'a Path,
    pub(in crate::pipeline) truth: Truth,
    pub(in crate::pipeline) watch: SolveWatch,
    pub(in crate::pipeline) viewers: MapWatch,
    /// State of the product files; `Some` if a failure to write them does not end the run.
    pub(in crate::pipeline) product_state: Option<ProductsWatch>,
    /// Keeps the sums of the final maps.
    pub(in crate::pipeline) kept: Option<KeptSums>,
}

/// Adds the ground segment to `graph`. Its only input is the bytes of the downlink.
///
/// # Errors
/// Prior maps that cannot be read.
pub(in crate::pipeline) fn add(
    graph: &mut Graph,
    bytes: Link<Vec<u8>>,
    config: &Config,
    ground: Ground,
    mapping: MappingContext<'_>,
) -> Result<SegmentOutcome, PipelineError> {
    let MappingContext { out, truth, watch, viewers, product_state, kept } = mapping;
    let outcome = SegmentOutcome { ground: ground.outcome(), written: Arc::default() };
    let ranks = ground.ranks().clone();
    let iteration_folder = config.map.refine.is_on().then(|| out.to_owned());
    let setup = SolverSetup { iteration_folder, kept, ..config.solver(watch.with_ranks(&ranks))? };
    if !ranks.is_first() {
        let sums = graph.stage(GROUND, 1, bytes, ground);
        let maps = graph.stage(SOLVE, 1, sums, Solver::new(setup));
        graph.sink("publish", maps, NullSink);
        return Ok(outcome);
    }
    let provenance = Provenance { ground_hash: config.ground_hash(), map: config.map.clone() };
    let written = Arc::clone(&outcome.written);
    let publisher =
        Publisher::new(config.products.clone(), out, truth, provenance, written)?.with_viewers(viewers);
    let publisher = product_state.iter().fold(publisher, Publisher::with_retries);
    let mut writer = GainsWriter::new(config, out);
    let ground = ground.with_observer(Box::new(move |gains| writer.update(gains)));
    // Snapshots are large: only one waits while another is solved.
    let sums = graph.stage(GROUND, 1, bytes, ground);
    let maps = graph.stage(SOLVE, 1, sums, Solver::new(setup));
    graph.sink("publish", maps, publisher);
    Ok(outcome)
}

/// Drops the maps of a rank, as the first rank publishes identical ones.
struct NullSink;

impl Sink for NullSink {
    type In = Solution;
    type Error = ProductsError;

    fn take(&mut self, _solution: Solution) -> Result<(), ProductsError> {
        Ok(())
    }
}

/// The regulariser R of each channel; a single one is for all channels.
fn regularisers(map: &MapConfig) -> Result<Vec<Regulariser>, PipelineError> {
    Ok(match map.regulariser() {
        RegulariserChoice::Data => vec![Regulariser::Data],
        RegulariserChoice::Degree(exponent) => vec![Regulariser::Power(exponent)],
        RegulariserChoice::File(files) => {
            files.iter().map(|path| Ok(Regulariser::read(path)?)).collect::<Result<_, PipelineError>>()?
        }
        _ => vec![Regulariser::default()],
    })
}

/// Prior maps of the channels, K, and the frequencies that their files state, Hz.
type PriorMaps = (Vec<Vec<f64>>, Vec<Option<f64>>);

/// Prior maps of the channels, smoothed and at the resolution of the maps, K, and the frequencies that their files state, Hz.
fn prior_maps(config: &Config) -> Result<PriorMaps, PipelineError> {
    let map = &config.map;
    let read = |(channel, path): (usize, &PathBuf)| {
        let prior = read_prior(path, &map.prior_options(&config.spacecraft.channels_hz, channel))?;
        let smooth = prior.map.to_ecliptic().smoothed(map.prior_fwhm_deg.to_radians())?;
        Ok((smooth.resized(map.nside)?.into_values(), prior.frequency_hz))
    };
    map.prior_files.iter().enumerate().map(read).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::Frame;
    use crate::sky::fits::{Column, WriteOptions, write_columns};

    #[test]
    fn a_prior_is_the_column_of_its_channel() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("prior.fits");
        let values = [[1e6; 48], [2e5; 48], [1e4; 48]];
        let columns: [Column; 3] = std::array::from_fn(|k| Column {
            name: ["T_1MHz", "T_3MHz", "T_10MHz"][k],
            unit: "K",
            values: &values[k],
        });
        write_columns(&path, Frame::Ecliptic, &columns, &WriteOptions::default()).unwrap();
        let mut config = Config::default();
        config.map.nside = 2;
        config.map.prior_files = vec![path.clone(), path];
        config.spacecraft.channels_hz = vec![10e6, 3e6];
        let (maps, hz) = prior_maps(&config).unwrap();
        assert_eq!(hz, [Some(10e6), Some(3e6)]);
        for (map, value) in maps.iter().zip([1e4, 2e5]) {
            // At nside 2 the smoothing keeps a constant to some 0.2 %; the columns differ by factors.
            assert!(map.iter().all(|found| (found / value - 1.0).abs() < 1e-2), "{map:?}");
        }
    }
}
