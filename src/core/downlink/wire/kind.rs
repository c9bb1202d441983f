//! Kinds of packets and their application process identifiers.

use std::fmt;

use serde::Serialize;

/// Base of the APIDs: a kind has this plus its number. It lies among the 2040 APIDs that CCSDS leaves to missions.
pub const APID_BASE: u16 = 0x100;

/// Content of a packet. Each kind has its own APID and packet count.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, bincode::Encode, bincode::Decode,
)]
#[serde(rename_all = "lowercase")]
#[repr(u8)]
pub enum PacketKind {
    /// The instrument description, APID 0x101.
    Instrument = 1,
    /// Satellite positions, APID 0x102.
    Ephemeris = 2,
    /// Integrated visibilities, APID 0x103.
    Visibilities = 3,
    /// Calibration, APID 0x104: reserved. The ground counts such packets and skips them.
    Calibration = 4,
    /// Housekeeping: the spacecraft's counts, APID 0x105.
    Housekeeping = 5,
}

impl PacketKind {
    /// All kinds, in the order of their APIDs.
    pub const ALL: [Self; 5] =
        [Self::Instrument, Self::Ephemeris, Self::Visibilities, Self::Calibration, Self::Housekeeping];

    /// Application process identifier, 11 bits.
    #[must_use]
    pub fn apid(self) -> u16 {
        APID_BASE + self as u16
    }

    /// The kind of an APID.
    #[must_use]
    pub fn of_apid(apid: u16) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.apid() == apid)
    }

    /// Index in [`PacketKind::ALL`].
    #[must_use]
    pub fn index(self) -> usize {
        self as usize - 1
    }
}

impl fmt::Display for PacketKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Instrument => "instrument",
            Self::Ephemeris => "ephemeris",
            Self::Visibilities => "visibilities",
            Self::Calibration => "calibration",
            Self::Housekeeping => "housekeeping",
        })
    }
}
