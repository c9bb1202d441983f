//! The ground stage that places visibilities and calibrates them.

use std::collections::{BTreeMap, HashSet};

use super::{Calibration, CalibrationError, VanVleck};
use crate::array::{Ephemeris, FlaggedCounts};
use crate::frames::{EphemerisSegment, GroundFrame, Housekeeping, Instrument, PlacedFrame, VisibilityBlock};
use crate::runtime::{Ledger, Outlet, Stage, Units};
use crate::units::{ChannelId, Pair};

/// Identity of a block of visibilities: every one is used once, however often it arrives.
type BlockKey = (ChannelId, Pair, i64, u32);

/// What a calibrator has learnt and counted, for another to go on with; its ledger is apart.
#[derive(Clone, Debug, Default, PartialEq, bincode::Encode, bincode::Decode)]
pub struct CalibratorState {
    instrument: Option<Instrument>,
    ephemeris: Vec<EphemerisSegment>,
    /// Sorted.
    seen: Vec<BlockKey>,
    received: BTreeMap<i64, u64>,
    reported: Option<Housekeeping>,
}

/// Gives each visibility the positions of its satellites, from the ephemeris packets alone, and hands
/// it to the calibration hook. What cannot be used is flagged in the ledger with its reason.
///
/// The ledger is closed against the spacecraft's own counts: sampled less dropped less received is
/// what the link lost. Visibilities after the last housekeeping packet count as sampled when received.
pub struct Calibrator {
    van_vleck: Option<VanVleck>,
    calibration: Box<dyn Calibration>,
    ledger: Ledger,
    ephemeris: Ephemeris,
    instrument: Option<Instrument>,
    seen: HashSet<BlockKey>,
    /// Visibilities received, by the start of their window (ticks).
    received: BTreeMap<i64, u64>,
    /// The spacecraft's latest counts.
    reported: Option<Housekeeping>,
}

impl Calibrator {
    /// A stage that posts to `ledger`.
    #[must_use]
    pub fn new(calibration: Box<dyn Calibration>, ledger: Ledger) -> Self {
        Self {
            van_vleck: None,
            calibration,
            ledger,
            ephemeris: Ephemeris::default(),
            instrument: None,
            seen: HashSet::new(),
            received: BTreeMap::new(),
            reported: None,
        }
    }

    /// What it knows.
    #[must_use]
    pub fn state(&self) -> CalibratorState {
        let mut seen: Vec<BlockKey> = self.seen.iter().copied().collect();
        seen.sort_unstable();
        CalibratorState {
            instrument: self.instrument.clone(),
            ephemeris: self.ephemeris.segments().cloned().collect(),
            seen,
            received: self.received.clone(),
            reported: self.reported,
        }
    }

    /// Takes what another knows as well; of ephemeris segments that begin at the same time its own stay.
    pub fn absorb(&mut self, state: CalibratorState) {
        let CalibratorState { instrument, ephemeris, seen, received, reported } = state;
        self.instrument = self.instrument.take().or(instrument);
        for segment in ephemeris {
            self.ephemeris.insert(segment);
        }
        self.seen.extend(seen);
        for (start, count) in received {
            *self.received.entry(start).or_default() += count;
        }
        let latest = [self.reported, reported].into_iter().flatten().max_by_key(|report| report.time);
        self.reported = latest;
    }

    /// Goes on with what another knew.
    #[must_use]
    pub fn resume(self, state: CalibratorState) -> Self {
        let CalibratorState { instrument, ephemeris: segments, seen, received, reported } = state;
        let mut ephemeris = Ephemeris::default();
        for segment in segments {
            ephemeris.insert(segment);
        }
        Self { ephemeris, instrument, seen: seen.into_iter().collect(), received, reported, ..self }
    }

    /// Takes out first what quantisers of few bits do.
    #[must_use]
    pub fn with_van_vleck(self, van_vleck: Option<VanVleck>) -> Self {
        Self { van_vleck, ..self }
    }

    fn visibilities(
        &mut self,
        mut block: VisibilityBlock,
        out: &mut Outlet<PlacedFrame>,
    ) -> Result<(), CalibrationError> {
        let count = block.len() as u64;
        let Some(&first) = block.offset_ticks.first() else { return Ok(()) };
        if !self.seen.insert((block.channel, block.pair, block.start.0, first)) {
            self.ledger.sampled(count);
            self.ledger.flagged("duplicate", count);
            return Ok(());
        }
        *self.received.entry(block.start.0).or_default() += count;
        let channel = self.instrument.as_ref().and_then(|i| i.channels.get(usize::from(block.channel.0)));
        let Some(channel) = channel else {
            self.ledger.flagged("no instrument description", count);
            return Ok(());
        };
        if let Some(van_vleck) = &self.van_vleck {
            van_vleck.apply(&mut block, channel.width_hz);
        }
        let (mut placed, placing) = self.ephemeris.place(&block, channel.frequency_hz);
        self.ledger.flagged("no ephemeris", placing.without_ephemeris);
        self.post_flagged(&placing.flagged);
        let calibrated = self.calibration.apply(&mut placed)?;
        for (reason, count) in calibrated.removed() {
            self.ledger.flagged(reason, count as u64);
        }
        if !placed.is_empty() {
            out.push(PlacedFrame::Visibilities(placed));
        }
        Ok(())
    }
}

impl Calibrator {
    fn post_flagged(&self, flagged: &FlaggedCounts) {
        self.ledger.flagged("interference", flagged.interference);
        self.ledger.flagged("incomplete integration", flagged.incomplete);
        self.ledger.flagged("saturated receiver", flagged.saturated);
        self.ledger.flagged("uncalibrated", flagged.uncalibrated);
        self.ledger.flagged("unknown flag", flagged.other);
    }
}

impl Stage for Calibrator {
    type In = GroundFrame;
    type Out = PlacedFrame;
    type Error = CalibrationError;

    fn step(&mut self, frame: GroundFrame, out: &mut Outlet<PlacedFrame>) -> Result<(), CalibrationError> {
        match frame {
            GroundFrame::Instrument(instrument) => {
                // The decoder reports descriptions that contradict the first.
                if self.instrument.is_none() {
                    self.instrument = Some(instrument.clone());
                    out.push(PlacedFrame::Instrument(instrument));
                }
            }
            GroundFrame::Ephemeris(segment) => {
                // Whatever becomes of it, visibilities without positions are counted one by one.
                self.ephemeris.insert(segment);
            }
            GroundFrame::Visibilities(block) => self.visibilities(block, out)?,
            GroundFrame::Housekeeping(report) => {
                if self.reported.is_none_or(|last| last.time <= report.time) {
                    self.reported = Some(report);
                }
                out.push(PlacedFrame::Housekeeping(report));
            }
        }
        Ok(())
    }

    fn finish(&mut self, _: &mut Outlet<PlacedFrame>) -> Result<(), CalibrationError> {
        let all: u64 = self.received.values().sum();
        let Some(report) = self.reported else {
            self.ledger.sampled(all);
            return Ok(());
        };
        let counted: u64 = self.received.range(..report.time.0).map(|(_, count)| count).sum();
        let missing = report.sampled.saturating_sub(report.dropped).saturating_sub(counted);
        self.ledger.sampled(counted + missing + report.dropped + (all - counted));
        self.ledger.lost("store", "full", report.dropped);
        self.ledger.lost("downlink", "not received", missing);
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.received.values().sum(), "visibilities")
    }
}
