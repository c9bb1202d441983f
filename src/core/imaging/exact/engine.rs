//! The engine of exact sums over any basis of the sky.
//!
//! An [`ExactEngine`] checks and counts visibilities and collects them in batches. Its [`SkyBasis`] rounds each batch to integers and adds
//! them to the sums, while the next batch is collected.

use std::fmt;
use std::io::{Read, Write};
use std::sync::Arc;

use super::checkpoint::{BasisKind, FrameReader, FrameWriter};
use super::deferred::Deferred;
use super::fixed_point::{Direction, Totals, WeightScale};
use super::noise::companion_noise;
use crate::frames::{ERROR_DRAWS_MAX, PlacedVisibilities};
use crate::imaging::{AccumulationError, Added, NormalEngine, NormalSums, Refusal, SumCounts};
use crate::units::vector::Vec3;
use num_complex::Complex64;

/// A basis of the sky, which defines how visibilities are added to the sums, and how equations follow from the sums.
pub trait SkyBasis: Sized + Send + Sync + 'static {
    /// All settings that determine the sums; only engines of equal setup can be merged.
    type Setup: Copy + fmt::Debug + PartialEq + Send + Sync;
    /// The position of a visibility in the sums.
    type Place: Copy + Send + Sync + 'static;
    /// The sums as integers.
    type Exact: Clone + Send + Sync + 'static;
    /// The sums as floating-point numbers, ready to be solved.
    type Equations: NormalSums;
    /// A setup as it is stored in a checkpoint.
    type Head: bincode::Encode + bincode::Decode<()>;

    /// Identifies the basis in checkpoints.
    const KIND: BasisKind;
    /// Number of visibilities in a batch.
    const BATCH: usize;
    /// Maximum total weight of the sums, in units of the scale.
    const SCALES_MAX: f64;

    /// Creates the tables for a setup.
    ///
    /// # Errors
    /// The setup is out of range.
    fn new(setup: &Self::Setup, scale: WeightScale) -> Result<Self, AccumulationError>;

    /// The settings that all engines share.
    fn common(setup: &Self::Setup) -> CommonSetup;

    /// Empty sums.
    fn zeros(&self) -> Self::Exact;

    /// The position in the sums of a visibility of satellites at these positions.
    ///
    /// # Errors
    /// The basis does not cover these positions.
    fn place(&self, r_i_m: Vec3, r_j_m: Vec3) -> Result<Self::Place, Refusal>;

    /// Adds a batch to the sums or removes it, depending on the direction.
    fn sum(&self, exact: &mut Self::Exact, batch: &[Accepted<Self::Place>], direction: Direction);

    /// Adds other sums or removes them, depending on the direction.
    fn combine(&self, exact: &mut Self::Exact, other: &Self::Exact, direction: Direction);

    /// Converts a copy of the sums to floating point.
    fn equations(&self, exact: &Self::Exact, counts: SumCounts) -> Self::Equations {
        self.finish(exact.clone(), counts)
    }

    /// Converts the sums to floating point, and frees the integers.
    fn finish(&self, exact: Self::Exact, counts: SumCounts) -> Self::Equations;

    /// The setup for a checkpoint.
    fn head(setup: &Self::Setup) -> Self::Head;

    /// Restores the setup from a checkpoint.
    ///
    /// # Errors
    /// A value is out of range.
    fn setup_of(head: Self::Head) -> Result<Self::Setup, AccumulationError>;

    /// Writes the sums.
    ///
    /// # Errors
    /// The writer's.
    fn write(&self, exact: &Self::Exact, out: &mut FrameWriter<'_>) -> Result<(), AccumulationError>;

    /// Reads the sums, and allocates memory only for data that could be read.
    ///
    /// # Errors
    /// The reader's, or values out of range.
    fn read(&self, from: &mut FrameReader<'_>) -> Result<Self::Exact, AccumulationError>;
}

/// The settings that all engines share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CommonSetup {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Maximum weight of a visibility, (K sr)^-2.
    pub weight_max: f64,
    /// Seed of the noise-only companion.
    pub companion_seed: u64,
}

/// Largest relative error of a visibility by its gains: eight of the largest standard deviations that gains may have, of both.
const GAIN_ERROR_MAX: f64 = 16.0;

