//! Excess of residuals over noise: gains that change within the interval, and errors of the model.
//!
//! The residuals of a pair in a channel, projected on the prediction of the solution, are summed over parts of the
//! interval: `score`, whose variance is the `information` of the part. If the gain of daughter n is off by a factor
//! `1 + d` during a part, `information * d` is added to all of its pairs, so that their sum shows the change of the
//! gain; the rest comes from the model, not from gains.

use num_complex::Complex64;

use super::layout::{ParameterLayout, ParameterValues};
use super::sums::ModelledBlock;

/// Number of parts of an interval.
const PARTS: usize = 32;

/// Numbers of parts in which changes are sought, from the slowest change to the fastest.
const SCALES: [usize; 5] = [2, 4, 8, 16, 32];

/// Numbers of parts in which errors of the model are sought.
const MODEL_SCALES: [usize; 2] = [1, 4];

/// Significance, in standard deviations of noise, of scatter.
const SIGMAS: f64 = 4.0;

/// Significance for a gain that jumped in the pass, as it may drift as well.
const SUSPECT_SIGMAS: f64 = 1.5;

/// Sums of one pair in one channel by part.
#[derive(Clone)]
struct PairResiduals {
    channel: usize,
    /// Both daughters.
    daughters: [usize; 2],
    score: [Complex64; PARTS],
    information: [f64; PARTS],
}

/// Sums of all pairs and channels.
pub(super) struct Residuals {
    satellites: usize,
    channels: usize,
    pairs: Vec<PairResiduals>,
}

/// Variance of the logarithm of a gain beyond that due to noise.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Excess {
    /// Variance of the change within the interval, of log amplitude and phase (rad).
    pub(super) scatter: [f64; 2],
    /// Variance due to errors of the model that are seen to last, of either.
    pub(super) model: f64,
    /// The same by errors that noise may hide.
    pub(super) model_below_noise: f64,
    /// The same by a model whose errors have the power of the signal.
    pub(super) model_full_power: f64,
}

/// Fraction of outliers in a part of the interval above which something other than a gain is disturbed.
const BURST_FRACTION: f64 = 0.4;

/// Score and information of a daughter's gain in each part.
type Series = [(Complex64, f64); PARTS];

impl Residuals {
    /// Sums the blocks that are used, without outliers. With a `cut` outliers are included, with residuals limited to
    /// so many standard deviations, as data after a jump may be outliers; but not in parts of the interval with many
    /// outliers.
    pub(super) fn of(
        layout: &ParameterLayout,
        values: &ParameterValues,
        blocks: &[ModelledBlock],
        (variance_factors, is_pair_used): (&[f64], &[bool]),
        span_s: [f64; 2],
        cut: Option<f64>,
    ) -> Self {
        let [from_s, until_s] = data_span_s(blocks, span_s);
        let step_s = (until_s - from_s) / PARTS as f64;
        let part = |time_s: f64| (((time_s - from_s) / step_s) as usize).min(PARTS - 1);
        let chosen =
            blocks.iter().zip(variance_factors).zip(is_pair_used).filter(|(_, is_pair_used)| **is_pair_used);
        let mut outliers = [[0_u64; 2]; PARTS];
        for ((block, _), _) in chosen.clone() {
            for (time_s, is_out) in block.time_s.iter().zip(&block.is_out) {
                if (span_s[0]..span_s[1]).contains(time_s) {
                    let [out, all] = &mut outliers[part(*time_s)];
                    (*out, *all) = (*out + u64::from(*is_out), *all + 1);
                }
            }
        }
        let is_disturbed = outliers.map(|[out, all]| out as f64 > BURST_FRACTION * all as f64);
        let pairs = chosen.map(|((block, variance_factor), _)| {
            let mut sums = PairResiduals {
                channel: block.channel,
                daughters: [block.pair.i, block.pair.j].map(usize::from),
                score: [Complex64::ZERO; PARTS],
                information: [0.0; PARTS],
            };
            for_each_score(
                layout,
                values,
                (block, *variance_factor),
                (span_s, cut),
                |time_s, score, information| {
                    if cut.is_none() || !is_disturbed[part(time_s)] {
                        sums.score[part(time_s)] += score;
                        sums.information[part(time_s)] += information;
                    }
                },
            );
            sums
        });
        Self { satellites: layout.satellites, channels: layout.channels(), pairs: pairs.collect() }
    }

