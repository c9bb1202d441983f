//! The ground stage that places visibilities and calibrates them.

use std::collections::{BTreeMap, HashSet};

use std::sync::{Arc, Mutex, PoisonError};

use num_complex::Complex64;

use super::autos::{AUTOS_MAX, AutoTable};
use super::{Calibration, CalibrationError, VanVleck};
use crate::array::Ephemeris;
use crate::frames::{
    AutoPower, Channel, EphemerisSegment, GroundFrame, Housekeeping, Instrument, PlacedFrame,
    PlacedVisibilities, VisibilityBlock, VisibilityReason,
};
use crate::runtime::{Ledger, Outlet, Stage, Units};
use crate::units::{ChannelId, MissionTime, Pair};

/// Identity of a block of visibilities, the beginning of its first integration in it: every one is used once,
/// however often it arrives.
type BlockKey = (ChannelId, Pair, MissionTime);

/// Greatest number of the spacecraft's reports that are kept.
const REPORTS_MAX: usize = 1 << 16;

/// What a calibrator has learnt and counted, for another to go on with; its ledger, the blocks that it has used and the
/// daughters' own powers are apart.
#[derive(Clone, Debug, Default, PartialEq, bincode::Encode, bincode::Decode)]
pub struct CalibratorState {
    instrument: Option<Instrument>,
    ephemeris: Vec<EphemerisSegment>,
    received: BTreeMap<i64, u64>,
    reports: BTreeMap<MissionTime, Housekeeping>,
}

impl CalibratorState {
    /// Positions that it knows, in the order of time.
    pub fn ephemeris(&self) -> impl Iterator<Item = &EphemerisSegment> {
        self.ephemeris.iter()
    }
}

/// Gives each visibility the positions of its satellites, from the ephemeris packets alone, and hands
/// it to the calibration hook. What cannot be used is flagged in the ledger with its reason.
///
/// The ledger is closed against the spacecraft's own counts: sampled less dropped less received is
/// what the link lost. Visibilities after the last housekeeping packet count as sampled when received.
pub struct Calibrator {
    van_vleck: Option<VanVleck>,
    /// Where the daughters' own powers go at the end.
    autos: Option<Arc<Mutex<Vec<AutoPower>>>>,
    powers: AutoTable,
    calibration: Box<dyn Calibration>,
    ledger: Ledger<VisibilityReason>,
    ephemeris: Ephemeris,
    instrument: Option<Instrument>,
    seen: HashSet<BlockKey>,
    /// Visibilities received, by the start of their window (ticks).
    received: BTreeMap<i64, u64>,
    /// The spacecraft's counts, by the time up to which they hold.
    reports: BTreeMap<MissionTime, Housekeeping>,
}

impl Calibrator {
    /// A stage that posts to `ledger`.
    #[must_use]
    pub fn new(calibration: Box<dyn Calibration>, ledger: Ledger<VisibilityReason>) -> Self {
        Self {
            van_vleck: None,
            autos: None,
            powers: AutoTable::default(),
            calibration,
            ledger,
            ephemeris: Ephemeris::default(),
            instrument: None,
            seen: HashSet::new(),
            received: BTreeMap::new(),
            reports: BTreeMap::new(),
        }
    }

    /// What it knows.
    #[must_use]
    pub fn state(&self) -> CalibratorState {
        CalibratorState {
            instrument: self.instrument.clone(),
            ephemeris: self.ephemeris.segments().cloned().collect(),
            received: self.received.clone(),
            reports: self.reports.clone(),
        }
    }

    /// Takes what another knows as well; of ephemeris segments that begin at the same time its own stay. Blocks that
    /// the other has used are to be told by [`Calibrator::has_used`].
    pub fn absorb(&mut self, other: Self) {
        self.powers.absorb(other.powers);
        let (instrument, received, reports) = (other.instrument, other.received, other.reports);
        let ephemeris: Vec<EphemerisSegment> = other.ephemeris.segments().cloned().collect();
        self.instrument = self.instrument.take().or(instrument);
        self.describe();
        for segment in ephemeris {
            self.ephemeris.insert(segment);
        }
        for (start, count) in received {
            *self.received.entry(start).or_default() += count;
        }
        self.reports.extend(reports);
    }

    /// Goes on with what another knew; blocks that it has used are to be told by [`Calibrator::has_used`].
    #[must_use]
    pub fn resume(mut self, state: CalibratorState, powers: AutoTable) -> Self {
        let CalibratorState { instrument, ephemeris, received, reports } = state;
        for segment in ephemeris {
            self.ephemeris.insert(segment);
        }
        let mut resumed = Self { instrument, received, reports, powers, ..self };
        resumed.describe();
        resumed
    }

