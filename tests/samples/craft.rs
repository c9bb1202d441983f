//! Shared parts: a spacecraft in sample fidelity without a chain, skies with known visibilities, and moments.

use std::f64::consts::TAU;
use std::sync::Arc;

use lunarray::array::{Array, ArrayConfig, IntegrationRule, ObservingWindows};
use lunarray::daughters::{
    DaughtersConfig, InstrumentConfig, InstrumentErrors, NavigationConfig, Sampler, SamplerCounts, Scene,
};
use lunarray::frames::{
    AntennaResponse, Channel, GroundFrame, Instrument, ObservingWindow, SampleBlock, Samples, SpaceFrame,
    VisibilityBlock,
};
use lunarray::mother::correlator::{Correlator, CorrelatorCounts, CorrelatorSetup, Division};
use lunarray::mother::{Schedule, WindowThinning};
use lunarray::response::model::{DaughterPosition, ModelError, PairPosition, VisibilityModel};
use lunarray::runtime::{Flow, Outlet, Source, Stage};
use lunarray::units::MissionTime;
use lunarray::units::constants::SPEED_OF_LIGHT_M_S;
use lunarray::units::vector::{Vec3, dot, sub};
use num_complex::Complex64;

pub const WIDTH_HZ: f64 = 8e3;

/// Every pair has visibility `cross`, and every daughter power one.
pub struct Constant {
    pub cross: f64,
}

impl VisibilityModel for Constant {
    fn predict(&mut self, _: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        out.fill(Complex64::new(self.cross, 0.0));
        Ok(())
    }

    fn predict_powers(&mut self, _: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
        out.fill(1.0);
        Ok(())
    }
}

/// A point source of unit flux that nothing occults.
pub struct Point {
    pub n_hat: Vec3,
    pub frequency_hz: f64,
}

pub fn fringe(n_hat: Vec3, frequency_hz: f64, r_i_m: Vec3, r_j_m: Vec3) -> Complex64 {
    Complex64::cis(-TAU * frequency_hz / SPEED_OF_LIGHT_M_S * dot(n_hat, sub(r_i_m, r_j_m)))
}

impl VisibilityModel for Point {
    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        for (out, at) in out.iter_mut().zip(positions) {
            *out = fringe(self.n_hat, self.frequency_hz, at.r_i_m, at.r_j_m);
        }
        Ok(())
    }

    fn predict_powers(&mut self, _: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
        out.fill(1.0);
        Ok(())
    }
}

/// The model of a channel at a frequency, Hz.
pub type Sky = Box<dyn Fn(f64) -> Box<dyn VisibilityModel> + Send + Sync>;

pub fn constant(cross: f64) -> Sky {
    Box::new(move |_| Box::new(Constant { cross }))
}

pub fn point(n_hat: Vec3) -> Sky {
    Box::new(move |frequency_hz| Box::new(Point { n_hat, frequency_hz }))
}

/// A spacecraft in sample fidelity, without links.
pub struct Spacecraft {
    pub array: Arc<Array>,
    pub sky: Sky,
    pub frequencies_hz: Vec<f64>,
    pub receiver_noise_k_sr: f64,
    pub rule: IntegrationRule,
    pub daughters: DaughtersConfig,
    pub instrument: InstrumentConfig,
    pub window: ObservingWindow,
    pub division: Division,
    pub auto_integration_s: f64,
}

impl Spacecraft {
    pub fn new(array: ArrayConfig, frequencies_hz: Vec<f64>, sky: Sky, seconds: f64) -> Self {
        let array = Arc::new(Array::new(&array).unwrap());
        let start = ObservingWindows::new(&array, 0.0, 1e9).next().unwrap().start;
        let end = MissionTime::from_seconds(start.seconds() + seconds);
        Self {
            array,
            sky,
            frequencies_hz,
            receiver_noise_k_sr: 0.0,
            rule: IntegrationRule::default(),
            daughters: DaughtersConfig { bits: 32, ..DaughtersConfig::default() },
            instrument: InstrumentConfig::default(),
            window: ObservingWindow { index: 0, start, end },
            division: Division::NONE,
            auto_integration_s: 0.0,
        }
    }

    pub fn channels(&self) -> Vec<Channel> {
        self.frequencies_hz.iter().map(|&frequency_hz| Channel { frequency_hz, width_hz: WIDTH_HZ }).collect()
    }

    /// Errors of the instrument, if there are any.
    pub fn errors(&self, seed: u64) -> Option<InstrumentErrors> {
        InstrumentErrors::new(
            &self.instrument,
            &NavigationConfig::default(),
            seed,
            &self.array,
            &self.channels(),
        )
    }

    /// All frames of the daughters.
    pub fn sample(&self, seed: u64) -> (Vec<SpaceFrame>, SamplerCounts) {
        let scene = Scene {
            array: Arc::clone(&self.array),
            models: self.frequencies_hz.iter().map(|&frequency_hz| (self.sky)(frequency_hz)).collect(),
            channels: self.channels(),
            receiver_noise_k_sr: vec![self.receiver_noise_k_sr; self.frequencies_hz.len()],
            seed,
        };
        let counts = Arc::default();
        let mut sampler = Sampler::new(scene, self.daughters.clone(), vec![self.window], Arc::clone(&counts))
            .with_errors(self.errors(seed).map(Arc::new));
        let mut out = Outlet::collect();
        while sampler.next(&mut out).unwrap() == Flow::Continue {}
        let counts = *counts.lock().unwrap();
        (out.into_vec(), counts)
    }

