//! Counters and ledger of samples, for runs with sample fidelity.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use serde::Serialize;

use crate::daughters::{LinkCounts, SamplerCounts};
use crate::frames::SampleReason;
use crate::mother::Fidelity;
use crate::mother::correlator::CorrelatorCounts;
use crate::pipeline::config::{PipelineError, Plan};
use crate::runtime::{Ledger, LedgerImbalance, LedgerReport};

/// Shared counters of the stages that simulate samples.
#[derive(Clone, Default)]
pub struct SampleCounts {
    /// Counters of the sampler.
    pub sampler: Arc<Mutex<SamplerCounts>>,
    /// Counters of the links from the daughters to the mother.
    pub link: Arc<Mutex<LinkCounts>>,
    /// Counters of the correlator.
    pub correlator: Arc<Mutex<CorrelatorCounts>>,
}

impl SampleCounts {
    /// The summary of the samples of a run; `None` if it simulates no samples.
    pub(crate) fn close(&self, plan: &Plan) -> Result<Option<SampleSummary>, PipelineError> {
        let has_samples = plan.config.spacecraft.fidelity == Fidelity::Samples;
        Ok(has_samples.then(|| SampleSummary::close(self)).transpose()?)
    }
}

/// Statistics of a run's complex samples, over all daughters and channels.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SampleSummary {
    /// Number of real and imaginary parts beyond the quantiser's range.
    pub saturated: u64,
    /// Correlations of the covariance matrices that samples were drawn from.
    pub correlations: u64,
    /// Correlations that were reduced to make their matrix positive semidefinite.
    pub repaired: u64,
    /// Greatest change of a correlation, as a fraction of the two daughters' powers.
    pub repair_max: f32,
    /// Blocks that the links carried and dropped.
    pub link: LinkCounts,
    /// Blocks at the mother.
    pub blocks: BlockSummary,
    /// Number of correlated visibilities.
    pub visibilities: u64,
    /// The ledger of samples.
    pub ledger: LedgerReport<SampleReason>,
}

/// Numbers of sample blocks at the mother.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct BlockSummary {
    /// Blocks that were correlated.
    pub used: u64,
    /// Blocks absent when the others of their time were correlated.
    pub missing: u64,
    /// Blocks received after the others of their time had been correlated.
    pub late: u64,
    /// Duplicate blocks.
    pub duplicate: u64,
    /// Malformed blocks.
    pub malformed: u64,
    /// Blocks outside every observing window.
    pub stray: u64,
}

impl SampleSummary {
    /// Collects the counters and checks the ledger of samples.
    ///
    /// # Errors
    /// [`LedgerImbalance`] unless sampled = correlated + lost.
    pub fn close(counts: &SampleCounts) -> Result<Self, LedgerImbalance<SampleReason>> {
        fn read<T: Clone>(counts: &Mutex<T>) -> T {
            counts.lock().unwrap_or_else(PoisonError::into_inner).clone()
        }
        let (sampler, link) = (read(&counts.sampler), read(&counts.link));
        let correlator = read(&counts.correlator);
        let blocks = correlator.blocks;
        let ledger = Ledger::new();
        ledger.add_sampled(sampler.samples);
        ledger.add_accumulated(blocks.used_samples);
        ledger.add_left_out(SampleReason::LinkOverrun, link.dropped_samples);
        ledger.add_left_out(SampleReason::Late, blocks.late_samples);
        ledger.add_left_out(SampleReason::Malformed, blocks.malformed_samples);
        ledger.add_left_out(SampleReason::OutsideWindow, correlator.stray_samples);
        Ok(Self {
            saturated: sampler.saturated,
            correlations: sampler.repairs.elements,
            repaired: sampler.repairs.changed,
            repair_max: sampler.repairs.change_max,
            link,
            blocks: BlockSummary {
                used: blocks.used,
                missing: blocks.missing,
                late: blocks.late,
                duplicate: blocks.duplicate,
                malformed: blocks.malformed,
                stray: correlator.stray,
            },
            visibilities: correlator.visibilities,
            ledger: ledger.balanced_report()?,
        })
    }
}

impl fmt::Display for SampleSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { saturated, repaired, correlations, repair_max, blocks, .. } = self;
        writeln!(f, "{}", self.ledger)?;
        writeln!(f, "parts out of the quantisers' range: {saturated}")?;
        writeln!(f, "correlations repaired: {repaired} of {correlations}, by {repair_max:.1e} at most")?;
        let BlockSummary { used, missing, late, duplicate, malformed, stray } = blocks;
        write!(
            f,
            "blocks: {used} used, {missing} missing, {late} late, {duplicate} duplicates, {malformed} malformed, {stray} stray"
        )
    }
}
