//! The normal equations of several channels in the unknowns of their prior: `T' A T` and `T' b`.

use std::borrow::Cow;

use faer::Mat;
use rayon::prelude::*;

use super::powers::WeightedRows;
use super::prior::Prior;
use crate::imaging::power::{Block, Coupling};
use crate::imaging::solver::add;
use crate::imaging::unknowns::{degrees_orders_parts, index_of};
use crate::imaging::{Accuracy, NormalSums, SumCounts};

/// The sums of all channels. Residuals of a channel in excess of its noise count as noise.
pub(super) struct JointSums<'a> {
    pub(super) prior: &'a Prior,
    pub(super) channels: Vec<&'a (dyn NormalSums + Sync)>,
    /// Noise factor s of each channel; weights are divided by s^2.
    pub(super) noise_factors: Vec<f64>,
    /// Total powers of each channel, `None` if there are none.
    powers: Vec<Option<WeightedRows<'a>>>,
    right: Vec<f64>,
    noise_right: Vec<f64>,
}

impl<'a> JointSums<'a> {
    pub(super) fn new(
        prior: &'a Prior,
        channels: Vec<&'a (dyn NormalSums + Sync)>,
        noise_factors: Vec<f64>,
    ) -> Self {
        let transposed = |right: &dyn Fn(&(dyn NormalSums + Sync)) -> Vec<f64>, exponent: i32| {
            let scaled = |(sums, factor): (&&'a (dyn NormalSums + Sync), &f64)| {
                right(*sums).into_iter().map(|b| b / factor.powi(exponent)).collect::<Vec<f64>>()
            };
            prior.transposed(&channels.iter().zip(&noise_factors).map(scaled).collect::<Vec<_>>())
        };
        let right = transposed(&|sums| sums.right_hand_side().to_vec(), 2);
        // The noise is s times as large.
        let noise_right = transposed(&|sums| sums.noise_right_hand_side().to_vec(), 1);
        let powers = channels.iter().map(|_| None).collect();
        Self { prior, channels, noise_factors, powers, right, noise_right }
    }

    /// Adds the total powers of each channel.
    pub(super) fn with_powers(mut self, powers: Vec<Option<WeightedRows<'a>>>) -> Self {
        let right = |(powers, sums): (&Option<WeightedRows<'a>>, &&(dyn NormalSums + Sync))| {
            powers.as_ref().map_or_else(|| vec![0.0; sums.unknowns()], WeightedRows::right_hand_side)
        };
        let rights: Vec<Vec<f64>> = powers.iter().zip(&self.channels).map(right).collect();
        add(&mut self.right, &self.prior.transposed(&rights));
        Self { powers, ..self }
    }

    /// The total powers of a channel.
    pub(super) fn powers(&self, channel: usize) -> Option<&WeightedRows<'a>> {
        self.powers.get(channel)?.as_ref()
    }
}

impl NormalSums for JointSums<'_> {
    fn unknowns(&self) -> usize {
        self.right.len()
    }

    fn apply(&self, x: &[f64], y: &mut [f64]) {
        for product in self.apply_all(&[x]) {
            y.copy_from_slice(&product);
        }
    }

    fn apply_all(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
        // By vector, then by channel.
        let skies: Vec<Vec<Vec<f64>>> = x.iter().map(|x| self.prior.skies(x)).collect();
        let mut products: Vec<Vec<Vec<f64>>> = vec![Vec::new(); x.len()];
        for (channel, (sums, factor)) in self.channels.iter().zip(&self.noise_factors).enumerate() {
            let channel_skies: Vec<&[f64]> = skies.iter().map(|skies| skies[channel].as_slice()).collect();
            let channel_products = sums.apply_all(&channel_skies).into_iter().zip(channel_skies);
            for ((mut product, sky), all) in channel_products.zip(&mut products) {
                product.iter_mut().for_each(|y| *y /= factor.powi(2));
                if let Some(powers) = &self.powers[channel] {
                    add(&mut product, &powers.product(sky));
                }
                all.push(product);
            }
        }
        products.iter().map(|products| self.prior.transposed(products)).collect()
    }

    fn right_hand_side(&self) -> &[f64] {
        &self.right
    }

    fn noise_right_hand_side(&self) -> &[f64] {
        &self.noise_right
    }

    fn counts(&self) -> SumCounts {
        let mut all = SumCounts::default();
        for counts in self.channels.iter().map(|sums| sums.counts()) {
            all.visibilities += counts.visibilities;
            all.weight += counts.weight;
            all.power += counts.power;
        }
        all
    }

    fn accuracy(&self) -> Accuracy {
        let each = self.channels.iter().map(|sums| sums.accuracy());
        each.fold(Accuracy { relative: 0.0, absolute: 0.0 }, |a, b| Accuracy {
            relative: a.relative.max(b.relative),
            absolute: a.absolute.max(b.absolute),
        })
    }

    fn failure(&self) -> Option<&str> {
        self.channels.iter().find_map(|sums| sums.failure())
    }
}

