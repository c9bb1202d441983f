//! Source of the space segment that simulates voltages, not visibilities: samples of all daughters and channels, window by window.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use super::bins::HOP;
use super::config::DaughtersConfig;
use super::covariance::{CovarianceRequest, Covariances, Epochs, Tables};
use super::disturbances::BlockTones;
use super::errors::{InstrumentErrors, PassErrors};
use super::quantiser::Quantiser;
use super::repair::Repairs;
use super::synthesis::{Draft, DrawKey, Planes, Response, SampleSlot, SampleSynthesis};
use crate::array::Array;
use crate::frames::{Channel, ObservingWindow, SampleBlock, SpaceFrame};
use crate::response::model::{ModelError, VisibilityModel};
use crate::runtime::{Flow, Outlet, Source, Units};
use crate::units::{ChannelId, MissionTime, TICKS_PER_SECOND};

/// Number of samples made from one prediction: 2 s at 8 kHz. Longer chunks need fewer predictions of slow fringes,
/// shorter ones a shorter sum over instants at each epoch (every 64 samples).
const CHUNK_SAMPLES: usize = 1 << 14;

/// Array and sky that determine the samples.
pub struct Scene {
    /// The array.
    pub array: Arc<Array>,
    /// The sky as the array sees it: one model per channel.
    pub models: Vec<Box<dyn VisibilityModel>>,
    /// Channels.
    pub channels: Vec<Channel>,
    /// Receiver noise of each channel, equal at all daughters, K sr.
    pub receiver_noise_k_sr: Vec<f64>,
    /// Seed of all random numbers.
    pub seed: u64,
}

/// Counters of the sampler.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SamplerCounts {
    /// Complex samples made for all daughters and channels.
    pub samples: u64,
    /// Number of real or imaginary parts out of a quantiser's range.
    pub saturated: u64,
    /// Repairs of covariances.
    pub repairs: Repairs,
}

/// Source that samples observing windows in chunks of all channels and daughters. It makes a chunk while it sends the
/// one before.
///
/// Windows are cut to whole hops of 64 samples. The same seed gives the same samples for any number of threads.
pub struct Sampler {
    scene: Scene,
    config: DaughtersConfig,
    windows: std::vec::IntoIter<ObservingWindow>,
    current: Option<WindowProgress>,
    synthesis: SampleSynthesis,
    tables: Tables,
    /// Workspaces that no thread uses at the moment.
    spare: Mutex<Vec<ChannelWorkspace>>,
    counts: Arc<Mutex<SamplerCounts>>,
    errors: Option<Arc<InstrumentErrors>>,
    /// Errors in the current window, a pass of the satellites.
    pass: Option<PassErrors>,
}

/// Memory for the samples of one channel.
struct ChannelWorkspace {
    covariances: Covariances,
    draft: Draft,
    planes: Vec<Planes>,
}

/// Blocks of each channel in one chunk.
type Chunk = Vec<(Vec<SampleBlock>, Repairs)>;

/// Progress through a window.
struct WindowProgress {
    window: ObservingWindow,
    /// Samples in the window.
    samples: usize,
    /// Samples made so far.
    done: usize,
    /// A complete chunk that is not sent yet.
    ready: Option<Chunk>,
    /// Quantisers by channel and daughter.
    quantisers: Vec<Vec<Quantiser>>,
}

