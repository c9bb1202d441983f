//! The fluxes of bodies that move, solved for together with a map.
//!
//! With the columns C of the bodies, S their products and e those with the data ([`super::movers`]), the equations of map and fluxes are
//! `(A + R) x + C f = b` and `C'x + S f = e`. Hence `f = M^-1 (e - C'(A + R)^-1 b)` with `M = S - C'(A + R)^-1 C`, and x is the map of the
//! right-hand side `b - C f`: all else is made of sums from which the bodies are taken. A column takes one solution.
//!
//! M^-1 is the covariance of f if the sky has the power that R expects. With another R the sky counts with the power that the map has in units of
//! that, if it is more: `M^-1 (M + (p - 1) Y'RY) M^-1` with `Y = (A + R)^-1 C`. The noise map goes through the same equations.

use std::fmt;

use bincode::{Decode, Encode};
use serde::Serialize;

use super::mover_columns::{Column, MONTH_S, MoverColumns};
use super::posterior::NOISES_TOGETHER;
use super::solve::{HarmonicRequest, largest_of_circle, predicted_power, prior_unknowns};
use super::whole::PowerEquations;
use super::{HarmonicSums, degrees};
use crate::imaging::power::Factors;
use crate::imaging::regulariser::{Diagonal, Regulariser};
use crate::imaging::solver::{
    NamedWatch, StoppingRule, System, check_request, dot, right_hand_side, subtract,
};
use crate::imaging::{NormalSums, SolveError};
use crate::numerics::DenseFactor;
use crate::sky::{Body, k_sr_per_jy};
use crate::units::constants::DAY_S;

/// Least share of a body's power that the sky cannot have instead: the sums are accurate to 4e-4 of it.
const SHARE_MIN: f64 = 0.01;

/// Rounds of power and fluxes: what the bodies add to the sky's power is small after the first.
const POWER_ROUNDS: usize = 2;

/// The flux density of a body in a month.
#[derive(Clone, Debug, PartialEq, Serialize, Encode, Decode)]
pub struct MoverFlux {
    /// The body.
    pub mover: Body,
    /// Start of the month, mission time, s.
    pub month_start_s: f64,
    /// Flux density, Jy; absent where a static sky explains the body's visibilities as well: it is then in the map.
    pub flux_jy: Option<f64>,
    /// Its standard deviation, Jy.
    pub sigma_jy: Option<f64>,
}

/// The flux densities of all bodies and months.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Encode, Decode)]
pub struct MoverFluxes {
    /// Length of a month, s.
    pub month_s: f64,
    /// By month, then body.
    pub fluxes: Vec<MoverFlux>,
    /// Visibilities of months beyond the last one with a flux, in which the bodies remain.
    pub visibilities_beyond: u64,
}

impl fmt::Display for MoverFluxes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let known = self.fluxes.iter().filter(|flux| flux.flux_jy.is_some()).count();
        let (all, days) = (self.fluxes.len(), self.month_s / DAY_S);
        write!(
            f,
            "flux of {known} of {all} bodies and months of {days:.0} days solved for, and not in the map: movers.csv"
        )?;
        match self.visibilities_beyond {
            0 => Ok(()),
            beyond => write!(f, "; none of further months: {beyond} visibilities"),
        }
    }
}

impl MoverFluxes {
    /// A table (CSV): frequency, body, start of the month after the mission's epoch, flux density and its standard deviation; both empty where
    /// they are not determined.
    #[must_use]
    pub fn csv(&self, frequency_hz: f64) -> String {
        let mut text = String::from("frequency_hz,mover,month_start_s,flux_jy,sigma_jy\n");
        for MoverFlux { mover, month_start_s, flux_jy, sigma_jy } in &self.fluxes {
            let [flux, sigma] =
                [flux_jy, sigma_jy].map(|jy| jy.map(|jy| format!("{jy:.6e}")).unwrap_or_default());
            text += &format!("{frequency_hz},{},{month_start_s},{flux},{sigma}\n", mover.name());
        }
        text
    }

