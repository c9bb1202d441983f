//! The equations of a pixel map over harmonics up to 2.5 nside: `Y'AY x = Y'b`, the map being `Y x`.

use std::borrow::Cow;

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, Par};
use rayon::prelude::*;

use super::PixelSums;
use crate::imaging::SolveError;
use crate::imaging::circle::{coefficients, unknowns};
use crate::imaging::power::Block;
use crate::imaging::{Accuracy, NormalSums, SumCounts};
use crate::numerics::legendre::Legendre;
use crate::sky::harmonics::Transform;
use crate::sky::healpix::{pixel_area_sr, pixel_directions};

/// Degrees per nside, as for harmonic maps.
const DEGREES_PER_NSIDE: f64 = 2.5;

/// Maximum degree of pixel maps whose R depends on the degree: pixels represent no higher ones of a sky whose power falls with the degree.
pub(in crate::imaging) fn degree_max(nside: usize) -> usize {
    (DEGREES_PER_NSIDE * nside as f64) as usize
}

/// Transforms between pixels and the unknowns of harmonics.
#[derive(Debug)]
pub(super) struct Harmonics {
    transform: Transform,
}

impl Harmonics {
    pub(super) fn new(nside: usize) -> Result<Self, SolveError> {
        Ok(Self { transform: Transform::new(nside, degree_max(nside))? })
    }

    pub(super) fn l_max(&self) -> usize {
        self.transform.l_max()
    }

    /// `Y x`.
    pub(super) fn to_pixels(&self, x: &[f64]) -> Result<Vec<f64>, SolveError> {
        Ok(self.transform.synthesis(&coefficients(x, self.l_max()))?)
    }

    /// `Y' map`.
    pub(super) fn harmonics_of(&self, map: &[f64]) -> Result<Vec<f64>, SolveError> {
        // The adjoint transform includes the area of a pixel.
        let area_sr = pixel_area_sr(self.transform.nside());
        Ok(unknowns(&self.transform.adjoint(map)?).into_iter().map(|x| x / area_sr).collect())
    }
}

/// Equations over pixels as equations over harmonics.
pub(super) struct Projected<'a> {
    pub(super) pixels: &'a (dyn NormalSums + Sync),
    pub(super) harmonics: &'a Harmonics,
    /// `Y'b` of the map less its prior, and of the noise map.
    pub(super) right: Vec<f64>,
    pub(super) noise: Vec<f64>,
}

impl NormalSums for Projected<'_> {
    fn unknowns(&self) -> usize {
        self.right.len()
    }

    fn apply(&self, x: &[f64], y: &mut [f64]) {
        for product in self.apply_all(&[x]) {
            y.copy_from_slice(&product);
        }
    }

    fn apply_all(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
        // The transforms know no other sizes, so that none fails.
        let maps: Vec<Vec<f64>> = x.iter().map(|x| self.harmonics.to_pixels(x).unwrap_or_default()).collect();
        let maps: Vec<&[f64]> = maps.iter().map(Vec::as_slice).collect();
        let products = self.pixels.apply_all(&maps);
        products.iter().map(|map| self.harmonics.harmonics_of(map).unwrap_or_default()).collect()
    }

    fn right_hand_side(&self) -> &[f64] {
        &self.right
    }

    fn noise_right_hand_side(&self) -> &[f64] {
        &self.noise
    }

    fn counts(&self) -> SumCounts {
        self.pixels.counts()
    }

    fn accuracy(&self) -> Accuracy {
        self.pixels.accuracy()
    }
}

/// The blocks of `Y'AY` that keep order and parity, averaged over turns about the pole, as those of sums on a circle.
pub(in crate::imaging) fn averaged_blocks(sums: &PixelSums) -> Vec<Block<'static>> {
    let l_max = degree_max(sums.nside);
    let rings = Rings::new(sums.nside);
    let points = rings.cos_sin.iter().copied();
    let legendre = Legendre::new(l_max, points);
    let of_rings = rings.averaged(sums, l_max);
    let ones = vec![1.0; rings.cos_sin.len()];
    let of_order = |m: usize| {
        let lambda = legendre.rows::<f64>(m, &ones);
        // Unknowns of lower orders: one for each degree of m = 0, and two of the others.
        let first: usize = (0..m).map(|m| parts_of(m) * (l_max + 1 - m)).sum();
        (0..2)
            .filter(move |parity| m + parity <= l_max)
            .map(move |parity| (parity, lambda.clone(), first))
            .map(|(parity, lambda, first)| {
                let degrees: Vec<usize> = (m + parity..=l_max).step_by(2).collect();
                let y = Mat::from_fn(ones.len(), degrees.len(), |ring, k| {
                    lambda[(degrees[k] - m) * ones.len() + ring]
                });
                let place =
                    |part: usize| degrees.iter().map(|l| first + (l - m) * parts_of(m) + part).collect();
                Block {
                    matrix: Cow::Owned(y.transpose() * (&of_rings[m] * &y)),
                    places: (0..parts_of(m)).map(place).collect(),
                    degrees,
                }
            })
            .collect::<Vec<_>>()
    };
    (0..=l_max).into_par_iter().map(of_order).collect::<Vec<_>>().into_iter().flatten().collect()
}

/// Number of real unknowns per coefficient of order m.
fn parts_of(m: usize) -> usize {
    if m == 0 { 1 } else { 2 }
}

