//! What a pipeline will cost, before anything runs.

use std::fmt;
use std::time::Instant;

use num_complex::Complex64;
use serde::Serialize;

use super::plan::Plan;
use crate::accumulation::{NormalEngine, PixelEngine, PixelSetup};
use crate::array::response::{Directions, PairGeometry, sky_sums};
use crate::frames::PlacedVisibilities;
use crate::mother::VISIBILITY_BYTES;
use crate::sky::healpix::{pixel_area_sr, pixel_count, pixel_directions};
use crate::units::Pair;

/// The cost of one channel.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChannelCost {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Visibilities sent down.
    pub visibilities_sent: f64,
    /// Of these, within the map's longest baseline.
    pub visibilities_mapped: f64,
    /// Longest baseline used in the map, m.
    pub baseline_m_max: f64,
    /// Multiply-adds of the simulation by direct sum, one a pixel and visibility (of some 30 operations).
    pub simulation_fringes: f64,
    /// Multiply-adds of the normal equations.
    pub accumulation_multiply_adds: f64,
    /// Multiply-adds of one solution.
    pub solution_multiply_adds: f64,
}

/// The cost of a whole pipeline.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Cost {
    /// Channel by channel.
    pub channels: Vec<ChannelCost>,
    /// Observing windows used.
    pub windows: usize,
    /// Snapshot solutions of each channel, the final one included.
    pub solutions: u64,
    /// Size of the downlink file, bytes.
    pub downlink_bytes: f64,
    /// Memory for sums, snapshots, solving and the simulated sky, bytes.
    pub memory_bytes: f64,
    /// Rate that the daughters' samples need on their links to the mother, all together, bit/s; with
    /// samples alone.
    pub samples_bits_per_s: Option<f64>,
    /// Time on this machine, s, from a measurement of a fraction of a second.
    pub predicted_s: f64,
}

/// Rates of this machine, measured with this pipeline's own sizes.
struct Rates {
    /// Visibilities simulated in a second, all cores.
    simulated_per_s: f64,
    /// Visibilities accumulated in a second, all cores.
    accumulated_per_s: f64,
}

impl Plan {
    /// Counts and measures what the pipeline will cost. Takes well under a second but for large maps.
    #[must_use]
    pub fn cost(&self) -> Cost {
        let map = &self.config.map;
        let (pixels, sky_pixels) = (pixel_count(map.nside) as f64, self.sky_pixels() as f64);
        let expected = self.visibilities();
        let frequencies = &self.config.spacecraft.channels_hz;
        let channels: Vec<ChannelCost> = frequencies
            .iter()
            .zip(&expected)
            .map(|(&frequency_hz, expected)| ChannelCost {
                frequency_hz,
                visibilities_sent: expected.sent.round(),
                visibilities_mapped: expected.mapped.round(),
                baseline_m_max: map.baseline_m_max(frequency_hz),
                simulation_fringes: expected.sent * sky_pixels,
                accumulation_multiply_adds: expected.mapped * pixels * pixels,
                solution_multiply_adds: pixels.powi(3) / 6.0,
            })
            .collect();
        let sent: f64 = expected.iter().map(|e| e.sent).sum();
        let mapped: f64 = expected.iter().map(|e| e.mapped).sum();
        let solutions = self.solutions();
        let engine_bytes = PixelEngine::memory_bytes(map.nside) as f64;
        // One engine a channel; a snapshot being made, one in the queue, one in the solver, which works in it.
        let snapshots = if solutions > 1 { 3.0 } else { 0.0 };
        let memory_bytes = engine_bytes * (frequencies.len() as f64 + snapshots)
            + sky_pixels * 8.0 * (frequencies.len() + 3) as f64;
        let rates = self.measure();
        // A Cholesky factorisation runs at about the rate of the rank-k updates (one core of it: half).
        let flops = rates.accumulated_per_s * pixels * pixels;
        let solving: f64 = channels.iter().map(|c| c.solution_multiply_adds).sum::<f64>() * solutions as f64;
        let predicted_s =
            sent / rates.simulated_per_s + mapped / rates.accumulated_per_s + 2.0 * solving / flops;
        Cost {
            channels,
            windows: self.windows.len(),
            solutions,
            downlink_bytes: sent * VISIBILITY_BYTES as f64 + self.windows.len() as f64 * 10_000.0,
            memory_bytes,
            samples_bits_per_s: self.samples_bits_per_s(),
            predicted_s,
        }
    }

