//! Visibilities of a known signal: the sky of a map, an artificial signal, or both.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::circle::{CircleSky, Rotations};
use super::config::{CalibrationMode, SkyModel, SolverConfig};
use super::diagnosis::DIAGNOSIS_NSIDE;
use super::sums::{MODEL_TERMS, ModelTerms};
use crate::array::{track_axes, track_offset_m};
use crate::frames::{AntennaResponse, Channel, Instrument, PlacedVisibilities};
use crate::response::beacon::Beacon;
use crate::response::model::{DirectMoments, DirectSum, ModelError, PairPosition, VisibilityModel};
use crate::response::pixel::PairGeometry;
use crate::sky::{MapError, SkyMap};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, sub};

/// Model of the sky in a channel. Where positions are solved for it sums over the map and over the map times each
/// component of the direction, which gives the derivatives by the baseline.
enum ChannelSky {
    Value(DirectSum),
    Circle(Box<CircleSky>),
    Gradient(DirectMoments),
}

/// Visibilities of a sky, and where positions are solved for their derivatives by the baseline, per m.
#[derive(Default)]
struct Predicted {
    values: Vec<Complex64>,
    gradients: Vec<[Complex64; 3]>,
}

/// Known signal in all channels.
pub struct KnownSignal {
    sky: Vec<ChannelSky>,
    rotations: Rotations,
    beacon: Beacon,
    frequencies_hz: Vec<f64>,
    solves_positions: bool,
    /// Maps of low resolution, one per channel, to tell a wrong frequency.
    coarse: Vec<SkyMap>,
    moon_radius_m: f64,
    response: AntennaResponse,
}

/// Position errors of all daughters about which the model is linearised, and the normals of their orbits.
#[derive(Clone, Debug, PartialEq)]
pub struct Offsets {
    /// Errors along the track, across it and away from the Moon, by daughter, m.
    pub offset_m: Vec<[f64; 3]>,
    /// Normal of each daughter's orbit.
    pub normal_hat: Vec<Vec3>,
}

impl KnownSignal {
    /// Creates the signal for an instrument, with a map (K) for each channel; mode `beacon` uses no map.
    ///
    /// # Errors
    /// A map has pixels without value.
    pub fn new(config: &SolverConfig, instrument: &Instrument, maps: &[SkyMap]) -> Result<Self, MapError> {
        let solves_positions = config.position_sigma_m > 0.0;
        let uses_sky = config.mode != CalibrationMode::Beacon;
        let sky = |(map, channel): (&SkyMap, &Channel)| {
            map.check_whole()?;
            let map = match config.model_nside {
                nside if nside > map.nside() => map.upgrade(nside)?,
                _ => map.clone(),
            };
            let (hz, moon_m, response) =
                (channel.frequency_hz, instrument.moon_radius_m, instrument.response);
            Ok(match solves_positions {
                true => ChannelSky::Gradient(DirectMoments::new(&map, hz, moon_m, response)),
                false if config.is_harmonic(map.nside()) => {
                    let always = config.sky_model == SkyModel::Harmonic;
                    ChannelSky::Circle(Box::new(CircleSky::new(&map, hz, moon_m, response, always)?))
                }
                false => ChannelSky::Value(DirectSum::new(&map, hz, moon_m, response)),
            })
        };
        let coarse = |map: &SkyMap| match map.nside() > DIAGNOSIS_NSIDE {
            true => map.degrade(DIAGNOSIS_NSIDE),
            false => Ok(map.clone()),
        };
        let skies = maps.iter().zip(&instrument.channels).filter(|_| uses_sky).map(sky);
        Ok(Self {
            sky: skies.collect::<Result<_, MapError>>()?,
            rotations: Rotations::default(),
            beacon: config.beacon(),
            frequencies_hz: instrument.channels.iter().map(|channel| channel.frequency_hz).collect(),
            solves_positions,
            coarse: maps.iter().filter(|_| uses_sky).map(coarse).collect::<Result<_, MapError>>()?,
            moon_radius_m: instrument.moon_radius_m,
            response: instrument.response,
        })
    }

