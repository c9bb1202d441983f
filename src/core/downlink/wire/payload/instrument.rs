//! The instrument description.
//!
//! Record: `name` (u64 length, UTF-8), `epoch_tai_s` f64, `moon_radius_m` f64, `satellites` u8, `response` u8 (plus 128 for
//! a simulation without thermal noise), `seed` u64, `configuration_hash` u64, `channels` u16. Array: `frequency_hz` and
//! `width_hz`, f64, for each channel. A spectrometer adds three f64: its lowest frequency and the width of its channels
//! (Hz), and their number.

use bincode::{Decode, Encode};

use super::arrays::{Arrays, put_f64};
use super::{PayloadFault, put_record, require, require_length, take_record};
use crate::frames::{Channel, Instrument, Spectrometer};
use crate::units::MAX_SATELLITES;

const NAME_BYTES_MAX: usize = 256;
/// Maximum number of channels; the whole band has 3738 channels of 8 kHz.
const CHANNELS_MAX: usize = 4096;
/// Bytes of the spectrometer's numbers, which follow the channels.
const SPECTROMETER_BYTES: usize = 24;
const SPECTRUM_HZ: std::ops::RangeInclusive<f64> = 0.1e6..=1e9;
/// The band of the mission, Hz.
const FREQUENCY_HZ: std::ops::RangeInclusive<f64> = 0.1e6..=30e6;

#[derive(Encode, Decode)]
struct InstrumentRecord {
    name: String,
    epoch_tai_s: f64,
    moon_radius_m: f64,
    satellites: u8,
    response: u8,
    seed: u64,
    configuration_hash: u64,
    channels: u16,
}

pub(crate) fn encode(instrument: &Instrument, out: &mut Vec<u8>) -> Result<(), PayloadFault> {
    check(instrument)?;
    let record = InstrumentRecord {
        name: instrument.name.clone(),
        epoch_tai_s: instrument.epoch_tai_s,
        moon_radius_m: instrument.moon_radius_m,
        satellites: instrument.satellites,
        response: instrument.response_code(),
        seed: instrument.seed,
        configuration_hash: instrument.configuration_hash,
        channels: instrument.channels.len() as u16,
    };
    put_record("instrument", record, out)?;
    for channel in &instrument.channels {
        put_f64([channel.frequency_hz, channel.width_hz].iter(), out);
    }
    if let Some(Spectrometer { low_hz, width_hz, channels }) = instrument.spectrometer {
        put_f64([low_hz, width_hz, f64::from(channels)].iter(), out);
    }
    Ok(())
}

