//! The instrument description: everything that the ground knows about the array except its ephemeris.

use bincode::de::Decoder;
use bincode::enc::Encoder;
use bincode::error::{DecodeError, EncodeError};
use bincode::{Decode, Encode};

use crate::units::{ChannelId, Pair};

/// One frequency channel.
#[derive(Clone, Copy, Debug, PartialEq, bincode::Encode, bincode::Decode)]
pub struct Channel {
    /// Centre frequency, Hz.
    pub frequency_hz: f64,
    /// Width, Hz.
    pub width_hz: f64,
}

/// Antenna power response A of a daughter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bincode::Encode, bincode::Decode)]
#[non_exhaustive]
pub enum AntennaResponse {
    /// A = 1, the paper's choice.
    #[default]
    Isotropic,
    /// A short dipole along the orbit normal: A = 1 - (n . w)^2, fixed in the body frame.
    DipoleNormal,
    /// Three orthogonal short dipoles, the first along the orbit normal, each with a receiver: the mean of the correlations of
    /// equal dipoles, times 3/2. A = 1 for satellites of one attitude.
    ThreeDipoles,
}

impl AntennaResponse {
    /// Number of receivers whose correlations are averaged.
    #[must_use]
    #[doc(hidden)]
    pub fn receivers(self) -> u8 {
        match self {
            Self::Isotropic | Self::DipoleNormal => 1,
            Self::ThreeDipoles => 3,
        }
    }

    /// Degree of the response of two such antennas as a polynomial in the direction, for any attitudes.
    #[must_use]
    #[doc(hidden)]
    pub fn degree(self) -> usize {
        match self {
            Self::Isotropic => 0,
            Self::DipoleNormal | Self::ThreeDipoles => 2,
        }
    }
}

/// A spectrometer: an additional satellite that measures the total power of the sky in adjacent channels.
#[derive(Clone, Copy, Debug, PartialEq, bincode::Encode, bincode::Decode)]
pub struct Spectrometer {
    /// Lowest frequency of the first channel, Hz.
    pub low_hz: f64,
    /// Width of each channel, Hz.
    pub width_hz: f64,
    /// Number of channels.
    pub channels: u16,
}

impl Spectrometer {
    /// The channel with index `k`.
    #[must_use]
    pub fn channel(&self, k: u16) -> Channel {
        Channel { frequency_hz: self.low_hz + (f64::from(k) + 0.5) * self.width_hz, width_hz: self.width_hz }
    }

    /// All channels.
    pub fn channels(&self) -> impl Iterator<Item = Channel> {
        (0..self.channels).map(|k| self.channel(k))
    }
}

/// The instrument description at the start of a downlink.
#[derive(Clone, Debug, PartialEq)]
pub struct Instrument {
    /// Name of the pipeline or mission.
    pub name: String,
    /// Mission epoch: TAI seconds since 1958-01-01, the CCSDS epoch.
    pub epoch_tai_s: f64,
    /// Radius of the body that occults the sky, m.
    pub moon_radius_m: f64,
    /// Number of daughters.
    pub satellites: u8,
    /// Channels in the order of their [`crate::units::ChannelId`].
    pub channels: Vec<Channel>,
    /// Antenna response of every daughter.
    pub response: AntennaResponse,
    /// Seed of a simulation; 0 for real data.
    pub seed: u64,
    /// Hash of the space segment's configuration; 0 for real data.
    pub configuration_hash: u64,
    /// The spectrometer, if there is one. It has the satellite number and the channel numbers that follow the last ones.
    pub spectrometer: Option<Spectrometer>,
    /// Whether the data are simulated without thermal noise.
    pub noiseless: bool,
}

/// Bit of the code of an antenna response that means a simulation without thermal noise.
const NOISELESS: u8 = 128;

impl Instrument {
    /// Code of the antenna response in packets and states: 0 (isotropic), 1 (dipole) or 2 (three dipoles), plus 128 for a
    /// simulation without thermal noise.
    #[must_use]
    #[doc(hidden)]
    pub fn response_code(&self) -> u8 {
        let response = match self.response {
            AntennaResponse::Isotropic => 0,
            AntennaResponse::DipoleNormal => 1,
            AntennaResponse::ThreeDipoles => 2,
        };
        response | if self.noiseless { NOISELESS } else { 0 }
    }

    /// Decodes [`Instrument::response_code`]: the antenna response, and whether there is no thermal noise. `None` for an unknown
    /// code.
    #[must_use]
    #[doc(hidden)]
    pub fn decode_response(code: u8) -> Option<(AntennaResponse, bool)> {
        let response = match code & !NOISELESS {
            0 => AntennaResponse::Isotropic,
            1 => AntennaResponse::DipoleNormal,
            2 => AntennaResponse::ThreeDipoles,
            _ => return None,
        };
        Some((response, code & NOISELESS != 0))
    }

    /// Centre frequencies of the channels, Hz.
    #[must_use]
    pub fn frequencies_hz(&self) -> Vec<f64> {
        self.channels.iter().map(|channel| channel.frequency_hz).collect()
    }

    /// The channel of a pair; `None` if the pair has no such channel.
    #[must_use]
    #[doc(hidden)]
    pub fn channel_of(&self, channel: ChannelId, pair: Pair) -> Option<Channel> {
        let index = usize::from(channel.0);
        if !self.is_spectrum(pair) {
            let is_of_daughters = pair.i.max(pair.j) < self.satellites;
            return self.channels.get(index).copied().filter(|_| is_of_daughters);
        }
        let spectrometer = self.spectrometer.as_ref()?;
        let k = u16::try_from(index.checked_sub(self.channels.len())?).ok()?;
        (k < spectrometer.channels).then(|| spectrometer.channel(k))
    }

    /// Whether `pair` is the auto-correlation of the spectrometer.
    #[must_use]
    #[doc(hidden)]
    pub fn is_spectrum(&self, pair: Pair) -> bool {
        self.spectrometer.is_some() && (pair.i, pair.j) == (self.satellites, self.satellites)
    }
}

impl Encode for Instrument {
    fn encode<E: Encoder>(&self, out: &mut E) -> Result<(), EncodeError> {
        let Self { name, epoch_tai_s, moon_radius_m, satellites, channels, .. } = self;
        (name, epoch_tai_s, moon_radius_m, satellites, channels).encode(out)?;
        (self.response_code(), self.seed, self.configuration_hash, &self.spectrometer).encode(out)
    }
}

impl<C> Decode<C> for Instrument {
    fn decode<D: Decoder<Context = C>>(from: &mut D) -> Result<Self, DecodeError> {
        let (name, epoch_tai_s, moon_radius_m, satellites, channels) = Decode::decode(from)?;
        let (code, seed, configuration_hash, spectrometer) = Decode::decode(from)?;
        let (response, noiseless) =
            Self::decode_response(code).ok_or(DecodeError::Other("an unknown antenna response"))?;
        Ok(Self {
            name,
            epoch_tai_s,
            moon_radius_m,
            satellites,
            channels,
            response,
            seed,
            configuration_hash,
            spectrometer,
            noiseless,
        })
    }
}

bincode::impl_borrow_decode!(Instrument);
