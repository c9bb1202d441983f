//! The stage that places visibilities and calibrates them.

use std::collections::{BTreeMap, BTreeSet};

use num_complex::Complex64;

use super::autos::{AUTOS_MAX, AutoTable};
use super::blocks::{BlockKey, Completeness, MissingPackets, ReceivedBlocks};
use super::{Calibration, CalibrationError, FoundBursts, VanVleck};
use crate::array::Ephemeris;
use crate::frames::{
    AutoPower, Channel, CountedVisibilities, EphemerisSegment, GroundFrame, Instrument, PlacedFrame,
    PlacedVisibilities, VisibilityBlock, VisibilityReason,
};
use crate::runtime::{Ledger, Outlet, Stage, Units};
use crate::units::{ChannelId, MissionTime, Pair};

/// Stage that places visibilities by the ephemeris packets alone, and applies the calibration. Visibilities that
/// cannot be used are in the ledger with their reason.
///
/// At the end the ledger is compared with the spacecraft's own counts: sampled minus dropped minus received is what
/// the link lost. Visibilities after the latest report count as sampled when received; of others sampled since then
/// only missing packets are known, so the ledger is not known to be complete.
pub struct Calibrator {
    van_vleck: Option<VanVleck>,
    /// Auto-correlations; `None` if they are not kept.
    autos: Option<AutoTable>,
    calibration: Box<dyn Calibration>,
    ledger: Ledger<VisibilityReason>,
    ephemeris: Ephemeris,
    instrument: Option<Instrument>,
    blocks: ReceivedBlocks,
    /// The channels whose values are needed; `None` for all.
    group: Option<BTreeSet<ChannelId>>,
    bursts: FoundBursts,
}

impl Calibrator {
    /// Creates a stage that posts to `ledger`.
    #[must_use]
    pub fn new(calibration: Box<dyn Calibration>, ledger: Ledger<VisibilityReason>) -> Self {
        Self {
            van_vleck: None,
            autos: None,
            calibration,
            ledger,
            ephemeris: Ephemeris::default(),
            instrument: None,
            blocks: ReceivedBlocks::default(),
            group: None,
            bursts: FoundBursts::default(),
        }
    }

    /// Calibrates only the channels of `group`, or all if `None`. Visibilities of other channels are counted as left
    /// out, where calibration would not remove any.
    #[must_use]
    #[doc(hidden)]
    pub fn with_group(self, group: Option<BTreeSet<ChannelId>>) -> Self {
        Self { group, ..self }
    }

    /// Leaves out visibilities in the bursts of a table.
    #[must_use]
    #[doc(hidden)]
    pub fn with_bursts(self, bursts: &FoundBursts) -> Self {
        Self { bursts: bursts.clone(), ..self }
    }

    /// The bursts found so far.
    #[must_use]
    #[doc(hidden)]
    pub fn bursts(&self) -> &FoundBursts {
        &self.bursts
    }

    /// Undoes the quantiser's effect on correlations before calibration.
    #[must_use]
    #[doc(hidden)]
    pub fn with_van_vleck(self, van_vleck: Option<VanVleck>) -> Self {
        Self { van_vleck, ..self }
    }

    /// Keeps auto-correlations, each once, by channel, daughter and time; otherwise they are flagged.
    #[must_use]
    #[doc(hidden)]
    pub fn with_autos(self) -> Self {
        Self { autos: Some(AutoTable::default()), ..self }
    }

    /// Sets the maximum number of ephemeris segments kept.
    #[must_use]
    #[doc(hidden)]
    pub fn with_segments(self, segments_max: usize) -> Self {
        Self { ephemeris: Ephemeris::new(segments_max), ..self }
    }

    /// Resumes with the instrument, positions, auto-correlations and received blocks of earlier sessions.
    ///
    /// If the calibration refuses the instrument, it does so again with the first visibilities.
    #[must_use]
    #[doc(hidden)]
    pub fn resume(
        mut self,
        instrument: Option<Instrument>,
        ephemeris: impl IntoIterator<Item = EphemerisSegment>,
        autos: AutoTable,
        blocks: ReceivedBlocks,
    ) -> Self {
        for segment in ephemeris {
            self.ephemeris.insert(segment);
        }
        if let Some(instrument) = &instrument {
            self.calibration.describe(instrument).ok();
        }
        Self { instrument, autos: Some(autos), blocks, ..self }
    }

    /// The ephemeris received so far.
    #[must_use]
    pub fn ephemeris(&self) -> &Ephemeris {
        &self.ephemeris
    }

    /// Record of received blocks.
    #[must_use]
    #[doc(hidden)]
    pub fn blocks(&self) -> &ReceivedBlocks {
        &self.blocks
    }

    /// Removes the ephemeris segment that starts at `start`.
    #[doc(hidden)]
    pub fn remove_segment(&mut self, start: MissionTime) {
        self.ephemeris.remove(start);
    }

