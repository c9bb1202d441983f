//! Tests the coverage of map errors with simulated skies from a prior.
#![allow(clippy::print_stderr)] // Tests print what they measured.

use std::borrow::Cow;

use rand_distr::{Distribution, StandardNormal};

use super::super::sigma::pixel_sigma_k;
use super::*;
use crate::imaging::power::{Block, Factors, PowerProblem};
use crate::sky::harmonics::synthesis;
use crate::units::{StreamKind, random_stream};

const NSIDE: usize = 8;
/// Maximum degree of a sky with more degrees than the map.
const SKY_L_MAX: usize = 28;
/// Degrees whose power is tested.
const DEGREES: [usize; 4] = [3, 6, 12, 20];

/// The unknowns of a sky that the map has.
fn lower(unknowns: &[f64]) -> Vec<f64> {
    let of_map = unknowns.iter().zip(degrees(SKY_L_MAX)).filter(|(_, l)| *l <= L_MAX);
    of_map.map(|(x, _)| *x).collect()
}

/// Fractions within 1 and 1.96 sigma.
#[derive(Default)]
struct Held([f64; 2], f64);

impl Held {
    fn count(&mut self, score: f64) {
        self.0[0] += f64::from(u8::from(score.abs() < 1.0));
        self.0[1] += f64::from(u8::from(score.abs() < 1.96));
        self.1 += 1.0;
    }

    fn shares(&self) -> [f64; 2] {
        self.0.map(|held| held / self.1)
    }
}

/// Coverage of pixels, monopoles, and powers at [`DEGREES`], for simulated skies with structure up to `sky_l_max`.
fn coverage(skies: usize, sky_l_max: usize) -> Vec<[f64; 2]> {
    let placed = blocks(0, 60);
    let of = |l_max: usize| {
        let mut engine = HarmonicEngine::new(HarmonicSetup { l_max, ..setup() }).unwrap();
        for block in &placed {
            let _ = engine.add(block).unwrap();
        }
        engine.into_sums()
    };
    let (wide, sums) = (of(SKY_L_MAX).order_blocks(), of(L_MAX));
    let (wide_blocks, order_blocks) = (wide.blocks(), sums.order_blocks());
    // The matrix of the map is a submatrix of that of the sky.
    let cut = |(block, whole): (Block<'_>, &Block<'_>)| {
        let order = block.degrees.len();
        let matrix = Cow::Owned(whole.matrix.submatrix(0, 0, order, order).to_owned());
        Block { matrix, degrees: block.degrees, places: block.places }
    };
    let blocks: Vec<Block<'_>> = order_blocks.blocks().into_iter().zip(&wide_blocks).map(cut).collect();
    // Signal equals noise at the last degree.
    let level = ((L_MAX + 1) as f64).powi(3) / order_blocks.diagonal(L_MAX);
    let power = |l: usize| level * ((l + 1) as f64).powi(-3);
    let little: Vec<f64> = (0..=SKY_L_MAX).map(|l| 1e-8 / power(l)).collect();
    let noise_factors = Factors::new(&wide_blocks, &little);
    let (sky_degrees, map_degrees): (Vec<usize>, Vec<usize>) =
        (degrees(SKY_L_MAX).collect(), degrees(L_MAX).collect());
    let mut stream = random_stream(5, StreamKind::Probe, [1, 1]);
    let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
    let mut held: Vec<Held> = (0..2 + DEGREES.len()).map(|_| Held::default()).collect();
    for _ in 0..skies {
        let structure = |l: usize| if l <= sky_l_max { power(l).sqrt() } else { 0.0 };
        let mut sky: Vec<f64> = sky_degrees.iter().map(|l| structure(*l) * normal()).collect();
        // Far more than the power of structure.
        sky[0] = 1e3 * power(2).sqrt();
        // A (A + r)^-1 A equals A for measured modes.
        let mut data: Vec<f64> = sky.iter().map(|_| normal()).collect();
        noise_factors.solve_upper(&mut data);
        data.iter_mut().zip(&sky).for_each(|(noise, sky)| *noise += sky);
        wide.multiply(&mut data);
        let right = lower(&data);
        let problem = PowerProblem {
            sums: &sums,
            blocks: &blocks,
            degrees: &map_degrees,
            right: &right,
            power: 0.0,
            numbers: 1.0,
        };
        let found = problem.solve_blocks().unwrap();
        let factors = Factors::new(&blocks, &found.regularisation);
        let sigma_k = pixel_sigma_k(&blocks, &factors, &found.ratio, NSIDE);
        let truth = lower(&sky);
        let off: Vec<f64> = found.solution.iter().zip(&truth).map(|(a, b)| a - b).collect();
        let off_k = synthesis(&coefficients(&off, L_MAX), NSIDE).unwrap();
        // Errors of neighbouring pixels are correlated.
        off_k.iter().zip(&sigma_k).step_by(17).for_each(|(off, sigma)| held[0].count(off / sigma));
        let mut monopole = vec![0.0; right.len()];
        monopole[0] = 1.0;
        factors.solve(&mut monopole);
        held[1].count(off[0] / monopole[0].sqrt());
        for (held, l) in held[2..].iter_mut().zip(DEGREES) {
            held.count((found.power.power_k2[l] / power(l)).ln() / found.power.sigma_ln[l]);
        }
    }
    held.iter().map(Held::shares).collect()
}

#[test]
fn errors_hold_for_skies_with_the_degrees_of_the_map() {
    let skies = std::env::var("LUNARRAY_SKIES").ok().and_then(|text| text.parse().ok()).unwrap_or(200);
    let found = coverage(skies, L_MAX);
    eprintln!("{skies} skies: pixels, monopole, C_l at {DEGREES:?}: {found:.3?}");
    for (what, shares) in ["pixels", "monopole", "C_3", "C_6", "C_12", "C_20"].iter().zip(&found) {
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
    let found = coverage(SKIES, SKY_L_MAX);
    eprintln!("{SKIES} skies with more degrees: pixels, monopole, C_l at {DEGREES:?}: {found:.3?}");
    for (what, [_, share]) in ["monopole", "C_3", "C_6", "C_12"].iter().zip(&found[1..]) {
        let error = (0.95 * 0.05 / SKIES as f64).sqrt();
        assert!((share - 0.95).abs() < 3.0 * error + 0.03, "{what}: {share}");
    }
}
