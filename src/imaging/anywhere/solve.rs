//! Maps from positions as they are: conjugate gradients on the true normal equations, preconditioned by a circle's.
//!
//! A circle's rows are of no use for data from another orbit, but its normal matrix tells which modes are measured nearly as
//! well as the true one does. So
//!
//! ```text
//! (Bt N^-1 B + R) x = Bt N^-1 V,   preconditioned by   M = Bc^t N^-1 Bc + R
//! ```
//!
//! with B the rows of the true positions and Bc those of the nearest circle, converges in a few products with the former. M
//! is solved by inner conjugate gradients, so that the outer ones are flexible (Notay 2000, SIAM J. Sci. Comput. 22, 1444).
//! R is that of the circle's greatest eigenvalue. The map and the noise-only map share passes over the visibilities. An earlier
//! solution, of less data or of an iteration that was interrupted, costs one pass as a beginning and saves those that led to it.
//! Where all data are on the circle, within its limits, the beginning is the map of the circle's own sums: a pass says what the true rows
//! leave of it.

use std::collections::BTreeMap;
use std::fmt;

use num_complex::Complex64;
use serde::Serialize;

use crate::imaging::SolveError;
use crate::imaging::anywhere::{Departures, RefinedSums, orbit_phase_deg};
use crate::imaging::circle::{HarmonicRequest, HarmonicSolution, W_MAX_TOLERANCE, lifted, prior_unknowns};
use crate::imaging::circle::{OrderFactors, coefficients, unknowns_of_gradient};
use crate::imaging::pixel::{Diagnostics, check_request, subtract_prediction};
use crate::imaging::regulariser::Diagonal;
use crate::imaging::solver::NamedWatch;
use crate::imaging::solver::{Convergence, StoppingRule, System};
use crate::imaging::solver::{LargestEigenvalue, largest_eigenvalue_from};
use crate::imaging::solver::{add, dot, subtract};
use crate::imaging::{AccumulationError, NormalSums};
use crate::sky::harmonics::{Alm, synthesis};
use crate::sky::healpix::pixel_area_sr;
use crate::units::constants::DAY_S;

/// Residual of the inner iterations: well below the third to tenth that one outer step leaves. More exact ones save no outer step, and
/// cost more than a pass over the visibilities.
const INNER_RESIDUAL: f64 = 1e-2;

/// When a refinement stops.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RefineRule {
    /// Most products with the true matrix.
    pub passes_max: usize,
    /// Greatest residual, relative to the right-hand side, in the preconditioner's norm.
    pub residual_max: f64,
}

/// How a map was refined, and what remains of the data.
#[derive(Clone, Debug, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct Refinement {
    /// How the iteration for the map ended; its iterations are products with the true matrix.
    pub convergence: Convergence,
    /// Residual after each product.
    pub residuals: Vec<f64>,
    /// How far the positions are from the circle of the preconditioner.
    pub departures: Departures,
    /// Rows of B that were computed; the others were interpolated between them.
    pub rows_computed: u64,
    /// Averages over integrations that were taken for instants in their middle, as too few others of their pair are near.
    pub taken_as_instants: u64,
    /// Mean squares of what the map leaves of the data, in units of their noise.
    pub chi_square: ChiSquares,
}

/// `|V - B x|^2 w / 2`, the mean over visibilities: 1 for noise alone that the map does not fit.
#[derive(Clone, Debug, Default, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct ChiSquares {
    /// Of all.
    pub all: f64,
    /// By pair, `1-2`, counted from 1.
    pub by_pair: BTreeMap<String, f64>,
    /// By daughter, from 1: of all pairs that it is part of.
    pub by_daughter: BTreeMap<u16, f64>,
    /// By day of mission time, from 0.
    pub by_day: BTreeMap<i64, f64>,
    /// By phase of the orbit from its ascending node, in bins of 15 degrees named by their beginning. Visibilities without a neighbour,
    /// whose plane is not known, are in none.
    pub by_phase_deg: BTreeMap<u16, f64>,
}

/// Width of a bin of phase, degrees.
const PHASE_BIN_DEG: u16 = 15;