/// The rings of a map.
struct Rings {
    /// First pixel of each, and one past the last.
    first: Vec<usize>,
    longitude_rad: Vec<f64>,
    cos_sin: Vec<(f64, f64)>,
}

impl Rings {
    fn new(nside: usize) -> Self {
        let directions = pixel_directions(nside);
        let (mut first, mut cos_sin) = (Vec::new(), Vec::new());
        for (pixel, [x, y, z]) in directions.iter().enumerate() {
            if pixel == 0 || directions[pixel - 1][2] != *z {
                first.push(pixel);
                cos_sin.push((*z, x.hypot(*y)));
            }
        }
        first.push(directions.len());
        Self { first, longitude_rad: directions.iter().map(|[x, y, _]| y.atan2(*x)).collect(), cos_sin }
    }

    /// For each order m the sums over pixels p, q of two rings of `A_pq cos m (phi_p - phi_q)`.
    fn averaged(&self, sums: &PixelSums, l_max: usize) -> Vec<Mat<f64>> {
        let count = self.cos_sin.len();
        let range = |ring: usize| self.first[ring]..self.first[ring + 1];
        // Cosines of all orders, then sines.
        let waves = |ring: usize| {
            let first = self.first[ring];
            Mat::from_fn(range(ring).len(), 2 * (l_max + 1), |pixel, column| {
                let (sin, cos) =
                    ((column % (l_max + 1)) as f64 * self.longitude_rad[first + pixel]).sin_cos();
                if column <= l_max { cos } else { sin }
            })
        };
        let all_waves: Vec<Mat<f64>> = (0..count).into_par_iter().map(waves).collect();
        let of_pair = |one: usize, other: usize| -> Vec<f64> {
            let (rows, columns) = (self.first[one], self.first[other]);
            let matrix = Mat::from_fn(range(one).len(), range(other).len(), |p, q| {
                sums.normal.get(rows + p, columns + q)
            });
            let mut half = Mat::zeros(matrix.nrows(), 2 * (l_max + 1));
            matmul(half.as_mut(), Accum::Replace, matrix.as_ref(), all_waves[other].as_ref(), 1.0, Par::Seq);
            let products = |column: usize| -> f64 {
                (0..matrix.nrows()).map(|p| all_waves[one][(p, column)] * half[(p, column)]).sum()
            };
            (0..=l_max).map(|m| products(m) + products(m + l_max + 1)).collect()
        };
        let of_ring = |one: usize| (one..count).map(|other| of_pair(one, other)).collect::<Vec<_>>();
        let pairs: Vec<Vec<Vec<f64>>> = (0..count).into_par_iter().map(of_ring).collect();
        let element = |m: usize, a: usize, b: usize| pairs[a.min(b)][a.max(b) - a.min(b)][m];
        (0..=l_max).map(|m| Mat::from_fn(count, count, |a, b| element(m, a, b))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::circle::degrees;
    use crate::imaging::pixel::{ColumnBlock, SymmetricTiles};
    use crate::sky::healpix::pixel_count;

    /// The blocks of a matrix are means of the elements of `Y'AY` that keep order and parity: of cosines and sines, which transforms give one
    /// by one.
    #[test]
    fn blocks_are_means_over_cosines_and_sines() {
        const NSIDE: usize = 2;
        const ROWS: usize = 3;
        let pixels = pixel_count(NSIDE);
        let harmonics = Harmonics::new(NSIDE).unwrap();
        let l_max = harmonics.l_max();
        let count = degrees(l_max).count();
        // Three rows without any symmetry of the sphere.
        let values: Vec<f64> = (0..ROWS * pixels).map(|k| (0.37 * (k * k) as f64).sin()).collect();
        let mut normal = SymmetricTiles::zeros(pixels);
        normal.add_products_f64(ColumnBlock { values: &values, columns: ROWS, stride: pixels });
        let element = |p: usize, q: usize| -> f64 {
            (0..ROWS).map(|row| values[row * pixels + p] * values[row * pixels + q]).sum()
        };
        let zeros = vec![0.0; pixels];
        let counts = SumCounts::default();
        let sums = PixelSums { nside: NSIDE, normal, right: zeros.clone(), noise: zeros, counts };
        let column = |k: usize| {
            let unit: Vec<f64> = (0..count).map(|n| f64::from(u8::from(n == k))).collect();
            let map = harmonics.to_pixels(&unit).unwrap();
            let product: Vec<f64> =
                (0..pixels).map(|p| (0..pixels).map(|q| element(p, q) * map[q]).sum()).collect();
            harmonics.harmonics_of(&product).unwrap()
        };
        let dense: Vec<Vec<f64>> = (0..count).map(column).collect();
        let mut seen = 0;
        for block in averaged_blocks(&sums) {
            assert!(block.places.iter().all(|places| places.len() == block.degrees.len()));
            seen += block.places.len() * block.degrees.len();
            for i in 0..block.degrees.len() {
                for j in 0..block.degrees.len() {
                    let of_part = |places: &Vec<usize>| dense[places[i]][places[j]];
                    let mean = block.places.iter().map(of_part).sum::<f64>() / block.places.len() as f64;
                    // Sums of 48^2 terms of order one.
                    assert!((block.matrix[(i, j)] - mean).abs() < 1e-10, "{i} {j} {mean}");
                }
            }
        }
        assert_eq!(seen, count);
    }
}