    /// Keeps positions of so many segments.
    #[must_use]
    pub fn with_segments(self, segments_max: usize) -> Self {
        Self { ephemeris: Ephemeris::new(segments_max), ..self }
    }

    /// Says that a block, of which this is the beginning of the first integration, has been used.
    pub fn has_used(&mut self, channel: ChannelId, pair: Pair, first: MissionTime) {
        self.seen.insert((channel, pair, first));
    }

    /// Positions.
    #[must_use]
    pub fn ephemeris(&self) -> &Ephemeris {
        &self.ephemeris
    }

    /// Forgets positions from a time on, as if they had never come.
    pub fn forget_segment(&mut self, start: MissionTime) {
        self.ephemeris.remove(start);
    }

    /// Forgets what the spacecraft has said of its counts.
    pub fn forget_report(&mut self, report: &Housekeeping) {
        self.reports.retain(|_, known| known != report);
    }

    /// Calibrated visibilities of a block that was used, as they were handed on if the positions are the same;
    /// nothing changes.
    ///
    /// # Errors
    /// As [`Calibrator::step`].
    pub fn place_again(&mut self, block: VisibilityBlock) -> Result<PlacedVisibilities, CalibrationError> {
        let aside = std::mem::take(&mut self.ledger);
        let placed = self.place(block);
        self.ledger = aside;
        Ok(placed?.unwrap_or_default())
    }

    /// Takes the powers of a daughter that a block has brought out again; how many there were.
    ///
    /// # Errors
    /// As [`Calibrator::step`].
    pub fn take_out_powers(&mut self, block: VisibilityBlock) -> Result<u64, CalibrationError> {
        let aside = std::mem::take(&mut self.ledger);
        let placed = self.own_powers(block);
        self.ledger = aside;
        Ok(placed?.map_or(0, |placed| self.powers.remove(&placed)))
    }

    /// The daughters' own powers so far.
    #[must_use]
    pub fn powers(&self) -> &AutoTable {
        &self.powers
    }