impl ChiSquares {
    /// A table: a line for all, and for each pair, daughter, phase and day.
    #[must_use]
    pub fn csv(&self) -> String {
        let mut table = String::from(
            "# Mean of |V - B x|^2 w / 2: what the map leaves of the data, in units of their noise; 1 for noise alone.\n\
             # by: all; pair; daughter, from 1; phase: beginning of 15 deg from the ascending node; day of the mission, from 0.\n\
             by,which,chi_square\n",
        );
        let mut line = |by: &str, which: &dyn fmt::Display, value: f64| {
            table.push_str(&format!("{by},{which},{value:.6e}\n"));
        };
        line("all", &"all", self.all);
        self.by_pair.iter().for_each(|(pair, value)| line("pair", pair, *value));
        self.by_daughter.iter().for_each(|(daughter, value)| line("daughter", daughter, *value));
        self.by_phase_deg.iter().for_each(|(phase_deg, value)| line("phase", phase_deg, *value));
        self.by_day.iter().for_each(|(day, value)| line("day", day, *value));
        table
    }
}

impl fmt::Display for Refinement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { convergence, departures, chi_square, .. } = self;
        match convergence.iterations {
            0 => write!(f, "the map that refinement begins with has a residual of")?,
            1 => write!(f, "refined in 1 pass to a residual of")?,
            passes => write!(f, "refined in {passes} passes to a residual of")?,
        }
        write!(
            f,
            " {:.1e}{}; {} visibilities on the circle of {:.1} km and {:.2} deg, {} up to \
             {:.2} km, {:.2} deg off its plane and {:.2} deg off the horizontal; chi-square {:.4}",
            convergence.residual,
            if convergence.converged { "" } else { " (not converged)" },
            departures.on_the_circle,
            departures.circle_radius_m / 1e3,
            departures.circle_inclination_deg,
            departures.by_refinement,
            departures.altitude_m_max / 1e3,
            departures.tilt_deg_max,
            departures.radial_deg_max,
            chi_square.all,
        )?;
        match self.taken_as_instants {
            0 => Ok(()),
            count => {
                write!(f, "; {count} averages over integrations taken for instants: too few others near them")
            }
        }
    }
}

impl From<AccumulationError> for SolveError {
    fn from(error: AccumulationError) -> Self {
        Self::Refinement(error.to_string())
    }
}

/// Where an iteration begins, and who is told of its steps.
pub struct RefineSteps<'a> {
    /// Earlier solutions: of the map, without its prior, and of the noise-only map.
    pub start: Option<[Vec<f64>; 2]>,
    /// Gets both after each pass.
    pub passed: &'a mut dyn FnMut([&[f64]; 2]),
}

