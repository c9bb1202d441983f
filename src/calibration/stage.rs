//! The ground stage that places visibilities and calibrates them.

use std::collections::{BTreeMap, HashSet};

use std::sync::{Arc, Mutex, PoisonError};

use num_complex::Complex64;

use super::{Calibration, CalibrationError, VanVleck};
use crate::array::{Ephemeris, FlaggedCounts};
use crate::frames::{
    AutoPower, Channel, EphemerisSegment, GroundFrame, Housekeeping, Instrument, PlacedFrame,
    PlacedVisibilities, VisibilityBlock,
};
use crate::runtime::{Ledger, Outlet, Stage, Units};
use crate::units::{ChannelId, Pair};

/// Most powers of daughters that are kept: 100 MB, more than two hours of every second of 30 channels.
const AUTOS_MAX: usize = 2_000_000;

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
    /// Where the daughters' own powers go.
    autos: Option<Arc<Mutex<Vec<AutoPower>>>>,
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
            autos: None,
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
        self.describe();
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
        let seen = seen.into_iter().collect();
        let mut resumed = Self { ephemeris, instrument, seen, received, reported, ..self };
        resumed.describe();
        resumed
    }

    /// Tells the calibration of an instrument that another has seen. A refusal then comes with the first visibilities.
    fn describe(&mut self) {
        if let Some(instrument) = &self.instrument {
            self.calibration.describe(instrument).ok();
        }
    }

    /// Takes out first what quantisers of few bits do.
    #[must_use]
    pub fn with_van_vleck(self, van_vleck: Option<VanVleck>) -> Self {
        Self { van_vleck, ..self }
    }

    /// Keeps the daughters' own powers in `autos`; without that they are left out.
    #[must_use]
    pub fn with_autos(self, autos: Arc<Mutex<Vec<AutoPower>>>) -> Self {
        Self { autos: Some(autos), ..self }
    }

    /// Calibrates and keeps the powers of one daughter.
    fn autos(&mut self, block: &VisibilityBlock, channel: Channel) -> Result<(), CalibrationError> {
        let good: Vec<usize> = (0..block.len()).filter(|&k| block.flags[k].is_good()).collect();
        let mut flagged = FlaggedCounts::default();
        block.flags.iter().for_each(|&flags| flagged.add(flags));
        self.post_flagged(&flagged);
        let mut placed = PlacedVisibilities {
            channel: block.channel,
            frequency_hz: channel.frequency_hz,
            pair: block.pair,
            time_s: good.iter().map(|&k| block.middle_s(k)).collect(),
            r_i_m: vec![[0.0; 3]; good.len()],
            r_j_m: vec![[0.0; 3]; good.len()],
            value_k_sr: good.iter().map(|&k| Complex64::new(block.value_k_sr[k].re.into(), 0.0)).collect(),
            weight: good.iter().map(|&k| f64::from(block.weight[k])).collect(),
        };
        let calibrated = self.calibration.apply(&mut placed)?;
        for (reason, count) in calibrated.removed() {
            self.ledger.flagged(reason, count as u64);
        }
        let Some(autos) = &self.autos else {
            self.ledger.flagged("auto-correlation", placed.len() as u64);
            return Ok(());
        };
        let mut autos = autos.lock().unwrap_or_else(PoisonError::into_inner);
        let kept = placed.len().min(AUTOS_MAX.saturating_sub(autos.len()));
        autos.extend((0..kept).map(|k| AutoPower {
            daughter: block.pair.i,
            frequency_hz: channel.frequency_hz,
            width_hz: channel.width_hz,
            time_s: placed.time_s[k],
            power_k_sr: placed.value_k_sr[k].re,
            sigma_k_sr: placed.weight[k].sqrt().recip(),
        }));
        self.ledger.accumulated(kept as u64);
        self.ledger.flagged("auto-correlation beyond the table", (placed.len() - kept) as u64);
        Ok(())
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
        let Some(&channel) = channel else {
            self.ledger.flagged("no instrument description", count);
            return Ok(());
        };
        if let Some(van_vleck) = &self.van_vleck {
            van_vleck.apply(&mut block, channel.width_hz);
        }
        if block.pair.i == block.pair.j {
            return self.autos(&block, channel);
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
                    out.push(PlacedFrame::Instrument(self.calibration.describe(&instrument)?));
                    self.instrument = Some(instrument);
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