    /// The fluxes of visibilities that are divided by a factor.
    pub(in crate::imaging) fn divided_by(mut self, factor: f64) -> Self {
        for MoverFlux { flux_jy, sigma_jy, .. } in &mut self.fluxes {
            [flux_jy, sigma_jy].into_iter().flatten().for_each(|jy| *jy /= factor);
        }
        self
    }
}

/// What the equations have besides the columns: data and noise, less the prior.
struct Sides {
    right: [Vec<f64>; 2],
    products: [Vec<f64>; 2],
}

/// Powers of the bodies, K sr, in the data and in the noise of the noise-only map.
#[derive(Clone, Debug)]
struct Powers {
    data: Vec<f64>,
    noise: Vec<f64>,
    /// Variance of each; `None` if it is not determined, and 0.
    variance: Vec<Option<f64>>,
}

impl MoverColumns {
    /// `BtN^-1P f`.
    fn projected(&self, powers: &[f64]) -> Vec<f64> {
        let mut sum = vec![0.0; self.right.first().map_or(0, Vec::len)];
        self.right.iter().zip(powers).for_each(|(column, power)| subtract(&mut sum, -power, column));
        sum
    }

    /// What `V'N^-1V` loses with the bodies, for `P'N^-1V` = `data`.
    fn chi2_lost(&self, data: &[f64], powers: &[f64]) -> f64 {
        let own: f64 = self
            .products
            .chunks(powers.len().max(1))
            .zip(powers)
            .map(|(row, power)| power * dot(row, powers))
            .sum();
        2.0 * dot(data, powers) - own
    }

    fn sides(&self, sums: &HarmonicSums, prior: Option<&[f64]>) -> Result<Sides, SolveError> {
        let mut data = self.data.clone();
        if let Some(prior) = prior {
            data.iter_mut().zip(&self.right).for_each(|(product, column)| *product -= dot(column, prior));
        }
        let right = [right_hand_side(sums, prior)?, sums.noise_right_hand_side().to_vec()];
        Ok(Sides { right, products: [data, self.noise.clone()] })
    }

