//! Traces of the covariances of a map: thermal noise and imperfection (the paper, Sect. 4), and of what the data decide, with their
//! error.
//!
//! Where the matrix can be held, its eigenvalues give them without probes. Otherwise random probes do: the trace of f(A) is
//! the mean of `v.f(A)v` over vectors v of random signs (Hutchinson), and k Lanczos steps from v bound each of these.
//! With `g1 = 1 / (x + eps)` and `g2 = 1 / (x + eps)^2`, whose derivatives alternate in sign, Gauss quadrature is below
//! `v.g(A)v` and Gauss-Radau quadrature with a node below the spectrum above it (Golub & Meurant 2010). Steps go on until
//! these bounds meet, and the remaining distance is part of the error.
//!
//! The engine's eigenvalues differ from those of `BtN^-1B` by what [`Accuracy`] says, and each moves its term of a trace by
//! what f changes over that distance. That is part of the error too, and an epsilon that it makes meaningless is refused.

use faer::{Mat, Side};
use rand_distr::{Distribution, StandardNormal};
use thiserror::Error;

use super::lanczos::{Krylov, tridiagonal_eigen};
use super::watch::NamedWatch;
use crate::imaging::{Accuracy, NormalSums};
use crate::units::{StreamKind, random_stream};

/// Most unknowns whose matrix is held and decomposed: nside 16, 75 MB, half a minute.
pub const HELD_MAX: usize = 3072;
/// Most steps from one probe.
const STEPS_MAX: usize = 300;
/// Steps between looks at the bounds.
const STEPS_BETWEEN: usize = 20;
/// Distance of the bounds, relative to them, at which steps end: a tenth of the spread of a few probes, or less.
const CLOSED: f64 = 1e-3;
/// Greatest part of a trace that the accuracy of the matrix may leave open.
const OPEN_MAX: f64 = 0.5;

/// A value with its error.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, bincode::Encode, bincode::Decode)]
pub struct Estimate {
    /// Value.
    pub value: f64,
    /// What it may be off by: the standard error over probes (none if the matrix was held, infinite for a single one), half
    /// the distance of the bounds on each, and what the accuracy of BtN^-1B leaves open.
    pub error: f64,
}

impl std::ops::Div<f64> for Estimate {
    type Output = Self;

    fn div(self, by: f64) -> Self {
        Self { value: self.value / by, error: self.error / by }
    }
}

/// Traces of the thermal covariance and of the imperfection (the paper, Sect. 4).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, bincode::Encode, bincode::Decode)]
pub struct Traces {
    /// `sum W / (W + eps)^2`, K^2.
    pub sigma_n_k2: Estimate,
    /// `sum (eps / (W + eps))^2` over the unknowns.
    pub sigma_s: Estimate,
    /// `Tr A (A + R)^-1 = sum W / (W + eps)`, A the normal matrix: as many unknowns do the data decide.
    pub measured: Estimate,
    /// Random probes; 0 if the matrix was held.
    pub probes: usize,
}

/// An epsilon for which the engine's sums determine no traces.
#[derive(Clone, Copy, Debug, Error, PartialEq, serde::Serialize, bincode::Encode, bincode::Decode)]
#[error(
    "no traces at epsilon = {epsilon:e}: eigenvalues that decide them are known to {accuracy:e} of W_max only; expected a \
     larger epsilon, or map.engine = \"pixel\", which keeps more digits"
)]
pub struct UnsupportedEpsilon {
    /// epsilon.
    pub epsilon: f64,
    /// Accuracy of the engine's eigenvalues, of W_max.
    pub accuracy: f64,
}

/// Both traces for R = `epsilon` `w_max` I.
///
/// Of matrices of up to [`HELD_MAX`] unknowns from their eigenvalues, else from `probes` random probes. `None` if they were
/// interrupted.
///
/// # Errors
/// An epsilon that the accuracy of the sums does not support.
pub fn traces(
    sums: &dyn NormalSums,
    epsilon: f64,
    w_max: f64,
    probes: usize,
    watch: NamedWatch<'_>,
) -> Result<Option<Traces>, UnsupportedEpsilon> {
    if sums.unknowns() > HELD_MAX {
        return probed_traces(sums, epsilon, w_max, probes, watch);
    }
    let Some(matrix) = held_matrix(sums, watch) else { return Ok(None) };
    let Some(eigenvalues) = eigenvalues_of(matrix) else {
        return probed_traces(sums, epsilon, w_max, probes, watch);
    };
    let functions = Functions::new(sums, epsilon, w_max);
    functions.accept(functions.traces(&[Bounds::exact(functions, &eigenvalues)]), epsilon, w_max).map(Some)
}