    /// Auto-correlations so far; `None` if they are not kept.
    #[must_use]
    #[doc(hidden)]
    pub fn autos(&self) -> Option<&AutoTable> {
        self.autos.as_ref()
    }

    /// Auto-correlations so far, by channel, daughter and time.
    #[must_use]
    pub fn auto_powers(&self) -> Vec<AutoPower> {
        let known = self.autos.as_ref().zip(self.instrument.as_ref());
        known.map(|(autos, instrument)| autos.list(instrument)).unwrap_or_default()
    }

    /// Returns the visibilities of a block, placed and calibrated, without changing the ledger or the received
    /// blocks.
    ///
    /// # Errors
    /// As [`Calibrator::accept`].
    #[doc(hidden)]
    pub fn calibrated(&mut self, block: VisibilityBlock) -> Result<PlacedVisibilities, CalibrationError> {
        block.check_lengths()?;
        let ledger = std::mem::take(&mut self.ledger);
        let placed = self.place(block);
        self.ledger = ledger;
        Ok(placed?.unwrap_or_default())
    }

    /// Removes the auto-correlations of a block; returns how many there were.
    ///
    /// # Errors
    /// As [`Calibrator::accept`].
    #[doc(hidden)]
    pub fn remove_autos(&mut self, block: VisibilityBlock) -> Result<u64, CalibrationError> {
        block.check_lengths()?;
        let ledger = std::mem::take(&mut self.ledger);
        let placed = self.calibrate_autos(block);
        self.ledger = ledger;
        let (placed, autos) = (placed?, self.autos.as_mut());
        Ok(placed.zip(autos).map_or(0, |(placed, autos)| autos.remove(&placed)))
    }

    /// Processes the next frame; returns what is to be accumulated.
    ///
    /// # Errors
    /// [`CalibrationError`] if calibration was not made for this instrument, or the arrays of a block have unequal lengths.
    pub fn accept(&mut self, frame: GroundFrame) -> Result<Option<PlacedFrame>, CalibrationError> {
        match frame {
            // The decoder reports descriptions that contradict the first one.
            GroundFrame::Instrument(_) if self.instrument.is_some() => Ok(None),
            GroundFrame::Instrument(instrument) => {
                let calibrated = self.calibration.describe(&instrument)?;
                self.instrument = Some(instrument);
                Ok(Some(PlacedFrame::Instrument(calibrated)))
            }
            GroundFrame::Ephemeris(segment) => {
                // If it is not inserted, visibilities without positions are counted individually.
                self.ephemeris.insert(segment);
                Ok(None)
            }
            GroundFrame::Visibilities(block) => self.accept_visibilities(block),
            GroundFrame::Housekeeping(report) => {
                self.blocks.report(report);
                Ok(Some(PlacedFrame::Housekeeping(report)))
            }
        }
    }

    /// Counts visibilities that were received now and are accumulated in the next session.
    #[doc(hidden)]
    pub fn count_for_next_session(&mut self, block: &VisibilityBlock) {
        let count = block.len() as u64;
        let Some(key) = BlockKey::of(block) else { return };
        if self.blocks.insert(key) {
            self.blocks.count(block.start, count);
            self.ledger.add_left_out(VisibilityReason::NextSession, count);
        } else {
            self.ledger.add_sampled(count);
            self.ledger.add_left_out(VisibilityReason::Duplicate, count);
        }
    }

    /// Counts visibilities that the decoder left out of a block in the window that starts at `window`, because their
    /// values are unusable.
    #[doc(hidden)]
    pub fn count_bad(&mut self, window: MissionTime, visibilities: u64) {
        self.blocks.count_bad(window, visibilities);
    }

    /// Posts to the ledger the visibilities sampled, and those lost before reception; returns whether the counts are
    /// complete.
    #[doc(hidden)]
    pub fn post_losses(&self, missing: MissingPackets) -> Completeness {
        self.blocks.post_losses(&self.ledger, missing)
    }

    fn accept_visibilities(
        &mut self,
        block: VisibilityBlock,
    ) -> Result<Option<PlacedFrame>, CalibrationError> {
        block.check_lengths()?;
        let count = block.len() as u64;
        let Some(key) = BlockKey::of(&block) else { return Ok(None) };
        if !self.blocks.insert(key) {
            self.ledger.add_sampled(count);
            self.ledger.add_left_out(VisibilityReason::Duplicate, count);
            return Ok(None);
        }
        self.blocks.count(block.start, count);
        if block.pair.i != block.pair.j {
            if self.is_not_imaged(&block) {
                return Ok(self.count_not_imaged(&block).map(PlacedFrame::NotMapped));
            }
            let placed = self.place(block)?.filter(|placed| !placed.is_empty());
            return Ok(placed.map(PlacedFrame::Visibilities));
        }
        if let Some(placed) = self.calibrate_autos(block)? {
            self.keep_autos(&placed);
        }
        Ok(None)
    }

