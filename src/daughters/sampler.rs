//! The source of the space segment in sample fidelity: windows, as samples of all daughters and channels.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use super::colour::Repairs;
use super::config::DaughtersConfig;
use super::covariance::{Covariances, Epochs, Request, Tables};
use super::disturbances::Stretch;
use super::quantiser::Quantiser;
use super::synthesis::{DrawKey, HOP, Response, Synthesis};
use crate::array::Array;
use crate::frames::{Channel, ObservingWindow, SampleBlock, SpaceFrame};
use crate::mother::{ModelError, VisibilityModel};
use crate::runtime::{Flow, Outlet, Source, Units};
use crate::units::{ChannelId, MissionTime, TICKS_PER_SECOND};

/// Samples that are made of one prediction: 4 s at 8 kHz.
const CHUNK_SAMPLES: usize = 1 << 15;

/// What the daughters listen to, and where they are.
pub struct Scene {
    /// The array.
    pub array: Arc<Array>,
    /// The sky, as the array sees it: one model a channel.
    pub models: Vec<Box<dyn VisibilityModel>>,
    /// Channels.
    pub channels: Vec<Channel>,
    /// Receiver noise T_rec / zeta of each daughter, K sr.
    pub receiver_noise_k_sr: f64,
    /// Seed of all noise.
    pub seed: u64,
}

/// What sampling has counted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SamplerCounts {
    /// Complex samples made, of all daughters and channels.
    pub samples: u64,
    /// Parts beyond a quantiser's range.
    pub saturated: u64,
    /// What was done to covariances.
    pub repairs: Repairs,
}

/// Samples windows, one stretch of all channels and daughters after another.
///
/// Windows are cut to whole hops of 64 samples. The same seed gives the same samples, whatever the threads.
pub struct Sampler {
    scene: Scene,
    config: DaughtersConfig,
    windows: std::vec::IntoIter<ObservingWindow>,
    current: Option<Progress>,
    synthesis: Synthesis,
    tables: Tables,
    counts: Arc<Mutex<SamplerCounts>>,
}

/// How far a window has been sampled.
struct Progress {
    window: ObservingWindow,
    /// Samples that the window has.
    samples: usize,
    done: usize,
    /// By channel and daughter.
    quantisers: Vec<Vec<Quantiser>>,
}

impl Sampler {
    /// Samples `windows` of a scene; what it counts can be read through `counts`.
    #[must_use]
    pub fn new(
        scene: Scene,
        config: DaughtersConfig,
        windows: Vec<ObservingWindow>,
        counts: Arc<Mutex<SamplerCounts>>,
    ) -> Self {
        let windows = windows.into_iter();
        Self {
            scene,
            config,
            windows,
            current: None,
            synthesis: Synthesis::new(),
            tables: Tables::default(),
            counts,
        }
    }

    fn begin(&self, mut window: ObservingWindow) -> Progress {
        let width_hz = self.width_hz();
        let length_s = (window.end.0 - window.start.0) as f64 / TICKS_PER_SECOND as f64;
        let samples = (length_s * width_hz) as usize / HOP * HOP;
        window.end = self.time(window.start, samples);
        let block_s = self.config.block_samples as f64 / width_hz;
        let quantiser = Quantiser::new(self.config.bits, block_s, self.config.level_time_constant_s);
        let quantisers = vec![vec![quantiser; self.scene.array.satellites()]; self.scene.channels.len()];
        Progress { window, samples, done: 0, quantisers }
    }

    fn width_hz(&self) -> f64 {
        self.scene.channels.first().map_or(1.0, |channel| channel.width_hz)
    }

    fn time(&self, start: MissionTime, samples: usize) -> MissionTime {
        start.plus_ticks(sample_ticks(samples as u64, self.width_hz()))
    }

    /// The next stretch of the current window.
    fn stretch(&mut self, progress: &mut Progress, out: &mut Outlet<SpaceFrame>) -> Result<(), ModelError> {
        let samples = CHUNK_SAMPLES.max(self.config.block_samples).min(progress.samples - progress.done);
        let width_hz = self.width_hz();
        let from = self.time(progress.window.start, progress.done);
        let epochs =
            Epochs { start_s: from.seconds(), step_s: HOP as f64 / width_hz, count: samples / HOP + 1 };
        let Scene { array, models, channels, receiver_noise_k_sr, .. } = &mut self.scene;
        let request = |channel| Request {
            array: &*array,
            channel,
            receiver_noise_k_sr: *receiver_noise_k_sr,
            epochs,
            tables: &self.tables,
        };
        let asked = models.par_iter_mut().zip(&*channels);
        let predicted: Vec<Result<Covariances, ModelError>> =
            asked.map(|(model, &channel)| Covariances::predict(model.as_mut(), &request(channel))).collect();
        // The first error in the order of channels, whichever thread was first.
        let covariances = predicted.into_iter().collect::<Result<Vec<_>, _>>()?;
        for covariances in &covariances {
            self.synthesis.prepare(covariances);
        }
        let job = |(k, quantisers): (usize, &mut Vec<Quantiser>)| {
            let work = ChannelWork {
                sampler: self,
                id: ChannelId(k as u16),
                window: progress.window,
                first: progress.done,
                samples,
            };
            work.run(&covariances[k], quantisers)
        };
        let made: Vec<(Vec<SampleBlock>, Repairs)> =
            progress.quantisers.par_iter_mut().enumerate().map(job).collect();
        progress.done += samples;
        self.hand_on(made, out);
        Ok(())
    }