    fn series(&self, channel: usize, daughter: usize) -> Series {
        let mut series = [(Complex64::ZERO, 0.0); PARTS];
        for pair in
            self.pairs.iter().filter(|pair| pair.channel == channel && pair.daughters.contains(&daughter))
        {
            for (part, (score, information)) in series.iter_mut().enumerate() {
                let own = pair.score[part];
                *score += if pair.daughters[0] == daughter { own } else { own.conj() };
                *information += pair.information[part];
            }
        }
        series
    }

    /// Subtracts the change of a daughter's gain from its pairs, in `scale` parts.
    fn subtract_change(&mut self, channel: usize, daughter: usize, series: &Series, scale: usize) {
        let parts_per_group = PARTS / scale;
        let change: Vec<Complex64> = series.chunks(parts_per_group).map(mean).collect();
        let has_daughter =
            |pair: &&mut PairResiduals| pair.channel == channel && pair.daughters.contains(&daughter);
        for pair in self.pairs.iter_mut().filter(has_daughter) {
            for part in 0..PARTS {
                let change = change[part / parts_per_group];
                let change = if pair.daughters[0] == daughter { change } else { change.conj() };
                pair.score[part] -= pair.information[part] * change;
            }
        }
    }

    /// Finds the gains that change, the worst of each channel first, and subtracts each change before the next is
    /// found.
    fn subtract_changes(&mut self, suspects: &[bool]) -> Vec<(usize, usize, Scatter)> {
        let mut found = Vec::new();
        for channel in 0..self.channels {
            let mut open: Vec<usize> = (0..self.satellites).collect();
            while let Some((at, scatter)) = self.most_variable(channel, &open, suspects) {
                let daughter = open.remove(at);
                let series = self.series(channel, daughter);
                self.subtract_change(channel, daughter, &series, scatter.scale);
                found.push((channel, daughter, scatter));
            }
        }
        found
    }

    /// The daughter of `open` whose gain changes most, if significantly.
    fn most_variable(&self, channel: usize, open: &[usize], suspects: &[bool]) -> Option<(usize, Scatter)> {
        let scatter = |(at, n): (usize, &usize)| {
            let least = if suspects[channel * self.satellites + n] { SUSPECT_SIGMAS } else { SIGMAS };
            (at, Scatter::of(&self.series(channel, *n), least))
        };
        let each = open.iter().enumerate().map(scatter).filter(|(_, scatter)| scatter.is_significant());
        each.max_by(|(_, a), (_, b)| a.significance.total_cmp(&b.significance))
    }

    /// Excess of all gains (by channel, then daughter), and the fraction of the signal of each channel that is due to
    /// errors of the model, 0 where that may be noise.
    pub(super) fn excess(mut self, suspects: &[bool]) -> (Vec<Excess>, Vec<f64>) {
        let mut excess = vec![Excess::default(); self.satellites * self.channels];
        for (channel, daughter, scatter) in self.subtract_changes(suspects) {
            excess[channel * self.satellites + daughter].scatter = scatter.variance;
        }
        let mut parts = vec![0.0; self.channels];
        for (channel, part) in parts.iter_mut().enumerate() {
            let of_all = self.model_error_fraction(channel, None);
            *part = of_all;
            for daughter in 0..self.satellites {
                let most = of_all.max(self.model_error_fraction(channel, Some(daughter)));
                let own =
                    self.pairs.iter().filter(|p| p.channel == channel && p.daughters.contains(&daughter));
                let (sum, square) = own.fold((0.0, 0.0), |(sum, square), pair| {
                    let information: f64 = pair.information.iter().sum();
                    (sum + information, square + information * information)
                });
                // The excess of amplitude or phase. An error of the model lasts for the pass and differs between
                // pairs.
                let share = if sum > 0.0 { square / (sum * sum) } else { 0.0 };
                let excess = &mut excess[channel * self.satellites + daughter];
                excess.model = 0.5 * most * share;
                excess.model_below_noise =
                    0.5 * self.model_error_fractions(channel, Some(daughter))[1] * share;
                excess.model_full_power = 0.5 * share;
            }
        }
        (excess, parts)
    }