    /// Returns the calibrated auto-correlations of one daughter; `None` if no instrument is known.
    fn calibrate_autos(
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
            duration_s: Vec::new(),
            gain_errors: Vec::new(),
        };
        // The spectrometer is not one of the antennas with gains.
        if !self.is_spectrum(block.pair) {
            self.calibrate(&mut placed)?;
        }
        // Sub-bands of auto-correlations are not combined.
        placed.channel = block.channel;
        Ok(Some(placed))
    }

    fn keep_autos(&mut self, placed: &PlacedVisibilities) {
        let Some(autos) = &mut self.autos else {
            self.ledger.add_left_out(VisibilityReason::Auto, placed.len() as u64);
            return;
        };
        let insertion = autos.insert(placed, AUTOS_MAX);
        self.ledger.add_accumulated(insertion.kept);
        self.ledger.add_left_out(VisibilityReason::AutoTableFull, insertion.refused);
        self.ledger.add_left_out(VisibilityReason::AutoRepeated, insertion.duplicates);
    }

    fn is_spectrum(&self, pair: Pair) -> bool {
        self.instrument.as_ref().is_some_and(|instrument| instrument.is_spectrum(pair))
    }

    /// Undoes a block's quantisation; returns its channel, if the instrument is known and has it.
    fn prepare(&self, block: &mut VisibilityBlock) -> Option<Channel> {
        let channel = self.instrument.as_ref().and_then(|i| i.channel_of(block.channel, block.pair));
        let Some(channel) = channel else {
            self.ledger.add_left_out(VisibilityReason::NoInstrument, block.len() as u64);
            return None;
        };
        // The spectrometer has no sample quantiser.
        if let Some(van_vleck) = &self.van_vleck
            && !self.is_spectrum(block.pair)
        {
            van_vleck.apply(block, channel.width_hz);
        }
        Some(channel)
    }

    fn is_not_imaged(&self, block: &VisibilityBlock) -> bool {
        let is_other = self.group.as_ref().is_some_and(|group| !group.contains(&block.channel));
        let is_known =
            || self.instrument.as_ref().and_then(|i| i.channel_of(block.channel, block.pair)).is_some();
        is_other && self.calibration.is_identity() && is_known()
    }

    /// Posts what would become of a block of two daughters; `None` if nothing of it would be left.
    fn count_not_imaged(&self, block: &VisibilityBlock) -> Option<CountedVisibilities> {
        let (placing, first_s) = self.ephemeris.count(block);
        self.ledger.add_left_out(VisibilityReason::NoEphemeris, placing.without_ephemeris);
        self.post_flagged(placing.flagged);
        first_s.map(|first_s| CountedVisibilities { first_s, visibilities: placing.placed })
    }

    /// Places and calibrates a block of two daughters; `None` if no instrument is known.
    fn place(&mut self, mut block: VisibilityBlock) -> Result<Option<PlacedVisibilities>, CalibrationError> {
        let Some(channel) = self.prepare(&mut block) else { return Ok(None) };
        let (mut placed, placing) = self.ephemeris.place(&block, channel.frequency_hz);
        self.ledger.add_left_out(VisibilityReason::NoEphemeris, placing.without_ephemeris);
        self.post_flagged(placing.flagged);
        self.calibrate(&mut placed)?;
        self.take_bursts_out(&mut placed, 0);
        Ok(Some(placed))
    }

    /// Takes bursts out of visibilities, except the first `known`, which have been taken out already.
    pub(crate) fn take_bursts_out(&self, placed: &mut PlacedVisibilities, known: usize) {
        if let Some(divided) = self.bursts.divided(placed, known) {
            self.ledger.add_left_out(VisibilityReason::Burst, divided.left_out.len() as u64);
            *placed = divided.used;
        }
    }

    fn calibrate(&mut self, placed: &mut PlacedVisibilities) -> Result<(), CalibrationError> {
        let calibrated = self.calibration.apply(placed)?;
        placed.check_lengths()?;
        for (reason, count) in calibrated.removed() {
            self.ledger.add_left_out(reason, count as u64);
        }
        Ok(())
    }

    fn post_flagged(&self, flagged: BTreeMap<VisibilityReason, u64>) {
        for (reason, count) in flagged {
            self.ledger.add_left_out(reason, count);
        }
    }
}

impl Stage for Calibrator {
    type In = GroundFrame;
    type Out = PlacedFrame;
    type Error = CalibrationError;

    fn step(&mut self, frame: GroundFrame, out: &mut Outlet<PlacedFrame>) -> Result<(), CalibrationError> {
        if let Some(placed) = self.accept(frame)? {
            out.push(placed);
        }
        Ok(())
    }

    fn finish(&mut self, _: &mut Outlet<PlacedFrame>) -> Result<(), CalibrationError> {
        self.post_losses(MissingPackets::default());
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.blocks.visibilities(), "visibilities")
    }
}
