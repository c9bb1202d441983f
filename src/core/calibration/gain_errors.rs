//! Draws of the errors of applied gains.
//!
//! A draw depends on the seed, the solution, the channel, the satellite and the number of the draw alone: not on which visibilities it is for,
//! or when they arrive.

use num_complex::Complex64;
use rand_distr::{Distribution, StandardNormal};

use super::ChannelGains;
use crate::units::{Pair, StreamKind, random_stream};

/// Errors of the gains of a channel, by entry of its table.
#[derive(Clone, Debug, Default)]
pub(super) struct ErrorTable {
    /// The solution of each entry, and standard deviations of ln amplitude and phase (rad) by satellite.
    entries: Vec<Option<(f64, Vec<[f64; 2]>)>>,
}

/// The solution that errors are of, s, and the standard deviations of both satellites; `None` if they are not stated.
pub(super) type PairErrors = Option<(f64, [[f64; 2]; 2])>;

impl ErrorTable {
    pub(super) fn new(channel: &ChannelGains) -> Self {
        let errors = channel.solutions.iter().map(|solution| solution.errors.as_ref());
        let entry = |errors: &super::GainErrors| (errors.solution_s, errors.sigma.clone());
        Self { entries: errors.map(|errors| errors.map(entry)).collect() }
    }

    /// Whether any errors are stated.
    pub(super) fn is_stated(&self) -> bool {
        self.entries.iter().any(Option::is_some)
    }

    pub(super) fn of_pair(&self, row: usize, pair: Pair) -> PairErrors {
        let (solution_s, sigma) = self.entries.get(row)?.as_ref()?;
        let of = |n: u8| sigma.get(usize::from(n)).copied();
        Some((*solution_s, [of(pair.i)?, of(pair.j)?]))
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
        let Some((solution_s, sigmas)) = self.table.of_pair(row, self.pair) else {
            return vec![Complex64::ZERO; self.draws];
        };
        let of = |n: u8, [ln_amplitude, phase_rad]: [f64; 2]| {
            // A millihertz tells channels apart; 2^40 of them are 1.1 GHz.
            let source = ((self.frequency_hz * 1e3).round() as u64) << 8 | u64::from(n);
            let mut stream = random_stream(self.seed, StreamKind::GainErrors, [solution_s.to_bits(), source]);
            let mut normal = move || -> f64 { StandardNormal.sample(&mut stream) };
            std::iter::repeat_with(move || Complex64::new(ln_amplitude * normal(), phase_rad * normal()))
        };
        let [sigma_i, sigma_j] = sigmas;
        let both = of(self.pair.i, sigma_i).zip(of(self.pair.j, sigma_j));
        both.map(|(i, j)| i + j.conj()).take(self.draws).collect()
    }
}
