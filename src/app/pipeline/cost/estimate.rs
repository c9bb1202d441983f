//! Estimates of the cost of a pipeline before it runs: visibilities, bytes, operations and times.

use std::fmt;

use serde::Serialize;

use super::rates::{FRINGES_PER_S, SAMPLES_PER_S};
use crate::frames::ObservingWindow;
use crate::imaging::cost::{ChannelData, EngineCost};
use crate::imaging::rates::{AVERAGE_INSTANTS, cores};
use crate::mother::{Fidelity, VISIBILITY_BYTES};
use crate::pipeline::config::{Expected, MemoryLimit, PipelineError, Plan};
use crate::response::model::{ModelKind, ModelPlan};
use crate::sky::healpix::pixel_count;
use crate::units::ChannelId;
use crate::units::vector::norm;

/// Maximum number of visibilities that wait for a batch of the model.
const QUEUED_VISIBILITIES_MAX: f64 = 1e6;
/// Memory of a waiting visibility with its positions, bytes.
const QUEUED_VISIBILITY_BYTES: f64 = 200.0;

/// Memory of the program, queues and pictures, bytes.
const BASE_BYTES: f64 = 5e7;
/// The part of it that pictures take.
const PICTURE_BYTES: f64 = 2e7;

/// Processor time of a program's start and plan, and of a generated sky up to nside 64, by channel, s.
const START_S: f64 = 0.15;
const SKY_S: f64 = 0.27;

/// Memory of a snapshot's record in the summary, bytes.
const SNAPSHOT_RECORD_BYTES: f64 = 500.0;

/// The cost of one channel.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChannelCost {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Visibilities in the downlink.
    pub visibilities_sent: f64,
    /// Visibilities within the map's longest baseline.
    pub visibilities_mapped: f64,
    /// Longest baseline used in the map, m.
    pub baseline_m_max: f64,
    /// The chosen model and its cost in fringes. A fringe is one pixel and visibility of a direct sum, some 30 operations; other models
    /// are converted by time.
    pub simulation: ModelPlan,
    /// Estimated time of the simulation by direct sums, s.
    pub simulation_direct_s: f64,
    /// Estimated time of the simulation by harmonics, s: set-up and visibilities.
    pub simulation_harmonic_s: [f64; 2],
    /// Estimated time of the simulation by the general model, s.
    pub simulation_general_s: f64,
    /// Multiply-adds of the normal equations.
    pub accumulation_multiply_adds: f64,
    /// Multiply-adds of all solutions.
    pub solving_multiply_adds: f64,
    /// Estimated time of accumulation and of all solutions, s.
    pub mapping_s: f64,
}

/// The cost of a whole pipeline.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Cost {
    /// Cost of each channel.
    pub channels: Vec<ChannelCost>,
    /// Number of observing windows.
    pub windows: usize,
    /// Number of solutions of each channel: snapshots and the final map.
    pub solutions: u64,
    /// Size of the downlink file, bytes.
    pub downlink_bytes: f64,
    /// Peak memory of the whole run, bytes.
    pub memory_bytes: f64,
    /// Memory of the space segment, bytes.
    pub simulation_memory_bytes: f64,
    /// Data rate of the samples of all daughters on their links to the mother, bit/s; `None` if no samples are simulated.
    pub samples_bits_per_s: Option<f64>,
    /// Data rate of one daughter's samples, and the limit of its link, bit/s; `None` without samples or without a limit.
    pub link_bits_per_s: Option<[f64; 2]>,
    /// Data rate of the ninth daughter's spectra while the array observes, bit/s; `None` without that daughter.
    pub ninth_bits_per_s: Option<f64>,
    /// Exchange between ranks; memory and time are then those of one rank. `None` for one rank.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ranks: Option<RankCost>,
    /// Estimated time to draw, quantise, send and correlate the samples, s; `None` if no samples are simulated.
    pub sampling_s: Option<f64>,
    /// Estimated time of the whole run, s, at measured rates per core and with the number of cores of this machine.
    pub predicted_s: f64,
}

/// Cost of ranks that share the normal equations of each channel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RankCost {
    /// Number of ranks.
    pub ranks: usize,
    /// Bytes that each rank sends to the others, and receives, in all solutions.
    pub reduced_bytes: f64,
    /// Memory of a node, bytes, and the number of nodes that hold all ranks; set by [`Cost::on_nodes`].
    pub nodes: Option<(f64, usize)>,
}

/// Part of a pipeline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Segment {
    /// Space and ground segment.
    Whole,
    /// Space segment alone, up to the downlink.
    Space,
}

