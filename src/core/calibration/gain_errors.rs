//! Draws of the errors of applied gains.
//!
//! A draw depends on the seed, the solution, the channel, the satellite and the number of the draw alone: not on which visibilities it is for,
//! or when they arrive.

use num_complex::Complex64;
use rand_distr::{Distribution, StandardNormal};

use super::{ChannelGains, GainErrors};
use crate::units::{Pair, StreamKind, random_stream};

/// Errors of the gains of a channel, by entry of its table.
#[derive(Clone, Debug, Default)]
pub(super) struct ErrorTable {
    entries: Vec<Option<Entry>>,
}

/// Errors of an entry.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Entry {
    solution_s: f64,
    /// For each satellite, of ln amplitude and of phase (rad): the coefficients of independent unit normal numbers, of as many as satellites up to
    /// this one.
    factors: Vec<[Vec<f64>; 2]>,
}

impl Entry {
    fn new(errors: &GainErrors) -> Self {
        let mut factors: Vec<[Vec<f64>; 2]> = Vec::with_capacity(errors.sigma.len());
        let mut correlations = errors.correlations.iter();
        for n in 0..errors.sigma.len() {
            let with: Vec<[f64; 2]> =
                (0..n).map(|_| correlations.next().copied().unwrap_or_default()).collect();
            // Rows of the Cholesky factor of the correlations; what rounding makes negative is zero.
            let row = |axis: usize| {
                let mut row: Vec<f64> = Vec::with_capacity(n + 1);
                for (m, with) in with.iter().enumerate() {
                    let other: &[f64] = &factors[m][axis];
                    let known: f64 = row.iter().zip(other).map(|(a, b)| a * b).sum();
                    let own = other.last().copied().unwrap_or(0.0);
                    row.push(if own > PIVOT_MIN { (with[axis] - known) / own } else { 0.0 });
                }
                row.push((1.0 - row.iter().map(|x| x * x).sum::<f64>()).max(0.0).sqrt());
                let norm = row.iter().map(|x| x * x).sum::<f64>().sqrt();
                row.iter_mut().for_each(|x| *x /= norm);
                row
            };
            factors.push([row(0), row(1)]);
        }
        for (rows, sigma) in factors.iter_mut().zip(&errors.sigma) {
            rows.iter_mut().zip(sigma).for_each(|(row, sigma)| row.iter_mut().for_each(|x| *x *= sigma));
        }
        Self { solution_s: errors.solution_s, factors }
    }

    /// `d_i + conj(d_j)` of a draw, from two unit normal numbers of every satellite.
    fn of_pair(&self, pair: Pair, normals: &[[f64; 2]]) -> Complex64 {
        let of = |n: u8, axis: usize| -> f64 {
            let row = self.factors.get(usize::from(n)).map(|rows| &rows[axis]);
            row.into_iter().flatten().zip(normals).map(|(factor, normal)| factor * normal[axis]).sum()
        };
        Complex64::new(of(pair.i, 0) + of(pair.j, 0), of(pair.i, 1) - of(pair.j, 1))
    }
}

/// A pivot below which a number is a combination of those before it: correlations in files are rounded to 1e-6.
const PIVOT_MIN: f64 = 2e-3;

impl ErrorTable {
    pub(super) fn new(channel: &ChannelGains) -> Self {
        Self { entries: channel.solutions.iter().map(|one| one.errors.as_ref().map(Entry::new)).collect() }
    }

    /// Whether errors of any entry are stated.
    pub(super) fn states_any(&self) -> bool {
        self.entries.iter().any(Option::is_some)
    }

    /// Errors of an entry; `None` if they are not stated.
    pub(super) fn entry(&self, row: usize) -> Option<&Entry> {
        self.entries.get(row)?.as_ref()
    }

    /// Draws for visibilities of a pair in the order of time, in a channel of this frequency (Hz).
    pub(super) fn drawn(
        &self,
        (frequency_hz, pair): (f64, Pair),
        seed: u64,
        draws: usize,
    ) -> DrawnErrors<'_> {
        DrawnErrors { table: self, frequency_hz, pair, seed, draws, latest: [const { None }; 2] }
    }
}

/// Draws of the errors of a pair. Those of the latest two entries are kept.
pub(super) struct DrawnErrors<'a> {
    table: &'a ErrorTable,
    frequency_hz: f64,
    pair: Pair,
    seed: u64,
    draws: usize,
    latest: [Option<(usize, Vec<Complex64>)>; 2],
}

