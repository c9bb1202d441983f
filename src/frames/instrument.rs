//! The instrument description: all that the ground knows of the array besides its ephemeris.

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
}

/// What the spacecraft says of itself at the start of a downlink.
#[derive(Clone, Debug, PartialEq, bincode::Encode, bincode::Decode)]
pub struct Instrument {
    /// Name of the pipeline or mission.
    pub name: String,
    /// Mission epoch: TAI seconds since 1958-01-01, the CCSDS epoch.
    pub epoch_tai_s: f64,
    /// Radius of the body that hides the sky, m.
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
}
