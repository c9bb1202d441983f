//! The visibilities of a downlink file as a table, for analysis with other programs.

use std::io::{self, BufWriter, Write};
use std::path::Path;

use num_complex::Complex32;
use rayon::prelude::*;

use super::error::ProductsError;
use crate::array::Ephemeris;
use crate::downlink::{DownlinkError, DownlinkReader};
use crate::files::{AtomicFile, IfUnfinished};
use crate::frames::{Flags, GroundFrame, Instrument, VisibilityBlock};
use crate::runtime::Cancel;
use crate::units::constants::{BOLTZMANN_J_K, SPEED_OF_LIGHT_M_S};
use crate::units::vector::{Vec3, sub};
use crate::units::{ChannelId, Pair};

/// Maximum number of ephemeris segments, enough for two years of windows.
const SEGMENTS_MAX: usize = 8192;

const CSV_HEADER: &str = "time_s,tai_s,dt_s,i,j,u_m,v_m,w_m,x_i_m,y_i_m,z_i_m,x_j_m,y_j_m,z_j_m,re_k_sr,im_k_sr,re_jy,im_jy,weight,flag";

const JANSKY: f64 = 1e-26;

/// Converts visibilities from K sr to Jy: `2 k nu^2 / c^2`, for both polarisations.
#[must_use]
pub fn jansky_per_k_sr(frequency_hz: f64) -> f64 {
    2.0 * BOLTZMANN_J_K * (frequency_hz / SPEED_OF_LIGHT_M_S).powi(2) / JANSKY
}

/// One visibility as received, not calibrated, with the positions of its satellites.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VisibilityRow {
    /// Midpoint of the integration, half microseconds since the mission epoch, which is exact.
    pub middle_half_us: i64,
    /// Length of the integration, us.
    pub duration_us: u32,
    /// Pair of satellites, twice the same for an auto-correlation.
    pub pair: Pair,
    /// Positions of both satellites at the midpoint, m, Moon-centred ecliptic axes; `None` if the downlink has none.
    pub positions_m: Option<[Vec3; 2]>,
    /// Value of the visibility, K sr.
    pub value_k_sr: Complex32,
    /// Inverse variance of the real part, (K sr)^-2.
    pub weight: f32,
    /// Flags of the visibility.
    pub flags: Flags,
}

/// The contents of a downlink file in memory, with 21 bytes per visibility.
#[derive(Clone, Debug)]
pub struct VisibilityTable {
    instrument: Instrument,
    ephemeris: Ephemeris,
    blocks: Vec<VisibilityBlock>,
}

impl VisibilityTable {
    /// Reads a downlink file of any format. Damaged parts are skipped; `lunarray inspect` counts them.
    ///
    /// # Errors
    /// A file that cannot be read or has no description of the instrument; cancellation.
    pub fn read(path: &Path, cancel: &Cancel) -> Result<Self, ProductsError> {
        let failed = |error: DownlinkError| ProductsError::Downlink { source: Box::new(error) };
        let mut reader = DownlinkReader::open(path).map_err(failed)?;
        let (mut described, mut ephemeris, mut blocks) = (None, Ephemeris::new(SEGMENTS_MAX), Vec::new());
        while let Some(frame) = reader.next_frame().map_err(failed)? {
            match frame {
                GroundFrame::Instrument(instrument) => described = Some(instrument),
                GroundFrame::Ephemeris(segment) => {
                    ephemeris.insert(segment);
                }
                GroundFrame::Visibilities(block) => blocks.push(block),
                GroundFrame::Housekeeping(_) => {}
            }
            if cancel.is_cancelled() {
                return Err(ProductsError::Interrupted { path: path.to_owned() });
            }
        }
        let instrument = described.ok_or_else(|| ProductsError::NoInstrument { path: path.to_owned() })?;
        Ok(Self { instrument, ephemeris, blocks })
    }

    /// The description of the instrument.
    #[must_use]
    pub fn instrument(&self) -> &Instrument {
        &self.instrument
    }

    /// The ephemeris of the satellites.
    #[must_use]
    pub fn ephemeris(&self) -> &Ephemeris {
        &self.ephemeris
    }

    /// Cross-correlations of one channel, in the order of the file.
    #[must_use]
    pub fn visibilities(&self, channel: ChannelId) -> Vec<VisibilityRow> {
        self.rows(|block| block.channel == channel && block.pair.i != block.pair.j)
            .into_iter()
            .map(|(_, row)| row)
            .collect()
    }