impl ChannelCost {
    /// Estimated time of the simulation by the chosen model, s.
    #[must_use]
    pub fn simulation_s(&self) -> f64 {
        match self.simulation.kind {
            ModelKind::Direct => self.simulation_direct_s,
            ModelKind::Harmonic => self.simulation_harmonic_s.iter().sum(),
            ModelKind::General => self.simulation_general_s,
        }
    }
}

impl Plan {
    /// Estimated cost of a pipeline. Times follow from rates that were measured on one machine.
    #[must_use]
    #[doc(hidden)]
    pub fn cost(&self) -> Cost {
        self.cost_with_ranks(1)
    }

    /// Estimated cost for one of `ranks` ranks that share the normal equations.
    #[must_use]
    #[doc(hidden)]
    pub fn cost_with_ranks(&self, ranks: usize) -> Cost {
        let map = &self.config.map;
        let nsides = self.sky_nsides();
        let fringes_per_s = FRINGES_PER_S * cores();
        // The harmonic model averages in closed form; other models average over instants.
        let instants = if self.config.spacecraft.smear_integrations { AVERAGE_INSTANTS } else { 1.0 };
        let expected = self.visibilities();
        let frequencies = &self.config.spacecraft.channels_hz;
        let sent: f64 = expected.iter().map(|e| e.sent).sum();
        let solutions = self.solutions(sent);
        let (windows, limb_range_rad) = (self.windows.len() as f64, self.limb_range_rad());
        let engine = |(channel, (&frequency_hz, expected)): (usize, (&f64, &Expected))| {
            let is_mapped = map.is_mapped(ChannelId(channel as u16));
            let data = ChannelData {
                frequency_hz,
                visibilities: expected.mapped,
                windows,
                node_turns: self.node_turns(),
                duration_s: self.config.spacecraft.duration_s,
                every_nth: self.schedules[channel].every_nth as f64,
                solutions,
                limb_range_rad,
                error_draws: self.config.calibration.known_error_draws(),
            };
            if is_mapped { map.cost(data).with_ranks(ranks, map) } else { EngineCost::default() }
        };
        let engines: Vec<EngineCost> = frequencies.iter().zip(&expected).enumerate().map(engine).collect();
        let channels: Vec<ChannelCost> = frequencies
            .iter()
            .zip(&expected)
            .zip(self.model_plans_for(&expected, &nsides))
            .zip(&engines)
            .map(|(((&frequency_hz, expected), simulation), engine)| ChannelCost {
                frequency_hz,
                visibilities_sent: expected.sent.round(),
                visibilities_mapped: expected.mapped.round(),
                baseline_m_max: map.baseline_m_max(frequency_hz),
                simulation,
                simulation_direct_s: instants * simulation.direct_fringes / fringes_per_s,
                simulation_harmonic_s: [
                    simulation.set_up_fringes / fringes_per_s,
                    simulation.visibility_fringes * expected.sent / fringes_per_s,
                ],
                simulation_general_s: instants * simulation.general_fringes * expected.sent / fringes_per_s,
                accumulation_multiply_adds: expected.mapped * engine.visibility_multiply_adds,
                solving_multiply_adds: engine.solving_multiply_adds,
                mapping_s: engine.visibility_s * expected.mapped + engine.solving_s,
            })
            .collect();
        let simulation_memory_bytes = self.simulation_bytes(sent, &nsides)
            + channels.iter().map(|channel| channel.simulation.bytes).sum::<f64>();
        let memory_bytes = memory_bytes(simulation_memory_bytes, &engines, solutions)
            + self.known_sky_bytes()
            - if self.config.products.pictures { 0.0 } else { PICTURE_BYTES };
        let sampling_s = self.sampling_s();
        let simulating_s: f64 =
            sampling_s.unwrap_or_else(|| channels.iter().map(ChannelCost::simulation_s).sum());
        let starting_s = (START_S + self.generated_skies() as f64 * SKY_S) / cores();
        let predicted_s =
            starting_s + simulating_s + channels.iter().map(|channel| channel.mapping_s).sum::<f64>();
        Cost {
            channels,
            windows: self.windows.len(),
            solutions,
            downlink_bytes: self.config.downlink.expansion()
                * (sent * VISIBILITY_BYTES as f64
                    + self.windows.len() as f64 * 10_000.0
                    + self.auto_bytes()
                    + self.ninth_bytes()),
            memory_bytes,
            simulation_memory_bytes,
            samples_bits_per_s: self.samples_bits_per_s(),
            link_bits_per_s: self.link_bits_per_s(),
            ninth_bits_per_s: self.ninth_bits_per_s(),
            ranks: (ranks > 1).then(|| RankCost {
                ranks,
                reduced_bytes: engines.iter().map(|engine| engine.reduced_bytes(map)).sum(),
                nodes: None,
            }),
            sampling_s,
            predicted_s,
        }
    }

