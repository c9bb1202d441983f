//! Tests the coverage of map errors with simulated skies from a prior.
#![allow(clippy::print_stderr)] // Tests print what they measured.

use std::borrow::Cow;

use rand_distr::{Distribution, StandardNormal};

use super::super::sigma::pixel_sigma_k;
use super::*;
use crate::imaging::power::{Block, Factors, FoundPower, PowerProblem};
use crate::imaging::solver::dot;
use crate::sky::harmonics::{Transform, synthesis};
use crate::units::{StreamKind, random_stream};

/// Degrees that a sky may have beyond the map's.
const BEYOND: usize = 8;
/// Degrees whose power is looked at, in fifths of the greatest and at least 3.
const FIFTHS: [usize; 4] = [0, 1, 3, 5];
/// Draws for each sky; the sky is as likely to have any rank among them.
const DRAWS: usize = 39;

/// What is looked at: by sigma, by draws with the power that was found, and by Gibbs sampling.
const LOOKED_AT: [&str; 12] = [
    "pixels",
    "mean",
    "dipole",
    "C_l",
    "C_l",
    "C_l",
    "C_l",
    "pixel drawn",
    "pixel by Gibbs",
    "own C_l",
    "own C_l",
    "own C_l",
];

/// Of the unknowns of a sky those of the map.
fn lower(unknowns: &[f64], l_max: usize) -> Vec<f64> {
    let of_map = unknowns.iter().zip(degrees(l_max + BEYOND)).filter(|(_, l)| *l <= l_max);
    of_map.map(|(x, _)| *x).collect()
}

/// The power of coefficients at a degree.
fn own_power(unknowns: &[f64], l_max: usize, l: usize) -> f64 {
    unknowns.iter().zip(degrees(l_max)).filter(|(_, of)| *of == l).map(|(x, _)| x * x).sum::<f64>()
}

/// Shares within 1 and 1.96 sigma.
#[derive(Default)]
struct Held([f64; 2], f64);

impl Held {
    fn count(&mut self, score: f64) {
        self.0[0] += f64::from(u8::from(score.abs() < 1.0));
        self.0[1] += f64::from(u8::from(score.abs() < 1.96));
        self.1 += 1.0;
    }

    /// By the rank among draws: 27 and 38 of 40 are as near the middle as 67.5 and 95 %.
    fn rank(&mut self, truth: f64, draws: &[f64]) {
        let rank = draws.iter().filter(|draw| **draw < truth).count();
        self.0[0] += f64::from(u8::from((6..=32).contains(&rank)));
        self.0[1] += f64::from(u8::from((1..DRAWS).contains(&rank)));
        self.1 += 1.0;
    }

    fn shares(&self) -> [f64; 2] {
        self.0.map(|held| held / self.1)
    }
}

/// What draws are made of.
struct Drawn<'a> {
    found: &'a FoundPower,
    factors: &'a Factors<'a>,
    blocks: &'a [Block<'a>],
    right: &'a [f64],
    l_max: usize,
    looked_at: [usize; 4],
}

impl Drawn<'_> {
    /// Ranks the truth among draws with the power that was found, and by Gibbs sampling.
    fn rank(&self, truth: &[f64], number: u64, normal: &mut dyn FnMut() -> f64, held: &mut [Held]) {
        let l_max = self.l_max;
        let mut draw = |factors: &Factors<'_>| {
            let mut drawn: Vec<f64> = self.right.iter().map(|_| normal()).collect();
            factors.solve_upper(&mut drawn);
            let mut solution = self.right.to_vec();
            factors.solve(&mut solution);
            solution.iter_mut().zip(drawn).for_each(|(x, drawn)| *x += drawn);
            solution
        };
        let plain: Vec<Vec<f64>> = (0..DRAWS).map(|_| draw(self.factors)).collect();
        let gibbs: Vec<Vec<f64>> = (0..DRAWS as u64)
            .map(|k| number * DRAWS as u64 + k)
            .map(|which| self.found.gibbs(which, &mut |r| draw(&Factors::new(self.blocks, r))))
            .collect();
        // A pixel: harmonics at one place.
        let nside = 2 * l_max / 5;
        let mut point = vec![0.0; 12 * nside * nside];
        point[4 * nside * nside] = 1.0;
        let at = unknowns(&Transform::new(nside, l_max).unwrap().adjoint(&point).unwrap());
        for (held, draws) in held.iter_mut().zip([&plain, &gibbs]) {
            let values: Vec<f64> = draws.iter().map(|x| dot(&at, x)).collect();
            held.rank(dot(&at, truth), &values);
        }
        for (held, l) in held[2..].iter_mut().zip(self.looked_at) {
            let own: Vec<f64> = gibbs.iter().map(|x| own_power(x, l_max, l)).collect();
            held.rank(own_power(truth, l_max, l), &own);
        }
    }
}