pub(crate) fn decode(bytes: &[u8]) -> Result<Instrument, PayloadFault> {
    let (record, rest) = take_record::<InstrumentRecord>("instrument", bytes)?;
    let channels = usize::from(record.channels);
    let has_spectrometer = rest.len() == 16 * channels + SPECTROMETER_BYTES;
    let spectrometer_bytes = if has_spectrometer { SPECTROMETER_BYTES } else { 0 };
    require_length("instrument channels", 16 * channels + spectrometer_bytes, rest.len())?;
    let mut arrays = Arrays(rest);
    let mut numbers = arrays.f64(2 * channels + spectrometer_bytes / 8);
    let channel = |_| Some(Channel { frequency_hz: numbers.next()?, width_hz: numbers.next()? });
    let channels: Vec<Channel> = (0..channels).map_while(channel).collect();
    let spectrometer = match [numbers.next(), numbers.next(), numbers.next()] {
        [Some(low_hz), Some(width_hz), Some(channels)] => {
            let is_count = channels.fract() == 0.0 && (1.0..=CHANNELS_MAX as f64).contains(&channels);
            require(is_count, "channels of the spectrometer", channels, "1 to 4096")?;
            Some(Spectrometer { low_hz, width_hz, channels: channels as u16 })
        }
        _ => None,
    };
    let code = record.response;
    let decoded = Instrument::decode_response(code);
    let expected = "0 (isotropic) or 1 (dipole), plus 128 without thermal noise";
    require(decoded.is_some(), "antenna response", f64::from(code), expected)?;
    let (response, noiseless) = decoded.unwrap_or_default();
    let instrument = Instrument {
        name: record.name,
        epoch_tai_s: record.epoch_tai_s,
        moon_radius_m: record.moon_radius_m,
        satellites: record.satellites,
        channels,
        response,
        seed: record.seed,
        configuration_hash: record.configuration_hash,
        spectrometer,
        noiseless,
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
    let is_array = (2..=MAX_SATELLITES).contains(&usize::from(satellites));
    require(is_array, "satellites", f64::from(satellites), "2 to 64")?;
    require((1..=CHANNELS_MAX).contains(&channels), "channels", channels as f64, "1 to 4096")?;
    for channel in &instrument.channels {
        let Channel { frequency_hz, width_hz } = *channel;
        require(FREQUENCY_HZ.contains(&frequency_hz), "frequency_hz", frequency_hz, "0.1e6 to 30e6")?;
        let is_narrow = width_hz > 0.0 && width_hz < 2.0 * frequency_hz;
        require(is_narrow, "width_hz", width_hz, "positive, less than twice the frequency")?;
    }
    instrument.spectrometer.map_or(Ok(()), |spectrometer| check_spectrometer(spectrometer, channels))
}

fn check_spectrometer(spectrometer: Spectrometer, array_channels: usize) -> Result<(), PayloadFault> {
    let Spectrometer { low_hz, width_hz, channels } = spectrometer;
    let total = array_channels + usize::from(channels);
    require(
        channels > 0 && total <= CHANNELS_MAX,
        "channels with the spectrometer's",
        total as f64,
        "up to 4096",
    )?;
    require(SPECTRUM_HZ.contains(&low_hz), "spectrometer's low_hz", low_hz, "0.1e6 to 1e9")?;
    let high_hz = low_hz + width_hz * f64::from(channels);
    let fits = width_hz > 0.0 && SPECTRUM_HZ.contains(&high_hz);
    require(fits, "spectrometer's width_hz", width_hz, "positive, with all channels below 1e9 Hz")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::AntennaResponse;

    #[test]
    fn a_spectrometer_is_encoded_and_a_bad_one_is_refused() {
        let spectrometer = Some(Spectrometer { low_hz: 30e6, width_hz: 1e6, channels: 90 });
        let instrument = Instrument {
            name: "nine".to_owned(),
            epoch_tai_s: 1e9,
            moon_radius_m: 1.7e6,
            satellites: 8,
            channels: vec![Channel { frequency_hz: 1e6, width_hz: 8e3 }; 3],
            response: AntennaResponse::Isotropic,
            seed: 1,
            configuration_hash: 2,
            spectrometer,
            noiseless: false,
        };
        let mut bytes = Vec::new();
        encode(&instrument, &mut bytes).unwrap();
        assert_eq!(decode(&bytes).unwrap(), instrument);
        let quiet = Instrument { noiseless: true, ..instrument.clone() };
        let mut quiet_bytes = Vec::new();
        encode(&quiet, &mut quiet_bytes).unwrap();
        assert_eq!(decode(&quiet_bytes).unwrap(), quiet);
        // Without the last three numbers, the description has no spectrometer.
        let plain = Instrument { spectrometer: None, ..instrument.clone() };
        assert_eq!(decode(&bytes[..bytes.len() - SPECTROMETER_BYTES]).unwrap(), plain);
        assert!(decode(&bytes[..bytes.len() - 8]).is_err());
        let at = bytes.len() - SPECTROMETER_BYTES;
        for (place, value) in [
            (0, f64::NAN),
            (0, 0.0),
            (1, -1.0),
            (1, f64::INFINITY),
            (2, 0.5),
            (2, 0.0),
            (2, 4094.0),
            (2, 1e300),
        ] {
            let mut bad = bytes.clone();
            bad[at + 8 * place..][..8].copy_from_slice(&value.to_le_bytes());
            assert!(decode(&bad).is_err(), "{place} {value}");
        }
    }
}