    /// Number of skies that are generated, not read.
    fn generated_skies(&self) -> usize {
        if self.config.sky.file.is_none() { self.config.spacecraft.channels_hz.len() } else { 0 }
    }

    /// Turns of the formation's node in the mission; infinite without a formation.
    fn node_turns(&self) -> f64 {
        let array = &self.config.array;
        let turns = self.config.spacecraft.duration_s / array.precession_period_s;
        if array.has_own_orbits() { f64::INFINITY } else { turns }
    }

    /// Range of the angle between nadir and limb of daughter 1 in the observing windows, rad.
    fn limb_range_rad(&self) -> f64 {
        const WINDOWS_SEEN: usize = 64;
        let limb_rad =
            |t_s: f64| (self.array.moon_radius_m() / norm(self.array.position_m(0, t_s))).min(1.0).asin();
        let seen = self.windows.iter().step_by(self.windows.len().div_ceil(WINDOWS_SEEN).max(1));
        let limbs = seen.flat_map(|window| [window.start, window.end].map(|time| limb_rad(time.seconds())));
        let (low, high) =
            limbs.fold((f64::INFINITY, 0.0_f64), |(low, high), limb| (low.min(limb), high.max(limb)));
        (high - low).max(0.0)
    }

    fn observing_s(&self) -> f64 {
        let length_s = |window: &ObservingWindow| window.end.seconds() - window.start.seconds();
        self.windows.iter().map(length_s).sum()
    }

    /// Estimated time to simulate and correlate samples, s; `None` if no samples are simulated.
    fn sampling_s(&self) -> Option<f64> {
        let width_hz = self.config.spacecraft.channel_width_hz;
        let channels = self.config.spacecraft.channels_hz.len();
        let samples_per_s = (self.array.satellites() * channels) as f64 * width_hz;
        let is_sampled = self.config.spacecraft.fidelity == Fidelity::Samples;
        is_sampled.then(|| samples_per_s * self.observing_s() / (SAMPLES_PER_S * cores()))
    }

    /// Size of the daughters' auto-correlations in the downlink, bytes.
    fn auto_bytes(&self) -> f64 {
        let spacecraft = &self.config.spacecraft;
        let streams = self.array.satellites() * spacecraft.channels_hz.len() * spacecraft.sub_bands;
        let integration_s = spacecraft.autos_s();
        let count =
            if integration_s > 0.0 { self.observing_s() / integration_s * streams as f64 } else { 0.0 };
        count * VISIBILITY_BYTES as f64
    }

    /// Size of the ninth daughter's spectra in the downlink, with one packet header for each channel and window, bytes.
    fn ninth_bytes(&self) -> f64 {
        const PACKET_BYTES: f64 = 42.0;
        let Some(rate) = self.ninth_bits_per_s() else { return 0.0 };
        let packets = self.config.spacecraft.ninth.channels * self.windows.len();
        self.observing_s() * rate / 8.0 + PACKET_BYTES * packets as f64
    }

    /// Number of solutions of each channel: one for each snapshot interval with data, and the final one. `sent` is the number of
    /// visibilities of all channels.
    fn solutions(&self, sent: f64) -> u64 {
        let every_s = self.config.map.snapshot_every_s;
        if every_s <= 0.0 {
            return 1;
        }
        let intervals = (self.config.spacecraft.duration_s / every_s).ceil();
        let observed = (self.observing_s() / every_s).ceil() + self.windows.len() as f64;
        intervals.min(observed).min(sent.ceil()).max(1.0) as u64
    }

    /// Memory of a simulation without channels, and additional memory of each channel's sky and model, bytes.
    pub(in crate::pipeline) fn simulation_bytes_by_channel(&self) -> (f64, Vec<f64>) {
        let nsides = self.sky_nsides();
        let sky = |nside: &usize| 8.0 * pixel_count(*nside) as f64;
        let resampling = 3.0 * nsides.iter().map(sky).fold(0.0, f64::max);
        let models = self.model_plans(&nsides);
        let each = nsides.iter().zip(&models).map(|(nside, model)| sky(nside) + model.bytes).collect();
        let tables = self.array.table_bytes() as f64;
        (resampling + tables + QUEUED_VISIBILITIES_MAX * QUEUED_VISIBILITY_BYTES + BASE_BYTES, each)
    }