    fn solutions(&self) -> u64 {
        let every_s = self.config.map.snapshot_every_s;
        if every_s > 0.0 { (self.config.spacecraft.duration_s / every_s).ceil() as u64 } else { 1 }
    }

    fn sky_pixels(&self) -> usize {
        // A file's size is not read here; the published maps have this one.
        pixel_count(self.config.sky.nside)
    }

    /// Times a few visibilities of the shortest pair through simulation and accumulation.
    fn measure(&self) -> Rates {
        const SAMPLES: usize = 512;
        // No larger than what is measured in a fraction of a second and a fraction of a gigabyte.
        let measured_nside = self.config.map.nside.min(16);
        let frequency_hz = self.config.spacecraft.channels_hz.first().copied().unwrap_or(10e6);
        let time_s = self.windows.first().map_or(0.0, |window| window.start.seconds());
        let at = |k: usize| time_s + k as f64;
        let positions = |n| (0..SAMPLES).map(|k| self.array.position_m(n, at(k))).collect::<Vec<_>>();
        let (r_i_m, r_j_m) = (positions(0), positions(1));
        let response = self.instrument.response;
        let moon_radius_m = self.instrument.moon_radius_m;
        let pairs: Vec<PairGeometry> = r_i_m
            .iter()
            .zip(&r_j_m)
            .map(|(&r_i_m, &r_j_m)| PairGeometry { r_i_m, r_j_m, frequency_hz, moon_radius_m, response })
            .collect();
        let nside = self.config.sky.nside;
        let directions = Directions::from(pixel_directions(nside).as_slice());
        let sky_k = vec![1.0_f32; directions.len()];
        let few = &pairs[..SAMPLES.min(64)];
        let since = Instant::now();
        let summed = sky_sums(few, &directions, &sky_k, pixel_area_sr(nside)).is_ok();
        let simulated_per_s =
            if summed { few.len() as f64 / since.elapsed().as_secs_f64() } else { f64::NAN };
        let placed = PlacedVisibilities {
            frequency_hz,
            pair: Pair { i: 0, j: 1 },
            time_s: (0..SAMPLES).map(at).collect(),
            r_i_m,
            r_j_m,
            value_k_sr: vec![Complex64::ONE; SAMPLES],
            weight: vec![1.0; SAMPLES],
            ..PlacedVisibilities::default()
        };
        let setup = PixelSetup {
            nside: measured_nside,
            frequency_hz,
            method: self.config.map.rows,
            moon_radius_m,
            response,
            companion_seed: 0,
        };
        let rate = PixelEngine::new(setup).map_or(f64::NAN, |mut engine| {
            // The first time makes tables and touches memory for the first time.
            let warmed = engine.add(&placed).is_ok();
            let since = Instant::now();
            let added = warmed && engine.add(&placed).is_ok();
            if added { SAMPLES as f64 / since.elapsed().as_secs_f64() } else { f64::NAN }
        });
        // The work of a visibility grows as the number of pixels squared.
        let shrink = pixel_count(measured_nside) as f64 / pixel_count(self.config.map.nside) as f64;
        let accumulated_per_s = rate * shrink * shrink;
        Rates { simulated_per_s, accumulated_per_s }
    }
}

impl fmt::Display for Cost {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:>12} {:>14} {:>14} {:>14} {:>16} {:>16}",
            "channel", "visibilities", "in the map", "b max (m)", "fringes", "multiply-adds"
        )?;
        for channel in &self.channels {
            writeln!(
                f,
                "{:>8.3} MHz {:>14.0} {:>14.0} {:>14.1} {:>16.2e} {:>16.2e}",
                channel.frequency_hz / 1e6,
                channel.visibilities_sent,
                channel.visibilities_mapped,
                channel.baseline_m_max,
                channel.simulation_fringes,
                channel.accumulation_multiply_adds + channel.solution_multiply_adds * self.solutions as f64
            )?;
        }
        writeln!(f)?;
        writeln!(f, "windows          {}", self.windows)?;
        writeln!(f, "maps per channel {}", self.solutions)?;
        writeln!(f, "downlink         {:.1} MB", self.downlink_bytes / 1e6)?;
        writeln!(f, "memory           {:.2} GB", self.memory_bytes / 1e9)?;
        if let Some(rate) = self.samples_bits_per_s {
            writeln!(f, "samples          {:.3} Mbit/s from all daughters", rate / 1e6)?;
        }
        write!(f, "predicted time   {:.0} s on this machine", self.predicted_s)
    }
}
