//! Traces of the covariances of a map (thermal noise and imperfection; the paper, Sect. 5.1) and of the data's resolution matrix, with errors.
//!
//! If the matrix can be stored, its eigenvalues give the traces. Otherwise random probes do (Hutchinson): the trace of f(A) is the mean of
//! `v.f(A)v` over vectors v of random signs, and k Lanczos steps from v bound each term. For `g1 = 1 / (x + eps)` and
//! `g2 = 1 / (x + eps)^2`, whose derivatives alternate in sign, Gauss quadrature is a lower bound of `v.g(A)v`, and Gauss-Radau quadrature
//! with a node below the spectrum is an upper bound (Golub & Meurant 2010). Steps continue until the bounds meet; their remaining distance
//! is part of the error.
//!
//! The engine's eigenvalues differ from those of `BtN^-1B` within [`Accuracy`]; the change of f over that distance is part of the error
//! too. An epsilon for which this error dominates is refused.

use faer::{Mat, Side};
use rand_distr::{Distribution, StandardNormal};
use thiserror::Error;

use super::lanczos::{Krylov, tridiagonal_eigen};
use super::watch::NamedWatch;
use crate::imaging::{Accuracy, NormalSums};
use crate::units::{StreamKind, random_stream};

/// Maximum number of unknowns whose matrix is stored and decomposed: nside 16, 75 MB, half a minute.
pub const STORED_MAX: usize = 3072;
/// Maximum number of steps per probe.
const STEPS_MAX: usize = 300;
/// Steps between evaluations of the bounds.
const STEPS_BETWEEN: usize = 20;
/// Relative distance of the bounds at which steps end: at most a tenth of the spread of a few probes.
const DISTANCE_MAX: f64 = 1e-3;
/// Maximum error of a trace from the accuracy of the matrix, as a fraction of the trace.
const ACCURACY_FRACTION_MAX: f64 = 0.5;

/// A value with its error.
#[derive(
    Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize, bincode::Encode, bincode::Decode,
)]
pub struct Estimate {
    /// Value.
    pub value: f64,
    /// Error: the sum of the standard error over probes (0 if the matrix was stored, infinite for a single probe), half the
    /// distance of the bounds, and the effect of the accuracy of BtN^-1B.
    #[serde(deserialize_with = "infinite_if_null")]
    pub error: f64,
}

/// Reads a number that JSON has as null because it is infinite.
fn infinite_if_null<'a, D: serde::Deserializer<'a>>(from: D) -> Result<f64, D::Error> {
    Ok(<Option<f64> as serde::Deserialize>::deserialize(from)?.unwrap_or(f64::INFINITY))
}

impl std::ops::Div<f64> for Estimate {
    type Output = Self;

    fn div(self, by: f64) -> Self {
        Self { value: self.value / by, error: self.error / by }
    }
}

/// Traces of the thermal covariance, the imperfection (the paper, Sect. 5.1) and the resolution matrix.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, bincode::Encode, bincode::Decode)]
pub struct Traces {
    /// `sum W / (W + eps)^2`, K^2.
    pub sigma_n_k2: Estimate,
    /// `sum (eps / (W + eps))^2` over the unknowns.
    pub sigma_s: Estimate,
    /// `Tr A (A + R)^-1 = sum W / (W + eps)`, A the normal matrix: the number of unknowns that the data determine.
    pub measured: Estimate,
    /// Number of random probes; 0 if the matrix was stored.
    pub probes: usize,
}

/// An epsilon for which the engine's sums do not determine the traces.
#[derive(Clone, Copy, Debug, Error, PartialEq, serde::Serialize, bincode::Encode, bincode::Decode)]
#[error(
    "no traces at epsilon = {epsilon:e}: eigenvalues that decide them are known to {accuracy:e} of W_max only; expected a \
     larger epsilon, or map.engine = \"pixel\", which keeps more digits"
)]
pub struct UnsupportedEpsilon {
    /// The refused epsilon.
    pub epsilon: f64,
    /// Accuracy of the engine's eigenvalues as a fraction of W_max.
    pub accuracy: f64,
}