/// Order and parity of each block of a channel, in the order of blocks.
fn orders(l_max: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..=l_max).flat_map(move |m| [(m, 0), (m, 1)]).filter(move |(m, parity)| m + parity <= l_max)
}

/// The scaled blocks `s_l A s_l' / s^2` of one order and parity.
pub(super) struct ScaledBlocks {
    m: usize,
    parity: usize,
    /// Blocks of the channels that reach this order.
    of_channel: Vec<Mat<f64>>,
}

/// Scales the blocks of all channels; `blocks` holds those of each channel, `powers` those of its total powers.
pub(super) fn scaled_blocks(
    prior: &Prior,
    blocks: &[Vec<Block<'_>>],
    noise_factors: &[f64],
    powers: &[Option<Vec<Mat<f64>>>],
) -> Vec<ScaledBlocks> {
    let scaled = |(index, (m, parity)): (usize, (usize, usize))| {
        // A block has the same index in all channels that have it.
        let of_channel = (0..prior.channels_with_degree(m + parity)).map(|channel| {
            let at = index_in(prior.l_max[channel], m, parity);
            let block = &blocks[channel][at];
            let powers = powers.get(channel).and_then(|powers| Some(&powers.as_ref()?[at]));
            let scale = |k: usize| prior.scale[channel][block.degrees[k]];
            Mat::from_fn(block.degrees.len(), block.degrees.len(), |i, j| {
                let of_visibilities = block.matrix[(i, j)] / noise_factors[channel].powi(2);
                scale(i) * (of_visibilities + powers.map_or(0.0, |powers| powers[(i, j)])) * scale(j)
            })
        });
        debug_assert_eq!(index_in(prior.l_max[0], m, parity), index);
        ScaledBlocks { m, parity, of_channel: of_channel.collect() }
    };
    let all: Vec<_> = orders(prior.l_max.first().copied().unwrap_or(0)).enumerate().collect();
    all.into_par_iter().map(scaled).collect()
}

/// The index of the block of an order and parity; each order has two blocks, except the last, which has one.
fn index_in(l_max: usize, m: usize, parity: usize) -> usize {
    debug_assert!(m + parity <= l_max);
    2 * m + parity
}

/// Computes the blocks of `T' A T`.
pub(super) fn joint_blocks(prior: &Prior, scaled: &[ScaledBlocks]) -> Vec<Block<'static>> {
    let (offsets, _) = prior.offsets();
    scaled.par_iter().map(|scaled| joint_block(prior, scaled, &offsets)).collect()
}

fn joint_block(prior: &Prior, scaled: &ScaledBlocks, offsets: &[usize]) -> Block<'static> {
    let ScaledBlocks { m, parity, of_channel } = scaled;
    let sizes: Vec<usize> = of_channel.iter().map(Mat::nrows).collect();
    let first: Vec<usize> =
        sizes.iter().scan(0, |sum, size| Some(std::mem::replace(sum, *sum + size))).collect();
    let count = sizes.iter().sum();
    let mut matrix = Mat::<f64>::zeros(count, count);
    for a in 0..sizes.len() {
        for b in 0..=a {
            // Channel c depends on the unknowns of channels up to c, at its own degrees.
            for c in a..sizes.len() {
                let shares = |source: usize| -> Vec<f64> {
                    (0..sizes[c]).map(|k| prior.share(m + parity + 2 * k, c, source)).collect()
                };
                let (rows, columns) = (shares(a), shares(b));
                for j in 0..sizes[c] {
                    for i in 0..sizes[c] {
                        matrix[(first[a] + i, first[b] + j)] += rows[i] * of_channel[c][(i, j)] * columns[j];
                    }
                }
            }
            if a != b {
                for j in 0..sizes[b] {
                    for i in 0..sizes[a] {
                        matrix[(first[b] + j, first[a] + i)] = matrix[(first[a] + i, first[b] + j)];
                    }
                }
            }
        }
    }
    let rows: Vec<(usize, usize)> = (0..sizes.len())
        .flat_map(|channel| (0..sizes[channel]).map(move |k| (channel, m + parity + 2 * k)))
        .collect();
    let parts = if *m == 0 { 1 } else { 2 };
    let places = |part: usize| {
        let place =
            |(channel, l): &(usize, usize)| offsets[*channel] + index_of(prior.l_max[*channel], *l, *m, part);
        rows.iter().map(place).collect()
    };
    Block {
        matrix: Cow::Owned(matrix),
        degrees: rows.iter().map(|(_, l)| *l).collect(),
        places: (0..parts).map(places).collect(),
    }
}