impl DrawnErrors<'_> {
    /// Appends the draws at a place of the table: an entry, or between it and another.
    pub(super) fn push_at(&mut self, (row, towards): (usize, Option<(usize, f64)>), to: &mut Vec<Complex64>) {
        if self.draws == 0 {
            return;
        }
        self.keep(row);
        let Some((next, u)) = towards else { return to.extend(self.of(row)) };
        self.keep(next);
        to.extend(self.of(row).zip(self.of(next)).map(|(before, after)| before * (1.0 - u) + after * u));
    }

    fn of(&self, row: usize) -> impl Iterator<Item = Complex64> {
        self.latest[row % 2].iter().flat_map(|(_, draws)| draws).copied()
    }

    /// Makes the draws of an entry. Entries that follow each other have places of their own.
    fn keep(&mut self, row: usize) {
        if self.latest[row % 2].as_ref().is_none_or(|(of, _)| *of != row) {
            self.latest[row % 2] = Some((row, self.pair_draws(row)));
        }
    }

    /// `d_i + conj(d_j)` of every draw, d the error of ln g.
    fn pair_draws(&self, row: usize) -> Vec<Complex64> {
        let Some(entry) = self.table.entry(row) else {
            return vec![Complex64::ZERO; self.draws];
        };
        // A millihertz tells channels apart.
        let channel = (self.frequency_hz * 1e3).round() as u64;
        let mut stream =
            random_stream(self.seed, StreamKind::GainErrors, [entry.solution_s.to_bits(), channel]);
        let mut normals = vec![[0.0; 2]; entry.factors.len()];
        let draw = |_| {
            normals
                .as_flattened_mut()
                .iter_mut()
                .for_each(|normal| *normal = StandardNormal.sample(&mut stream));
            entry.of_pair(self.pair, &normals)
        };
        (0..self.draws).map(draw).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::GainSolution;

    const SIGMA: [[f64; 2]; 3] = [[0.1, 0.2], [0.3, 0.05], [0.0, 0.1]];
    const HZ: f64 = 10e6;

    /// Two solutions: one of two entries, and one of one.
    fn table() -> ErrorTable {
        let entry = |time_s: f64, solution_s: f64| GainSolution {
            time_s,
            gains: vec![[1.0, 0.0]; 3],
            errors: Some(GainErrors { solution_s, sigma: SIGMA.to_vec(), correlations: Vec::new() }),
        };
        let solutions = vec![entry(0.0, 5.0), entry(10.0, 5.0), entry(20.0, 20.0)];
        ErrorTable::new(&ChannelGains { frequency_hz: HZ, solutions })
    }

    fn drawn(pair: (u8, u8), hz: f64, seed: u64, place: (usize, Option<(usize, f64)>)) -> Vec<Complex64> {
        let mut to = Vec::new();
        table().drawn((hz, Pair { i: pair.0, j: pair.1 }), seed, 64).push_at(place, &mut to);
        to
    }

    #[test]
    fn draws_are_of_solutions_and_interpolated() {
        let [start, end, other] = [0, 1, 2].map(|row| drawn((0, 1), HZ, 3, (row, None)));
        assert_eq!(start, end);
        // A quarter of the way between entries of one solution, and of two.
        let near = |a: &[Complex64], b: &[Complex64]| a.iter().zip(b).all(|(a, b)| (a - b).norm() < 1e-15);
        assert!(near(&drawn((0, 1), HZ, 3, (0, Some((1, 0.25)))), &start));
        let expected: Vec<Complex64> = end.iter().zip(&other).map(|(a, b)| a * 0.75 + b * 0.25).collect();
        assert!(near(&drawn((0, 1), HZ, 3, (1, Some((2, 0.25)))), &expected));
        // Another solution, channel or seed has other draws: 64 normal numbers are not alike by chance.
        for other in [other, drawn((0, 1), HZ + 4e3, 3, (0, None)), drawn((0, 1), HZ, 4, (0, None))] {
            let product: Complex64 = start.iter().zip(&other).map(|(a, b)| a * b.conj()).sum();
            let power = |draws: &[Complex64]| draws.iter().map(Complex64::norm_sqr).sum::<f64>();
            assert!(product.norm() < 0.5 * (power(&start) * power(&other)).sqrt(), "{product}");
        }
    }

    /// Amplitudes of two satellites of which only the sum is known, and one that goes with neither.
    #[test]
    fn draws_have_the_stated_correlations() {
        let correlations = vec![[-0.9999, 0.0], [0.0, 0.5], [0.0, -0.25]];
        let errors = GainErrors { solution_s: 1.0, sigma: vec![[0.3, 0.1]; 3], correlations };
        let entry = Entry::new(&errors);
        let covariance = |axis: usize, i: usize, j: usize| -> f64 {
            entry.factors[i][axis].iter().zip(&entry.factors[j][axis]).map(|(a, b)| a * b).sum()
        };
        for (k, (i, j)) in [(1, 0), (2, 0), (2, 1)].into_iter().enumerate() {
            for (axis, variance) in [(0, 0.09), (1, 0.01)] {
                let expected = variance * errors.correlations[k][axis];
                assert!((covariance(axis, i, j) - expected).abs() < 1e-15, "{axis} {i} {j}");
                assert!((covariance(axis, i, i) - variance).abs() < 1e-15);
            }
        }
        // The sum of two satellites that go against each other.
        let sum = entry.of_pair(Pair { i: 0, j: 1 }, &[[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]]);
        assert!((sum.re - 0.3 * 1e-4).abs() < 1e-12, "{sum}");
    }

    #[test]
    fn errors_of_pairs_are_those_of_their_satellites() {
        let mut squares = [[0.0; 2]; 2];
        for seed in 0..50 {
            let [a, b, c] = [(0, 1), (1, 2), (0, 2)].map(|pair| drawn(pair, HZ, seed, (0, None)));
            for ((a, b), c) in a.iter().zip(&b).zip(&c) {
                // Phases close; a_0 + a_1 + a_1 + a_2 - a_0 - a_2 are two of satellite 2's ln amplitude.
                assert!((a.im + b.im - c.im).abs() < 1e-14);
                for (sum, value) in squares[0].iter_mut().zip([a.re, a.im]) {
                    *sum += value * value / 3200.0;
                }
                squares[1][0] += (0.5 * (a.re + b.re - c.re)).powi(2) / 3200.0;
            }
        }
        let [[amplitude, phase], [single, _]] = squares;
        // Variances of 3,200 normal numbers are known to 2.5 %: four times that.
        for (found, expected) in [(amplitude, 0.1), (phase, 0.0425), (single, 0.09)] {
            assert!((found / expected - 1.0).abs() < 0.1, "{found} {expected}");
        }
    }
}