/// As [`traces`], from random probes in any case.
///
/// # Errors
/// An epsilon that the accuracy of the sums does not support.
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
    if functions.delta > OPEN_MAX * functions.eps {
        return Err(unsupported);
    }
    match probe(sums, functions, probes, watch) {
        ProbeOutcome::Interrupted => Ok(None),
        ProbeOutcome::NoBounds => Err(unsupported),
        ProbeOutcome::Bounds(bounds) => functions.accept(functions.traces(&bounds), epsilon, w_max).map(Some),
    }
}

/// A matrix that is small enough to be held; `None` if it was interrupted.
fn held_matrix(sums: &dyn NormalSums, watch: NamedWatch<'_>) -> Option<Mat<f64>> {
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
    // The decomposition's thresholds are absolute: the matrix has to be of order one.
    let scale = (0..matrix.nrows()).map(|k| matrix[(k, k)].abs()).fold(f64::MIN_POSITIVE, f64::max);
    matrix *= faer::Scale(1.0 / scale);
    let eigenvalues = matrix.self_adjoint_eigenvalues(Side::Lower).ok()?;
    Some(eigenvalues.into_iter().map(|w| w * scale).collect())
}

/// Number of the traces.
const COUNT: usize = 3;

/// The functions of an eigenvalue whose sums are the traces.
#[derive(Clone, Copy)]
struct Functions {
    /// eps, K^-2.
    eps: f64,
    /// How far an eigenvalue of zero may be off, K^-2.
    delta: f64,
    /// How far others may be off besides, of themselves.
    relative: f64,
}

impl Functions {
    fn new(sums: &dyn NormalSums, epsilon: f64, w_max: f64) -> Self {
        let Accuracy { relative, absolute } = sums.accuracy();
        Self { eps: epsilon * w_max, delta: absolute * w_max, relative }
    }

    /// The traces, unless accuracy leaves too much of them open.
    fn accept(
        self,
        (traces, open): (Traces, [f64; COUNT]),
        epsilon: f64,
        w_max: f64,
    ) -> Result<Traces, UnsupportedEpsilon> {
        let values = [traces.sigma_n_k2.value, traces.sigma_s.value];
        // What is open of an eigenvalue near nothing is at most 1 of the third trace, which counts all the others.
        let is_known = values.iter().zip(open).all(|(value, open)| open <= OPEN_MAX * value);
        if is_known { Ok(traces) } else { Err(UnsupportedEpsilon { epsilon, accuracy: self.delta / w_max }) }
    }

    fn thermal(self, w: f64) -> f64 {
        w / ((w + self.eps) * (w + self.eps))
    }

    fn imperfect(self, w: f64) -> f64 {
        (self.eps / (w + self.eps)).powi(2)
    }

    fn measured(self, w: f64) -> f64 {
        w / (w + self.eps)
    }

    /// How far the terms of an eigenvalue may be off: it is not negative, and as near to what was found as the accuracy says.
    fn open(self, w: f64) -> [f64; COUNT] {
        let w = w.max(0.0);
        let off = self.relative * w + self.delta;
        let (low, high) = ((w - off).max(0.0), w + off);
        // The first rises up to eps, and falls beyond.
        let ends = [low, high, self.eps.clamp(low, high)].map(|x| (self.thermal(x) - self.thermal(w)).abs());
        let most = |f: &dyn Fn(f64) -> f64| (f(low) - f(w)).abs().max((f(high) - f(w)).abs());
        [ends.into_iter().fold(0.0, f64::max), most(&|x| self.imperfect(x)), most(&|x| self.measured(x))]
    }

    /// The traces from one exact sum, or from those of several probes; and what accuracy leaves open of them.
    fn traces(self, sums: &[Bounds]) -> (Traces, [f64; COUNT]) {
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
            let open = mean(&|sum| sum.open[k]);
            (Estimate { value, error: scatter + half + open }, open)
        };
        let [(sigma_n_k2, open_n), (sigma_s, open_s), (measured, open_m)] = [0, 1, 2].map(estimate);
        let probes = if exact { 0 } else { sums.len() };
        (Traces { sigma_n_k2, sigma_s, measured, probes }, [open_n, open_s, open_m])
    }
}

/// Bounds on the traces, or on those of one probe.
struct Bounds {
    low: [f64; COUNT],
    high: [f64; COUNT],
    /// What the accuracy of the matrix leaves open.
    open: [f64; COUNT],
    is_exact: bool,
}