    /// Auto-correlations of all channels, each with its channel.
    #[must_use]
    pub fn autos(&self) -> Vec<(ChannelId, VisibilityRow)> {
        self.rows(|block| block.pair.i == block.pair.j)
    }

    /// Writes the visibilities of one channel as a CSV table with one line each, and returns their number.
    ///
    /// Times are in s since the mission epoch and in TAI s since 1958. Satellites are counted from 1. u, v, w is the baseline
    /// r_i - r_j, and x, y, z are positions, m, on Moon-centred ecliptic axes; they are empty if the downlink has none.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write_csv(&self, channel: ChannelId, path: &Path) -> Result<usize, ProductsError> {
        let failed = |source| ProductsError::Write { path: path.to_owned(), source };
        let file = AtomicFile::create(path, IfUnfinished::Remove).map_err(failed)?;
        let mut out = BufWriter::new(file);
        let rows = self.write_csv_to(channel, &mut out).map_err(failed)?;
        let file = out.into_inner().map_err(|error| failed(error.into_error()))?;
        file.finish().map_err(failed)?;
        Ok(rows)
    }

    /// Like [`Self::write_csv`], to any writer.
    ///
    /// # Errors
    /// Errors of `out`.
    pub fn write_csv_to(&self, channel: ChannelId, out: &mut impl Write) -> io::Result<usize> {
        let frequency_hz =
            self.instrument.channels.get(usize::from(channel.0)).map_or(f64::NAN, |c| c.frequency_hz);
        let rows = self.visibilities(channel);
        writeln!(out, "{CSV_HEADER}")?;
        for row in &rows {
            self.write_line(out, row, jansky_per_k_sr(frequency_hz))?;
        }
        Ok(rows.len())
    }

    fn write_line(&self, out: &mut impl Write, row: &VisibilityRow, jansky_per_k_sr: f64) -> io::Result<()> {
        let time_s = row.middle_half_us as f64 * 0.5e-6;
        let tai_s = self.instrument.epoch_tai_s + time_s;
        let dt_s = f64::from(row.duration_us) * 1e-6;
        write!(out, "{time_s:.7},{tai_s:.6},{dt_s:.6},{},{}", row.pair.i + 1, row.pair.j + 1)?;
        match row.positions_m {
            Some([r_i_m, r_j_m]) => {
                for value in [sub(r_i_m, r_j_m), r_i_m, r_j_m].into_iter().flatten() {
                    write!(out, ",{value}")?;
                }
            }
            None => write!(out, ",,,,,,,,,")?,
        }
        let Complex32 { re, im } = row.value_k_sr;
        let jansky = |part: f32| f64::from(part) * jansky_per_k_sr;
        writeln!(out, ",{re},{im},{},{},{},{}", jansky(re), jansky(im), row.weight, row.flags.0)
    }

    fn rows(&self, is_wanted: impl Fn(&VisibilityBlock) -> bool) -> Vec<(ChannelId, VisibilityRow)> {
        let wanted: Vec<&VisibilityBlock> = self.blocks.iter().filter(|block| is_wanted(block)).collect();
        let rows = |block: &&VisibilityBlock| {
            let channel = block.channel;
            self.rows_of(block).into_iter().map(move |row| (channel, row))
        };
        wanted.par_iter().flat_map_iter(rows).collect()
    }

    /// The rows of a block. Flagged visibilities get positions as well.
    fn rows_of(&self, block: &VisibilityBlock) -> Vec<VisibilityRow> {
        let all = VisibilityBlock { flags: vec![Flags::GOOD; block.len()], ..block.clone() };
        let (placed, _) = self.ephemeris.place(&all, 0.0);
        // Positions of the visibilities that have some, in the order of the block.
        let mut positions = placed.time_s.iter().zip(placed.r_i_m.iter().zip(&placed.r_j_m)).peekable();
        let row = |k: usize| {
            let (offset, duration_us) = (i64::from(block.offset_ticks[k]), block.duration_ticks[k]);
            let middle_half_us = 2 * block.start.plus_ticks(offset).0 + i64::from(duration_us);
            let time_s = middle_half_us as f64 / 2e6;
            let position = positions.next_if(|(placed_s, _)| **placed_s == time_s);
            VisibilityRow {
                middle_half_us,
                duration_us,
                pair: block.pair,
                positions_m: position.map(|(_, (r_i_m, r_j_m))| [*r_i_m, *r_j_m]),
                value_k_sr: block.value_k_sr[k],
                weight: block.weight[k],
                flags: block.flags[k],
            }
        };
        (0..block.len()).map(row).collect()
    }
}
