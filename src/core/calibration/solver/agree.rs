//! Test whether the pairs of some daughters contradict those of the others about positions.
//!
//! A wrong minimum may leave little of the signal of any one daughter unexplained. But where it involves several
//! daughters, their pairs hold one another in place. So the data are solved again without the pairs of each daughter
//! in turn, starting from the solution. The decrease of the remaining cost is small if the model is right: between
//! two solutions of which one has more data, the difference d has the covariance C_rest - C_all (Hausman 1978,
//! Econometrica 46, 1251), so that the decrease d' F d, with F the information of the remaining data, has the mean tr
//! F (C_rest - C_all) = parameters - tr F C_all, as a chi-square with so many degrees of freedom.

use super::layout::ParameterLayout;
use super::newton::NewtonFit;
use super::sums::PairSums;

/// Significance, in standard deviations, of a decrease that shows a contradiction.
const SIGMAS: f64 = 3.0;

/// Maximum number of iterations without a daughter.
const ITERATIONS_MAX: usize = 20;

/// Whether any daughter, except the reference, contradicts the others.
pub(super) fn is_contradicted(layout: &ParameterLayout, found: &NewtonFit, sums: &[PairSums]) -> bool {
    let contradicts = |daughter: usize| {
        let has_daughter = |sums: &PairSums| [sums.pair.i, sums.pair.j].map(usize::from).contains(&daughter);
        let (removed, rest): (Vec<PairSums>, Vec<PairSums>) =
            sums.iter().partition(|sums| has_daughter(sums));
        if removed.is_empty() || rest.is_empty() {
            return false;
        }
        let refit = layout.minimise(found.values.clone(), &rest, None, ITERATIONS_MAX);
        let decrease = layout.cost(&found.values, &rest, None) - layout.cost(&refit.values, &rest, None);
        let (information, _) = layout.normal(&found.values, &rest, None);
        let trace: f64 = information.iter().zip(&found.covariance).map(|(a, b)| a * b).sum();
        let degrees_of_freedom = layout.order() as f64 - trace;
        decrease > chi_square_limit(degrees_of_freedom)
    };
    (0..layout.satellites).filter(|daughter| *daughter != layout.reference).any(contradicts)
}

/// Chi-square that is exceeded with the probability of [`SIGMAS`] standard deviations of a Gaussian (Wilson &
/// Hilferty 1931).
fn chi_square_limit(degrees_of_freedom: f64) -> f64 {
    // The approximation fails below one degree of freedom.
    let degrees_of_freedom = degrees_of_freedom.max(1.0);
    let spread = 2.0 / (9.0 * degrees_of_freedom);
    degrees_of_freedom * (1.0 - spread + SIGMAS * spread.sqrt()).powi(3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_match_published_tables() {
        // Chi-square exceeded with a probability of 0.00135, that of three deviations on one side.
        for (degrees_of_freedom, expected) in [(1.0, 10.27), (4.0, 17.80), (10.0, 28.79), (50.0, 85.37)] {
            let found = chi_square_limit(degrees_of_freedom);
            // The approximation is good to some percent at one degree of freedom.
            assert!((found / expected - 1.0).abs() < 0.03, "{degrees_of_freedom}: {found}, {expected}");
        }
    }
}
