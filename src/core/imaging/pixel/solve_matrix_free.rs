//! Solves for pixel maps without a stored matrix, by conjugate gradients.

use super::solve::PixelSolution;
use crate::imaging::SolveError;
use crate::imaging::regulariser::Diagonal;
use crate::imaging::solver::{Diagnostics, NamedWatch, add, check_request, right_hand_side};
use crate::imaging::solver::{LargestEigenvalue, largest_eigenvalue_from, random_vector};
use crate::imaging::solver::{StoppingRule, System};
use crate::imaging::{MatrixFreeSums, NormalSums};

/// Relative change of W_max at which it has converged: above the error of products, some 1e-7. W_max only scales R, so its error changes the
/// map by less than the residual of the iteration does.
const W_MAX_TOLERANCE: f64 = 1e-6;

/// Solves as [`crate::imaging::solve_pixels`], by conjugate gradients. Each product computes each row of B once for the map and the
/// noise-only map. `start` holds earlier solutions of both, without the prior.
///
/// # Errors
/// There is no data, or the prior has another size; [`SolveError::Interrupted`].
pub fn solve_matrix_free(
    sums: &MatrixFreeSums,
    epsilon: f64,
    prior_k: Option<&[f64]>,
    start: Option<[Vec<f64>; 2]>,
    rule: StoppingRule,
    watch: NamedWatch<'_>,
) -> Result<(PixelSolution, [Vec<f64>; 2]), SolveError> {
    check_request(sums, epsilon)?;
    let pixels = sums.unknowns();
    let right = right_hand_side(sums, prior_k)?;
    let LargestEigenvalue { value: w_max, iterations, .. } = {
        let task = watch.start("largest eigenvalue", W_MAX_TOLERANCE);
        largest_eigenvalue_from(
            random_vector(pixels),
            sums,
            W_MAX_TOLERANCE,
            &mut |needs_step, step, change| task.report_step(needs_step, step, change),
        )
    };
    if !watch.may_continue() {
        return Err(SolveError::Interrupted);
    }
    let system = System {
        sums,
        regularisation: Diagonal::Uniform(epsilon * w_max),
        // Preconditioning by the diagonal saved no product in trials with random pairs at nside 16.
        precondition: &|_| (),
    };
    let mut solved = match start {
        Some(start) if start.iter().all(|x| x.len() == pixels) => start.to_vec(),
        _ => vec![vec![0.0; pixels]; 2],
    };
    let task = watch.start("map", rule.residual_max);
    let convergence =
        system.solve(&[&right, sums.noise_right_hand_side()], &mut solved, &[rule, rule], &task);
    drop(task);
    if solved[0].iter().all(|x| *x == 0.0) && !watch.may_continue() {
        return Err(SolveError::Interrupted);
    }
    let mut columns = solved.into_iter();
    let unknowns = [(); 2].map(|()| columns.next().unwrap_or_default());
    let [mut map_k, noise_k] = unknowns.clone();
    if let Some(prior_k) = prior_k {
        add(&mut map_k, prior_k);
    }
    let diagnostics = Diagnostics {
        epsilon: Some(epsilon),
        w_max: Some(w_max),
        w_max_iterations: iterations,
        ..Diagnostics::default()
    }
    .with_convergence(&convergence);
    Ok((PixelSolution { map_k, noise_k, beams: Vec::new(), diagnostics }, unknowns))
}
