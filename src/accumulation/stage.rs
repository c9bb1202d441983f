//! The ground stage that sums normal equations, channel by channel.

use std::sync::Arc;

use super::{AccumulationError, MapConfig, NormalEngine, PixelEngine, PixelSetup, PixelSums};
use crate::frames::{Channel, Instrument, PlacedFrame, PlacedVisibilities};
use crate::runtime::{Ledger, Outlet, Stage, Units};
use crate::units::ChannelId;
use crate::units::vector::{norm, sub};

/// The sums of one channel at a moment, for solving on the side.
pub struct Snapshot {
    /// Instrument.
    pub instrument: Arc<Instrument>,
    /// Channel.
    pub channel: ChannelId,
    /// Number of the snapshot in its channel, from 1.
    pub number: u32,
    /// Whether all data is in it.
    pub is_final: bool,
    /// First and last mission time of the data in it, s.
    pub span_s: [f64; 2],
    /// The sums.
    pub sums: PixelSums,
}

/// One channel's engine and what it holds.
struct ChannelSums {
    engine: PixelEngine,
    span_s: [f64; 2],
    snapshots: u32,
}

/// Sums what calibration hands on; emits snapshots at equal steps of mission time, and a last one.
pub struct Accumulator {
    config: MapConfig,
    ledger: Ledger,
    instrument: Option<Arc<Instrument>>,
    channels: Vec<Option<ChannelSums>>,
    next_snapshot_s: Option<f64>,
    accumulated: u64,
}

impl Accumulator {
    /// A stage that posts to `ledger`.
    #[must_use]
    pub fn new(config: MapConfig, ledger: Ledger) -> Self {
        Self { config, ledger, instrument: None, channels: Vec::new(), next_snapshot_s: None, accumulated: 0 }
    }

    fn open(&mut self, instrument: Instrument) -> Result<(), AccumulationError> {
        let channels = instrument.channels.len();
        if let Some(&key) = self.config.misfits(channels).first() {
            return Err(AccumulationError::Misfit { key, channels });
        }
        self.channels = (0..channels).map(|_| None).collect();
        self.instrument = Some(Arc::new(instrument));
        Ok(())
    }

    fn sums(&mut self, channel: ChannelId) -> Result<&mut ChannelSums, AccumulationError> {
        let index = usize::from(channel.0);
        let unknown = || AccumulationError::UnknownChannel(channel);
        let instrument = self.instrument.as_ref().ok_or_else(unknown)?;
        let slot = self.channels.get_mut(index).ok_or_else(unknown)?;
        if slot.is_none() {
            let Channel { frequency_hz, .. } = instrument.channels[index];
            let engine = PixelEngine::new(PixelSetup {
                nside: self.config.nside,
                frequency_hz,
                method: self.config.rows,
                moon_radius_m: instrument.moon_radius_m,
                response: instrument.response,
                companion_seed: self.config.companion_seed,
            })?;
            *slot = Some(ChannelSums { engine, span_s: [f64::INFINITY, f64::NEG_INFINITY], snapshots: 0 });
        }
        slot.as_mut().ok_or_else(unknown)
    }

    fn add(&mut self, placed: &PlacedVisibilities) -> Result<(), AccumulationError> {
        let near = within(placed, self.config.baseline_m_max(placed.frequency_hz));
        self.ledger.flagged("baseline beyond the map's limit", (placed.len() - near.len()) as u64);
        if near.is_empty() {
            // A channel of which nothing is used has no sums, and no map.
            return Ok(());
        }
        let sums = self.sums(placed.channel)?;
        let added = sums.engine.add(&near)?.visibilities;
        if let (Some(first), Some(last)) = (near.time_s.first(), near.time_s.last()) {
            sums.span_s = [sums.span_s[0].min(*first), sums.span_s[1].max(*last)];
        }
        self.accumulated += added;
        self.ledger.accumulated(added);
        self.ledger.flagged("refused by the engine", near.len() as u64 - added);
        Ok(())
    }

    /// Emits what there is so far, channel by channel.
    fn emit(&mut self, out: &mut Outlet<Snapshot>) {
        let Some(instrument) = &self.instrument else { return };
        for (index, slot) in self.channels.iter_mut().enumerate() {
            let Some(channel) = slot else { continue };
            channel.snapshots += 1;
            out.push(Snapshot {
                instrument: Arc::clone(instrument),
                channel: ChannelId(index as u16),
                number: channel.snapshots,
                is_final: false,
                span_s: channel.span_s,
                sums: channel.engine.sums(),
            });
        }
    }

    /// Emits snapshots when data of a later step of mission time arrives.
    fn emit_if_due(&mut self, time_s: f64, out: &mut Outlet<Snapshot>) {
        let every_s = self.config.snapshot_every_s;
        if every_s <= 0.0 {
            return;
        }
        let next_s = ((time_s / every_s).floor() + 1.0) * every_s;
        match self.next_snapshot_s {
            Some(due_s) if time_s >= due_s => {
                self.emit(out);
                self.next_snapshot_s = Some(next_s);
            }
            Some(_) => {}
            None => self.next_snapshot_s = Some(next_s),
        }
    }
}

/// The visibilities whose baseline is shorter than `baseline_m_max`.
fn within(placed: &PlacedVisibilities, baseline_m_max: f64) -> PlacedVisibilities {
    let is_near = |k: &usize| norm(sub(placed.r_i_m[*k], placed.r_j_m[*k])) < baseline_m_max;
    let kept: Vec<usize> = (0..placed.len()).filter(is_near).collect();
    fn pick<T: Copy>(from: &[T], kept: &[usize]) -> Vec<T> {
        kept.iter().map(|&k| from[k]).collect()
    }
    PlacedVisibilities {
        channel: placed.channel,
        frequency_hz: placed.frequency_hz,
        pair: placed.pair,
        time_s: pick(&placed.time_s, &kept),
        r_i_m: pick(&placed.r_i_m, &kept),
        r_j_m: pick(&placed.r_j_m, &kept),
        value_k_sr: pick(&placed.value_k_sr, &kept),
        weight: pick(&placed.weight, &kept),
    }
}

impl Stage for Accumulator {
    type In = PlacedFrame;
    type Out = Snapshot;
    type Error = AccumulationError;

    fn step(&mut self, frame: PlacedFrame, out: &mut Outlet<Snapshot>) -> Result<(), AccumulationError> {
        match frame {
            PlacedFrame::Instrument(instrument) => self.open(instrument)?,
            PlacedFrame::Visibilities(placed) => {
                if let Some(&time_s) = placed.time_s.first() {
                    self.emit_if_due(time_s, out);
                }
                self.add(&placed)?;
            }
            PlacedFrame::Housekeeping(_) => {}
        }
        Ok(())
    }

    fn finish(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), AccumulationError> {
        let Some(instrument) = self.instrument.take() else { return Ok(()) };
        for (index, slot) in self.channels.drain(..).enumerate() {
            let Some(ChannelSums { engine, span_s, snapshots, .. }) = slot else { continue };
            out.push(Snapshot {
                instrument: Arc::clone(&instrument),
                channel: ChannelId(index as u16),
                number: snapshots + 1,
                is_final: true,
                span_s,
                sums: engine.into_sums(),
            });
        }
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.accumulated, "visibilities")
    }
}