/// Computes the traces for R = `epsilon` `w_max` I: up to [`STORED_MAX`] unknowns from eigenvalues, else from `probes` random probes. `None`
/// if interrupted.
///
/// # Errors
/// The accuracy of the sums does not support this epsilon.
pub fn traces(
    sums: &dyn NormalSums,
    epsilon: f64,
    w_max: f64,
    probes: usize,
    watch: NamedWatch<'_>,
) -> Result<Option<Traces>, UnsupportedEpsilon> {
    if sums.unknowns() > STORED_MAX {
        return probed_traces(sums, epsilon, w_max, probes, watch);
    }
    let Some(matrix) = stored_matrix(sums, watch) else { return Ok(None) };
    let Some(eigenvalues) = eigenvalues_of(matrix) else {
        return probed_traces(sums, epsilon, w_max, probes, watch);
    };
    let functions = Functions::new(sums, epsilon, w_max);
    functions.accept(functions.traces(&[Bounds::exact(functions, &eigenvalues)]), epsilon, w_max).map(Some)
}

/// Computes the traces as [`traces`], but always from random probes.
///
/// # Errors
/// The accuracy of the sums does not support this epsilon.
pub fn probed_traces(
    sums: &dyn NormalSums,
    epsilon: f64,
    w_max: f64,
    probes: usize,
    watch: NamedWatch<'_>,
) -> Result<Option<Traces>, UnsupportedEpsilon> {
    let functions = Functions::new(sums, epsilon, w_max);
    let unsupported = UnsupportedEpsilon { epsilon, accuracy: sums.accuracy().absolute };
    // The functions have a pole at -eps, and bounds need a node below the spectrum.
    if functions.delta > ACCURACY_FRACTION_MAX * functions.eps {
        return Err(unsupported);
    }
    match probe(sums, functions, probes, watch) {
        ProbeOutcome::Interrupted => Ok(None),
        ProbeOutcome::NoBounds => Err(unsupported),
        ProbeOutcome::Bounds(bounds) => functions.accept(functions.traces(&bounds), epsilon, w_max).map(Some),
    }
}

/// Forms the matrix column by column; `None` if interrupted.
fn stored_matrix(sums: &dyn NormalSums, watch: NamedWatch<'_>) -> Option<Mat<f64>> {
    let order = sums.unknowns();
    let task = watch.start("eigenvalues", 0.0);
    let mut matrix = Mat::<f64>::zeros(order, order);
    let (mut unit, mut column) = (vec![0.0; order], vec![0.0; order]);
    for k in 0..order {
        unit[k] = 1.0;
        sums.apply(&unit, &mut column);
        unit[k] = 0.0;
        for (row, x) in column.iter().enumerate() {
            matrix[(row, k)] += 0.5 * x;
            matrix[(k, row)] += 0.5 * x;
        }
        if !task.report(k, 1.0 - k as f64 / order as f64) {
            return None;
        }
    }
    Some(matrix)
}

/// Eigenvalues of a symmetric matrix.
fn eigenvalues_of(mut matrix: Mat<f64>) -> Option<Vec<f64>> {
    // The decomposition has absolute thresholds, so the matrix is scaled to order one.
    let scale = (0..matrix.nrows()).map(|k| matrix[(k, k)].abs()).fold(f64::MIN_POSITIVE, f64::max);
    matrix *= faer::Scale(1.0 / scale);
    let eigenvalues = matrix.self_adjoint_eigenvalues(Side::Lower).ok()?;
    Some(eigenvalues.into_iter().map(|w| w * scale).collect())
}

/// Number of traces.
const TRACES: usize = 3;

/// The functions of an eigenvalue that sum to the traces.
#[derive(Clone, Copy)]
struct Functions {
    /// eps, K^-2.
    eps: f64,
    /// Absolute error of eigenvalues, K^-2.
    delta: f64,
    /// Relative error of eigenvalues, in addition.
    relative: f64,
}

impl Functions {
    fn new(sums: &dyn NormalSums, epsilon: f64, w_max: f64) -> Self {
        let Accuracy { relative, absolute } = sums.accuracy();
        Self { eps: epsilon * w_max, delta: absolute * w_max, relative }
    }

    /// The traces, unless the accuracy of the matrix leaves too large an error.
    fn accept(
        self,
        (traces, errors): (Traces, [f64; TRACES]),
        epsilon: f64,
        w_max: f64,
    ) -> Result<Traces, UnsupportedEpsilon> {
        let values = [traces.sigma_n_k2.value, traces.sigma_s.value];
        // The third trace needs no check: an uncertain eigenvalue changes it by at most 1.
        let is_accurate =
            values.iter().zip(errors).all(|(value, error)| error <= ACCURACY_FRACTION_MAX * value);
        if is_accurate {
            Ok(traces)
        } else {
            Err(UnsupportedEpsilon { epsilon, accuracy: self.delta / w_max })
        }
    }

