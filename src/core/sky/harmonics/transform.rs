//! Synthesis of RING maps from coefficients, and its transpose.

use num_complex::Complex64;
use pulp::Arch;
use rayon::prelude::*;

use super::kernel::{AdjointTask, GROUP, SynthesisTask};
use super::lanes::{BLOCK_MAX, RingLanes};
use super::recurrence::{Order, all_orders};
use super::rings::{RingFourier, RingPair, Scratch};
use super::{Alm, HarmonicsError};
use crate::sky::healpix::{is_valid_nside, pixel_count, ring};

/// Maximum degree, which bounds the tables (0.7 GB) and the growth in one step of the recurrence.
pub const L_MAX: usize = 8191;

/// Number of ring pairs that are summed together, which bounds memory to 130 kB per order.
const CHUNK: usize = 512;

/// Transform between coefficients up to `l_max` and maps of `nside`, with its tables.
///
/// Building it costs about as much as one transform; keep it for repeated use.
pub struct Transform {
    nside: usize,
    l_max: usize,
    arch: Arch,
    orders: Vec<Order>,
    lanes: RingLanes,
    fourier: RingFourier,
}

impl std::fmt::Debug for Transform {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Transform")
            .field("nside", &self.nside)
            .field("l_max", &self.l_max)
            .finish_non_exhaustive()
    }
}

impl Transform {
    /// Builds the tables for maps of `nside` and coefficients up to `l_max`, which may exceed 3 nside - 1.
    ///
    /// # Errors
    /// [`HarmonicsError::Nside`], [`HarmonicsError::Degree`].
    pub fn new(nside: usize, l_max: usize) -> Result<Self, HarmonicsError> {
        if !is_valid_nside(nside) {
            return Err(HarmonicsError::Nside { nside });
        }
        if l_max > L_MAX {
            return Err(HarmonicsError::Degree { l_max, most: L_MAX });
        }
        Ok(Self {
            nside,
            l_max,
            arch: Arch::new(),
            orders: all_orders(l_max),
            lanes: RingLanes::new(nside, l_max),
            fourier: RingFourier::new(nside, l_max),
        })
    }

    /// Resolution of the maps.
    #[must_use]
    pub fn nside(&self) -> usize {
        self.nside
    }

    /// Maximum degree of the coefficients.
    #[must_use]
    pub fn l_max(&self) -> usize {
        self.l_max
    }

    /// Synthesises the map of a real field at pixel centres, in RING order: the sum of a_lm Y_lm.
    ///
    /// # Errors
    /// [`HarmonicsError::Coefficients`] unless `alm` has the transform's `l_max`.
    pub fn synthesis(&self, alm: &Alm) -> Result<Vec<f64>, HarmonicsError> {
        if alm.l_max() != self.l_max {
            return Err(HarmonicsError::Coefficients { found: alm.l_max(), expected: self.l_max });
        }
        let mut map = vec![0.0; pixel_count(self.nside)];
        let mut pairs = self.ring_pairs_mut(&mut map);
        for (chunk, pairs) in pairs.chunks_mut(CHUNK).enumerate() {
            let first = chunk * CHUNK;
            let lanes = first..(first + pairs.len()).next_multiple_of(BLOCK_MAX);
            // A stride that is not a power of two spreads rows over the sets of the cache.
            let stride = lanes.len() + GROUP;
            let mut planes = vec![0.0; 4 * stride * (self.l_max + 1)];
            let order_planes = planes.par_chunks_mut(4 * stride);
            order_planes.zip(&self.orders).for_each_init(Vec::new, |mixed, (out, order)| {
                order.mix(alm.order(order.m), mixed);
                let (rings, chunk) = (&self.lanes, lanes.clone());
                let task = SynthesisTask { order, l_max: self.l_max, mixed, rings, chunk, out, stride };
                self.arch.dispatch(task);
            });
            pairs.par_chunks_mut(GROUP).enumerate().for_each_init(Scratch::new, |scratch, (group, pairs)| {
                for (k, pixels) in pairs.iter_mut().enumerate() {
                    let lane = group * GROUP + k;
                    self.fourier.synthesise(first + lane, &planes[lane..], stride, pixels, scratch);
                }
            });
        }
        Ok(map)
    }