    /// Memory of the space segment without its models, bytes.
    fn simulation_bytes(&self, sent: f64, nsides: &[usize]) -> f64 {
        let pixels: Vec<f64> = nsides.iter().map(|&nside| pixel_count(nside) as f64).collect();
        // Every sky, and three copies of the largest while it is rotated and resampled.
        let skies = pixels.iter().sum::<f64>() + 3.0 * pixels.iter().copied().fold(0.0, f64::max);
        let tables = self.array.table_bytes() as f64;
        8.0 * skies + tables + sent.min(QUEUED_VISIBILITIES_MAX) * QUEUED_VISIBILITY_BYTES
    }
}

/// Peak memory of a run, bytes: during accumulation, or at the end, when the space segment has been freed.
pub(in crate::pipeline) fn memory_bytes(
    simulation_bytes: f64,
    engines: &[EngineCost],
    solutions: u64,
) -> f64 {
    let largest = |bytes: fn(&EngineCost) -> f64| engines.iter().map(bytes).fold(0.0, f64::max);
    let sums = engines.iter().map(|engine| engine.sums_bytes).sum::<f64>()
        + solutions as f64 * engines.len() as f64 * SNAPSHOT_RECORD_BYTES;
    let copy = largest(|engine| engine.copy_bytes);
    let solver = largest(|engine| engine.other_bytes);
    // One copy is made, one waits in the queue, and one is in the solver. The final map is solved in the memory of the sums.
    let intermediate = if solutions > 1 { 3.0 * copy + solver } else { 0.0 };
    (simulation_bytes + sums + intermediate).max(sums + solver) + BASE_BYTES
}

impl Cost {
    /// Adds the number of nodes with memory `limit` that hold all ranks, if a node holds at least one rank.
    #[must_use]
    pub fn on_nodes(mut self, limit: Option<MemoryLimit>) -> Self {
        if let (Some(limit), Some(cost)) = (limit, &mut self.ranks) {
            let bytes = limit.bytes as f64;
            let ranks_per_node = (bytes / self.memory_bytes) as usize;
            cost.nodes = (ranks_per_node > 0).then(|| (bytes, cost.ranks.div_ceil(ranks_per_node)));
        }
        self
    }

    /// Requires that all estimates are finite; a run without a finite estimate may never end.
    ///
    /// # Errors
    /// [`PipelineError::Unbounded`].
    pub fn require_finite(&self) -> Result<(), PipelineError> {
        let channels = self.channels.iter().flat_map(|channel| {
            let name = |what| format!("{what} of the channel at {:.3} MHz", channel.frequency_hz / 1e6);
            [
                (name("number of visibilities"), channel.visibilities_sent),
                (name("time of the simulation"), channel.simulation_s()),
                (name("time of the map"), channel.mapping_s),
            ]
        });
        let whole = [
            ("size of the downlink", self.downlink_bytes),
            ("memory", self.memory_bytes),
            ("memory of the simulation", self.simulation_memory_bytes),
            ("time", self.predicted_s),
        ];
        let all = channels.chain(whole.map(|(what, value)| (what.to_owned(), value)));
        match all.into_iter().find(|(_, value)| !value.is_finite() || *value < 0.0) {
            None => Ok(()),
            Some((what, value)) => Err(PipelineError::Unbounded { what, value }),
        }
    }

    /// Requires that a segment fits into memory.
    ///
    /// # Errors
    /// [`PipelineError::Memory`]; as [`Cost::require_finite`].
    pub fn require_memory(&self, segment: Segment, limit: Option<MemoryLimit>) -> Result<(), PipelineError> {
        self.require_finite()?;
        let needed_bytes = match segment {
            Segment::Whole => self.memory_bytes,
            Segment::Space => self.simulation_memory_bytes,
        };
        match limit {
            Some(limit) if needed_bytes > limit.bytes as f64 => {
                Err(PipelineError::Memory { needed_bytes, limit })
            }
            _ => Ok(()),
        }
    }
}