    fn thermal(self, w: f64) -> f64 {
        w / ((w + self.eps) * (w + self.eps))
    }

    fn imperfection(self, w: f64) -> f64 {
        (self.eps / (w + self.eps)).powi(2)
    }

    fn measured(self, w: f64) -> f64 {
        w / (w + self.eps)
    }

    /// Errors of the terms of an eigenvalue, which is not negative and within its accuracy of `w`.
    fn term_errors(self, w: f64) -> [f64; TRACES] {
        let w = w.max(0.0);
        let error = self.relative * w + self.delta;
        let (low, high) = ((w - error).max(0.0), w + error);
        // The first function has its maximum at eps.
        let thermal_changes =
            [low, high, self.eps.clamp(low, high)].map(|x| (self.thermal(x) - self.thermal(w)).abs());
        let change_max = |f: &dyn Fn(f64) -> f64| (f(low) - f(w)).abs().max((f(high) - f(w)).abs());
        [
            thermal_changes.into_iter().fold(0.0, f64::max),
            change_max(&|x| self.imperfection(x)),
            change_max(&|x| self.measured(x)),
        ]
    }

    /// The traces from one exact sum or from those of several probes, with their errors from the accuracy of the matrix.
    fn traces(self, sums: &[Bounds]) -> (Traces, [f64; TRACES]) {
        let count = sums.len() as f64;
        let mean = |of: &dyn Fn(&Bounds) -> f64| sums.iter().map(of).sum::<f64>() / count;
        let exact = sums.iter().all(|sum| sum.is_exact);
        let estimate = |k: usize| {
            let middle = |sum: &Bounds| 0.5 * (sum.low[k] + sum.high[k]);
            let value = mean(&middle);
            let squares: f64 = sums.iter().map(|sum| (middle(sum) - value).powi(2)).sum();
            let scatter = match sums.len() {
                _ if exact => 0.0,
                0 | 1 => f64::INFINITY,
                _ => (squares / (count - 1.0) / count).sqrt(),
            };
            let half = mean(&|sum| 0.5 * (sum.high[k] - sum.low[k]).abs());
            let from_accuracy = mean(&|sum| sum.accuracy_error[k]);
            (Estimate { value, error: scatter + half + from_accuracy }, from_accuracy)
        };
        let [(sigma_n_k2, error_n), (sigma_s, error_s), (measured, error_m)] = [0, 1, 2].map(estimate);
        let probes = if exact { 0 } else { sums.len() };
        (Traces { sigma_n_k2, sigma_s, measured, probes }, [error_n, error_s, error_m])
    }
}

/// Bounds on the traces, from all eigenvalues or from one probe.
struct Bounds {
    low: [f64; TRACES],
    high: [f64; TRACES],
    /// Error from the accuracy of the matrix.
    accuracy_error: [f64; TRACES],
    is_exact: bool,
}

impl Bounds {
    fn exact(functions: Functions, eigenvalues: &[f64]) -> Self {
        let mut sums = [0.0; TRACES];
        let mut accuracy_error = [0.0; TRACES];
        for &w in eigenvalues {
            let w = w.max(0.0);
            let terms = [functions.thermal(w), functions.imperfection(w), functions.measured(w)];
            sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
            accuracy_error.iter_mut().zip(functions.term_errors(w)).for_each(|(sum, term)| *sum += term);
        }
        Self { low: sums, high: sums, accuracy_error, is_exact: true }
    }

    /// Largest distance of the bounds relative to their middle.
    fn distance(&self) -> f64 {
        let of = |k: usize| (self.high[k] - self.low[k]).abs() / (0.5 * (self.high[k] + self.low[k])).abs();
        of(0).max(of(1))
    }
}

/// The result of random probing.
enum ProbeOutcome {
    /// Bounds from each probe.
    Bounds(Vec<Bounds>),
    /// Rounding errors make the bounds meaningless.
    NoBounds,
    Interrupted,
}

