//! The rounds in which the weights of total powers are found.

use super::powers::{PowerRows, WeightedRows};
use super::prior::Prior;
use super::solve::{JointRequest, Posterior};
use super::sums::{JointSums, ScaledBlocks, scaled_blocks};
use crate::imaging::NormalSums;
use crate::imaging::power::Block;
use crate::imaging::solver::{NamedWatch, SolveError};

/// Rounds before the last solution: with weights from the measured powers, then from a map.
const ROUNDS: usize = 2;

/// The sums of all channels with their blocks.
pub(super) struct Equations<'a> {
    pub(super) prior: &'a Prior,
    pub(super) sums: &'a [&'a (dyn NormalSums + Sync)],
    pub(super) blocks: &'a [Vec<Block<'a>>],
    pub(super) noise_factors: &'a [f64],
}

impl<'a> Equations<'a> {
    fn joint(&self, powers: Vec<Option<WeightedRows<'a>>>) -> (JointSums<'a>, Vec<ScaledBlocks>) {
        let power_blocks: Vec<_> =
            powers.iter().map(|powers| powers.as_ref().map(WeightedRows::blocks)).collect();
        let scaled = scaled_blocks(self.prior, self.blocks, self.noise_factors, &power_blocks);
        (
            JointSums::new(self.prior, self.sums.to_vec(), self.noise_factors.to_vec()).with_powers(powers),
            scaled,
        )
    }

    /// Finds the weights of the powers in rounds. Returns the equations, with a solution from which to begin.
    pub(super) fn with_powers(
        &self,
        rows: &'a [Option<PowerRows>],
        request: &JointRequest,
        watch: NamedWatch<'_>,
    ) -> Result<(JointSums<'a>, Vec<ScaledBlocks>, Option<Vec<f64>>), SolveError> {
        let weighted =
            |rows: &'a Option<PowerRows>| rows.as_ref().map(|rows| rows.weighted(&rows.measured(), 1.0));
        let (mut joint, mut scaled) = self.joint(rows.iter().map(weighted).collect());
        let mut start = None;
        let rounds = if rows.iter().any(Option::is_some) { ROUNDS } else { 0 };
        let request = JointRequest { samples: 0, ..request.clone() };
        for _ in 0..rounds {
            let posterior = Posterior::new(&joint, &scaled, &request, start.as_deref(), watch)?;
            let weighted = |(channel, rows): (usize, &'a Option<PowerRows>)| {
                let (rows, before) = (rows.as_ref()?, joint.powers(channel)?);
                let x = posterior.coefficients(&self.prior.view_of(channel), &posterior.solution);
                // Residuals in excess of the noise count as noise.
                let noise = before.agreement(&x).chi_square.max(1.0);
                Some(rows.weighted(&rows.model(&x), noise))
            };
            let next = self.joint(rows.iter().enumerate().map(weighted).collect());
            start = Some(posterior.solution);
            (joint, scaled) = next;
        }
        Ok((joint, scaled, start))
    }
}
