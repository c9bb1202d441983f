//! Whether the pairs of some daughters want other positions than those of the rest.
//!
//! A wrong minimum may leave little of the signal of any one daughter. But where several daughters take part in it, their pairs hold one
//! another in place. So the rest is solved again without the pairs of each daughter in turn, from where the solution is. What this saves
//! of the rest's cost is small if all is as the model says: of two solutions of which one has more data, the difference d has the covariance
//! C_rest - C_all (Hausman 1978, Econometrica 46, 1251), so that the saved d' F d, with F the information of the rest, has the mean tr F (C_rest - C_all) =
//! parameters - tr F C_all, as a chi-square of so many degrees of freedom.

use super::layout::ParameterLayout;
use super::newton::NewtonFit;
use super::sums::PairSums;

/// Standard deviations of what is saved beyond which daughters contradict one another.
const SIGNIFICANT: f64 = 3.0;

/// Most iterations without a daughter.
const ITERATIONS: usize = 20;

/// Whether any daughter but the reference contradicts the others.
pub(super) fn is_contradicted(layout: &ParameterLayout, found: &NewtonFit, sums: &[PairSums]) -> bool {
    let without = |daughter: usize| {
        let is_of = |sums: &PairSums| [sums.pair.i, sums.pair.j].map(usize::from).contains(&daughter);
        let (own, rest): (Vec<PairSums>, Vec<PairSums>) = sums.iter().partition(|sums| is_of(sums));
        if own.is_empty() || rest.is_empty() {
            return false;
        }
        let again = layout.minimise(found.values.clone(), &rest, None, ITERATIONS);
        let saved = layout.cost(&found.values, &rest, None) - layout.cost(&again.values, &rest, None);
        let (information, _) = layout.normal(&found.values, &rest, None);
        let kept: f64 = information.iter().zip(&found.covariance).map(|(a, b)| a * b).sum();
        let freedom = layout.order() as f64 - kept;
        saved > limit(freedom)
    };
    (0..layout.satellites).filter(|daughter| *daughter != layout.reference).any(without)
}

/// Chi-square, for these degrees of freedom, as unlikely as a Gaussian's significant deviation (Wilson & Hilferty 1931).
fn limit(freedom: f64) -> f64 {
    // Below one the approximation fails.
    let freedom = freedom.max(1.0);
    let spread = 2.0 / (9.0 * freedom);
    freedom * (1.0 - spread + SIGNIFICANT * spread.sqrt()).powi(3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_are_those_of_tables() {
        // Chi-square exceeded with a probability of 0.00135, that of three deviations on one side.
        for (freedom, expected) in [(1.0, 10.27), (4.0, 17.80), (10.0, 28.79), (50.0, 85.37)] {
            let found = limit(freedom);
            // The approximation is good to some percent at one degree of freedom.
            assert!((found / expected - 1.0).abs() < 0.03, "{freedom}: {found}, {expected}");
        }
    }
}
