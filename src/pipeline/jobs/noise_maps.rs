//! Maps of noise of many realisations from one downlink: its weights are summed and the matrix is prepared once for many.

use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::downlink::FileSource;
use crate::ground::{Ground, WAIT_BYTES};
use crate::imaging::circle::{NoiseSums, memory};
use crate::imaging::{EngineKind, Snapshot, SnapshotData};
use crate::imaging::{HarmonicRequest, NOISES_TOGETHER, SolveError, SolveWatch, SolverSetup, solve_noises};
use crate::pipeline::config::{Config, MemoryLimit, PipelineError};
use crate::pipeline::graph::ground_segment::GROUND;
use crate::pipeline::graph::run::start_alone;
use crate::pipeline::graph::{READ, Watched, Watcher};
use crate::products::ProductsError;
use crate::runtime::{Cancel, Graph, Sink};
use crate::sky::fits::{WriteOptions, write_map};
use crate::sky::{Frame, SkyMap};
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Most realisations of one reading.
const AT_ONCE: usize = 50;
/// Part of the memory that sums may take.
const MEMORY_PART: f64 = 0.7;

/// Realisations of noise of a downlink, besides that of the map's own companion.
pub(in crate::pipeline) struct NoiseMaps<'a> {
    /// Settings of the ground.
    pub(in crate::pipeline) config: &'a Config,
    /// The downlink.
    pub(in crate::pipeline) file: &'a Path,
    /// Folder of the products.
    pub(in crate::pipeline) out: &'a Path,
    /// A seed for each; their numbers begin with 2.
    pub(in crate::pipeline) seeds: &'a [u64],
}

impl Config {
    /// Whether realisations of the noise-only map can share all but their noise: with the harmonic engine, without refinement, and if
    /// errors of the instrument do not differ with them.
    pub(in crate::pipeline) fn shares_realisations(&self) -> bool {
        self.map.engine == EngineKind::Harmonic && !self.map.refine.is_on() && !self.has_errors()
    }
}

/// The file of a realisation of noise in a folder of products, numbered from 1; the first is that of the map's companion.
pub(in crate::pipeline) fn noise_file(out: &Path, frequency_hz: f64, number: usize) -> PathBuf {
    let folder = out.join(format!("{:.3}MHz", frequency_hz / 1e6));
    match number {
        1 => folder.join("noise.fits"),
        _ => folder.join("realisations").join(format!("noise-{number:04}.fits")),
    }
}

impl NoiseMaps<'_> {
    /// Makes the maps, with as many realisations at a time as memory allows; whether all of them were made.
    pub(in crate::pipeline) fn make(
        &self,
        cancel: &Cancel,
        watch: Watcher<'_>,
    ) -> Result<bool, PipelineError> {
        let mut number = 2;
        for seeds in self.seeds.chunks(self.at_once()) {
            if !self.make_some(number, seeds, cancel, watch)? {
                return Ok(false);
            }
            number += seeds.len();
        }
        Ok(true)
    }

    /// Realisations that fit beside the other sums; at least one.
    fn at_once(&self) -> usize {
        let map = &self.config.map;
        let channels = &self.config.spacecraft.channels_hz;
        let sizes = channels.iter().map(|&frequency_hz| {
            let u_max = map.baseline_m_max(frequency_hz) * frequency_hz / SPEED_OF_LIGHT_M_S;
            let memory = memory(map.degree(), u_max, rayon::current_num_threads(), NOISES_TOGETHER);
            // One copy waits while another is solved.
            let sums = 2 * memory.sums + memory.tables + memory.workspace;
            [sums, NoiseSums::bytes_each(map.degree(), u_max)]
        });
        let [sums, each] = sizes.fold([0.0, 1.0], |[a, b], [c, d]| [a + c as f64, b + d as f64]);
        let limit = MemoryLimit::of_machine().map_or(0.0, |limit| MEMORY_PART * limit.bytes as f64);
        (((limit - sums) / each) as usize).clamp(1, AT_ONCE)
    }

    fn make_some(
        &self,
        first: usize,
        seeds: &[u64],
        cancel: &Cancel,
        watch: Watcher<'_>,
    ) -> Result<bool, PipelineError> {
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
        let watched = Watched { solving, ..Watched::of_space(&graph) };
        Ok(!start_alone(graph, &config.runtime, cancel, watched, watch)?.cancelled)
    }
}

/// Solves for the realisations in sums, and writes their maps.
struct NoiseMapSolver {
    setup: SolverSetup,
    out: PathBuf,
    /// Number of the first.
    first: usize,
}

impl Sink for NoiseMapSolver {
    type In = Snapshot;
    type Error = PipelineError;

    fn take(&mut self, snapshot: Snapshot) -> Result<(), PipelineError> {
        let Snapshot { instrument, channel, nside, is_final, data, .. } = snapshot;
        let SnapshotData::Harmonic(sums) = data else { return Ok(()) };
        if !is_final {
            return Ok(());
        }
        let setup = &self.setup;
        let index = usize::from(channel.0);
        let epsilon = setup.epsilon.get(index).ok_or(SolveError::NoEpsilon(channel))?;
        let request = HarmonicRequest { epsilon, nside, rule: setup.rule, samples: 0, probes: 0 };
        let frequency_hz = instrument.channels.get(index).map_or(0.0, |channel| channel.frequency_hz);
        let name = format!("{:.3} MHz", frequency_hz / 1e6);
        let maps = match solve_noises(&sums, request, &setup.regulariser(index), setup.watch.named(&name)) {
            Err(SolveError::Interrupted) => return Ok(()),
            maps => maps?,
        };
        // As those of the solver, which divides maps by what the Moon is taken to reflect.
        let factor = 1.0 + setup.moon_reflection;
        for (number, mut map_k) in (self.first..).zip(maps) {
            map_k.iter_mut().for_each(|value| *value /= factor);
            let path = noise_file(&self.out, frequency_hz, number);
            if let Some(folder) = path.parent() {
                std::fs::create_dir_all(folder)
                    .map_err(|source| ProductsError::Write { path: folder.to_owned(), source })?;
            }
            write_map(&path, &SkyMap::new(Frame::Ecliptic, map_k)?, &WriteOptions::default())?;
        }
        Ok(())
    }
}
