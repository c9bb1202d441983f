//! How often the errors of maps hold: skies drawn from a prior and seen through the array.
#![allow(clippy::print_stderr)] // It says what it measured.

use std::borrow::Cow;

use rand_distr::{Distribution, StandardNormal};

use super::super::sigma::pixel_sigma_k;
use super::*;
use crate::imaging::power::{Block, Factors, PowerProblem};
use crate::sky::harmonics::synthesis;
use crate::units::{StreamKind, random_stream};

const NSIDE: usize = 8;
/// Degrees of a sky that has more than the map.
const SKY_L_MAX: usize = 28;
/// Degrees whose power is looked at.
const DEGREES: [usize; 4] = [3, 6, 12, 20];

/// Of the unknowns of a sky those of the map.
fn lower(unknowns: &[f64]) -> Vec<f64> {
    let of_map = unknowns.iter().zip(degrees(SKY_L_MAX)).filter(|(_, l)| *l <= L_MAX);
    of_map.map(|(x, _)| *x).collect()
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

    fn shares(&self) -> [f64; 2] {
        self.0.map(|held| held / self.1)
    }
}

/// Shares of pixels, monopoles, and powers at [`DEGREES`], of so many skies with structure up to `sky_l_max`.
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
    // A map's matrix is a part of the sky's.
    let cut = |(block, whole): (Block<'_>, &Block<'_>)| {
        let order = block.degrees.len();
        let matrix = Cow::Owned(whole.matrix.submatrix(0, 0, order, order).to_owned());
        Block { matrix, degrees: block.degrees, places: block.places }
    };
    let blocks: Vec<Block<'_>> = order_blocks.blocks().into_iter().zip(&wide_blocks).map(cut).collect();
    // As much signal as noise at the last degree.
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
        // Far more than structure, and than a prior that is not free would have.
        sky[0] = 1e3 * power(2).sqrt();
        // A (A + r)^-1 A is A where anything is measured.
        let mut data: Vec<f64> = sky.iter().map(|_| normal()).collect();
        noise_factors.solve_upper(&mut data);
        data.iter_mut().zip(&sky).for_each(|(noise, sky)| *noise += sky);
        wide.multiply(&mut data);
        let right = lower(&data);
        let sought = PowerProblem {
            sums: &sums,
            blocks: &blocks,
            degrees: &map_degrees,
            right: &right,
            power: 0.0,
            numbers: 1.0,
        };
        let found = sought.found_in_blocks().unwrap();
        let factors = Factors::new(&blocks, &found.regularisation);
        let sigma_k = pixel_sigma_k(&blocks, &factors, &found.ratio, NSIDE);
        let truth = lower(&sky);
        let off: Vec<f64> = found.solution.iter().zip(&truth).map(|(a, b)| a - b).collect();
        let off_k = synthesis(&coefficients(&off, L_MAX), NSIDE).unwrap();
        // Neighbours err alike.
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
fn errors_hold_of_skies_that_end_where_the_map_does() {
    let skies = std::env::var("LUNARRAY_SKIES").ok().and_then(|text| text.parse().ok()).unwrap_or(200);
    let found = coverage(skies, L_MAX);
    eprintln!("{skies} skies: pixels, monopole, C_l at {DEGREES:?}: {found:.3?}");
    for (what, shares) in ["pixels", "monopole", "C_3", "C_6", "C_12", "C_20"].iter().zip(&found) {
        for (share, expected) in shares.iter().zip([0.683, 0.95]) {
            // Three standard errors, pixels of a sky counted as one; R is taken as known, which leaves out its own error: 0.03.
            let error = (expected * (1.0 - expected) / skies as f64).sqrt();
            assert!((share - expected).abs() < 3.0 * error + 0.03, "{what}: {share} {expected}");
        }
    }
}

/// What a map leaves out of the sky is in the data all the same: here little of it, as the last degrees have no more signal than noise.
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
