//! Pixel maps whose R depends on the degree, by products alone: R from the data, a power of the degree, or a table of C_l.
//!
//! The unknowns x are those of harmonics up to 2.5 nside, and the map is `Y x`: then `Y'AY` stands for A, and R is diagonal. Blocks near
//! `Y'AY` precondition, and say together with draws how much of each degree the data decide.

use super::projected::{Harmonics, Projected};
use super::solve::{PixelSolution, point_response};
use crate::imaging::NormalSums;
use crate::imaging::SolveError;
use crate::imaging::circle::{HarmonicRequest, Posterior, unknowns};
use crate::imaging::power::{Block, Factors, MapsWithPower, PowerProblem, Uncertainty};
use crate::imaging::regulariser::{Diagonal, Regulariser};
use crate::imaging::solver::{Convergence, Diagnostics, NamedWatch, PointBeam, System};
use crate::imaging::solver::{LargestEigenvalue, largest_eigenvalue_from, random_vector};
use crate::imaging::solver::{add, check_request, dot, right_hand_side, subtract};
use crate::sky::harmonics::{AnalysisOptions, analysis};
use crate::sky::healpix::pixel_area_sr;

/// Relative change of W_max at which it has converged, as of harmonic maps: it only scales R.
const W_MAX_TOLERANCE: f64 = 1e-3;

/// The equations of a map over pixels, and blocks near theirs over harmonics.
pub(in crate::imaging) struct PixelEquations<'a> {
    pub(in crate::imaging) sums: &'a (dyn NormalSums + Sync),
    pub(in crate::imaging) blocks: &'a [Block<'a>],
}

/// A pixel map whose R depends on the degree.
pub(in crate::imaging) struct SolvedByDegree {
    pub(in crate::imaging) solution: PixelSolution,
    /// Unknowns of the map, without its prior, and of the noise map: a start for more data.
    pub(in crate::imaging) unknowns: [Vec<f64>; 2],
    /// Errors, with R from the data.
    pub(in crate::imaging) uncertainty: Option<Uncertainty>,
}

/// The unknowns of map and noise map, and the R that they have.
struct Columns {
    columns: [Vec<f64>; 2],
    convergence: Vec<Convergence>,
    regularisation: Diagonal,
    diagnostics: Diagnostics,
    uncertainty: Option<Uncertainty>,
}

/// The projected equations with the prior map that was taken off.
struct Problem<'a> {
    projected: &'a Projected<'a>,
    blocks: &'a [Block<'a>],
    request: HarmonicRequest,
    prior_k: Option<&'a [f64]>,
    watch: NamedWatch<'a>,
}

impl PixelEquations<'_> {
    /// Solves for the map, the noise map and beams at `beams`.
    ///
    /// # Errors
    /// There is no data, the prior has another size, a table of power ends before the map's degrees, or numbers are not finite;
    /// [`SolveError::Interrupted`].
    pub(in crate::imaging) fn solve(
        &self,
        request: HarmonicRequest,
        regulariser: &Regulariser,
        prior_k: Option<&[f64]>,
        start: Option<&[Vec<f64>; 2]>,
        beams: &[usize],
        watch: NamedWatch<'_>,
    ) -> Result<SolvedByDegree, SolveError> {
        let is_of_data = *regulariser == Regulariser::Data;
        check_request(self.sums, if is_of_data { 1.0 } else { request.epsilon })?;
        let harmonics = Harmonics::new(request.nside)?;
        let projected = Projected {
            pixels: self.sums,
            right: harmonics.harmonics_of(&right_hand_side(self.sums, prior_k)?)?,
            noise: harmonics.harmonics_of(self.sums.noise_right_hand_side())?,
            harmonics: &harmonics,
        };
        let problem = Problem { projected: &projected, blocks: self.blocks, request, prior_k, watch };
        let solved = if is_of_data { problem.with_power(start) } else { problem.with(regulariser, start) }?;
        if solved.columns[0].iter().all(|x| *x == 0.0) && !watch.may_continue() {
            return Err(SolveError::Interrupted);
        }
        let beams = problem.beams(&solved.regularisation, beams)?;
        let solution = PixelSolution {
            map_k: problem.whole(&solved.columns[0])?,
            noise_k: harmonics.to_pixels(&solved.columns[1])?,
            beams,
            diagnostics: solved.diagnostics.with_convergence(&solved.convergence),
        };
        Ok(SolvedByDegree { solution, unknowns: solved.columns, uncertainty: solved.uncertainty })
    }
}