/// Maximum number of coupled unknowns, whose matrix takes 128 MB, some four times while it is factorised.
pub(super) const COUPLED_MAX: usize = 4000;

/// What couples the blocks of [`joint_blocks`], from that of each channel's visibilities and powers: `sum_c T_c' E_c T_c`.
pub(super) fn joint_coupling(
    prior: &Prior,
    visibilities: &[Option<&Coupling>],
    noise_factors: &[f64],
    powers: &[Option<Coupling>],
    unknowns_max: usize,
) -> Coupling {
    // Channel c depends on the unknowns of channels up to c.
    let of_channel = |channel: usize| {
        let both = visibilities[channel].into_iter().chain(&powers[channel]);
        both.map(|coupling| coupling.degree_max).max().unwrap_or(0)
    };
    let of_unknowns = |channel: usize| (channel..prior.channels()).map(of_channel).max().unwrap_or(0);
    let all: Vec<usize> = (0..prior.channels()).map(of_unknowns).collect();
    let capped = |cap: usize| all.iter().map(|degree| *degree.min(&cap)).collect::<Vec<usize>>();
    let highest = all.iter().copied().max().unwrap_or(0);
    let degree_max = (0..=highest).rev().find(|cap| count_up_to(&capped(*cap)) <= unknowns_max).unwrap_or(0);
    // By channel the highest degree of its coupled unknowns, and the first of them.
    let degrees = capped(degree_max);
    let first: Vec<usize> = (0..degrees.len()).map(|a| count_up_to(&degrees[..a])).collect();
    let (offsets, _) = prior.offsets();
    let of_one = |((degree, l_max), offset): ((&usize, &usize), usize)| {
        let l_max = *l_max;
        degrees_orders_parts(*degree).map(move |(l, m, part)| offset + index_of(l_max, l, m, part))
    };
    let places: Vec<usize> = degrees.iter().zip(&prior.l_max).zip(offsets).flat_map(of_one).collect();
    let mut matrix = Mat::<f64>::zeros(places.len(), places.len());
    for channel in 0..prior.channels() {
        let weighted = [(visibilities[channel], noise_factors[channel]), (powers[channel].as_ref(), 1.0)];
        for (coupling, factor) in weighted {
            let Some(coupling) = coupling else { continue };
            let unknowns = || degrees_orders_parts(coupling.degree_max.min(degree_max));
            let at = |degree: usize| -> Vec<usize> {
                unknowns().map(|(l, m, part)| index_of(degree, l, m, part)).collect()
            };
            let scale = |source: usize| -> Vec<f64> {
                let of_degree = |l: usize| prior.share(l, channel, source) * prior.scale[channel][l] / factor;
                unknowns().map(|(l, ..)| of_degree(l)).collect()
            };
            let own = at(coupling.degree_max);
            for a in 0..=channel {
                for b in 0..=channel {
                    let (rows, columns) = (at(degrees[a]), at(degrees[b]));
                    let (of_row, of_column) = (scale(a), scale(b));
                    for (j, column) in columns.iter().enumerate() {
                        for (i, row) in rows.iter().enumerate() {
                            matrix[(first[a] + row, first[b] + column)] +=
                                of_row[i] * coupling.matrix[(own[i], own[j])] * of_column[j];
                        }
                    }
                }
            }
        }
    }
    Coupling { degree_max, places, matrix }
}