impl Bounds {
    fn exact(functions: Functions, eigenvalues: &[f64]) -> Self {
        let mut sums = [0.0; COUNT];
        let mut open = [0.0; COUNT];
        for &w in eigenvalues {
            let w = w.max(0.0);
            let terms = [functions.thermal(w), functions.imperfect(w), functions.measured(w)];
            sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
            open.iter_mut().zip(functions.open(w)).for_each(|(sum, term)| *sum += term);
        }
        Self { low: sums, high: sums, open, is_exact: true }
    }

    /// Largest distance of the bounds relative to their middle.
    fn distance(&self) -> f64 {
        let of = |k: usize| (self.high[k] - self.low[k]).abs() / (0.5 * (self.high[k] + self.low[k])).abs();
        of(0).max(of(1))
    }
}

/// What random probes gave.
enum ProbeOutcome {
    /// Bounds of each, if there are any.
    Bounds(Vec<Bounds>),
    /// Bounds that make no sense, as rounding has the last word.
    NoBounds,
    Interrupted,
}

fn probe(sums: &dyn NormalSums, functions: Functions, probes: usize, watch: NamedWatch<'_>) -> ProbeOutcome {
    let mut all = Vec::new();
    for probe in 0..probes {
        let task = watch.start(&format!("trace {} of {probes}", probe + 1), CLOSED);
        let mut krylov = Krylov::new(signs(sums.unknowns(), probe));
        let mut bounds = None;
        for step in 1..=STEPS_MAX.min(sums.unknowns()) {
            let is_open = krylov.step(sums);
            let distance = if !is_open || step % STEPS_BETWEEN == 0 || step == STEPS_MAX {
                bounds = quadratures(&krylov, functions, is_open, sums.unknowns() as f64);
                bounds.as_ref().map_or(f64::INFINITY, Bounds::distance)
            } else {
                f64::INFINITY
            };
            let wants = is_open && distance >= CLOSED;
            if !task.report_wanting(wants, step, distance.min(1.0)) {
                if wants {
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

/// Bounds from the quadratures of a probe whose square is `length`.
fn quadratures(krylov: &Krylov, functions: Functions, is_open: bool, length: f64) -> Option<Bounds> {
    let (alphas, betas) = (&krylov.alphas, &krylov.betas);
    let count = alphas.len();
    let gauss = rule(alphas, &betas[..count - 1])?;
    // A closed space has no more to give.
    let radau = match betas.get(count - 1).filter(|_| is_open) {
        None => gauss.clone(),
        Some(&beta) => {
            let below = -functions.delta;
            // The last pivot of T - below I: the node is an eigenvalue where that of the next row vanishes.
            let mut pivot = alphas[0] - below;
            for (alpha, beta) in alphas[1..].iter().zip(betas) {
                pivot = alpha - below - beta * beta / pivot;
            }
            // Negative below all eigenvalues by rounding alone.
            if pivot <= 0.0 {
                return None;
            }
            let longer = [alphas.as_slice(), &[below + beta * beta / pivot]].concat();
            rule(&longer, &betas[..count])?
        }
    };
    let Functions { eps, .. } = functions;
    let sum = |rule: &Rule, power: i32| -> f64 {
        length * rule.iter().map(|(w, c)| c * (w + eps).powi(-power)).sum::<f64>()
    };
    let [low_1, low_2] = [1, 2].map(|power| sum(&gauss, power));
    let [high_1, high_2] = [1, 2].map(|power| sum(&radau, power));
    // w / (w + eps)^2 = g1 - eps g2.
    let mut open = [0.0; COUNT];
    for (w, c) in &gauss {
        open.iter_mut().zip(functions.open(*w)).for_each(|(sum, term)| *sum += length * c * term);
    }
    Some(Bounds {
        // w / (w + eps) = 1 - eps g1, and the square of the probe is `length`.
        low: [(low_1 - eps * high_2).max(0.0), eps * eps * low_2, (length - eps * high_1).max(0.0)],
        high: [high_1 - eps * low_2, eps * eps * high_2, length - eps * low_1],
        open,
        is_exact: false,
    })
}

/// The quadrature rule of a tridiagonal matrix: its eigenvalues, and squares of the first components of its eigenvectors.
fn rule(alphas: &[f64], betas: &[f64]) -> Option<Rule> {
    let (eigenvalues, vectors) = tridiagonal_eigen(alphas, betas)?;
    Some(eigenvalues.iter().enumerate().map(|(k, w)| (*w, vectors[(0, k)].powi(2))).collect())
}

/// A probe of random signs, which gives traces the least spread.
fn signs(order: usize, probe: usize) -> Vec<f64> {
    let mut stream = random_stream(2, StreamKind::Probe, [order as u64, probe as u64]);
    let mut sign = || -> f64 { StandardNormal.sample(&mut stream) };
    (0..order).map(|_| sign().signum()).collect()
}