/// An accepted visibility that waits for its batch.
#[derive(Clone, Debug, PartialEq)]
pub struct Accepted<P> {
    /// Position in the sums.
    pub place: P,
    /// Inverse variance, (K sr)^-2.
    pub weight: f64,
    /// Value, K sr.
    pub value_k_sr: Complex64,
    /// Simulated noise for the noise-only map, in units of the standard deviation.
    pub noise: Complex64,
    /// Draws of the error of the value by its gains, K sr; empty if it is not known.
    pub gain_errors_k_sr: Box<[Complex64]>,
}

/// Exact normal equations of one channel over a basis; see [`NormalEngine`].
pub struct ExactEngine<B: SkyBasis> {
    setup: B::Setup,
    scale: WeightScale,
    pub(in crate::imaging) basis: Arc<B>,
    exact: Deferred<B::Exact>,
    /// Totals of the engine, pending visibilities included.
    totals: Totals,
    pending: Vec<Accepted<B::Place>>,
    /// Whether the pending visibilities are to be added or removed.
    direction: Direction,
}

impl<B: SkyBasis> fmt::Debug for ExactEngine<B> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ExactEngine")
            .field("setup", &self.setup)
            .field("totals", &self.totals)
            .finish_non_exhaustive()
    }
}

impl<B: SkyBasis> ExactEngine<B> {
    /// Creates an empty engine.
    ///
    /// # Errors
    /// The setup is out of range.
    pub fn new(setup: B::Setup) -> Result<Self, AccumulationError> {
        Self::with_sums(setup, Totals::default(), |basis| Ok(basis.zeros()))
    }

    /// Creates an engine with the sums that `exact` returns, which is called only if the setup is valid.
    pub(in crate::imaging) fn with_sums(
        setup: B::Setup,
        totals: Totals,
        exact: impl FnOnce(&B) -> Result<B::Exact, AccumulationError>,
    ) -> Result<Self, AccumulationError> {
        let scale = WeightScale::new(B::common(&setup).weight_max)?;
        let basis = B::new(&setup, scale)?;
        Ok(Self {
            exact: Deferred::Ready(exact(&basis)?),
            setup,
            scale,
            basis: Arc::new(basis),
            totals,
            pending: Vec::with_capacity(B::BATCH),
            direction: Direction::In,
        })
    }

    /// Setup.
    #[must_use]
    #[doc(hidden)]
    pub fn setup(&self) -> &B::Setup {
        &self.setup
    }

    /// Visibility `k` as it enters the sums, or why it is refused.
    pub(in crate::imaging) fn accept(
        &self,
        placed: &PlacedVisibilities,
        k: usize,
    ) -> Result<Accepted<B::Place>, Refusal> {
        let CommonSetup { weight_max, companion_seed, .. } = B::common(&self.setup);
        let place = self.basis.place(placed.r_i_m[k], placed.r_j_m[k])?;
        let (weight, value_k_sr) = (placed.weight[k], placed.value_k_sr[k]);
        self.scale.check(value_k_sr, weight, weight_max)?;
        let errors = placed.gain_errors_of(k);
        let is_bounded = errors.iter().all(|error| error.norm() <= GAIN_ERROR_MAX);
        if !is_bounded || errors.len() > ERROR_DRAWS_MAX {
            return Err(Refusal::NotFinite);
        }
        let gain_errors_k_sr = errors.iter().map(|error| error * value_k_sr).collect();
        let noise = companion_noise(companion_seed, placed, k);
        Ok(Accepted { place, weight, value_k_sr, noise, gain_errors_k_sr })
    }

    /// Adds visibilities or removes them.
    fn change(
        &mut self,
        placed: &PlacedVisibilities,
        direction: Direction,
    ) -> Result<Added, AccumulationError> {
        let (expected_hz, found_hz) = (B::common(&self.setup).frequency_hz, placed.frequency_hz);
        if found_hz != expected_hz {
            return Err(AccumulationError::Frequency { expected_hz, found_hz });
        }
        placed.check_lengths()?;
        // Done on this thread, while the pool sums the previous batch.
        let found: Vec<_> = (0..placed.len()).map(|k| self.accept(placed, k)).collect();
        let scale = self.scale;
        let totals_of =
            |accepted: &Accepted<B::Place>| Totals::single(scale, accepted.weight, accepted.value_k_sr);
        if direction == Direction::Out {
            let mut accepted = found.iter().flatten();
            let remaining = accepted
                .try_fold(self.totals, |totals, removed| totals.combined(totals_of(removed), direction));
            remaining.ok_or(AccumulationError::NothingHeld(placed.channel))?;
        }
        if self.direction != direction {
            self.flush();
            self.direction = direction;
        }
        let mut added = Added::default();
        for found in found {
            match found
                .and_then(|accepted| Ok((self.totals_with(totals_of(&accepted), direction)?, accepted)))
            {
                Ok((totals, accepted)) => {
                    added.visibilities += 1;
                    self.totals = totals;
                    self.pending.push(accepted);
                }
                Err(reason) => added.refuse(reason),
            }
            if self.pending.len() >= B::BATCH {
                self.sum_pending();
            }
        }
        Ok(added)
    }