/// Solves for the map and the noise-only map with the rows of the true positions.
///
/// # Errors
/// No data, or a prior whose size is not a map's; [`SolveError::Interrupted`] before the first pass is done.
pub fn solve_refined(
    sums: &RefinedSums,
    request: HarmonicRequest,
    rule: RefineRule,
    prior_k: Option<&[f64]>,
    steps: RefineSteps<'_>,
    watch: NamedWatch<'_>,
) -> Result<(HarmonicSolution, Refinement), SolveError> {
    check_request(&sums.circle, request.epsilon)?;
    let l_max = sums.circle.setup().l_max;
    let prior = prior_k.map(|map| prior_unknowns(map, l_max)).transpose()?;
    let blocks = sums.circle.order_blocks();
    let LargestEigenvalue { value: w_max, iterations, .. } = {
        let task = watch.start("largest eigenvalue", W_MAX_TOLERANCE);
        let (start, report) = (lifted(&blocks, sums.circle.unknowns()), &mut |wants, step, change| {
            task.report_wanting(wants, step, change)
        });
        largest_eigenvalue_from(start, &sums.circle, W_MAX_TOLERANCE, report)
    };
    let regularisation = request.epsilon * w_max;
    let factors = blocks.factors(regularisation);
    drop(blocks);
    let problem = RefinedProblem { sums, regularisation, inner: request.rule, factors };
    let mut data = sums.data.value_k_sr.clone();
    if let Some(prior) = &prior {
        let predicted = problem.forward(&[prior.as_slice()]);
        data.iter_mut().zip(&predicted[0]).for_each(|(value, predicted)| *value -= predicted);
    }
    let weighted: Vec<Complex64> =
        data.iter().zip(&sums.data.weight).map(|(value, weight)| value * *weight).collect();
    let noise: Vec<Complex64> =
        sums.data.noise.iter().zip(&sums.data.weight).map(|(noise, weight)| noise * weight.sqrt()).collect();
    let right = problem.adjoint(&[&weighted, &noise]);
    drop((weighted, noise));
    let mut circle_data = sums.circle.right_hand_side().to_vec();
    if let Some(prior) = &prior {
        subtract_prediction(&sums.circle, prior, &mut circle_data);
    }
    let [map, noise] = problem.solve(right, circle_data, data, rule, steps, watch);
    if map.was_left() {
        return Err(SolveError::Interrupted);
    }
    let area_sr = pixel_area_sr(request.nside);
    let synthesised = |x: &[f64]| synthesis(&coefficients(x, l_max), request.nside).map_err(SolveError::from);
    let mut whole = map.x.clone();
    if let Some(prior) = prior {
        add(&mut whole, &prior);
    }
    let diagnostics = Diagnostics {
        epsilon: Some(request.epsilon),
        w_max: Some(w_max * area_sr),
        w_max_iterations: iterations,
        l_max: Some(l_max),
        convergence: Some(map.convergence()),
        noise_convergence: Some(noise.convergence()),
        traces: None,
        traces_refused: None,
        fit: None,
    };
    let refinement = Refinement {
        convergence: map.convergence(),
        residuals: map.residuals.clone(),
        departures: sums.departures,
        rows_computed: sums.plan.computed() as u64,
        taken_as_instants: sums.plan.instants() as u64,
        chi_square: chi_squares(sums, &map.data),
    };
    let solution = HarmonicSolution {
        map_k: synthesised(&whole)?,
        noise_k: synthesised(&noise.x)?,
        unknowns: [map.x, noise.x],
        diagnostics,
        uncertainty: None,
    };
    Ok((solution, refinement))
}

/// The true normal equations and their preconditioner.
struct RefinedProblem<'a> {
    sums: &'a RefinedSums,
    regularisation: f64,
    /// When inner iterations stop, besides their residual.
    inner: StoppingRule,
    /// The circle's blocks of one order, plus R.
    factors: OrderFactors,
}

/// Solves several right-hand sides with the preconditioner.
type Precondition<'a> = &'a dyn Fn(&[&[f64]]) -> Vec<Vec<f64>>;

/// One right-hand side on its way.
struct Column {
    x: Vec<f64>,
    residual: Vec<f64>,
    direction: Vec<f64>,
    /// `r.Mr` now and `b.Mb`.
    energy: f64,
    whole: f64,
    /// What x leaves of the data; empty where nobody asks.
    data: Vec<Complex64>,
    residuals: Vec<f64>,
    rule: RefineRule,
    /// Whether rounding errors dominate.
    is_stuck: bool,
}

impl Column {
    fn relative(&self) -> f64 {
        if self.whole > 0.0 { (self.energy.max(0.0) / self.whole).sqrt() } else { 0.0 }
    }

    fn is_open(&self) -> bool {
        !self.is_stuck
            && self.relative() > self.rule.residual_max
            && self.residuals.len() < self.rule.passes_max
    }

    /// Whether nothing was done about it, although there was something to do.
    fn was_left(&self) -> bool {
        // The circle's solution, too, may have been interrupted, so that its energy says nothing.
        let is_new = self.x.iter().all(|x| *x == 0.0);
        is_new && self.residuals.is_empty() && !self.is_stuck && self.residual.iter().any(|r| *r != 0.0)
    }

    fn convergence(&self) -> Convergence {
        let residual = self.relative();
        Convergence {
            iterations: self.residuals.len(),
            residual,
            converged: residual <= self.rule.residual_max,
        }
    }
}