    /// Directions of the pixels of a channel's sky; empty unless positions are solved for.
    pub(super) fn directions(&self, channel: usize) -> Vec<Vec3> {
        match self.sky.get(channel) {
            Some(ChannelSky::Gradient(sum)) => sum.directions(),
            _ => Vec::new(),
        }
    }

    /// Sums over the sky of a channel, see [`DirectMoments::weighted_sums`]; empty without a sky.
    ///
    /// # Errors
    /// The model does not cover the positions.
    pub(super) fn sums_with(
        &self,
        channel: usize,
        positions: &[PairPosition],
        functions: &[f32],
    ) -> Result<Vec<f32>, ModelError> {
        match self.sky.get(channel) {
            Some(ChannelSky::Gradient(sum)) => sum.weighted_sums(positions, functions),
            _ => Ok(Vec::new()),
        }
    }

    /// The sky of a channel at low resolution, with its frequency times a factor; `None` without one.
    pub(super) fn at_ratio(
        &self,
        channel: usize,
        ratio: f64,
        positions: &[PairPosition],
    ) -> Option<Vec<Complex64>> {
        let hz = ratio * self.frequencies_hz[channel];
        let mut sum = DirectSum::new(self.coarse.get(channel)?, hz, self.moon_radius_m, self.response);
        let mut values = vec![Complex64::ZERO; positions.len()];
        sum.predict(positions, &mut values).ok()?;
        Some(values)
    }

    /// Geometry of a visibility.
    pub(super) fn geometry(&self, placed: &PlacedVisibilities, k: usize) -> PairGeometry {
        PairGeometry {
            r_i_m: placed.r_i_m[k],
            r_j_m: placed.r_j_m[k],
            frequency_hz: placed.frequency_hz,
            moon_radius_m: self.moon_radius_m,
            response: self.response,
        }
    }

    /// The artificial signal and the frequency of a channel.
    pub(super) fn beacon(&self, channel: usize) -> (Beacon, f64) {
        (self.beacon, self.frequencies_hz[channel])
    }

    /// Model terms of blocks of placed visibilities, linearised about `offsets`; the flag of each block says whether
    /// the artificial signal is on. Many blocks in one call are fastest.
    ///
    /// # Errors
    /// The model does not cover the positions.
    pub fn models(
        &mut self,
        blocks: &[(&PlacedVisibilities, bool)],
        offsets: &Offsets,
    ) -> Result<Vec<Vec<ModelTerms>>, ModelError> {
        let positions: Vec<Vec<PairPosition>> =
            blocks.iter().map(|(placed, _)| self.positions(placed, offsets)).collect();
        let mut skies: Vec<Predicted> = positions.iter().map(|_| Predicted::default()).collect();
        for channel in 0..self.frequencies_hz.len() {
            let of_channel = |&k: &usize| usize::from(blocks[k].0.channel.0) == channel;
            let block_indices: Vec<usize> = (0..blocks.len()).filter(of_channel).collect();
            let all: Vec<PairPosition> =
                block_indices.iter().flat_map(|&k| positions[k].iter().copied()).collect();
            let Predicted { values, gradients } = self.predict_sky(channel, &all)?;
            let (mut values, mut gradients) = (values.into_iter(), gradients.into_iter());
            for k in block_indices {
                let count = positions[k].len();
                skies[k].values = values.by_ref().take(count).collect();
                skies[k].gradients = gradients.by_ref().take(count).collect();
            }
        }
        let terms = |(k, sky): (usize, Predicted)| {
            let (placed, beacon_is_on) = blocks[k];
            self.terms(placed, offsets, sky, beacon_is_on.then_some(&positions[k]))
        };
        Ok(skies.into_iter().enumerate().map(terms).collect())
    }

