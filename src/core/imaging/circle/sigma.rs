//! The standard deviation and the resolution of every pixel of a harmonic map, and the moments of degrees 0 and 1.
//!
//! The blocks that keep m couple no orders, so that a variance depends on the latitude alone. By degree it is scaled as draws say that the
//! covariance of the true matrix is.

use faer::Mat;
use rayon::prelude::*;

use super::blocks::orders_of;
use crate::imaging::power::{Block, Factors, Sample};
use crate::imaging::unknowns::{degrees, degrees_orders_parts};
use crate::sky::healpix::pixel_directions;
use crate::units::vector::Vec3;

/// Standard deviations, K, of the pixels of a map, HEALPix RING; `ratio` is that of traces, by degree.
pub(super) fn pixel_sigma_k(
    blocks: &[Block<'_>],
    factors: &Factors<'_>,
    ratio: &[f64],
    nside: usize,
) -> Vec<f64> {
    view_sigma_k(blocks, factors, &|_, l| ratio[l].sqrt(), &[], nside)
}

/// Root of the solid angle, degrees, for each coefficient that the data decide at the pixels of a map. Their density is
/// `y.(1 - R^1/2 (A + R)^-1 R^1/2) y` of the harmonics y at a pixel, whose integral is the number of those that the data decide: with the
/// blocks for A each degree counts by how many of it are constrained in truth.
pub(super) fn pixel_resolution_deg(
    blocks: &[Block<'_>],
    factors: &Factors<'_>,
    (r, constrained): (&[f64], &[f64]),
    nside: usize,
) -> Vec<f64> {
    let share = |((l, trace), constrained): ((usize, f64), &f64)| {
        let by_blocks = (2 * l + 1) as f64 - r[l] * trace;
        if by_blocks > 0.0 { (constrained / by_blocks).min(1.0) } else { 1.0 }
    };
    let traces = factors.traces(r.len() - 1).into_iter().enumerate();
    let shares: Vec<f64> = traces.zip(constrained).map(share).collect();
    let open = view_sigma_k(blocks, factors, &|_, l| (shares[l] * r[l]).sqrt(), &[], nside);
    let most: f64 = shares.iter().enumerate().map(|(l, share)| (2 * l + 1) as f64 * share).sum();
    open.iter().map(|open| resolution_deg(most, open * open)).collect()
}

/// Of a pixel at which `open` of the density of coefficients is not constrained, where `most` over the whole sphere would be.
pub(in crate::imaging) fn resolution_deg(most: f64, open: f64) -> f64 {
    let sphere_sr = 4.0 * std::f64::consts::PI;
    // One at least, the mean.
    let constrained = (most / sphere_sr - open).max(sphere_sr.recip());
    constrained.sqrt().recip().to_degrees()
}

/// Where the unknowns of the mean and of the dipole along x, y and z are, and what each is multiplied by for kelvins.
pub(in crate::imaging) fn moments(l_max: usize) -> [(usize, f64); 4] {
    let mean = (4.0 * std::f64::consts::PI).sqrt().recip();
    let dipole = 3.0_f64.sqrt() * mean;
    // Y_11 is negative at x > 0, and the unknowns are sqrt(2) times the real and imaginary part.
    [(0, mean), (l_max + 1, -dipole), (l_max + 2, dipole), (1, dipole)]
}

/// Mean and dipole along x, y and z, K, of unknowns.
pub(in crate::imaging) fn moments_k(unknowns: &[f64], l_max: usize) -> [f64; 4] {
    moments(l_max).map(|(place, factor)| factor * unknowns.get(place).copied().unwrap_or(0.0))
}

/// A sample of these unknowns, whose map is known.
pub(in crate::imaging) fn sample(unknowns: &[f64], l_max: usize, map_k: Vec<f64>) -> Sample {
    let mut power_k2 = vec![0.0; l_max + 1];
    for (l, x) in degrees(l_max).zip(unknowns) {
        power_k2[l] += x * x / (2 * l + 1) as f64;
    }
    let [_, x, y, z] = moments_k(unknowns, l_max);
    Sample { map_k, dipole_k: [x, y, z], power_k2 }
}

/// Standard deviations, K, of the pixels of a map that is a sum of several sets of unknowns of the same blocks: `weight(set, l)` times each,
/// and a variance by degree that none decides, `open`. The degrees of a set rise within a block.
pub(in crate::imaging) fn view_sigma_k(
    blocks: &[Block<'_>],
    factors: &Factors<'_>,
    weight: &(dyn Fn(usize, usize) -> f64 + Sync),
    open: &[f64],
    nside: usize,
) -> Vec<f64> {
    if let [block] = blocks
        && block.places.len() == 1
        && block.degrees.len() == (block.degrees.iter().max().map_or(0, |l| l + 1)).pow(2)
    {
        return whole_sigma_k(block, factors, weight, open, nside);
    }
    let z: Vec<f64> = pixel_directions(nside).iter().map(|direction| direction[2]).collect();
    let rings: Vec<&[f64]> = z.chunk_by(|a, b| a == b).collect();
    let l_max = blocks.iter().flat_map(|block| &block.degrees).copied().max().unwrap_or(0);
    let orders = orders_of(l_max);
    let of_block = |(index, block): (usize, &Block<'_>)| -> Vec<f64> {
        let m = orders[index];
        let sets: Vec<usize> = block
            .degrees
            .iter()
            .scan((0, None), |(set, before), l| {
                *set += usize::from(before.replace(*l).is_some_and(|before| *l <= before));
                Some(*set)
            })
            .collect();
        let mut values = Mat::zeros(block.degrees.len(), rings.len());
        let highest = block.degrees.iter().copied().max().unwrap_or(m);
        for (column, ring) in rings.iter().enumerate() {
            let lambda = legendre(m, highest, ring[0]);
            for ((row, l), set) in block.degrees.iter().enumerate().zip(&sets) {
                values[(row, column)] = weight(*set, *l) * lambda[l - m];
            }
        }
        let mut variances = factors.quadratic_forms(index, values);
        // sqrt(2) Y_lm of cosine and sine: their squares add up to 2.
        variances.iter_mut().for_each(|variance| *variance *= block.places.len() as f64);
        variances
    };
    let parts: Vec<Vec<f64>> = blocks.par_iter().enumerate().map(of_block).collect();
    let of_degree =
        |(l, variance): (usize, &f64)| (2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * variance;
    let mut variances = vec![open.iter().enumerate().map(of_degree).sum::<f64>(); rings.len()];
    for part in parts {
        variances.iter_mut().zip(part).for_each(|(sum, variance)| *sum += variance);
    }
    let of_ring = |(ring, variance): (&&[f64], &f64)| std::iter::repeat_n(variance.sqrt(), ring.len());
    rings.iter().zip(&variances).flat_map(of_ring).collect()
}

/// The same of one block of all unknowns, whose variances depend on the longitude, too.
fn whole_sigma_k(
    block: &Block<'_>,
    factors: &Factors<'_>,
    weight: &(dyn Fn(usize, usize) -> f64 + Sync),
    open: &[f64],
    nside: usize,
) -> Vec<f64> {
    let directions = pixel_directions(nside);
    let rings: Vec<&[Vec3]> = directions.chunk_by(|a, b| a[2] == b[2]).collect();
    let l_max = block.degrees.iter().copied().max().unwrap_or(0);
    let of_degree =
        |(l, variance): (usize, &f64)| (2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * variance;
    let open: f64 = open.iter().enumerate().map(of_degree).sum();
    let of_ring = |ring: &&[Vec3]| -> Vec<f64> {
        let lambda: Vec<Vec<f64>> = (0..=l_max).map(|m| legendre(m, l_max, ring[0][2])).collect();
        let unknowns: Vec<(usize, usize, usize)> = degrees_orders_parts(l_max).collect();
        let values = Mat::from_fn(unknowns.len(), ring.len(), |row, column| {
            let (l, m, part) = unknowns[row];
            let angle = m as f64 * ring[column][1].atan2(ring[column][0]);
            let turn = match (m, part) {
                (0, _) => 1.0,
                (_, 0) => std::f64::consts::SQRT_2 * angle.cos(),
                _ => -std::f64::consts::SQRT_2 * angle.sin(),
            };
            // The sign of Condon and Shortley.
            let sign = if m % 2 == 0 { 1.0 } else { -1.0 };
            sign * weight(0, l) * lambda[m][l - m] * turn
        });
        factors.quadratic_forms(0, values).iter().map(|variance| (open + variance).sqrt()).collect()
    };
    rings.par_iter().flat_map_iter(of_ring).collect()
}

/// `Y_lm(theta, 0)` for l = m ..= l_max at `z = cos theta`.
fn legendre(m: usize, l_max: usize, z: f64) -> Vec<f64> {
    let sin = (1.0 - z * z).max(0.0).sqrt();
    let mut first = (4.0 * std::f64::consts::PI).sqrt().recip();
    for k in 1..=m {
        first *= sin * ((2 * k + 1) as f64 / (2 * k) as f64).sqrt();
    }
    let factor = |l: usize| {
        let (l, m) = (l as f64, m as f64);
        ((4.0 * l * l - 1.0) / (l * l - m * m)).sqrt()
    };
    let mut values = vec![first];
    let mut before = 0.0;
    for l in m + 1..=l_max {
        let last = values[l - m - 1];
        let down = if l > m + 1 { before / factor(l - 1) } else { 0.0 };
        values.push(factor(l) * (z * last - down));
        before = last;
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn legendre_functions_are_those_of_tables() {
        // sqrt(3 / 4 pi) z, sqrt(5 / 16 pi) (3 z^2 - 1), sqrt(3 / 8 pi) sin, sqrt(15 / 8 pi) sin z, sqrt(15 / 32 pi) sin^2: magnitudes.
        let (z, pi) = (0.3_f64, std::f64::consts::PI);
        let sin = (1.0 - z * z).sqrt();
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-14, "{a} {b}");
        let zonal = legendre(0, 2, z);
        close(zonal[1], (3.0 / (4.0 * pi)).sqrt() * z);
        close(zonal[2], (5.0 / (16.0 * pi)).sqrt() * (3.0 * z * z - 1.0));
        close(legendre(1, 2, z)[0], (3.0 / (8.0 * pi)).sqrt() * sin);
        close(legendre(1, 2, z)[1], (15.0 / (8.0 * pi)).sqrt() * sin * z);
        close(legendre(2, 2, z)[0], (15.0 / (32.0 * pi)).sqrt() * sin * sin);
    }
}
