//! Downlink files of visibilities that other programs made.

use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use lunarray::downlink::{DownlinkConfig, DownlinkWriter};
use lunarray::frames::{
    AntennaResponse, Channel, EphemerisSegment, Flags, GroundFrame, Housekeeping, Instrument, VisibilityBlock,
};
use lunarray::units::{ChannelId, MissionTime, Pair};
use num_complex::Complex32;
use numpy::{PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use serde::Deserialize;

use crate::error::{exception, refused};

/// What a file says of its instrument.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    name: String,
    epoch_tai_s: f64,
    moon_radius_m: f64,
    satellites: u8,
    channels_hz: Vec<f64>,
    widths_hz: Vec<f64>,
    antenna: String,
    noiseless: bool,
}

impl Description {
    fn instrument(self) -> PyResult<Instrument> {
        let responses =
            [AntennaResponse::Isotropic, AntennaResponse::DipoleNormal, AntennaResponse::ThreeDipoles];
        let response = responses.into_iter().find(|response| format!("{response:?}") == self.antenna);
        let channel = |(&frequency_hz, &width_hz): (&f64, &f64)| Channel { frequency_hz, width_hz };
        Ok(Instrument {
            name: self.name,
            epoch_tai_s: self.epoch_tai_s,
            moon_radius_m: self.moon_radius_m,
            satellites: self.satellites,
            channels: self.channels_hz.iter().zip(&self.widths_hz).map(channel).collect(),
            response: response.ok_or_else(|| {
                refused(format!("antenna = {:?}: expected one of {responses:?}", self.antenna))
            })?,
            seed: 0,
            configuration_hash: 0,
            spectrometer: None,
            noiseless: self.noiseless,
        })
    }
}

/// A downlink file in the making, written by parts of its time.
#[pyclass(frozen)]
pub(crate) struct NativeWriter(Mutex<Option<Unfinished>>);

struct Unfinished {
    writer: DownlinkWriter,
    satellites: u8,
    written: u64,
}

#[pymethods]
impl NativeWriter {
    #[new]
    fn new(path: PathBuf, description: &str) -> PyResult<Self> {
        let description: Description = serde_json::from_str(description).map_err(exception)?;
        let instrument = description.instrument()?;
        let satellites = instrument.satellites;
        let mut writer = DownlinkWriter::create(&path, &DownlinkConfig::default()).map_err(exception)?;
        writer.write(&GroundFrame::Instrument(instrument)).map_err(exception)?;
        Ok(Self(Mutex::new(Some(Unfinished { writer, satellites, written: 0 }))))
    }

    /// Appends a segment of positions (m, a row a node, three columns a satellite) and its visibilities: satellites from 0, sorted by
    /// channel, satellites and time.
    #[expect(clippy::too_many_arguments, reason = "the columns of a table")]
    fn write(
        &self,
        start_ticks: i64,
        step_ticks: u32,
        positions_m: PyReadonlyArray2<'_, f64>,
        channel: PyReadonlyArray1<'_, u16>,
        i: PyReadonlyArray1<'_, u8>,
        j: PyReadonlyArray1<'_, u8>,
        time_ticks: PyReadonlyArray1<'_, i64>,
        duration_ticks: PyReadonlyArray1<'_, u32>,
        value_k_sr: PyReadonlyArray1<'_, Complex32>,
        weight: PyReadonlyArray1<'_, f32>,
        flags: PyReadonlyArray1<'_, u8>,
    ) -> PyResult<()> {
        let rows = Rows {
            channel: channel.as_slice()?,
            i: i.as_slice()?,
            j: j.as_slice()?,
            time_ticks: time_ticks.as_slice()?,
            duration_ticks: duration_ticks.as_slice()?,
            value_k_sr: value_k_sr.as_slice()?,
            weight: weight.as_slice()?,
            flags: flags.as_slice()?,
        };
        let blocks = rows.blocks()?;
        let places: Vec<f64> = positions_m.as_array().iter().copied().collect();
        let (positions_m, rest) = places.as_chunks::<3>();
        if !rest.is_empty() {
            return Err(refused("positions: expected three columns a satellite".to_owned()));
        }
        let mut held = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let file = held.as_mut().ok_or_else(|| refused("the file is finished".to_owned()))?;
        let (start, satellites) = (MissionTime(start_ticks), file.satellites);
        let segment = EphemerisSegment { start, step_ticks, satellites, positions_m: positions_m.to_vec() };
        file.writer.write(&GroundFrame::Ephemeris(segment)).map_err(exception)?;
        for block in blocks {
            file.written += block.len() as u64;
            file.writer.write(&GroundFrame::Visibilities(block)).map_err(exception)?;
        }
        Ok(())
    }

    /// Ends the file, which is there under its name from then on.
    fn finish(&self) -> PyResult<()> {
        let mut held = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut file = held.take().ok_or_else(|| refused("the file is finished".to_owned()))?;
        let counts = Housekeeping { time: Housekeeping::FOREVER, sampled: file.written, dropped: 0 };
        file.writer.write(&GroundFrame::Housekeeping(counts)).map_err(exception)?;
        file.writer.finish().map(drop).map_err(exception)
    }
}

/// Columns of a table of visibilities.
struct Rows<'a> {
    channel: &'a [u16],
    i: &'a [u8],
    j: &'a [u8],
    time_ticks: &'a [i64],
    duration_ticks: &'a [u32],
    value_k_sr: &'a [Complex32],
    weight: &'a [f32],
    flags: &'a [u8],
}

impl Rows<'_> {
    /// Blocks of one channel and pair each, as long as offsets fit.
    fn blocks(&self) -> PyResult<Vec<VisibilityBlock>> {
        let count = self.channel.len();
        let lengths = [
            self.i.len(),
            self.j.len(),
            self.time_ticks.len(),
            self.duration_ticks.len(),
            self.value_k_sr.len(),
            self.weight.len(),
            self.flags.len(),
        ];
        if lengths.iter().any(|&length| length != count) {
            return Err(refused(format!("columns of {count} and {lengths:?} rows: expected equal lengths")));
        }
        let mut blocks: Vec<VisibilityBlock> = Vec::new();
        for k in 0..count {
            let (channel, pair) = (ChannelId(self.channel[k]), Pair { i: self.i[k], j: self.j[k] });
            let time = self.time_ticks[k];
            let offset = |block: &VisibilityBlock| {
                let is_same = block.channel == channel && block.pair == pair;
                u32::try_from(time.checked_sub(block.start.0)?).ok().filter(|_| is_same)
            };
            let (block, offset_ticks) = match blocks.last_mut() {
                Some(last) if offset(last).is_some() => {
                    let offset_ticks = offset(last).unwrap_or_default();
                    (last, offset_ticks)
                }
                _ => {
                    blocks.push(VisibilityBlock {
                        channel,
                        pair,
                        start: MissionTime(time),
                        ..Default::default()
                    });
                    let at = blocks.len() - 1;
                    (&mut blocks[at], 0)
                }
            };
            block.offset_ticks.push(offset_ticks);
            block.duration_ticks.push(self.duration_ticks[k]);
            block.value_k_sr.push(self.value_k_sr[k]);
            block.weight.push(self.weight[k]);
            block.flags.push(Flags(self.flags[k]));
        }
        Ok(blocks)
    }
}