impl fmt::Display for Cost {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:>12} {:>14} {:>14} {:>14} {:>16}",
            "channel", "visibilities", "in the map", "b max (m)", "multiply-adds"
        )?;
        for channel in &self.channels {
            writeln!(
                f,
                "{:>8.3} MHz {:>14.0} {:>14.0} {:>14.1} {:>16.2e}",
                channel.frequency_hz / 1e6,
                channel.visibilities_sent,
                channel.visibilities_mapped,
                channel.baseline_m_max,
                channel.accumulation_multiply_adds + channel.solving_multiply_adds
            )?;
        }
        writeln!(f)?;
        if let Some(sampling_s) = self.sampling_s {
            writeln!(f, "samples: an estimated {sampling_s:.1} s to draw, send and correlate them")?;
        }
        for channel in self.channels.iter().filter(|_| self.sampling_s.is_none()) {
            let ModelPlan { kind, why, l_max, .. } = channel.simulation;
            let [set_up_s, visibilities_s] = channel.simulation_harmonic_s;
            writeln!(
                f,
                "{:>8.3} MHz simulated with spacecraft.model = \"{kind}\" ({why}); estimates: direct {:.1} s, harmonic (l up \
                 to {l_max}) {set_up_s:.1} s to set up and {visibilities_s:.1} s for visibilities, general {:.1} s",
                channel.frequency_hz / 1e6,
                channel.simulation_direct_s,
                channel.simulation_general_s
            )?;
        }
        writeln!(f)?;
        writeln!(f, "windows          {}", self.windows)?;
        writeln!(f, "maps per channel {}", self.solutions)?;
        writeln!(f, "downlink         {:.1} MB", self.downlink_bytes / 1e6)?;
        writeln!(f, "memory           {:.2} GB", self.memory_bytes / 1e9)?;
        if let Some(RankCost { ranks, reduced_bytes, nodes }) = self.ranks {
            writeln!(
                f,
                "ranks            {ranks}: memory and time are those of one; each gives {:.2} GB to the others and gets as much",
                reduced_bytes / 1e9
            )?;
            if let Some((bytes, nodes)) = nodes {
                writeln!(f, "nodes            {nodes} of {:.2} GB hold all ranks", bytes / 1e9)?;
            }
        }
        if let Some(rate) = self.samples_bits_per_s {
            writeln!(f, "samples          {:.3} Mbit/s from all daughters", rate / 1e6)?;
        }
        if let Some([needed, limit]) = self.link_bits_per_s {
            let (needed_k, limit_k) = (needed / 1e3, limit / 1e3);
            write!(f, "links            {needed_k:.3} kbit/s needed by a daughter, {limit_k:.3} there")?;
            let short =
                "; the rest waits in its buffer, and what has no room or no time after a window is dropped";
            writeln!(f, "{}", if needed > limit { short } else { "" })?;
        }
        if let Some(rate) = self.ninth_bits_per_s {
            writeln!(f, "ninth daughter   {:.3} kbit/s of spectra while observing", rate / 1e3)?;
        }
        let digits = usize::from(self.predicted_s < 10.0);
        write!(
            f,
            "estimated time   {:.digits$} s if nothing else runs on {} cores, from processor times measured on virtual machines (AMD \
             EPYC; Intel Xeon with AVX-512): other machines differ by some factor",
            self.predicted_s,
            cores()
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::config::ConfigSource;

    const FREE: [&str; 2] = ["map.engine=pixel", "map.matrix=free"];
    const REFINED: [&str; 3] = ["map.engine=harmonic", "map.refine.passes_max=3", "array.eccentricity=0.01"];
    const MONTH: [&str; 2] = ["spacecraft.duration_s=30d", "spacecraft.every_nth_window=10"];
    const FEW: [&str; 1] = ["spacecraft.every_nth_window=300"];

    /// Processor times of the stage `solve` of the quicklook at 3 MHz and nside 8, of a virtual machine with two cores of an Intel Xeon with AVX-512
    /// beside other work, 28 November 2026.
    #[test]
    fn maps_take_the_time_that_was_measured() {
        for (sets, measured_s) in [
            (&[&REFINED[..], &MONTH].concat(), 21.5),
            (&REFINED.to_vec(), 3.1),
            (&[&FREE[..], &MONTH].concat(), 121.0),
            (&[&FREE[..], &FEW].concat(), 26.4),
            (&[&FREE[..], &FEW, &["map.epsilon=1e-4"]].concat(), 19.7),
        ] {
            let common = ["spacecraft.channels_hz=[3e6]", "map.nside=8", "map.snapshot_every_s=0"];
            let overrides = common.iter().chain(sets).map(|set| (*set).to_owned()).collect();
            let config = ConfigSource { overrides, ..ConfigSource::default() }.load().unwrap();
            let cost = Plan::new(config).unwrap().cost();
            let estimated_s = cores() * cost.channels[0].mapping_s;
            // Other work on the machine changes processor times by about this.
            let ratio = estimated_s / measured_s;
            assert!((1.0 / 1.5..1.5).contains(&ratio), "{sets:?}: {estimated_s} s, {measured_s} s measured");
        }
    }
}