/// Shares of what is [`LOOKED_AT`], of so many skies with structure up to `sky_l_max`.
fn coverage(skies: usize, l_max: usize, sky_l_max: usize) -> Vec<[f64; 2]> {
    let nside = 2 * l_max / 5;
    let looked_at = FIFTHS.map(|fifths| (fifths * l_max / 5).max(3));
    let placed = blocks(0, 60);
    let of = |l_max: usize| {
        let mut engine = HarmonicEngine::new(HarmonicSetup { l_max, ..setup() }).unwrap();
        for block in &placed {
            let _ = engine.add(block).unwrap();
        }
        engine.into_sums()
    };
    let (wide, sums) = (of(l_max + BEYOND).order_blocks(), of(l_max));
    let (wide_blocks, order_blocks) = (wide.blocks(), sums.order_blocks());
    // The matrix of the map is a submatrix of that of the sky.
    let cut = |(block, whole): (Block<'_>, &Block<'_>)| {
        let order = block.degrees.len();
        let matrix = Cow::Owned(whole.matrix.submatrix(0, 0, order, order).to_owned());
        Block { matrix, degrees: block.degrees, places: block.places }
    };
    let blocks: Vec<Block<'_>> = order_blocks.blocks().into_iter().zip(&wide_blocks).map(cut).collect();
    // As much signal as noise at the last degree.
    let level = ((l_max + 1) as f64).powi(3) / order_blocks.diagonal(l_max);
    let power_of = |l: usize| level * ((l + 1) as f64).powi(-3);
    let little: Vec<f64> = (0..=l_max + BEYOND).map(|l| 1e-8 / power_of(l)).collect();
    let noise_factors = Factors::new(&wide_blocks, &little);
    let (sky_degrees, map_degrees): (Vec<usize>, Vec<usize>) =
        (degrees(l_max + BEYOND).collect(), degrees(l_max).collect());
    let mut stream = random_stream(5, StreamKind::Probe, [1, 1]);
    let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
    let mut held: Vec<Held> = LOOKED_AT.iter().map(|_| Held::default()).collect();
    for number in 0..skies as u64 {
        let structure = |l: usize| if l <= sky_l_max { power_of(l).sqrt() } else { 0.0 };
        let mut sky: Vec<f64> = sky_degrees.iter().map(|l| structure(*l) * normal()).collect();
        // Far more than the power of structure.
        sky[0] = 1e3 * power_of(2).sqrt();
        // A (A + r)^-1 A equals A for measured modes.
        let mut data: Vec<f64> = sky.iter().map(|_| normal()).collect();
        noise_factors.solve_upper(&mut data);
        data.iter_mut().zip(&sky).for_each(|(noise, sky)| *noise += sky);
        let values = data.clone();
        wide.multiply(&mut data);
        // V'N^-1V of values in the column space.
        let power = dot(&values, &data);
        let right = lower(&data, l_max);
        let sought = PowerProblem {
            sums: &sums,
            blocks: &blocks,
            coupling: None,
            degrees: &map_degrees,
            right: &right,
            data_chi2: power,
            // So many that residuals are noise.
            data_count: f64::INFINITY,
        };
        let found = sought.solve_blocks(&|_| Ok(true)).unwrap();
        let factors = Factors::new(&blocks, &found.regularisation);
        let sigma_k = pixel_sigma_k(&blocks, &factors, &found.ratio, nside);
        let truth = lower(&sky, l_max);
        let off: Vec<f64> = found.solution.iter().zip(&truth).map(|(a, b)| a - b).collect();
        let off_k = synthesis(&coefficients(&off, l_max), nside).unwrap();
        // Neighbours err alike.
        off_k.iter().zip(&sigma_k).step_by(17).for_each(|(off, sigma)| held[0].count(off / sigma));
        // Mean, and dipole along z: the first two unknowns.
        for place in [0, 1] {
            let mut column = vec![0.0; right.len()];
            column[place] = 1.0;
            factors.solve(&mut column);
            held[1 + place].count(off[place] / column[place].sqrt());
        }
        for (held, l) in held[3..7].iter_mut().zip(looked_at) {
            held.count((found.power.power_k2[l] / power_of(l)).ln() / found.power.sigma_ln[l]);
        }
        let drawn =
            Drawn { found: &found, factors: &factors, blocks: &blocks, right: &right, l_max, looked_at };
        drawn.rank(&truth, number, &mut normal, &mut held[7..]);
    }
    held.iter().map(Held::shares).collect()
}

/// Skies, and the greatest degree of maps: more by hand.
fn asked(variable: &str, usual: usize) -> usize {
    std::env::var(variable).ok().and_then(|text| text.parse().ok()).unwrap_or(usual)
}

#[test]
fn errors_hold_of_skies_that_end_where_the_map_does() {
    let (skies, l_max) = (asked("LUNARRAY_SKIES", 200), asked("LUNARRAY_SKIES_L_MAX", L_MAX));
    let found = coverage(skies, l_max, l_max);
    for (what, shares) in LOOKED_AT.iter().zip(&found) {
        eprintln!("{skies} skies to l = {l_max}, {what}: {shares:.3?}");
        for (share, expected) in shares.iter().zip([0.683, 0.95]) {
            // Three standard errors, with the pixels of a sky counted as one, and 0.03 for the neglected error of R.
            let error = (expected * (1.0 - expected) / skies as f64).sqrt();
            assert!((share - expected).abs() < 3.0 * error + 0.03, "{what}: {share} {expected}");
        }
    }
}

/// Degrees beyond the map contribute to the data, but little, as they have no more signal than noise.
#[test]
fn errors_hold_where_the_sky_has_more_degrees_than_the_map() {
    const SKIES: usize = 200;
    let found = coverage(SKIES, L_MAX, L_MAX + BEYOND);
    for (what, [_, share]) in LOOKED_AT.iter().zip(&found).skip(1).take(5) {
        eprintln!("{SKIES} skies with more degrees, {what}: {share:.3}");
        let error = (0.95 * 0.05 / SKIES as f64).sqrt();
        assert!((share - 0.95).abs() < 3.0 * error + 0.03, "{what}: {share}");
    }
}