    /// Fraction of the signal, of all pairs or of one daughter's, that remains beyond noise; 0 where it may be noise.
    fn model_error_fraction(&self, channel: usize, daughter: Option<usize>) -> f64 {
        self.model_error_fractions(channel, daughter)[0]
    }

    /// [`Self::model_error_fraction`], and as much as noise may hide.
    fn model_error_fractions(&self, channel: usize, daughter: Option<usize>) -> [f64; 2] {
        let own: Vec<&PairResiduals> = self.pairs.iter().filter(|pair| pair.channel == channel).collect();
        let mut present = vec![false; self.satellites];
        own.iter().flat_map(|pair| pair.daughters).for_each(|n| present[n] = true);
        let gains = present.iter().filter(|one| **one).count() as f64;
        let part = |scale: usize| {
            let (mut square, mut count, mut information, mut all) = (0.0, 0.0, 0.0, 0.0);
            for pair in &own {
                let counts = daughter.is_none_or(|n| pair.daughters.contains(&n));
                for (score, of_part) in pair.grouped(scale).filter(|(_, of_part)| *of_part > 0.0) {
                    all += 2.0;
                    if counts {
                        square += score.norm_sqr() / of_part;
                        information += of_part;
                        count += 2.0;
                    }
                }
            }
            // The solution fits the gains, so residuals of noise have less than its variance.
            let degrees_of_freedom: f64 = (1.0 - (2.0 * gains - 1.0) / f64::max(all, 1.0)).max(0.0);
            let excess_power = square - count * degrees_of_freedom;
            let noise = SIGMAS * (2.0 * count).sqrt();
            if information > 0.0 {
                let significant = if excess_power > noise { excess_power } else { 0.0 };
                [significant / information, (excess_power + noise).max(0.0) / information]
            } else {
                [0.0; 2]
            }
        };
        let parts = MODEL_SCALES.map(part);
        [0, 1].map(|k| parts.iter().map(|part| part[k]).fold(0.0, f64::max))
    }

    /// The daughter, with its channels, that has the largest jump of a gain rather than a drift. Gains of `drifting`
    /// (by channel, then daughter) are skipped.
    pub(super) fn largest_jumping(&mut self, drifting: &[bool]) -> Option<(usize, Vec<usize>)> {
        let mut found: Vec<(usize, usize, f64)> = Vec::new();
        let suspects = vec![false; drifting.len()];
        for channel in 0..self.channels {
            let mut open: Vec<usize> = (0..self.satellites).collect();
            while let Some((at, scatter)) = self.most_variable(channel, &open, &suspects) {
                let daughter = open.remove(at);
                let series = self.series(channel, daughter);
                let jump = largest_jump(&series).filter(|_| !drifting[channel * self.satellites + daughter]);
                if let Some(jump) = jump {
                    found.push((daughter, channel, jump));
                    break;
                }
                self.subtract_change(channel, daughter, &series, scatter.scale);
            }
        }
        let (daughter, ..) = *found.iter().max_by(|a, b| a.2.total_cmp(&b.2))?;
        Some((daughter, found.iter().filter(|one| one.0 == daughter).map(|one| one.1).collect()))
    }
}

impl PairResiduals {
    fn grouped(&self, scale: usize) -> impl Iterator<Item = (Complex64, f64)> + '_ {
        let parts_per_group = PARTS / scale;
        let scores = self.score.chunks(parts_per_group).map(|scores| scores.iter().sum());
        scores.zip(self.information.chunks(parts_per_group).map(|information| information.iter().sum()))
    }
}

fn mean(parts: &[(Complex64, f64)]) -> Complex64 {
    let (score, information) = total(parts);
    if information > 0.0 { score / information } else { Complex64::ZERO }
}

