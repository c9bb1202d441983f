//! Combines the sub-bands of a channel.

use super::{Calibration, CalibrationError, CalibrationReport};
use crate::array::scaled_baseline;
use crate::frames::{Channel, Instrument, PlacedVisibilities};
use crate::units::ChannelId;

/// Calibration that combines successive channels of the downlink into one, after another calibration.
///
/// A visibility depends on the baseline in wavelengths: at frequency nu_k and baseline b it equals the visibility at
/// the channel's centre nu with baseline b nu_k / nu. The two positions are moved on their circle about the Moon
/// until the chord has that length. This displaces the Moon's limb by half the change of the baseline, at most `|b| W
/// / (4 nu r)` for a channel of width W: 1e-5 rad for 100 km at 10 MHz, 5e-4 rad at 0.2 MHz.
pub struct SubBands {
    inner: Box<dyn Calibration>,
    count: usize,
    /// Combined channels.
    channels: Vec<Channel>,
}

impl SubBands {
    /// Combines each `count` (at least 1) channels that `inner` has calibrated into one.
    #[must_use]
    pub fn new(inner: Box<dyn Calibration>, count: usize) -> Self {
        Self { inner, count: count.max(1), channels: Vec::new() }
    }
}

impl Calibration for SubBands {
    fn name(&self) -> &'static str {
        self.inner.name()
    }

    fn describe(&mut self, instrument: &Instrument) -> Result<Instrument, CalibrationError> {
        let instrument = self.inner.describe(instrument)?;
        let channels = &instrument.channels;
        let combined = |bands: &[Channel]| {
            let count = bands.len() as f64;
            let frequency_hz = bands.iter().map(|band| band.frequency_hz).sum::<f64>() / count;
            Channel { frequency_hz, width_hz: bands.iter().map(|band| band.width_hz).sum() }
        };
        let are_adjoining = |bands: &[Channel]| {
            let step_hz = |k: usize| bands[k].frequency_hz - bands[k - 1].frequency_hz;
            (1..bands.len()).all(|k| (step_hz(k) / bands[k].width_hz - 1.0).abs() < 1e-3)
        };
        let is_divisible =
            channels.len().is_multiple_of(self.count) && channels.chunks(self.count).all(are_adjoining);
        if !is_divisible {
            return Err(CalibrationError::SubBands { sub_bands: self.count, channels: channels.len() });
        }
        self.channels = channels.chunks(self.count).map(combined).collect();
        Ok(Instrument { channels: self.channels.clone(), ..instrument })
    }

    fn apply(&mut self, block: &mut PlacedVisibilities) -> Result<CalibrationReport, CalibrationError> {
        let report = self.inner.apply(block)?;
        if block.pair.i == block.pair.j {
            // Auto-correlations keep their sub-bands, as a spectrum.
            return Ok(report);
        }
        let index = usize::from(block.channel.0) / self.count;
        let Some(channel) = self.channels.get(index) else {
            return Err(CalibrationError::SubBands { sub_bands: self.count, channels: self.channels.len() });
        };
        let factor = block.frequency_hz / channel.frequency_hz;
        for (r_i_m, r_j_m) in block.r_i_m.iter_mut().zip(&mut block.r_j_m) {
            (*r_i_m, *r_j_m) = scaled_baseline(*r_i_m, *r_j_m, factor);
        }
        block.band = block.channel.0 % self.count as u16;
        block.channel = ChannelId(index as u16);
        block.frequency_hz = channel.frequency_hz;
        Ok(report)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::Identity;
    use crate::frames::AntennaResponse;
    use crate::units::Pair;
    use crate::units::vector::{dot, norm, scale, sub};

    fn instrument(channels: &[[f64; 2]]) -> Instrument {
        Instrument {
            name: String::new(),
            epoch_tai_s: 0.0,
            moon_radius_m: 1.7371e6,
            satellites: 8,
            channels: channels
                .iter()
                .map(|&[frequency_hz, width_hz]| Channel { frequency_hz, width_hz })
                .collect(),
            response: AntennaResponse::Isotropic,
            seed: 0,
            configuration_hash: 0,
            spectrometer: None,
            noiseless: false,
        }
    }

    #[test]
    fn moved_positions_have_the_fringes_of_the_sub_band() {
        let mut bands = SubBands::new(Box::new(Identity), 2);
        let combined =
            bands.describe(&instrument(&[[9e5, 2e5], [1.1e6, 2e5], [1.9e6, 2e5], [2.1e6, 2e5]])).unwrap();
        let expected = [(1e6, 4e5), (2e6, 4e5)];
        for (channel, (frequency_hz, width_hz)) in combined.channels.iter().zip(expected) {
            assert!((channel.frequency_hz - frequency_hz).abs() < 1e-6);
            assert!((channel.width_hz - width_hz).abs() < 1e-6);
        }
        // 60 km apart on a circle of 2037.1 km.
        let radius_m = 2.0371e6;
        let at = |angle: f64| scale(radius_m, [angle.cos(), 0.8 * angle.sin(), 0.6 * angle.sin()]);
        let (r_i_m, r_j_m) = (at(1.0), at(1.03));
        for (channel, frequency_hz) in [(2, 1.9e6), (3, 2.1e6)] {
            let mut block = PlacedVisibilities {
                channel: ChannelId(channel),
                band: 0,
                frequency_hz,
                pair: Pair { i: 0, j: 1 },
                time_s: vec![0.0],
                r_i_m: vec![r_i_m],
                r_j_m: vec![r_j_m],
                value_k_sr: vec![num_complex::Complex64::ONE],
                weight: vec![1.0],
                duration_s: Vec::new(),
                gain_errors: Vec::new(),
            };
            assert_eq!(bands.apply(&mut block).unwrap().kept, 1);
            assert_eq!(
                (block.channel, block.frequency_hz),
                (ChannelId(1), combined.channels[1].frequency_hz)
            );
            assert_eq!(block.band, channel - 2);
            // Any direction has the same phase; rounding of 2e6 m leaves some 1e-9 m.
            for n_hat in [[1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.6, 0.48, 0.64]] {
                let path_m = |r_i_m, r_j_m| dot(n_hat, sub(r_i_m, r_j_m));
                let found = path_m(block.r_i_m[0], block.r_j_m[0]) * block.frequency_hz;
                let expected = path_m(r_i_m, r_j_m) * frequency_hz;
                assert!((found - expected).abs() < 1e-7 * frequency_hz, "{n_hat:?}: {found} {expected}");
            }
            for r_m in [block.r_i_m[0], block.r_j_m[0]] {
                assert!((norm(r_m) - radius_m).abs() < 1e-7);
            }
        }
    }

    #[test]
    fn channels_that_do_not_adjoin_are_refused() {
        for channels in [&[[1e6, 4e3], [1.004e6, 4e3], [1.008e6, 4e3]][..], &[[1e6, 4e3], [1.005e6, 4e3]]] {
            let mut bands = SubBands::new(Box::new(Identity), 2);
            let refused = bands.describe(&instrument(channels));
            assert!(matches!(refused, Err(CalibrationError::SubBands { sub_bands: 2, .. })));
        }
    }
}
