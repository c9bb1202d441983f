//! The instrument description.
//!
//! Record: `name` (u64 length, UTF-8), `epoch_tai_s` f64, `moon_radius_m` f64, `satellites` u8, `response` u8,
//! `seed` u64, `configuration_hash` u64, `channels` u16. Arrays: `frequency_hz` and `width_hz`, f64, one pair a channel.

use bincode::{Decode, Encode};

use super::arrays::{Arrays, put_f64};
use super::{PayloadFault, put_record, require, require_length, take_record};
use crate::frames::{AntennaResponse, Channel, Instrument};
use crate::units::MAX_SATELLITES;

const NAME_BYTES_MAX: usize = 256;
/// The whole band in channels of 8 kHz is 3738 of them.
const CHANNELS_MAX: usize = 4096;
/// The band of the mission, Hz.
const FREQUENCY_HZ: std::ops::RangeInclusive<f64> = 0.1e6..=30e6;

#[derive(Encode, Decode)]
struct Record {
    name: String,
    epoch_tai_s: f64,
    moon_radius_m: f64,
    satellites: u8,
    response: u8,
    seed: u64,
    configuration_hash: u64,
    channels: u16,
}

pub(in crate::downlink) fn encode(instrument: &Instrument, out: &mut Vec<u8>) -> Result<(), PayloadFault> {
    check(instrument)?;
    let record = Record {
        name: instrument.name.clone(),
        epoch_tai_s: instrument.epoch_tai_s,
        moon_radius_m: instrument.moon_radius_m,
        satellites: instrument.satellites,
        response: match instrument.response {
            AntennaResponse::Isotropic => 0,
            AntennaResponse::DipoleNormal => 1,
        },
        seed: instrument.seed,
        configuration_hash: instrument.configuration_hash,
        channels: instrument.channels.len() as u16,
    };
    put_record("instrument", record, out)?;
    for channel in &instrument.channels {
        put_f64([channel.frequency_hz, channel.width_hz].iter(), out);
    }
    Ok(())
}

pub(in crate::downlink) fn decode(bytes: &[u8]) -> Result<Instrument, PayloadFault> {
    let (record, rest) = take_record::<Record>("instrument", bytes)?;
    let channels = usize::from(record.channels);
    require_length("instrument channels", 16 * channels, rest.len())?;
    let mut arrays = Arrays(rest);
    let mut numbers = arrays.f64(2 * channels);
    let channel = |_| Some(Channel { frequency_hz: numbers.next()?, width_hz: numbers.next()? });
    let instrument = Instrument {
        name: record.name,
        epoch_tai_s: record.epoch_tai_s,
        moon_radius_m: record.moon_radius_m,
        satellites: record.satellites,
        channels: (0..channels).map_while(channel).collect(),
        response: match record.response {
            0 => AntennaResponse::Isotropic,
            1 => AntennaResponse::DipoleNormal,
            other => {
                require(false, "antenna response", f64::from(other), "0 (isotropic) or 1 (dipole)")?;
                AntennaResponse::Isotropic
            }
        },
        seed: record.seed,
        configuration_hash: record.configuration_hash,
    };
    check(&instrument)?;
    Ok(instrument)
}

fn check(instrument: &Instrument) -> Result<(), PayloadFault> {
    let Instrument { epoch_tai_s, moon_radius_m, satellites, .. } = *instrument;
    let (name, channels) = (instrument.name.len(), instrument.channels.len());
    require(name <= NAME_BYTES_MAX, "instrument name (bytes)", name as f64, "at most 256")?;
    require(
        (0.0..f64::from(u32::MAX)).contains(&epoch_tai_s),
        "epoch_tai_s",
        epoch_tai_s,
        "TAI seconds since 1958, before 2094",
    )?;
    require((1e3..=1e8).contains(&moon_radius_m), "moon_radius_m", moon_radius_m, "1e3 to 1e8 m")?;
    let daughters = (2..=MAX_SATELLITES).contains(&usize::from(satellites));
    require(daughters, "satellites", f64::from(satellites), "2 to 64")?;
    require((1..=CHANNELS_MAX).contains(&channels), "channels", channels as f64, "1 to 4096")?;
    for channel in &instrument.channels {
        let Channel { frequency_hz, width_hz } = *channel;
        require(FREQUENCY_HZ.contains(&frequency_hz), "frequency_hz", frequency_hz, "0.1e6 to 30e6")?;
        let narrow = width_hz > 0.0 && width_hz < 2.0 * frequency_hz;
        require(narrow, "width_hz", width_hz, "positive, less than twice the frequency")?;
    }
    Ok(())
}