impl Sampler {
    /// Creates a sampler of `windows` of a scene, which updates `counts` while it runs.
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
            synthesis: SampleSynthesis::new(),
            tables: Tables::default(),
            spare: Mutex::default(),
            counts,
            errors: None,
            pass: None,
        }
    }

    /// Adds errors of the instrument.
    #[must_use]
    pub fn with_errors(self, errors: Option<Arc<InstrumentErrors>>) -> Self {
        Self { errors, ..self }
    }

    fn begin(&self, mut window: ObservingWindow) -> WindowProgress {
        let sample_rate_hz = self.sample_rate_hz();
        let length_s = (window.end.0 - window.start.0) as f64 / TICKS_PER_SECOND as f64;
        let samples = (length_s * sample_rate_hz) as usize / HOP * HOP;
        window.end = self.time(window.start, samples);
        let block_s = self.config.block_samples as f64 / sample_rate_hz;
        let quantiser = Quantiser::new(self.config.bits, block_s, self.config.level_time_constant_s);
        let quantisers = vec![vec![quantiser; self.scene.array.satellites()]; self.scene.channels.len()];
        WindowProgress { window, samples, done: 0, ready: None, quantisers }
    }

    fn sample_rate_hz(&self) -> f64 {
        // Channels are sampled critically.
        self.scene.channels.first().map_or(1.0, |channel| channel.width_hz)
    }

    fn time(&self, start: MissionTime, samples: usize) -> MissionTime {
        start.plus_ticks(sample_ticks(samples as u64, self.sample_rate_hz()))
    }

    /// Makes the next chunk of the current window and sends the one before.
    fn advance(
        &mut self,
        progress: &mut WindowProgress,
        out: &mut Outlet<SpaceFrame>,
    ) -> Result<(), ModelError> {
        let ready = progress.ready.take();
        // Models move out of the scene, so that each thread can borrow one.
        let mut models = std::mem::take(&mut self.scene.models);
        let mut made = None;
        let sampler = &*self;
        rayon::in_place_scope(|scope| {
            if progress.done < progress.samples {
                scope.spawn(|_| made = Some(sampler.make(&mut models, progress)));
            }
            if let Some(ready) = ready {
                sampler.send(ready, out);
            }
        });
        self.scene.models = models;
        progress.ready = made.transpose()?;
        Ok(())
    }

    fn make(
        &self,
        models: &mut [Box<dyn VisibilityModel>],
        progress: &mut WindowProgress,
    ) -> Result<Chunk, ModelError> {
        let samples = CHUNK_SAMPLES.max(self.config.block_samples).min(progress.samples - progress.done);
        let (window, first) = (progress.window, progress.done);
        let epochs = Epochs {
            start_s: self.time(window.start, first).seconds(),
            step_s: HOP as f64 / self.sample_rate_hz(),
            count: samples / HOP + 1,
        };
        let asked = models.par_iter_mut().zip(progress.quantisers.par_iter_mut()).enumerate();
        let job =
            |(k, (model, quantisers)): (usize, (&mut Box<dyn VisibilityModel>, &mut Vec<Quantiser>))| {
                let work = ChannelWork { sampler: self, id: ChannelId(k as u16), window, first, samples };
                work.run(model.as_mut(), epochs, quantisers)
            };
        let made: Vec<Result<_, ModelError>> = asked.with_max_len(1).map(job).collect();
        progress.done += samples;
        // The first error in channel order, independent of the order of threads.
        made.into_iter().collect()
    }

    /// Takes a spare workspace or a new one. Its contents are undefined; it returns to `spare` after use.
    fn workspace(&self) -> ChannelWorkspace {
        let spare = self.spare.lock().unwrap_or_else(PoisonError::into_inner).pop();
        spare.unwrap_or_else(|| {
            let (daughters, samples) = (self.scene.array.satellites(), self.config.block_samples);
            let planes = || [vec![0.0; samples], vec![0.0; samples]];
            ChannelWorkspace {
                covariances: Covariances::default(),
                draft: self.synthesis.draft(daughters),
                planes: std::iter::repeat_with(planes).take(daughters).collect(),
            }
        })
    }

    /// Sends blocks in the order of time, daughter, channel. All blocks of a daughter and time travel as one frame, so
    /// that threads do not wake each other for every block.
    fn send(&self, chunk: Chunk, out: &mut Outlet<SpaceFrame>) {
        let mut counts = SamplerCounts::default();
        let mut channels = Vec::with_capacity(chunk.len());
        for (blocks, repairs) in chunk {
            counts.repairs.add(repairs);
            for block in &blocks {
                counts.samples += block.samples.len() as u64;
                counts.saturated += u64::from(block.saturated);
            }
            channels.push(blocks.into_iter());
        }
        let mut all = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        all.samples += counts.samples;
        all.saturated += counts.saturated;
        all.repairs.add(counts.repairs);
        drop(all);
        // Each channel's blocks are ordered daughter by daughter.
        while channels.iter().any(|blocks| blocks.len() > 0) {
            out.push(SpaceFrame::Samples(channels.iter_mut().filter_map(Iterator::next).collect()));
        }
    }
}

/// Duration of `samples`, ticks.
pub(crate) fn sample_ticks(samples: u64, width_hz: f64) -> i64 {
    (samples as f64 / width_hz * TICKS_PER_SECOND as f64).round() as i64
}

/// Inputs of the work on one channel in one chunk.
struct ChannelWork<'a> {
    sampler: &'a Sampler,
    id: ChannelId,
    window: ObservingWindow,
    /// Index of the first sample in the window, a whole number of blocks.
    first: usize,
    samples: usize,
}