impl Problem<'_> {
    fn l_max(&self) -> usize {
        self.projected.harmonics.l_max()
    }

    fn diagnostics(&self) -> Diagnostics {
        Diagnostics { l_max: Some(self.l_max()), is_of_pixels: true, ..Diagnostics::default() }
    }

    /// The map of unknowns, with its prior.
    fn whole(&self, x: &[f64]) -> Result<Vec<f64>, SolveError> {
        let mut map_k = self.projected.harmonics.to_pixels(x)?;
        if let Some(prior_k) = self.prior_k {
            add(&mut map_k, prior_k);
        }
        Ok(map_k)
    }

    /// Solves with R from the data.
    fn with_power(&self, start: Option<&[Vec<f64>; 2]>) -> Result<Columns, SolveError> {
        let (projected, rule, watch) = (self.projected, self.request.rule, self.watch);
        let degrees: Vec<usize> = crate::imaging::circle::degrees(self.l_max()).collect();
        let counts = projected.counts();
        let problem = PowerProblem {
            sums: projected,
            blocks: self.blocks,
            coupling: None,
            degrees: &degrees,
            right: &projected.right,
            data_chi2: counts.power - self.predicted_power()?,
            data_count: 2.0 * counts.visibilities as f64,
        };
        let MapsWithPower { found, columns, convergence } = problem.solve_maps(start, rule, watch)?;
        let errors = || -> Result<Uncertainty, SolveError> {
            let map_k = self.whole(&columns[0])?;
            let whole = analysis(&map_k, self.l_max(), &AnalysisOptions::default())?;
            let posterior = Posterior {
                sums: projected,
                blocks: self.blocks,
                found: &found,
                right: &projected.right,
                solved: &columns[0],
                whole: &unknowns(&whole.alm),
                nside: self.request.nside,
                rule,
                watch: watch.beside_map(),
            };
            let mut errors = posterior.uncertainty(self.request.samples, &|x| projected.apply_all(x))?;
            // What a sharp prior has beyond the degrees solved for.
            let mut beyond_k = map_k;
            subtract(&mut beyond_k, 1.0, &self.projected.harmonics.to_pixels(&unknowns(&whole.alm))?);
            errors.samples.iter_mut().for_each(|sample| add(&mut sample.map_k, &beyond_k));
            // A pixel holds the mean of a sky that has more than the degrees solved for.
            let beyond_k2 = found.power.variance_beyond_k2(self.request.nside);
            errors.sigma_k.iter_mut().for_each(|sigma_k| *sigma_k = sigma_k.hypot(beyond_k2.sqrt()));
            Ok(errors)
        };
        let uncertainty = watch.is_of_final_map().then(errors).transpose()?;
        Ok(Columns {
            columns,
            convergence,
            regularisation: Diagonal::ByDegree(found.regularisation),
            diagnostics: self.diagnostics(),
            uncertainty,
        })
    }

    /// The part of `V'N^-1V` that the prior p explains, `p.(2 b - A p)`.
    fn predicted_power(&self) -> Result<f64, SolveError> {
        let Some(prior_k) = self.prior_k else { return Ok(0.0) };
        let left = right_hand_side(self.projected.pixels, self.prior_k)?;
        Ok(dot(prior_k, self.projected.pixels.right_hand_side()) + dot(prior_k, &left))
    }

    /// Solves with an R that is given.
    fn with(&self, regulariser: &Regulariser, start: Option<&[Vec<f64>; 2]>) -> Result<Columns, SolveError> {
        let HarmonicRequest { epsilon, nside, rule, .. } = self.request;
        let projected = self.projected;
        // That of a table does not depend on W_max.
        let has_w_max = matches!(regulariser, Regulariser::Power(_));
        let largest = has_w_max.then(|| {
            let task = self.watch.start("largest eigenvalue", W_MAX_TOLERANCE);
            largest_eigenvalue_from(
                random_vector(projected.unknowns()),
                projected,
                W_MAX_TOLERANCE,
                &mut |needs_step, step, change| task.report_step(needs_step, step, change),
            )
        });
        let w_max = largest.as_ref().map(|LargestEigenvalue { value, .. }| *value);
        let regularisation = regulariser.diagonal(epsilon, w_max.unwrap_or(0.0), self.l_max())?;
        let of_degree: Vec<f64> = (0..=self.l_max()).map(|l| regularisation.at(l)).collect();
        let factors = Factors::new(self.blocks, &of_degree);
        let system = System {
            sums: projected,
            regularisation: regularisation.clone(),
            precondition: &|v| factors.solve(v),
        };
        let unknowns = projected.unknowns();
        let mut columns = match start {
            Some(start) if start.iter().all(|x| x.len() == unknowns) => start.clone(),
            _ => [vec![0.0; unknowns], vec![0.0; unknowns]],
        };
        let task = self.watch.start("map and noise map", rule.residual_max);
        let convergence =
            system.solve(&[&projected.right, &projected.noise], &mut columns, &[rule, rule], &task);
        drop(task);
        let diagnostics = Diagnostics {
            epsilon: Some(epsilon),
            w_max: w_max.map(|w_max| w_max * pixel_area_sr(nside)),
            w_max_iterations: largest.map_or(0, |largest| largest.iterations),
            ..self.diagnostics()
        };
        Ok(Columns { columns, convergence, regularisation, diagnostics, uncertainty: None })
    }

    /// The maps of skies that are 1 K in one pixel.
    fn beams(&self, regularisation: &Diagonal, pixels: &[usize]) -> Result<Vec<PointBeam>, SolveError> {
        if pixels.is_empty() {
            return Ok(Vec::new());
        }
        let Projected { pixels: sums, harmonics, .. } = *self.projected;
        let of_degree: Vec<f64> = (0..=self.l_max()).map(|l| regularisation.at(l)).collect();
        let factors = Factors::new(self.blocks, &of_degree);
        let system = System {
            sums: self.projected,
            regularisation: regularisation.clone(),
            precondition: &|v| factors.solve(v),
        };
        let (mut found, rule, watch) = (Vec::new(), self.request.rule, self.watch.beside_map());
        for &pixel in pixels {
            let right = harmonics.harmonics_of(&point_response(sums, pixel)?.map_k)?;
            let mut beam = [vec![0.0; right.len()]];
            let task = watch.start(&format!("beam at pixel {pixel}"), rule.residual_max);
            system.solve(&[&right], &mut beam, &[rule], &task);
            drop(task);
            if !watch.may_continue() {
                break;
            }
            found.push(PointBeam { pixel, map_k: harmonics.to_pixels(&beam[0])? });
        }
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::imaging::pixel::projected::averaged_blocks;
    use crate::imaging::pixel::solve_with_power::solve_pixels_with_power;
    use crate::imaging::pixel::{ColumnBlock, PixelSums, SymmetricTiles};
    use crate::imaging::{Samples, SolveWatch, StoppingRule, SumCounts};
    use crate::runtime::Cancel;
    use crate::sky::healpix::{pixel_count, pixel_directions};
    use crate::units::vector::dot as along;
    use crate::units::{StreamKind, random_stream};

    /// Sums of fringes on baselines of all directions up to 2.4 wavelengths, of a sky whose power falls with the degree, with noise.
    fn sums(nside: usize, count: usize) -> PixelSums {
        let pixels = pixel_count(nside);
        let directions = pixel_directions(nside);
        let mut stream = random_stream(7, StreamKind::Probe, [nside as u64, count as u64]);
        let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
        let harmonics = Harmonics::new(nside).unwrap();
        let unknowns = crate::imaging::circle::degrees(harmonics.l_max());
        let x: Vec<f64> = unknowns.map(|l| 10.0 * (l as f64 + 1.0).powf(-1.2) * normal()).collect();
        let sky = harmonics.to_pixels(&x).unwrap();
        let (mut values, mut right) = (Vec::new(), vec![0.0; pixels]);
        let mut power = 0.0;
        for _ in 0..count {
            let u = [normal(), normal(), normal()].map(|x| 1.2 * x.clamp(-2.0, 2.0));
            for part in [0.0, 0.25] {
                let area = pixel_area_sr(nside);
                let row: Vec<f64> = directions
                    .iter()
                    .map(|n| area * (std::f64::consts::TAU * (along(u, *n) - part)).cos())
                    .collect();
                let datum = dot(&row, &sky) + normal();
                power += datum * datum;
                row.iter().zip(&mut right).for_each(|(b, right)| *right += b * datum);
                values.extend(row);
            }
        }
        let mut matrix = SymmetricTiles::zeros(pixels);
        matrix.add_products_f64(ColumnBlock { values: &values, columns: 2 * count, stride: pixels });
        let counts = SumCounts { visibilities: count as u64, weight: count as f64, power };
        PixelSums { nside, normal: matrix, right, noise: vec![0.0; pixels], counts }
    }

    /// R from the data by products, as beyond nside 32, is that of the matrix.
    #[test]
    fn r_by_products_is_that_of_the_matrix() {
        let nside = 4;
        let sums = sums(nside, 400);
        let watch = SolveWatch::default();
        let (dense, errors) =
            solve_pixels_with_power(&sums, None, Samples::default(), &[], watch.named("dense")).unwrap();
        let equations = PixelEquations { sums: &sums, blocks: &averaged_blocks(&sums) };
        let rule = StoppingRule { residual_max: 1e-6, iterations_max: 500 };
        let request = HarmonicRequest { epsilon: 1.0, nside, rule, samples: Samples::default(), probes: 0 };
        let found =
            equations.solve(request, &Regulariser::Data, None, None, &[], watch.named("products")).unwrap();
        let sigma_k = found.uncertainty.unwrap().sigma_k;
        let rms = |values: &mut dyn Iterator<Item = f64>| {
            (values.map(|x| x * x).sum::<f64>() / sigma_k.len() as f64).sqrt()
        };
        let maps = found.solution.map_k.iter().zip(&dense.map_k).zip(&errors.sigma_k);
        let apart = rms(&mut maps.map(|((found, dense), sigma)| (found - dense) / sigma));
        let ratio = rms(&mut sigma_k.iter().zip(&errors.sigma_k).map(|(found, dense)| found / dense));
        // Rounds end when no knot of ln C_l changes by 0.1: the map changes by less than a tenth of its error, and sigma, which is by latitude
        // from few draws here, by less than a fifth.
        assert!(apart < 0.1 && (ratio - 1.0).abs() < 0.2, "{apart} {ratio}");
    }

    /// Where no time is left for a step there is no map, and a map from an earlier solution has no beams rather than beams of zeros.
    #[test]
    fn without_a_step_there_are_neither_maps_nor_beams() {
        let nside = 4;
        let sums = sums(nside, 100);
        let equations = PixelEquations { sums: &sums, blocks: &averaged_blocks(&sums) };
        let rule = StoppingRule { residual_max: 1e-6, iterations_max: 500 };
        let request = HarmonicRequest { epsilon: 1e-3, nside, rule, samples: Samples::default(), probes: 0 };
        let solve = |watch: &SolveWatch, start: Option<&[Vec<f64>; 2]>| {
            equations.solve(request, &Regulariser::Power(2.0), None, start, &[5], watch.named("beams"))
        };
        let solved = solve(&SolveWatch::default(), None).unwrap();
        let [beam] = &solved.solution.beams[..] else { panic!("{} beams", solved.solution.beams.len()) };
        assert!(beam.pixel == 5 && beam.map_k[5] > 0.0);
        let cancel = Cancel::new();
        cancel.cancel();
        let expired = SolveWatch::new(cancel).with_grace(Duration::ZERO);
        assert!(matches!(solve(&expired, None), Err(SolveError::Interrupted)));
        let hurried = solve(&expired, Some(&solved.unknowns)).unwrap();
        assert!(hurried.solution.map_k.iter().any(|k| *k != 0.0));
        assert!(hurried.solution.beams.is_empty());
    }
}