    /// Blocks in the order of time, channel, daughter.
    fn hand_on(&self, made: Vec<(Vec<SampleBlock>, Repairs)>, out: &mut Outlet<SpaceFrame>) {
        let daughters = self.scene.array.satellites();
        let mut counts = SamplerCounts::default();
        let mut channels = Vec::with_capacity(made.len());
        for (blocks, repairs) in made {
            counts.repairs.absorb(repairs);
            for block in &blocks {
                counts.samples += block.samples.len() as u64;
                counts.saturated += u64::from(block.saturated);
            }
            channels.push(blocks.into_iter());
        }
        let mut all = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        all.samples += counts.samples;
        all.saturated += counts.saturated;
        all.repairs.absorb(counts.repairs);
        drop(all);
        while channels.iter().any(|blocks| blocks.len() > 0) {
            for blocks in &mut channels {
                blocks.take(daughters).for_each(|block| out.push(SpaceFrame::Samples(block)));
            }
        }
    }
}

/// Ticks that `samples` last.
pub(crate) fn sample_ticks(samples: u64, width_hz: f64) -> i64 {
    (samples as f64 / width_hz * TICKS_PER_SECOND as f64).round() as i64
}

/// One channel of one stretch.
struct ChannelWork<'a> {
    sampler: &'a Sampler,
    id: ChannelId,
    window: ObservingWindow,
    /// Number of the first sample in the window, a whole number of blocks.
    first: usize,
    samples: usize,
}

impl ChannelWork<'_> {
    fn run(&self, covariances: &Covariances, quantisers: &mut [Quantiser]) -> (Vec<SampleBlock>, Repairs) {
        let Self { sampler, .. } = self;
        let daughters = quantisers.len();
        let block_samples = sampler.config.block_samples;
        let mut draft = sampler.synthesis.draft(daughters);
        // The epoch before the first sample only leaves its second half behind.
        let mut repairs = self.draw(covariances, 0, &mut draft);
        let mut planes = vec![[Vec::new(), Vec::new()]; daughters];
        let mut blocks = Vec::with_capacity(self.samples.div_ceil(block_samples) * daughters);
        for hop in 0..self.samples / HOP {
            repairs.absorb(self.draw(covariances, hop + 1, &mut draft));
            for ([re, im], samples) in planes.iter_mut().zip(draft.samples.chunks_exact(HOP)) {
                re.extend(samples.iter().map(|x| x.re));
                im.extend(samples.iter().map(|x| x.im));
            }
            let made = (hop + 1) * HOP;
            if made.is_multiple_of(block_samples) || made == self.samples {
                for (daughter, (plane, quantiser)) in planes.iter_mut().zip(&mut *quantisers).enumerate() {
                    let plane = std::mem::take(plane);
                    blocks.push(self.block(daughter, made, plane, quantiser));
                }
            }
        }
        (blocks, repairs)
    }

    fn draw(&self, covariances: &Covariances, epoch: usize, draft: &mut super::synthesis::Draft) -> Repairs {
        let Sampler { scene, config, synthesis, .. } = self.sampler;
        let time = self.sampler.time(self.window.start, self.first + epoch * HOP);
        let key = DrawKey { seed: scene.seed, channel: self.id.0, ticks: time.0 };
        let channel = scene.channels[usize::from(self.id.0)];
        let responses: Vec<Response> = if config.disturbances.changes_responses() {
            let response = |n| config.disturbances.response(n, channel, time.seconds());
            (0..covariances.daughters()).map(response).collect()
        } else {
            Vec::new()
        };
        synthesis.draw(covariances, epoch, key, &responses, draft)
    }

    /// The block of one daughter that ends `made` samples into the stretch.
    fn block(
        &self,
        daughter: usize,
        made: usize,
        [mut re, mut im]: [Vec<f32>; 2],
        quantiser: &mut Quantiser,
    ) -> SampleBlock {
        let Sampler { scene, config, .. } = self.sampler;
        let first = self.first + made - re.len();
        let time = self.sampler.time(self.window.start, first);
        if config.disturbances.has_tones() {
            let stretch = Stretch {
                disturbances: &config.disturbances,
                array: &scene.array,
                daughter,
                channel: scene.channels[usize::from(self.id.0)],
                window_s: self.window.start.seconds(),
                first: first as u64,
                seed: scene.seed,
            };
            stretch.add_tones(&mut re, &mut im);
        }
        let (samples, saturated) = quantiser.quantise(re, im);
        SampleBlock {
            channel: self.id,
            daughter: daughter as u8,
            number: (first / config.block_samples) as u64,
            time,
            clock_offset_s: config.disturbances.clock_offset_s(daughter, time.seconds()),
            saturated,
            samples,
        }
    }
}

impl Source for Sampler {
    type Out = SpaceFrame;
    type Error = ModelError;

    fn next(&mut self, out: &mut Outlet<SpaceFrame>) -> Result<Flow, ModelError> {
        let mut progress = match self.current.take() {
            Some(progress) => progress,
            None => {
                let Some(window) = self.windows.next() else { return Ok(Flow::Done) };
                let progress = self.begin(window);
                out.push(SpaceFrame::WindowStart(progress.window));
                progress
            }
        };
        if progress.done < progress.samples {
            self.stretch(&mut progress, out)?;
        }
        if progress.done < progress.samples {
            self.current = Some(progress);
        } else {
            out.push(SpaceFrame::WindowEnd(progress.window));
        }
        Ok(Flow::Continue)
    }

    /// A window that is broken off ends where its samples end.
    fn finish(&mut self, out: &mut Outlet<SpaceFrame>) -> Result<(), ModelError> {
        if let Some(progress) = self.current.take() {
            let end = self.time(progress.window.start, progress.done);
            out.push(SpaceFrame::WindowEnd(ObservingWindow { end, ..progress.window }));
        }
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.counts.lock().unwrap_or_else(PoisonError::into_inner).samples, "samples")
    }
}