    /// The combined totals, if the integers have room for them; the total weight bounds every element.
    fn totals_with(&self, others: Totals, direction: Direction) -> Result<Totals, Refusal> {
        let totals = self.totals.combined(others, direction).ok_or(Refusal::Full)?;
        let is_full = direction == Direction::In && totals.scales() > B::SCALES_MAX;
        if is_full { Err(Refusal::Full) } else { Ok(totals) }
    }

    /// Starts to sum the pending visibilities in the thread pool.
    fn sum_pending(&mut self) {
        if !self.pending.is_empty() {
            let batch = std::mem::replace(&mut self.pending, Vec::with_capacity(B::BATCH));
            let (basis, direction) = (Arc::clone(&self.basis), self.direction);
            self.exact.change(move |exact| basis.sum(exact, &batch, direction));
        }
    }

    /// The basis, the sums and their counts.
    pub(in crate::imaging) fn into_exact(mut self) -> (Arc<B>, B::Exact, SumCounts) {
        self.flush();
        let counts = self.counts();
        (self.basis, self.exact.into_value(), counts)
    }

    /// The sums of this engine and of another one, which must hold other parts of the sums of the same visibilities.
    pub(in crate::imaging) fn matching_parts(
        &mut self,
        other: Self,
    ) -> Result<(&mut B::Exact, B::Exact), AccumulationError> {
        if self.setup != other.setup || self.totals != other.totals {
            return Err(AccumulationError::Mismatch { what: "data" });
        }
        self.flush();
        Ok((self.exact.get(), other.exact.into_value()))
    }

    fn combine(&mut self, mut other: Self, direction: Direction) -> Result<(), AccumulationError> {
        if self.setup != other.setup {
            return Err(AccumulationError::Mismatch {
                what: "map sizes, frequencies, baselines, orbits, responses, seeds or maximum weights",
            });
        }
        let totals = self.totals_with(other.totals, direction).map_err(|_| AccumulationError::Range)?;
        self.flush();
        other.flush();
        self.basis.combine(self.exact.get(), other.exact.get(), direction);
        self.totals = totals;
        Ok(())
    }
}

impl<B: SkyBasis> NormalEngine for ExactEngine<B> {
    type Equations = B::Equations;

    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.change(placed, Direction::In)
    }

    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.change(placed, Direction::Out)
    }

    fn flush(&mut self) {
        self.sum_pending();
        self.exact.get();
    }

    fn merge(&mut self, other: Self) -> Result<(), AccumulationError> {
        self.combine(other, Direction::In)
    }

    fn subtract(&mut self, other: Self) -> Result<(), AccumulationError> {
        self.combine(other, Direction::Out)
    }

    fn counts(&self) -> SumCounts {
        self.totals.counts(self.scale)
    }

    fn sums(&mut self) -> B::Equations {
        self.flush();
        let counts = self.counts();
        self.basis.equations(self.exact.get(), counts)
    }

    fn into_sums(mut self) -> B::Equations {
        self.flush();
        let counts = self.counts();
        self.basis.finish(self.exact.into_value(), counts)
    }

    fn checkpoint(&mut self, out: &mut dyn Write) -> Result<(), AccumulationError> {
        self.flush();
        let mut out = FrameWriter::new(out, B::KIND, (B::head(&self.setup), self.totals))?;
        self.basis.write(self.exact.get(), &mut out)?;
        Ok(out.finish()?)
    }

    fn restore(from: &mut dyn Read) -> Result<Self, AccumulationError> {
        let (mut from, (head, totals)) = FrameReader::new(from, B::KIND)?;
        let engine = Self::with_sums(B::setup_of(head)?, totals, |basis| basis.read(&mut from))?;
        from.finish()?;
        Ok(engine)
    }
}
