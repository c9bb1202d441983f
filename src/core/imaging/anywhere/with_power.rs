//! R from the data for maps from positions as they are: the power by the true map, the matrix of the nearest circle and true residuals.

use super::refinement::chi_squares;
use super::solve::{RefineSteps, RefinedColumns, RefinedProblem, RightHandSides};
use crate::imaging::NormalSums;
use crate::imaging::SolveError;
use crate::imaging::circle::degrees;
use crate::imaging::power::{Block, Factors, FoundPower, PowerProblem};
use crate::imaging::regulariser::Diagonal;
use crate::imaging::solver::{Convergence, add};

/// Most maps, and the change of ln C_l at a knot, and of that of the noise, at which they end: as of maps on the circle.
const ROUNDS_MAX: usize = 3;
const SETTLED: f64 = 0.1;

impl RefinedProblem<'_> {
    /// Solves in rounds of map and power. The circle tells how well each degree is measured, the true map how strong it is, and true residuals
    /// the noise.
    pub(super) fn solve_with_power(
        &mut self,
        blocks: &[Block<'_>],
        right: RightHandSides<'_>,
        mut steps: RefineSteps<'_>,
    ) -> Result<(RefinedColumns, FoundPower), SolveError> {
        let circle = &self.sums.circle;
        let (degrees, counts) = (degrees(self.l_max()).collect::<Vec<usize>>(), circle.counts());
        let on_circle = PowerProblem {
            sums: circle,
            blocks,
            coupling: None,
            degrees: &degrees,
            right: right.of_circle,
            // Of data that the circle does not fit and a prior that is not taken off: where rounds begin, the noise is too large.
            data_chi2: counts.power,
            data_count: 2.0 * counts.visibilities as f64,
        };
        let mut found = on_circle.solve(None, self.inner, self.watch)?;
        let passes_max = self.rule.passes_max;
        let mut residuals = Vec::new();
        for round in 1.. {
            self.regularisation = Diagonal::ByDegree(found.regularisation.clone());
            // The first R is that of the circle: a pass is left for one of true rows.
            let kept = usize::from(round == 1);
            self.rule.passes_max = passes_max.saturating_sub(residuals.len() + kept).max(1);
            let these = RefineSteps { start: steps.start.take(), save: &mut *steps.save };
            let mut refined = self.solve(right.of_rows.clone(), right.of_circle.to_vec(), these)?;
            residuals.append(&mut refined.residuals);
            let mut whole = refined.columns[0].x.clone();
            if let Some(prior) = right.prior {
                add(&mut whole, prior);
            }
            let factor = chi_squares(self.sums, &self.data_residuals(&whole)).all.max(1.0).sqrt();
            let factors = Factors::new(blocks, &found.regularisation);
            let ratio = on_circle.sampled_ratio(&self.regularisation, &factors, &found.ratio, self.watch);
            let x = &refined.columns[0].x;
            let next = on_circle.next(&found.fit, x, (factor, &ratio))?;
            let change = next.fit.change(&found.fit).max((factor / found.noise_factor()).ln().abs());
            let is_spent = round > 1 && residuals.len() >= passes_max;
            let has_settled = change <= SETTLED || round >= ROUNDS_MAX;
            if has_settled || is_spent || !self.watch.may_continue() {
                // Of the R that this map has.
                let found = on_circle.estimated(&found.fit, x, (factor, &ratio))?;
                let iterations = residuals.len();
                let convergence = refined.convergence.map(|last| Convergence {
                    iterations,
                    converged: last.converged && has_settled,
                    ..last
                });
                return Ok((RefinedColumns { residuals, convergence, ..refined }, found));
            }
            steps.start = Some(refined.columns.map(|column| column.x));
            found = next;
        }
        Err(SolveError::NoPower)
    }
}