    /// True positions: those of the packets minus the offsets.
    fn positions(&self, placed: &PlacedVisibilities, offsets: &Offsets) -> Vec<PairPosition> {
        let [i, j] = [placed.pair.i, placed.pair.j].map(usize::from);
        let true_position = |r_m: Vec3, n: usize| match self.solves_positions {
            true => sub(r_m, track_offset_m(r_m, offsets.normal_hat[n], offsets.offset_m[n])),
            false => r_m,
        };
        let position = |(&r_i_m, &r_j_m): (&Vec3, &Vec3)| PairPosition {
            r_i_m: true_position(r_i_m, i),
            r_j_m: true_position(r_j_m, j),
            span_rad: 0.0,
            pair_time: None,
        };
        placed.r_i_m.iter().zip(&placed.r_j_m).map(position).collect()
    }

    /// Predicts the sky of a channel at positions; zero without a sky.
    fn predict_sky(&mut self, channel: usize, positions: &[PairPosition]) -> Result<Predicted, ModelError> {
        let mut values = vec![Complex64::ZERO; positions.len()];
        let mut gradients =
            vec![[Complex64::ZERO; 3]; if self.solves_positions { positions.len() } else { 0 }];
        let gradient_factor_per_m = self.gradient_factor_per_m(channel);
        match self.sky.get_mut(channel) {
            Some(ChannelSky::Value(sum)) => sum.predict(positions, &mut values)?,
            Some(ChannelSky::Circle(sky)) => values = sky.predict(positions, &mut self.rotations)?,
            Some(ChannelSky::Gradient(sum)) => {
                for (k, [value, moments @ ..]) in sum.predict(positions)?.into_iter().enumerate() {
                    values[k] = value;
                    gradients[k] = moments.map(|moment| gradient_factor_per_m * moment);
                }
            }
            None => {}
        }
        Ok(Predicted { values, gradients })
    }

    /// Derivative of a fringe by a component of its baseline, divided by the fringe and that component of the
    /// direction, per m.
    fn gradient_factor_per_m(&self, channel: usize) -> Complex64 {
        Complex64::new(0.0, -TAU * self.frequencies_hz[channel] / SPEED_OF_LIGHT_M_S)
    }

    /// Model terms of a block. The artificial signal is added at `beacon_positions`, which are `None` while it is
    /// off.
    fn terms(
        &self,
        placed: &PlacedVisibilities,
        offsets: &Offsets,
        sky: Predicted,
        beacon_positions: Option<&Vec<PairPosition>>,
    ) -> Vec<ModelTerms> {
        let Predicted { mut values, mut gradients } = sky;
        let [i, j] = [placed.pair.i, placed.pair.j].map(usize::from);
        let channel = usize::from(placed.channel.0);
        let (from_hat, gradient_factor_per_m) =
            (self.beacon.source_hat(), self.gradient_factor_per_m(channel));
        for (k, position) in beacon_positions.into_iter().flatten().enumerate() {
            let hz = self.frequencies_hz[channel];
            let wave = self.beacon.visibility_k_sr(position.r_i_m, position.r_j_m, hz);
            values[k] += wave;
            if let Some(gradient) = gradients.get_mut(k) {
                (0..3).for_each(|axis| gradient[axis] += gradient_factor_per_m * from_hat[axis] * wave);
            }
        }
        let terms = |(k, &value): (usize, &Complex64)| {
            let mut terms = [Complex64::ZERO; MODEL_TERMS];
            terms[0] = value;
            let Some(gradient) = gradients.get(k) else { return terms };
            let along = |axis: Vec3| -> Complex64 { (0..3).map(|a| gradient[a] * axis[a]).sum() };
            // Packets report the true position plus the offset, which is subtracted from r_i and so from the
            // baseline.
            for (first, sign, r_m, n) in [(1, -1.0, placed.r_i_m[k], i), (4, 1.0, placed.r_j_m[k], j)] {
                let axes = track_axes(r_m, offsets.normal_hat[n]);
                for (axis, axis_hat) in axes.into_iter().enumerate() {
                    let term = sign * along(axis_hat);
                    terms[first + axis] = term;
                    terms[0] -= offsets.offset_m[n][axis] * term;
                }
            }
            terms
        };
        values.iter().enumerate().map(terms).collect()
    }
}