/// The number of unknowns up to a degree for each channel, summed.
fn count_up_to(degrees: &[usize]) -> usize {
    degrees.iter().map(|degree| (degree + 1).pow(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::joint::correlation::Covariance;

    /// The product with the blocks equals successive products with T, the channels' blocks and `T'`.
    #[test]
    fn blocks_are_the_channels_blocks_between_t_and_its_transpose() {
        let scale = vec![vec![1.0, 0.5, 0.3, 0.2], vec![2.0, 1.5, 0.7], vec![1.2, 0.9, 0.4]];
        let covariance = Covariance::constant(vec![3e6, 10e6, 5e6], 3, 2.0, 0.05);
        let prior = Prior::new(scale, covariance).unwrap();
        let factors = [1.0, 1.5, 1.2];
        let of = |channel: usize| -> Vec<Block<'static>> {
            let l_max = prior.l_max[channel];
            let of_order = |(m, parity): (usize, usize)| {
                let degrees: Vec<usize> = (m + parity..=l_max).step_by(2).collect();
                let n = degrees.len();
                let element = |i: usize, j: usize| {
                    ((1 + channel) * (m + 1)) as f64 / (1.0 + (i + j) as f64) + f64::from(u8::from(i == j))
                };
                let parts = if m == 0 { 1 } else { 2 };
                let place = |part| degrees.iter().map(|l| index_of(l_max, *l, m, part)).collect();
                let places = (0..parts).map(place).collect();
                Block { matrix: Cow::Owned(Mat::from_fn(n, n, element)), degrees, places }
            };
            orders(l_max).map(of_order).collect()
        };
        let blocks: Vec<Vec<Block<'_>>> = (0..3).map(of).collect();
        let joint = joint_blocks(&prior, &scaled_blocks(&prior, &blocks, &factors, &[]));
        let (_, count) = prior.offsets();
        let u: Vec<f64> = (0..count).map(|k| (0.9 * k as f64).sin()).collect();
        let products: Vec<Vec<f64>> = prior
            .skies(&u)
            .iter()
            .enumerate()
            .map(|(channel, sky)| {
                let product = crate::imaging::power::multiply(&blocks[channel], sky);
                product.iter().map(|y| y / factors[channel] / factors[channel]).collect()
            })
            .collect();
        let (found, expected) = (crate::imaging::power::multiply(&joint, &u), prior.transposed(&products));
        for (a, b) in found.iter().zip(&expected) {
            assert!((a - b).abs() < 1e-12 * (1.0 + b.abs()), "{a} {b}");
        }
    }

    /// The form with the coupling is that of the channels' couplings with the skies of the unknowns, also where the number of unknowns is
    /// limited.
    #[test]
    fn coupling_is_the_channels_couplings_between_t_and_its_transpose() {
        let scale = vec![vec![1.0, 0.5, 0.3, 0.2], vec![2.0, 1.5, 0.7], vec![1.2, 0.9, 0.4]];
        let covariance = Covariance::constant(vec![10e6, 3e6, 5e6], 3, 2.0, 0.05);
        let prior = Prior::new(scale, covariance).unwrap();
        let factors = [1.0, 1.5, 1.2];
        let of = |channel: usize, degree_max: usize| {
            let count = (degree_max + 1).pow(2);
            let element = |i: usize, j: usize| ((channel + 2) as f64 * (i + j) as f64).cos();
            let places = degrees_orders_parts(degree_max)
                .map(|(l, m, part)| index_of(prior.l_max[channel], l, m, part))
                .collect();
            Coupling { degree_max, places, matrix: Mat::from_fn(count, count, element) }
        };
        let visibilities = [of(0, 2), of(1, 1)];
        let of_visibilities = [Some(&visibilities[0]), Some(&visibilities[1]), None];
        let powers = [None, None, Some(of(2, 1))];
        for (unknowns_max, count_of) in [(100, 9 + 4 + 4), (14, 4 + 4 + 4), (11, 3)] {
            let found = joint_coupling(&prior, &of_visibilities, &factors, &powers, unknowns_max);
            assert_eq!(found.places.len(), count_of);
            let (_, count) = prior.offsets();
            let mut u = vec![0.0; count];
            found.places.iter().for_each(|place| u[*place] = (0.9 * *place as f64).sin());
            let form = |coupling: &Coupling, x: &[f64]| -> f64 {
                let at = |k: usize| x[coupling.places[k]];
                let row = |i: usize| {
                    (0..coupling.places.len()).map(move |j| at(i) * coupling.matrix[(i, j)] * at(j))
                };
                (0..coupling.places.len()).flat_map(row).sum()
            };
            let skies = prior.skies(&u);
            let expected = form(&visibilities[0], &skies[0])
                + form(&visibilities[1], &skies[1]) / 1.5_f64.powi(2)
                + form(powers[2].as_ref().unwrap(), &skies[2]);
            assert!(
                (form(&found, &u) - expected).abs() < 1e-11 * expected.abs(),
                "{} {expected}",
                form(&found, &u)
            );
        }
    }
}