impl RefinedProblem<'_> {
    fn l_max(&self) -> usize {
        self.sums.circle.setup().l_max
    }

    /// `B x` for several x.
    fn forward(&self, x: &[&[f64]]) -> Vec<Vec<Complex64>> {
        let skies: Vec<_> = x.iter().map(|x| coefficients(x, self.l_max())).collect();
        self.sums.rows.forward(&self.sums.plan, &skies)
    }

    /// `Bt v` for several v.
    fn adjoint(&self, values: &[&[Complex64]]) -> Vec<Vec<f64>> {
        let gradients = self.sums.rows.adjoint(&self.sums.plan, values);
        gradients.iter().map(unknowns_of_gradient).collect()
    }

    /// Solves for several right-hand sides with the equations of the nearest circle.
    fn on_the_circle(&self, right: &[&[f64]], residual_max: f64, watch: NamedWatch<'_>) -> Vec<Vec<f64>> {
        let circle = System {
            sums: &self.sums.circle,
            regularisation: Diagonal::Uniform(self.regularisation),
            precondition: &|v| self.factors.solve(v),
        };
        let mut z: Vec<Vec<f64>> = right.iter().map(|b| vec![0.0; b.len()]).collect();
        let rule = StoppingRule { residual_max, ..self.inner };
        circle.solve(
            right,
            &mut z,
            &vec![rule; right.len()],
            &watch.part("on the nearest circle", residual_max),
        );
        z
    }

    /// Solves for two right-hand sides; `data` is what the first is made from, `circle_data` what it is by the circle's rows.
    fn solve(
        &self,
        right: Vec<Vec<f64>>,
        circle_data: Vec<f64>,
        data: Vec<Complex64>,
        rule: RefineRule,
        steps: RefineSteps<'_>,
        watch: NamedWatch<'_>,
    ) -> [Column; 2] {
        let task = watch.start("refined map", rule.residual_max);
        let precondition = |residuals: &[&[f64]]| self.on_the_circle(residuals, INNER_RESIDUAL, watch);
        let start = steps.start.filter(|start| right.iter().zip(start).all(|(b, x)| b.len() == x.len()));
        // Where all is on the circle, its map may be all that is wanted.
        let is_circle = start.is_none() && self.sums.departures.by_refinement == 0;
        let start = if is_circle {
            let circle = [circle_data.as_slice(), self.sums.circle.noise_right_hand_side()];
            self.on_the_circle(&circle, self.inner.residual_max, watch).try_into().ok()
        } else {
            start
        };
        let directions = match &start {
            Some(map) if is_circle => Vec::from(map.clone()),
            _ => precondition(&right.iter().map(Vec::as_slice).collect::<Vec<_>>()),
        };
        let mut columns = columns(right, directions, data, rule);
        if let Some(start) = start {
            self.begin_from(&mut columns, start, &precondition);
        }
        // As far as the slower of the two has come: noise has most of its power where little is measured.
        let passes = |columns: &[Column; 2]| columns.iter().map(|column| column.residuals.len()).max();
        let residual = |columns: &[Column; 2]| columns.iter().map(Column::relative).fold(0.0, f64::max);
        while columns.iter().any(Column::is_open)
            && task.report(passes(&columns).unwrap_or(0), residual(&columns))
        {
            self.advance(&mut columns, &precondition);
            (steps.passed)([&columns[0].x, &columns[1].x]);
        }
        columns
    }

    /// Takes an earlier solution as the first step.
    fn begin_from(&self, columns: &mut [Column; 2], start: [Vec<f64>; 2], precondition: Precondition<'_>) {
        let skies = start.each_ref().map(|x| coefficients(x, self.l_max()));
        let (seen, products) = self.sums.rows.normal(&self.sums.plan, &skies, &self.sums.data.weight);
        let products = products.iter().map(unknowns_of_gradient);
        for (((column, x), mut product), seen) in columns.iter_mut().zip(start).zip(products).zip(seen) {
            product.iter_mut().zip(&x).for_each(|(y, x)| *y += self.regularisation * x);
            subtract(&mut column.residual, 1.0, &product);
            column.data.iter_mut().zip(&seen).for_each(|(left, seen)| *left -= seen);
            column.x = x;
        }
        let z = precondition(&columns.each_ref().map(|column| column.residual.as_slice()));
        for (column, z) in columns.iter_mut().zip(z) {
            column.direction = z;
            column.energy = dot(&column.residual, &column.direction);
        }
    }

    /// One iteration of the flexible conjugate gradients for those columns that are open.
    fn advance(&self, columns: &mut [Column; 2], precondition: Precondition<'_>) {
        let open = columns.iter().filter(|column| column.is_open());
        let directions: Vec<Alm> = open.map(|column| coefficients(&column.direction, self.l_max())).collect();
        let (seen, products) = self.sums.rows.normal(&self.sums.plan, &directions, &self.sums.data.weight);
        let products = products.iter().map(unknowns_of_gradient);
        let open = columns.iter_mut().filter(|column| column.is_open());
        let mut stepped = Vec::new();
        for ((column, mut product), seen) in open.zip(products).zip(seen) {
            product.iter_mut().zip(&column.direction).for_each(|(y, d)| *y += self.regularisation * d);
            let curvature = dot(&column.direction, &product);
            if curvature.is_nan() || curvature <= 0.0 {
                column.is_stuck = true;
                continue;
            }
            let step = dot(&column.residual, &column.direction) / curvature;
            column.x.iter_mut().zip(&column.direction).for_each(|(x, d)| *x += step * d);
            column.data.iter_mut().zip(&seen).for_each(|(left, seen)| *left -= step * seen);
            let before = column.residual.clone();
            subtract(&mut column.residual, step, &product);
            stepped.push((column, before));
        }
        let z =
            precondition(&stepped.iter().map(|(column, _)| column.residual.as_slice()).collect::<Vec<_>>());
        for ((column, before), z) in stepped.into_iter().zip(z) {
            let next = dot(&column.residual, &z);
            let turn = (next - dot(&before, &z)) / column.energy;
            column.energy = next;
            column.direction.iter_mut().zip(&z).for_each(|(d, z)| *d = z + turn * *d);
            column.residuals.push(column.relative());
        }
    }
}