fn total(parts: &[(Complex64, f64)]) -> (Complex64, f64) {
    parts.iter().fold((Complex64::ZERO, 0.0), |(a, b), (score, information)| (a + score, b + information))
}

/// Change of a gain within an interval.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Scatter {
    /// Significance in standard deviations of noise.
    pub(super) significance: f64,
    /// Number of parts at which the change is most significant.
    scale: usize,
    /// Variance of the change beyond noise, of amplitude and phase.
    pub(super) variance: [f64; 2],
}

impl Scatter {
    fn is_significant(&self) -> bool {
        self.variance.iter().any(|variance| *variance > 0.0)
    }

    /// Computes the scatter; changes count from a significance of `least`.
    fn of(series: &Series, least: f64) -> Self {
        let mut scatter = Self { scale: PARTS, ..Self::default() };
        let (sum, information) = total(series);
        if information <= 0.0 {
            return scatter;
        }
        for scale in SCALES {
            let (mut squares, mut count) = ([0.0; 2], -1.0);
            for (score, of_part) in series.chunks(PARTS / scale).map(total) {
                if of_part > 0.0 {
                    squares[0] += score.re * score.re / of_part;
                    squares[1] += score.im * score.im / of_part;
                    count += 1.0;
                }
            }
            if count < 1.0 {
                continue;
            }
            let excess_power = [sum.re, sum.im].map(|sum| sum * sum / information);
            for axis in [0, 1] {
                let excess = squares[axis] - excess_power[axis] - count;
                let significance = excess / (2.0 * count).sqrt();
                // Many parts raise the chance of a false detection.
                if significance > least + if scale > 8 { 1.0 } else { 0.0 } {
                    scatter.variance[axis] = scatter.variance[axis].max(excess / information);
                }
                if significance > scatter.significance {
                    (scatter.significance, scatter.scale) = (significance, scale);
                }
            }
        }
        scatter
    }
}

/// Chi-square (two degrees of freedom) of a certain jump: noise reaches it at fewer than one of a hundred million
/// instants.
const JUMP_CHI2: f64 = 40.0;

/// Smallest fraction of the change of a gain that a jump explains.
const EXPLAINED_FRACTION: f64 = 0.6;

/// Smallest fraction of the jump that happens within [`JUMP_PARTS`] parts.
const SUDDEN_FRACTION: f64 = 0.7;

/// Number of parts on either side of a jump within which it must show.
const JUMP_PARTS: usize = 3;

/// Chi-square of the largest jump between two parts, if the change is a jump.
fn largest_jump(series: &Series) -> Option<f64> {
    let all = total(series);
    let own = |parts: &[(Complex64, f64)]| -> f64 {
        let squares = parts.iter().filter(|(_, information)| *information > 0.0);
        squares.map(|(score, information)| score.norm_sqr() / information - 2.0).sum()
    };
    let changes = own(series) - all.0.norm_sqr() / all.1;
    let chi_square = |at: usize| jump_between(&series[..at], &series[at..]).map_or(0.0, |jump| jump.1);
    let at = (1..PARTS).max_by(|a, b| chi_square(*a).total_cmp(&chi_square(*b)))?;
    let (jump, found) = jump_between(&series[..at], &series[at..])?;
    if found < JUMP_CHI2 || found < EXPLAINED_FRACTION * changes {
        return None;
    }
    // The jump may be within the part on either side.
    let near = (at.saturating_sub(1)..=(at + 1).min(PARTS)).filter_map(|at| {
        let (before, after) =
            (&series[at.saturating_sub(JUMP_PARTS)..at], &series[at..(at + JUMP_PARTS).min(PARTS)]);
        let (near, chi_square) = jump_between(before, after)?;
        let sigma = if chi_square > 0.0 { near.norm() / (0.5 * chi_square).sqrt() } else { f64::INFINITY };
        // Component along the jump.
        Some((near * jump.conj()).re / jump.norm() + sigma)
    });
    (near.fold(0.0, f64::max) > SUDDEN_FRACTION * jump.norm()).then_some(found)
}