impl ChannelWork<'_> {
    fn run(
        &self,
        model: &mut dyn VisibilityModel,
        epochs: Epochs,
        quantisers: &mut [Quantiser],
    ) -> Result<(Vec<SampleBlock>, Repairs), ModelError> {
        let Self { sampler, .. } = self;
        let request = CovarianceRequest {
            array: &sampler.scene.array,
            channel: sampler.scene.channels[usize::from(self.id.0)],
            receiver_noise_k_sr: sampler.scene.receiver_noise_k_sr[usize::from(self.id.0)],
            epochs,
            tables: &sampler.tables,
        };
        let mut workspace = sampler.workspace();
        let ChannelWorkspace { covariances, draft, planes } = &mut workspace;
        covariances.predict(model, &request)?;
        let daughters = quantisers.len();
        let block_samples = sampler.config.block_samples;
        // Epochs overlap by half. This fills the overlap; the samples that it writes are before the chunk, and overwritten next.
        let mut repairs = self.draw(covariances, 0, draft, SampleSlot { planes, first: 0 });
        let mut blocks = Vec::with_capacity(self.samples.div_ceil(block_samples) * daughters);
        for hop in 0..self.samples / HOP {
            let at = hop * HOP % block_samples;
            repairs.add(self.draw(covariances, hop + 1, draft, SampleSlot { planes, first: at }));
            let (length, made) = (at + HOP, (hop + 1) * HOP);
            if length == block_samples || made == self.samples {
                for (daughter, ([re, im], quantiser)) in planes.iter_mut().zip(&mut *quantisers).enumerate() {
                    let planes = [&mut re[..length], &mut im[..length]];
                    blocks.push(self.block(daughter, made, planes, quantiser));
                }
            }
        }
        sampler.spare.lock().unwrap_or_else(PoisonError::into_inner).push(workspace);
        Ok((blocks, repairs))
    }

    fn draw(
        &self,
        covariances: &Covariances,
        epoch: usize,
        draft: &mut Draft,
        out: SampleSlot<'_>,
    ) -> Repairs {
        let Sampler { scene, synthesis, pass, .. } = self.sampler;
        let time = self.sampler.time(self.window.start, self.first + epoch * HOP);
        let key = DrawKey { seed: scene.seed, channel: self.id.0, ticks: time.0 };
        let channel = scene.channels[usize::from(self.id.0)];
        let channel_index = usize::from(self.id.0);
        let responses: Vec<Response> = pass.as_ref().map_or_else(Vec::new, |pass| {
            let response = |n| Response::with_errors(pass, (n, channel_index), channel, time.seconds());
            (0..covariances.daughters()).map(response).collect()
        });
        synthesis.draw(covariances, epoch, key, &responses, draft, out)
    }

    /// Makes the block of one daughter that ends `made` samples into the chunk.
    fn block(
        &self,
        daughter: usize,
        made: usize,
        [re, im]: [&mut [f32]; 2],
        quantiser: &mut Quantiser,
    ) -> SampleBlock {
        let Sampler { scene, config, .. } = self.sampler;
        let first = self.first + made - re.len();
        let time = self.sampler.time(self.window.start, first);
        if config.tones.are_on() {
            let tones = BlockTones {
                tones: &config.tones,
                array: &scene.array,
                daughter,
                channel: scene.channels[usize::from(self.id.0)],
                window_s: self.window.start.seconds(),
                first: first as u64,
                seed: scene.seed,
                pass: self.sampler.pass.as_ref(),
                number: usize::from(self.id.0),
            };
            tones.add_to(re, im);
        }
        let (samples, saturated) = quantiser.quantise(re, im);
        SampleBlock {
            channel: self.id,
            daughter: daughter as u8,
            number: (first / config.block_samples) as u64,
            time,
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
                self.pass = self.errors.as_ref().map(|errors| errors.pass(window));
                let progress = self.begin(window);
                out.push(SpaceFrame::WindowStart(progress.window));
                progress
            }
        };
        self.advance(&mut progress, out)?;
        if progress.ready.is_some() {
            self.current = Some(progress);
        } else {
            out.push(SpaceFrame::WindowEnd(progress.window));
        }
        Ok(Flow::Continue)
    }

    /// Closes an interrupted window where its samples end.
    fn finish(&mut self, out: &mut Outlet<SpaceFrame>) -> Result<(), ModelError> {
        if let Some(mut progress) = self.current.take() {
            if let Some(ready) = progress.ready.take() {
                self.send(ready, out);
            }
            let end = self.time(progress.window.start, progress.done);
            out.push(SpaceFrame::WindowEnd(ObservingWindow { end, ..progress.window }));
        }
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.counts.lock().unwrap_or_else(PoisonError::into_inner).samples, "samples")
    }
}