    /// Solves for the powers; `solved` are the solutions of data, noise and columns, which are also those to start from. `None` if it was
    /// interrupted, or nothing is determined.
    fn powers(
        &self,
        system: &System<'_>,
        right_of: &dyn Fn(&[f64]) -> Vec<f64>,
        sides: &Sides,
        solved: &mut [Vec<f64>],
        (rule, expects_sky, watch): (StoppingRule, bool, NamedWatch<'_>),
    ) -> Option<Powers> {
        let all: Vec<&[f64]> = sides.right.iter().chain(&self.right).map(Vec::as_slice).collect();
        for (right, solved) in all.chunks(NOISES_TOGETHER).zip(solved.chunks_mut(NOISES_TOGETHER)) {
            let right: Vec<Vec<f64>> = right.iter().map(|right| right_of(right)).collect();
            let right: Vec<&[f64]> = right.iter().map(Vec::as_slice).collect();
            let task = watch.start("bodies that move", rule.residual_max);
            system.solve(&right, solved, &vec![rule; right.len()], &task);
            if !watch.may_continue() {
                return None;
            }
        }
        let order = self.columns.len();
        let [data, noise, columns @ ..] = solved else { return None };
        let element = |a: usize, b: usize| self.products[a * order + b] - dot(&self.right[a], &columns[b]);
        let kept: Vec<usize> =
            (0..order).filter(|&k| element(k, k) > SHARE_MIN * self.products[k * order + k]).collect();
        let count = kept.len();
        let pairs = || kept.iter().flat_map(|&a| kept.iter().map(move |&b| (a, b)));
        let matrix: Vec<f64> = pairs().map(|(a, b)| 0.5 * (element(a, b) + element(b, a))).collect();
        let factor = DenseFactor::new(&matrix, count).filter(|_| count > 0)?;
        let powers_of = |products: &[f64], x: &[f64]| {
            let mut powers: Vec<f64> = kept.iter().map(|&k| products[k] - dot(&self.right[k], x)).collect();
            factor.solve(&mut powers);
            let mut all = vec![0.0; order];
            kept.iter().zip(powers).for_each(|(k, power)| all[*k] = power);
            all
        };
        let found = [powers_of(&sides.products[0], data), powers_of(&sides.products[1], noise)];
        let mut covariance = factor.inverse();
        if !expects_sky {
            let excess = self.power_over_expected(system, &found[0], data, columns) - 1.0;
            let of_r: Vec<Vec<f64>> = kept.iter().map(|&k| times_r(system, &columns[k])).collect();
            let of_sky: Vec<f64> = (0..count)
                .flat_map(|a| kept.iter().map(move |&b| (a, b)))
                .map(|(a, b)| dot(&of_r[a], &columns[b]))
                .collect();
            for (k, variance) in add_sky(&covariance, &of_sky, count).into_iter().enumerate() {
                covariance[k * (count + 1)] += excess * variance;
            }
        }
        let mut variance = vec![None; order];
        kept.iter().enumerate().for_each(|(place, k)| variance[*k] = Some(covariance[place * (count + 1)]));
        let [data, noise] = found;
        Some(Powers { data, noise, variance })
    }

    /// Mean square of the map's unknowns in units of what R expects, at least 1.
    fn power_over_expected(
        &self,
        system: &System<'_>,
        powers: &[f64],
        data: &[f64],
        columns: &[Vec<f64>],
    ) -> f64 {
        let mut map = data.to_vec();
        columns.iter().zip(powers).for_each(|(column, power)| subtract(&mut map, *power, column));
        (dot(&map, &times_r(system, &map)) / map.len() as f64).max(1.0)
    }

    fn fluxes(&self, powers: Option<&Powers>, noise_factor: f64) -> MoverFluxes {
        let k_sr = k_sr_per_jy(self.frequency_hz);
        let flux = |(k, column): (usize, &Column)| {
            let variance = powers.and_then(|powers| powers.variance[k]);
            MoverFlux {
                mover: column.body,
                month_start_s: column.month as f64 * MONTH_S,
                flux_jy: powers.filter(|_| variance.is_some()).map(|powers| powers.data[k] / k_sr),
                sigma_jy: variance.map(|variance| noise_factor * variance.sqrt() / k_sr),
            }
        };
        MoverFluxes {
            month_s: MONTH_S,
            fluxes: self.columns.iter().enumerate().map(flux).collect(),
            visibilities_beyond: self.beyond,
        }
    }
}

fn times_r(system: &System<'_>, x: &[f64]) -> Vec<f64> {
    let mut product = vec![0.0; x.len()];
    system.regularisation.add_product(x, &mut product);
    product
}

/// The diagonal of `inverse sky inverse`.
fn add_sky(inverse: &[f64], sky: &[f64], order: usize) -> Vec<f64> {
    let row = |k: usize| &inverse[k * order..(k + 1) * order];
    let form =
        |k: usize| (0..order).map(|a| row(k)[a] * dot(&sky[a * order..(a + 1) * order], row(k))).sum::<f64>();
    (0..order).map(form).collect()
}

impl HarmonicSums {
    /// Solves for the fluxes of the bodies that were summed, and takes the bodies from the right-hand sides; `None` without bodies, or if it was
    /// interrupted.
    ///
    /// # Errors
    /// As [`crate::imaging::solve_regularised`].
    pub fn take_movers(
        &mut self,
        request: HarmonicRequest,
        regulariser: &Regulariser,
        prior_k: Option<&[f64]>,
        watch: NamedWatch<'_>,
    ) -> Result<Option<MoverFluxes>, SolveError> {
        let Some(columns) = self.movers.take() else { return Ok(None) };
        let prior = prior_k.map(|map| prior_unknowns(map, self.setup().l_max)).transpose()?;
        let (powers, noise_factor) = match regulariser {
            Regulariser::Data => self.movers_with_power(&columns, request, prior.as_deref(), watch)?,
            _ => (self.movers_with_given(&columns, request, (regulariser, prior.as_deref()), watch)?, 1.0),
        };
        if let Some(powers) = &powers {
            let less = |right: &[f64], powers: &[f64]| {
                let mut right = right.to_vec();
                subtract(&mut right, 1.0, &columns.projected(powers));
                right
            };
            self.right = less(self.right_hand_side(), &powers.data).into();
            self.noise = less(self.noise_right_hand_side(), &powers.noise).into();
            self.counts.power -= columns.chi2_lost(&columns.data, &powers.data);
        }
        Ok(watch.may_continue().then(|| columns.fluxes(powers.as_ref(), noise_factor)))
    }