    /// Computes the transpose of the synthesis times the pixel area: the sum over pixels of map conj(Y_lm) 4 pi / N_pix.
    ///
    /// This is the quadrature for a_lm without corrections; [`crate::sky::harmonics::analysis()`] computes the coefficients.
    ///
    /// # Errors
    /// [`HarmonicsError::Pixels`] unless `map` has the transform's `nside`.
    pub fn adjoint(&self, map: &[f64]) -> Result<Alm, HarmonicsError> {
        if map.len() != pixel_count(self.nside) {
            return Err(HarmonicsError::Pixels { found: map.len(), nside: self.nside });
        }
        let mut alm = Alm::zeros(self.l_max);
        let pairs = self.ring_pairs(map);
        for (chunk, pairs) in pairs.chunks(CHUNK).enumerate() {
            let first = chunk * CHUNK;
            let lanes = first..(first + pairs.len()).next_multiple_of(BLOCK_MAX);
            let group_stride = 4 * GROUP * (self.l_max + 1);
            let mut parts = vec![0.0; lanes.len() / GROUP * group_stride];
            let groups = parts.par_chunks_mut(group_stride).zip(pairs.par_chunks(GROUP)).enumerate();
            groups.for_each_init(Scratch::new, |scratch, (group, (out, pairs))| {
                for (k, pixels) in pairs.iter().enumerate() {
                    self.fourier.analyse(first + group * GROUP + k, pixels, &mut out[k..], scratch);
                }
            });
            let orders = self.split_orders(&mut alm);
            let buffers = || (Vec::new(), Vec::new());
            orders.into_par_iter().zip(&self.orders).for_each_init(
                buffers,
                |(by_lane, sums), (out, order)| {
                    let (rings, chunk) = (&self.lanes, lanes.clone());
                    let parts = &parts[4 * GROUP * order.m..];
                    self.arch.dispatch(AdjointTask {
                        order,
                        l_max: self.l_max,
                        rings,
                        chunk,
                        parts,
                        group_stride,
                        by_lane,
                        sums,
                    });
                    order.unmix(sums, out);
                },
            );
        }
        Ok(alm)
    }

    /// Divides a map into pairs of rings, from the poles to the equator.
    fn ring_pairs<'a>(&self, map: &'a [f64]) -> Vec<RingPair<&'a [f64]>> {
        let of = |k: usize| {
            let ring = ring(self.nside, k);
            &map[ring.first..ring.first + ring.len]
        };
        let equator = 2 * self.nside;
        (1..=equator)
            .map(|k| RingPair { north: of(k), south: if k < equator { of(4 * self.nside - k) } else { &[] } })
            .collect()
    }

    fn ring_pairs_mut<'a>(&self, mut map: &'a mut [f64]) -> Vec<RingPair<&'a mut [f64]>> {
        let mut pairs = Vec::with_capacity(2 * self.nside);
        for k in 1..=2 * self.nside {
            let len = ring(self.nside, k).len;
            let (north, rest) = map.split_at_mut(len);
            let southern = if rest.is_empty() { 0 } else { len };
            let (rest, south) = rest.split_at_mut(rest.len() - southern);
            pairs.push(RingPair { north, south });
            map = rest;
        }
        pairs
    }

    fn split_orders<'a>(&self, alm: &'a mut Alm) -> Vec<&'a mut [Complex64]> {
        let mut rest = alm.values_mut();
        let mut orders = Vec::with_capacity(self.l_max + 1);
        for m in 0..=self.l_max {
            let (order, after) = rest.split_at_mut(self.l_max + 1 - m);
            orders.push(order);
            rest = after;
        }
        orders
    }
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::*;
    use pulp::x86::V3;

    #[test]
    fn every_instruction_set_gives_the_same_fields() {
        let (nside, l_max) = (32, 300);
        let mut alm = Alm::zeros(l_max);
        for (k, value) in alm.values_mut().iter_mut().enumerate() {
            *value = Complex64::new((k as f64).sin(), if k <= l_max { 0.0 } else { (0.7 * k as f64).cos() });
        }
        let run = |arch| {
            let transform = Transform { arch, ..Transform::new(nside, l_max).unwrap() };
            let map = transform.synthesis(&alm).unwrap();
            let back = transform.adjoint(&map).unwrap();
            (map, back)
        };
        let (map, back) = run(Arch::Scalar);
        let others: Vec<_> =
            [Some(Arch::new()), V3::try_new().map(Arch::V3)].into_iter().flatten().map(run).collect();
        for (other_map, other_back) in &others {
            // Fused and separate operations round differently: 1e-16 each, over hundreds of degrees, for values up to 100.
            assert!(map.iter().zip(other_map).all(|(a, b)| (a - b).abs() < 1e-10));
            assert!(back.values().iter().zip(other_back.values()).all(|(a, b)| (a - b).norm() < 1e-10));
        }
        // Vectors of any width add in one order, so that AVX2 and AVX-512 give the same bits.
        assert!(
            others.iter().all(|(map, back)| *map == others[0].0 && back.values() == others[0].1.values())
        );
    }
}