/// Change of the mean between two groups of parts, and its chi-square.
fn jump_between(before: &[(Complex64, f64)], after: &[(Complex64, f64)]) -> Option<(Complex64, f64)> {
    let ((a, of_a), (b, of_b)) = (total(before), total(after));
    if of_a <= 0.0 || of_b <= 0.0 {
        return None;
    }
    let jump = b / of_b - a / of_a;
    Some((jump, jump.norm_sqr() / (of_a.recip() + of_b.recip())))
}

/// First and last instant of the data within an interval.
fn data_span_s(blocks: &[ModelledBlock], [from_s, until_s]: [f64; 2]) -> [f64; 2] {
    let times = blocks.iter().flat_map(|block| &block.time_s);
    let inside = times.filter(|time_s| (from_s..until_s).contains(*time_s));
    let span_s = inside.fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], t| [a.min(*t), b.max(*t)]);
    // A single instant counts as a short interval.
    [span_s[0], span_s[1].max(span_s[0] + 1e-6)]
}

/// Calls `each` with the time, score and information of each visibility of a block.
fn for_each_score(
    layout: &ParameterLayout,
    values: &ParameterValues,
    (block, variance_factor): (&ModelledBlock, f64),
    ([from_s, until_s], cut): ([f64; 2], Option<f64>),
    mut each: impl FnMut(f64, Complex64, f64),
) {
    let (gain, u) = layout.pair(values, block.channel, block.pair);
    for k in (0..block.time_s.len()).filter(|&k| (from_s..until_s).contains(&block.time_s[k])) {
        let model: Complex64 = block.model[k].iter().zip(&u).map(|(term, factor)| term * factor).sum();
        let (predicted, weight) = (gain * model, block.weight[k] / variance_factor);
        let residual = block.value_k_sr[k] - predicted;
        let size = residual.norm() * weight.sqrt();
        if !size.is_finite() || (cut.is_none() && block.is_out[k]) {
            continue;
        }
        let kept = cut.filter(|cut| size > *cut).map_or(1.0, |cut| cut / size);
        each(block.time_s[k], weight * kept * predicted.conj() * residual, weight * predicted.norm_sqr());
    }
}

/// Instant at which a gain jumps, from all visibilities of the daughter in the channels: half-way between the last
/// one before the jump and the first one after it.
pub(super) fn jump_s(
    layout: &ParameterLayout,
    values: &ParameterValues,
    blocks: &[ModelledBlock],
    (variance_factors, is_pair_used): (&[f64], &[bool]),
    span_s: [f64; 2],
    (cut, daughter, channels): (f64, usize, &[usize]),
) -> Option<f64> {
    let mut seen: Vec<(f64, usize, Complex64, f64)> = Vec::new();
    for ((block, variance_factor), is_pair_used) in blocks.iter().zip(variance_factors).zip(is_pair_used) {
        let daughters = [block.pair.i, block.pair.j].map(usize::from);
        let Some(place) = channels.iter().position(|c| *c == block.channel) else { continue };
        if *is_pair_used && daughters.contains(&daughter) {
            for_each_score(
                layout,
                values,
                (block, *variance_factor),
                (span_s, Some(cut)),
                |time_s, score, information| {
                    let score = if daughters[0] == daughter { score } else { score.conj() };
                    seen.push((time_s, place, score, information));
                },
            );
        }
    }
    seen.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut before = vec![(Complex64::ZERO, 0.0); channels.len()];
    let mut after = before.clone();
    for (_, place, score, information) in &seen {
        after[*place] = (after[*place].0 + score, after[*place].1 + information);
    }
    let mut best = (0.0, None);
    for k in 1..seen.len() {
        let (last_s, place, score, information) = seen[k - 1];
        before[place] = (before[place].0 + score, before[place].1 + information);
        after[place] = (after[place].0 - score, after[place].1 - information);
        if seen[k].0 > last_s {
            let both = before.iter().zip(&after);
            let chi_square: f64 =
                both.filter_map(|(a, b)| jump_between(&[*a], &[*b])).map(|(_, chi_square)| chi_square).sum();
            if chi_square > best.0 {
                best = (chi_square, Some(0.5 * (last_s + seen[k].0)));
            }
        }
    }
    best.1
}