/// The columns before the first iteration; `data` is what the first right-hand side is made from.
fn columns(
    right: Vec<Vec<f64>>,
    directions: Vec<Vec<f64>>,
    data: Vec<Complex64>,
    rule: RefineRule,
) -> [Column; 2] {
    let (mut right, mut directions, mut data) = (right.into_iter(), directions.into_iter(), Some(data));
    [(); 2].map(|()| {
        let residual = right.next().unwrap_or_default();
        let direction = directions.next().unwrap_or_default();
        let energy = dot(&residual, &direction);
        Column {
            x: vec![0.0; residual.len()],
            residual,
            direction,
            energy,
            whole: energy,
            data: data.take().unwrap_or_default(),
            residuals: Vec::new(),
            rule,
            is_stuck: false,
        }
    })
}

/// Mean squares of residuals in units of their noise.
fn chi_squares(sums: &RefinedSums, left: &[Complex64]) -> ChiSquares {
    #[derive(Clone, Copy, Default)]
    struct Mean(f64, f64);
    impl Mean {
        fn add(&mut self, value: f64) {
            self.0 += value;
            self.1 += 1.0;
        }
        fn value(self) -> f64 {
            self.0 / self.1.max(1.0)
        }
    }
    let mut all = Mean::default();
    let (mut pairs, mut daughters, mut days, mut phases) = (
        BTreeMap::<_, Mean>::new(),
        BTreeMap::<_, Mean>::new(),
        BTreeMap::<_, Mean>::new(),
        BTreeMap::<_, Mean>::new(),
    );
    for (k, ((at, left), weight)) in sums.at.iter().zip(left).zip(&sums.data.weight).enumerate() {
        let value = 0.5 * left.norm_sqr() * weight;
        all.add(value);
        pairs.entry((at.pair.i, at.pair.j)).or_default().add(value);
        for daughter in [at.pair.i, at.pair.j] {
            daughters.entry(u16::from(daughter) + 1).or_default().add(value);
        }
        days.entry((at.time_s / DAY_S).floor() as i64).or_default().add(value);
        if let Some(phase_deg) = orbit_phase_deg(&sums.at, k) {
            phases.entry(phase_deg as u16 / PHASE_BIN_DEG * PHASE_BIN_DEG).or_default().add(value);
        }
    }
    ChiSquares {
        all: all.value(),
        by_pair: pairs
            .into_iter()
            .map(|((i, j), mean)| (format!("{}-{}", u16::from(i) + 1, u16::from(j) + 1), mean.value()))
            .collect(),
        by_daughter: daughters.into_iter().map(|(daughter, mean)| (daughter, mean.value())).collect(),
        by_day: days.into_iter().map(|(day, mean)| (day, mean.value())).collect(),
        by_phase_deg: phases.into_iter().map(|(phase_deg, mean)| (phase_deg, mean.value())).collect(),
    }
}