    pub fn correlate(&self, frames: Vec<SpaceFrame>) -> (Vec<VisibilityBlock>, CorrelatorCounts) {
        let channels = self.division.divided(&self.channels());
        let schedule = |channel: &Channel| Schedule {
            rule: self.rule,
            frequency_hz: channel.frequency_hz,
            baseline_wavelengths_max: 0.0,
            every_nth: 1,
            windows: WindowThinning::EveryNth(1),
        };
        let setup = CorrelatorSetup {
            array: Arc::clone(&self.array),
            instrument: Instrument {
                name: String::new(),
                epoch_tai_s: 0.0,
                moon_radius_m: self.array.moon_radius_m(),
                satellites: 8,
                channels: channels.clone(),
                response: AntennaResponse::Isotropic,
                seed: 0,
                configuration_hash: 0,
                spectrometer: None,
                noiseless: false,
            },
            schedules: channels.iter().map(schedule).collect(),
            division: self.division,
            auto_integration_s: self.auto_integration_s,
            // These windows are cut from a real one's beginning, in which the last daughters still see the Earth.
            flag_earth: false,
            block_samples: self.daughters.block_samples,
            wait_blocks: 4,
        };
        let counts = Arc::default();
        let mut correlator = Correlator::new(setup, Arc::clone(&counts));
        let mut out = Outlet::collect();
        for frame in frames {
            correlator.step(frame, &mut out).unwrap();
        }
        correlator.finish(&mut out).unwrap();
        let visibilities = out.into_vec().into_iter().filter_map(|frame| match frame {
            GroundFrame::Visibilities(block) => Some(block),
            _ => None,
        });
        let counts = counts.lock().unwrap().clone();
        (visibilities.collect(), counts)
    }

    pub fn run(&self, seed: u64) -> Vec<VisibilityBlock> {
        self.correlate(self.sample(seed).0).0
    }
}

pub fn frequencies(count: usize) -> Vec<f64> {
    (0..count).map(|k| 1e6 * (k + 1) as f64).collect()
}

/// Values of all visibilities with an integration time of exactly `dt_s`.
pub fn values(blocks: &[VisibilityBlock], dt_s: f64) -> Vec<Complex64> {
    let ticks = (dt_s * 1e6).round() as u32;
    let each = |block: &VisibilityBlock| {
        let wanted = |k: &usize| block.duration_ticks[*k] == ticks;
        let value = |k: usize| Complex64::new(block.value_k_sr[k].re.into(), block.value_k_sr[k].im.into());
        (0..block.len()).filter(wanted).map(value).collect::<Vec<_>>()
    };
    blocks.iter().flat_map(each).collect()
}

/// Mean, and variance about it of real and imaginary parts together.
pub fn moments(values: &[Complex64]) -> (Complex64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<Complex64>() / n;
    (mean, values.iter().map(|v| (v - mean).norm_sqr()).sum::<f64>() / (2.0 * n - 2.0))
}

/// The model's mean over an integration and the channel, by the midpoint rule.
pub fn smeared(
    array: &Array,
    (i, j): (usize, usize),
    (from_s, dt_s): (f64, f64),
    frequency_hz: f64,
    visibility: impl Fn(f64, Vec3, Vec3) -> Complex64,
) -> Complex64 {
    const TIMES: usize = 16;
    const OFFSETS: usize = 64;
    let mut sum = Complex64::ZERO;
    for k in 0..TIMES {
        let t_s = from_s + dt_s * (k as f64 + 0.5) / TIMES as f64;
        let (r_i_m, r_j_m) = (array.position_m(i, t_s), array.position_m(j, t_s));
        for m in 0..OFFSETS {
            let offset = (m as f64 + 0.5) / OFFSETS as f64 - 0.5;
            sum += visibility(frequency_hz + WIDTH_HZ * offset, r_i_m, r_j_m);
        }
    }
    sum / (TIMES * OFFSETS) as f64
}

/// Samples of one daughter, blocks concatenated.
pub fn stream(frames: &[SpaceFrame], daughter: u8) -> Vec<Complex64> {
    let mut all = Vec::new();
    for block in blocks(frames).filter(|block| block.daughter == daughter) {
        if let Samples::Float { re, im } = &block.samples {
            all.extend(re.iter().zip(im).map(|(&re, &im)| Complex64::new(re.into(), im.into())));
        }
    }
    all
}

/// All blocks of frames, in order.
pub fn blocks(frames: &[SpaceFrame]) -> impl Iterator<Item = &SampleBlock> {
    frames.iter().flat_map(|frame| match frame {
        SpaceFrame::Samples(blocks) => blocks.as_slice(),
        _ => &[],
    })
}

/// Frames of one block each, modified by `change`, which returns `None` for a lost block.
pub fn block_by_block(
    frames: Vec<SpaceFrame>,
    mut change: impl FnMut(SampleBlock) -> Option<SampleBlock>,
) -> Vec<SpaceFrame> {
    let mut out = Vec::new();
    for frame in frames {
        match frame {
            SpaceFrame::Samples(blocks) => {
                let blocks = blocks.into_iter().filter_map(&mut change);
                out.extend(blocks.map(|block| SpaceFrame::Samples(vec![block])));
            }
            other => out.push(other),
        }
    }
    out
}