    /// Forgets a block that was used; the ledger is the caller's affair.
    pub fn forget_block(&mut self, block: &VisibilityBlock) {
        if let Some(key) = key_of(block) {
            self.seen.remove(&key);
        }
        if let Some(count) = self.received.get_mut(&block.start.0) {
            *count = count.saturating_sub(block.len() as u64);
            if *count == 0 {
                self.received.remove(&block.start.0);
            }
        }
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

    /// Keeps the daughters' own powers and leaves them in `autos` at the end, each once, by channel, daughter and time;
    /// without that they are left out.
    #[must_use]
    pub fn with_autos(self, autos: Arc<Mutex<Vec<AutoPower>>>) -> Self {
        Self { autos: Some(autos), ..self }
    }

    /// The powers of one daughter, calibrated; `None` for want of an instrument.
    fn own_powers(
        &mut self,
        mut block: VisibilityBlock,
    ) -> Result<Option<PlacedVisibilities>, CalibrationError> {
        let Some(channel) = self.prepare(&mut block) else { return Ok(None) };
        let good: Vec<usize> = (0..block.len()).filter(|&k| block.flags[k].is_good()).collect();
        let mut flagged = BTreeMap::new();
        for reason in block.flags.iter().filter_map(|flags| flags.reason()) {
            *flagged.entry(reason).or_default() += 1;
        }
        self.post_flagged(flagged);
        let mut placed = PlacedVisibilities {
            channel: block.channel,
            band: 0,
            frequency_hz: channel.frequency_hz,
            pair: block.pair,
            time_s: good.iter().map(|&k| block.middle_s(k)).collect(),
            r_i_m: vec![[0.0; 3]; good.len()],
            r_j_m: vec![[0.0; 3]; good.len()],
            value_k_sr: good.iter().map(|&k| Complex64::new(block.value_k_sr[k].re.into(), 0.0)).collect(),
            weight: good.iter().map(|&k| f64::from(block.weight[k])).collect(),
        };
        // A spectrometer is none of the antennas whose gains are known.
        if !self.is_spectrum(block.pair) {
            self.calibrate(&mut placed)?;
        }
        // Sub-bands are not brought together here.
        placed.channel = block.channel;
        Ok(Some(placed))
    }

    fn keep_powers(&mut self, placed: &PlacedVisibilities) {
        if self.autos.is_none() {
            self.ledger.left_out(VisibilityReason::Auto, placed.len() as u64);
            return;
        }
        let account = self.powers.take(placed, AUTOS_MAX);
        self.ledger.accumulated(account.kept);
        self.ledger.left_out(VisibilityReason::AutoTableFull, account.beyond);
        self.ledger.left_out(VisibilityReason::AutoRepeated, account.twice);
    }

    fn visibilities(
        &mut self,
        block: VisibilityBlock,
        out: &mut Outlet<PlacedFrame>,
    ) -> Result<(), CalibrationError> {
        let count = block.len() as u64;
        let Some(key) = key_of(&block) else { return Ok(()) };
        if !self.seen.insert(key) {
            self.ledger.sampled(count);
            self.ledger.left_out(VisibilityReason::Duplicate, count);
            return Ok(());
        }
        *self.received.entry(block.start.0).or_default() += count;
        if block.pair.i == block.pair.j {
            if let Some(placed) = self.own_powers(block)? {
                self.keep_powers(&placed);
            }
        } else if let Some(placed) = self.place(block)?.filter(|placed| !placed.is_empty()) {
            out.push(PlacedFrame::Visibilities(placed));
        }
        Ok(())
    }

    fn is_spectrum(&self, pair: Pair) -> bool {
        self.instrument.as_ref().is_some_and(|instrument| instrument.is_spectrum(pair))
    }

    /// Takes out of a block what its quantiser did; its channel, if there is an instrument that has it.
    fn prepare(&self, block: &mut VisibilityBlock) -> Option<Channel> {
        let channel = self.instrument.as_ref().and_then(|i| i.channel_of(block.channel, block.pair));
        let Some(channel) = channel else {
            self.ledger.left_out(VisibilityReason::NoInstrument, block.len() as u64);
            return None;
        };
        // A spectrum is not quantised with the samples.
        if let Some(van_vleck) = &self.van_vleck
            && !self.is_spectrum(block.pair)
        {
            van_vleck.apply(block, channel.width_hz);
        }
        Some(channel)
    }

    /// Places and calibrates a block of two daughters; `None` for want of an instrument.
    fn place(&mut self, mut block: VisibilityBlock) -> Result<Option<PlacedVisibilities>, CalibrationError> {
        let Some(channel) = self.prepare(&mut block) else { return Ok(None) };
        let (mut placed, placing) = self.ephemeris.place(&block, channel.frequency_hz);
        self.ledger.left_out(VisibilityReason::NoEphemeris, placing.without_ephemeris);
        self.post_flagged(placing.flagged);
        self.calibrate(&mut placed)?;
        Ok(Some(placed))
    }

    fn calibrate(&mut self, placed: &mut PlacedVisibilities) -> Result<(), CalibrationError> {
        let calibrated = self.calibration.apply(placed)?;
        for (reason, count) in calibrated.removed() {
            self.ledger.left_out(reason, count as u64);
        }
        Ok(())
    }

    fn post_flagged(&self, flagged: BTreeMap<VisibilityReason, u64>) {
        for (reason, count) in flagged {
            self.ledger.left_out(reason, count);
        }
    }
}

fn key_of(block: &VisibilityBlock) -> Option<BlockKey> {
    let &first = block.offset_ticks.first()?;
    Some((block.channel, block.pair, block.start.plus_ticks(i64::from(first))))
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
                self.reports.insert(report.time, report);
                if self.reports.len() > REPORTS_MAX {
                    self.reports.pop_first();
                }
                out.push(PlacedFrame::Housekeeping(report));
            }
        }
        Ok(())
    }

    fn finish(&mut self, _: &mut Outlet<PlacedFrame>) -> Result<(), CalibrationError> {
        if let (Some(autos), Some(instrument)) = (&self.autos, &self.instrument) {
            *autos.lock().unwrap_or_else(PoisonError::into_inner) = self.powers.list(instrument);
        }
        let all: u64 = self.received.values().sum();
        let Some((_, report)) = self.reports.last_key_value() else {
            self.ledger.sampled(all);
            return Ok(());
        };
        let counted: u64 = self.received.range(..report.time.0).map(|(_, count)| count).sum();
        let missing = report.sampled.saturating_sub(report.dropped).saturating_sub(counted);
        self.ledger.sampled(counted + missing + report.dropped + (all - counted));
        self.ledger.left_out(VisibilityReason::StoreFull, report.dropped);
        self.ledger.left_out(VisibilityReason::NotReceived, missing);
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.received.values().sum(), "visibilities")
    }
}
