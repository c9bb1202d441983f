//! Maps of many noise realisations from one downlink: the weights are accumulated and the matrix is prepared only once.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::step::Outcome;
use crate::downlink::FileSource;
use crate::ground::{Ground, WAIT_BYTES};
use crate::imaging::Samples;
use crate::imaging::circle::{NoiseSums, memory};
use crate::imaging::{HarmonicRequest, NOISES_TOGETHER, SolveError, SolveWatch, SolverSetup, solve_noises};
use crate::imaging::{Method, Snapshot};
use crate::pipeline::config::{Config, MemoryLimit, PipelineError};
use crate::pipeline::graph::ground_segment::GROUND;
use crate::pipeline::graph::run::run_graph_alone;
use crate::pipeline::graph::{OnStart, READ, RunView};
use crate::products::create_folder;
use crate::runtime::{Cancel, Graph, Sink};
use crate::sky::fits::{WriteOptions, write_map};
use crate::sky::{Frame, SkyMap};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::frequency_folder;

/// Maximum number of realisations in one reading of the downlink.
const PER_READING_MAX: usize = 50;
/// Fraction of the memory that sums may take.
const MEMORY_FRACTION: f64 = 0.7;

/// Maps of additional noise realisations; the first realisation is the map's own `noise.fits`.
pub(in crate::pipeline) struct NoiseMaps<'a> {
    pub(in crate::pipeline) config: &'a Config,
    pub(in crate::pipeline) file: &'a Path,
    pub(in crate::pipeline) out: &'a Path,
    /// Seeds of realisations 2, 3, ...
    pub(in crate::pipeline) seeds: &'a [u64],
}

impl Config {
    /// Whether noise realisations can share the weights and the matrix: with the harmonic engine, without iterative refinement, random errors
    /// of the instrument, and bodies that are solved for beside the map.
    pub(in crate::pipeline) fn shares_realisations(&self) -> bool {
        self.map.method() == Method::Harmonic && !self.has_errors() && self.map.movers.is_empty()
    }
}

/// The map file of a noise realisation in a folder of products. Realisation 1 is the map's own `noise.fits`.
pub(in crate::pipeline) fn noise_file(out: &Path, frequency_hz: f64, number: usize) -> PathBuf {
    let folder = out.join(frequency_folder(frequency_hz));
    match number {
        1 => folder.join("noise.fits"),
        _ => folder.join("realisations").join(format!("noise-{number:04}.fits")),
    }
}

impl NoiseMaps<'_> {
    /// Makes the maps, with as many realisations per reading as memory allows.
    pub(in crate::pipeline) fn make(
        &self,
        cancel: &Cancel,
        watch: OnStart<'_>,
    ) -> Result<Outcome, PipelineError> {
        let mut number = 2;
        for seeds in self.seeds.chunks(self.realisations_per_reading()) {
            if self.make_in_one_reading(number, seeds, cancel, watch)?.is_cancelled() {
                return Ok(Outcome::Cancelled);
            }
            number += seeds.len();
        }
        Ok(Outcome::Done)
    }

    /// Number of realisations that fit into memory beside the other sums; at least one.
    fn realisations_per_reading(&self) -> usize {
        let map = &self.config.map;
        let channels = &self.config.spacecraft.channels_hz;
        let sizes = channels.iter().map(|&frequency_hz| {
            let u_max = map.baseline_m_max(frequency_hz) * frequency_hz / SPEED_OF_LIGHT_M_S;
            let memory = memory(map.degree(), u_max, rayon::current_num_threads(), NOISES_TOGETHER);
            // One snapshot waits while another is solved.
            let sums = 2 * memory.sums + memory.tables + memory.workspace;
            [sums, NoiseSums::bytes_each(map.degree(), u_max)]
        });
        let [sums, each] = sizes.fold([0.0, 1.0], |[a, b], [c, d]| [a + c as f64, b + d as f64]);
        let limit = MemoryLimit::of_machine().map_or(0.0, |limit| MEMORY_FRACTION * limit.bytes as f64);
        (((limit - sums) / each) as usize).clamp(1, PER_READING_MAX)
    }

    fn make_in_one_reading(
        &self,
        first: usize,
        seeds: &[u64],
        cancel: &Cancel,
        watch: OnStart<'_>,
    ) -> Result<Outcome, PipelineError> {
        let config = self.config;
        let mut graph = Graph::new();
        let source = FileSource::open(&[self.file.to_owned()])?;
        let bytes = graph.source(READ, config.runtime.queue_capacity, source);
        let ground = Ground::new(&config.ground(WAIT_BYTES))?;
        let ground = ground.with_noise_realisations(seeds).with_cancel(cancel, Duration::ZERO);
        let sums = graph.stage(GROUND, 1, bytes, ground);
        let solving = SolveWatch::new(cancel.clone());
        let setup = config.solver(solving.clone())?;
        graph.sink("noise maps", sums, NoiseMapSolver { setup, out: self.out.to_owned(), first });
        watch(RunView { solving, ..RunView::without_ground(&graph) });
        Ok(Outcome::of(run_graph_alone(graph, &config.runtime, cancel)?.cancelled))
    }
}

/// Solves for the noise realisations in a snapshot, and writes their maps.
struct NoiseMapSolver {
    setup: SolverSetup,
    out: PathBuf,
    first: usize,
}

impl Sink for NoiseMapSolver {
    type In = Snapshot;
    type Error = PipelineError;

    fn take(&mut self, snapshot: Snapshot) -> Result<(), PipelineError> {
        let Snapshot { instrument, channel, nside, is_final, data, .. } = snapshot;
        let Ok(sums) = data.into_harmonic() else { return Ok(()) };
        if !is_final {
            return Ok(());
        }
        let setup = &self.setup;
        let index = usize::from(channel.0);
        let epsilon = setup.epsilon.get(index).ok_or(SolveError::NoEpsilon(channel))?;
        let request =
            HarmonicRequest { epsilon, nside, rule: setup.rule, samples: Samples::default(), probes: 0 };
        let frequency_hz = instrument.channels.get(index).map_or(0.0, |channel| channel.frequency_hz);
        let name = format!("{:.3} MHz", frequency_hz / 1e6);
        let maps = match solve_noises(&sums, request, &setup.regulariser(index), setup.watch.named(&name)) {
            Err(SolveError::Interrupted) => return Ok(()),
            maps => maps?,
        };
        // The solver divides its maps by the same factor.
        let factor = 1.0 + setup.moon_reflection;
        for (number, mut map_k) in (self.first..).zip(maps) {
            map_k.iter_mut().for_each(|value| *value /= factor);
            let path = noise_file(&self.out, frequency_hz, number);
            if let Some(folder) = path.parent() {
                create_folder(folder)?;
            }
            write_map(&path, &SkyMap::new(Frame::Ecliptic, map_k)?, &WriteOptions::default())?;
        }
        Ok(())
    }
}