fn probe(sums: &dyn NormalSums, functions: Functions, probes: usize, watch: NamedWatch<'_>) -> ProbeOutcome {
    let mut all = Vec::new();
    for probe in 0..probes {
        let task = watch.start(&format!("trace {} of {probes}", probe + 1), DISTANCE_MAX);
        let mut krylov = Krylov::new(random_signs(sums.unknowns(), probe));
        let mut bounds = None;
        for step in 1..=STEPS_MAX.min(sums.unknowns()) {
            let can_grow = krylov.step(sums);
            let distance = if !can_grow || step % STEPS_BETWEEN == 0 || step == STEPS_MAX {
                bounds = quadratures(&krylov, functions, can_grow, sums.unknowns() as f64);
                bounds.as_ref().map_or(f64::INFINITY, Bounds::distance)
            } else {
                f64::INFINITY
            };
            let needs_step = can_grow && distance >= DISTANCE_MAX;
            if !task.report_step(needs_step, step, distance.min(1.0)) {
                if needs_step {
                    return ProbeOutcome::Interrupted;
                }
                break;
            }
        }
        match bounds {
            Some(bounds) => all.push(bounds),
            None => return ProbeOutcome::NoBounds,
        }
    }
    ProbeOutcome::Bounds(all)
}

/// Nodes and weights of a quadrature.
type Rule = Vec<(f64, f64)>;

/// Bounds from the quadratures of a probe whose squared norm is `norm_square`.
fn quadratures(krylov: &Krylov, functions: Functions, can_grow: bool, norm_square: f64) -> Option<Bounds> {
    let (alphas, betas) = (&krylov.alphas, &krylov.betas);
    let count = alphas.len();
    let gauss = quadrature_rule(alphas, &betas[..count - 1])?;
    // In an invariant subspace Gauss quadrature is exact.
    let radau = match betas.get(count - 1).filter(|_| can_grow) {
        None => gauss.clone(),
        Some(&beta) => {
            let below = -functions.delta;
            // The last pivot of T - below I; the node is an eigenvalue if the pivot of the next row vanishes.
            let mut pivot = alphas[0] - below;
            for (alpha, beta) in alphas[1..].iter().zip(betas) {
                pivot = alpha - below - beta * beta / pivot;
            }
            // All pivots are positive below the spectrum, except for rounding errors.
            if pivot <= 0.0 {
                return None;
            }
            let longer = [alphas.as_slice(), &[below + beta * beta / pivot]].concat();
            quadrature_rule(&longer, &betas[..count])?
        }
    };
    let Functions { eps, .. } = functions;
    let sum = |rule: &Rule, power: i32| -> f64 {
        norm_square * rule.iter().map(|(w, c)| c * (w + eps).powi(-power)).sum::<f64>()
    };
    let [low_1, low_2] = [1, 2].map(|power| sum(&gauss, power));
    let [high_1, high_2] = [1, 2].map(|power| sum(&radau, power));
    // w / (w + eps)^2 = g1 - eps g2.
    let mut accuracy_error = [0.0; TRACES];
    for (w, c) in &gauss {
        accuracy_error
            .iter_mut()
            .zip(functions.term_errors(*w))
            .for_each(|(sum, term)| *sum += norm_square * c * term);
    }
    Some(Bounds {
        // w / (w + eps) = 1 - eps g1, and the squared norm of the probe is `norm_square`.
        low: [(low_1 - eps * high_2).max(0.0), eps * eps * low_2, (norm_square - eps * high_1).max(0.0)],
        high: [high_1 - eps * low_2, eps * eps * high_2, norm_square - eps * low_1],
        accuracy_error,
        is_exact: false,
    })
}

/// The quadrature rule of a tridiagonal matrix: its eigenvalues, and squares of the first components of its eigenvectors.
fn quadrature_rule(alphas: &[f64], betas: &[f64]) -> Option<Rule> {
    let (eigenvalues, vectors) = tridiagonal_eigen(alphas, betas)?;
    Some(eigenvalues.iter().enumerate().map(|(k, w)| (*w, vectors[(0, k)].powi(2))).collect())
}

/// A probe of random signs, for which the variance of trace estimates is minimal.
fn random_signs(order: usize, probe: usize) -> Vec<f64> {
    let mut stream = random_stream(2, StreamKind::Probe, [order as u64, probe as u64]);
    let mut sign = || -> f64 { StandardNormal.sample(&mut stream) };
    (0..order).map(|_| sign().signum()).collect()
}