    fn movers_with_given(
        &self,
        columns: &MoverColumns,
        request: HarmonicRequest,
        (regulariser, prior): (&Regulariser, Option<&[f64]>),
        watch: NamedWatch<'_>,
    ) -> Result<Option<Powers>, SolveError> {
        check_request(self, request.epsilon)?;
        let sides = columns.sides(self, prior)?;
        let blocks = self.order_blocks();
        let w_max = largest_of_circle(self, &blocks, watch).value;
        let regularisation = regulariser.diagonal(request.epsilon, w_max, self.setup().l_max)?;
        let factors = blocks.factors_with(&|l| regularisation.at(l));
        drop(blocks);
        let system = System { sums: self, regularisation, precondition: &|v| factors.solve(v) };
        let mut solved = vec![vec![0.0; self.unknowns()]; columns.columns.len() + 2];
        let settings = (request.rule, false, watch);
        Ok(columns.powers(&system, &<[f64]>::to_vec, &sides, &mut solved, settings))
    }

    /// The same with R from the data, in rounds; and the factor of the noise.
    fn movers_with_power(
        &self,
        columns: &MoverColumns,
        request: HarmonicRequest,
        prior: Option<&[f64]>,
        watch: NamedWatch<'_>,
    ) -> Result<(Option<Powers>, f64), SolveError> {
        check_request(self, 1.0)?;
        let sides = columns.sides(self, prior)?;
        let equations = PowerEquations::new(self, &sides.right[0], prior, watch);
        let (blocks, degrees) = (equations.blocks(), degrees(self.setup().l_max).collect::<Vec<usize>>());
        let all_chi2 =
            self.counts().power - prior.map_or(0.0, |prior| predicted_power(self, prior, &sides.right[0]));
        let mut solved = vec![vec![0.0; self.unknowns()]; columns.columns.len() + 2];
        let mut powers =
            Powers { data: vec![0.0; columns.columns.len()], noise: Vec::new(), variance: Vec::new() };
        let mut noise_factor = 1.0;
        for _ in 0..POWER_ROUNDS {
            let mut right = sides.right[0].clone();
            subtract(&mut right, 1.0, &columns.projected(&powers.data));
            let right = equations.right(&right);
            let chi2 = all_chi2 - columns.chi2_lost(&sides.products[0], &powers.data);
            let found =
                equations.problem(&blocks, &degrees, &right, chi2).solve(None, request.rule, watch)?;
            noise_factor = found.noise_factor();
            let factors = Factors::new(&blocks, &found.regularisation);
            let regularisation = Diagonal::ByDegree(found.regularisation);
            let system =
                System { sums: equations.sums(), regularisation, precondition: &|v| factors.solve(v) };
            let right_of = |right: &[f64]| equations.right(right);
            let settings = (request.rule, true, watch);
            let Some(next) = columns.powers(&system, &right_of, &sides, &mut solved, settings) else {
                return Ok((None, noise_factor));
            };
            powers = next;
        }
        Ok((Some(powers), noise_factor))
    }
}
