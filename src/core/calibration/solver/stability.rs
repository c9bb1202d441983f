//! Excess of residuals over noise: gains that change within the interval, and errors of the model.
//!
//! The residuals of a pair in a channel, projected on the prediction of the solution, are summed over parts of the
//! interval: `score`, whose variance is the `information` of the part. If the gain of daughter n is off by a factor
//! `1 + d` during a part, `information * d` is added to all of its pairs, so that their sum shows the change of the
//! gain; the rest comes from the model, not from gains. A wrong model leaves residuals that look like changes of gains,
//! too: as many as its errors have in common by chance. So changes count against what no gains explain, not against
//! noise alone ([`Residuals::model_factors`]).

use num_complex::Complex64;

use super::layout::{ParameterLayout, ParameterValues};
use super::part_gains::{PairPart, fit_part};
use super::sums::ModelledBlock;
use crate::numerics::median;

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
    /// See [`Self::model_factors`]; by channel, then daughter.
    model_factors: Vec<ModelFactors>,
}

/// Mean square of what no gains explain, over noise, at each of [`SCALES`]; 1 where it may be noise.
type ModelFactors = [f64; SCALES.len()];

/// Significance, in standard deviations, from which residuals beyond all gains count as errors of the model.
const MODEL_SIGMAS: f64 = 3.0;

/// Variance of the logarithm of a gain beyond that due to noise.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Excess {
    /// Variance of the change within the interval, of log amplitude and phase (rad).
    pub(super) scatter: [f64; 2],
    /// Variance of a change of the phase that changes of most other daughters may hide.
    pub(super) hidden: f64,
    /// Variance due to errors of the model that are seen, of either: those that last, and those that look like changes.
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
        let mut residuals = Self {
            satellites: layout.satellites,
            channels: layout.channels(),
            pairs: pairs.collect(),
            model_factors: Vec::new(),
        };
        residuals.model_factors =
            (0..residuals.channels).flat_map(|channel| residuals.model_factors(channel)).collect();
        residuals
    }

    /// Mean square of what changes of all gains of a channel leave of each daughter's residuals, over noise.
    fn model_factors(&self, channel: usize) -> Vec<ModelFactors> {
        let own: Vec<&PairResiduals> = self.pairs.iter().filter(|pair| pair.channel == channel).collect();
        let all: Vec<usize> = (0..self.satellites).collect();
        let mut factors = vec![[1.0; SCALES.len()]; self.satellites];
        for (place, scale) in SCALES.into_iter().enumerate() {
            let mut sums = vec![(0.0, 0.0); self.satellites];
            for group in 0..scale {
                let parts: Vec<PairPart> = own.iter().map(|pair| pair.part(group, scale)).collect();
                for (pair, left) in own.iter().zip(fit_part(&parts, self.satellites, &all)) {
                    for n in pair.daughters {
                        sums[n].0 += left.chi_square;
                        sums[n].1 += left.degrees_of_freedom;
                    }
                }
            }
            for (factors, (chi_square, degrees)) in factors.iter_mut().zip(sums) {
                if chi_square > degrees + MODEL_SIGMAS * f64::sqrt(2.0 * degrees) && degrees > 0.5 {
                    factors[place] = chi_square / degrees;
                }
            }
        }
        factors
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

    /// Subtracts the changes of daughters' gains, in `scale` parts, from what the pairs of a channel were at first.
    fn subtract_changes(
        &mut self,
        at_first: &[PairResiduals],
        channel: usize,
        daughters: &[usize],
        scale: usize,
    ) {
        let parts_per_group = PARTS / scale;
        for group in 0..scale {
            let parts: Vec<PairPart> = at_first.iter().map(|pair| pair.part(group, scale)).collect();
            let left = fit_part(&parts, self.satellites, daughters);
            let pairs = self.pairs.iter_mut().filter(|pair| pair.channel == channel);
            for ((pair, at_first), left) in pairs.zip(at_first).zip(left) {
                for part in group * parts_per_group..(group + 1) * parts_per_group {
                    pair.score[part] =
                        at_first.score[part] - at_first.information[part] * (left.change - 1.0);
                }
            }
        }
    }

    fn pairs_of(&self, channel: usize) -> Vec<PairResiduals> {
        self.pairs.iter().filter(|pair| pair.channel == channel).cloned().collect()
    }

    /// Finds the gains of a channel that change, the worst first, and subtracts their changes before the next is found;
    /// returns them with the number of parts in which changes were fitted.
    fn find_changes(&mut self, channel: usize, suspects: &[bool]) -> (Vec<(usize, Scatter)>, usize) {
        let at_first = self.pairs_of(channel);
        let (mut found, mut open, mut scale) = (Vec::new(), (0..self.satellites).collect::<Vec<_>>(), 1);
        while let Some((at, scatter)) = self.most_variable(channel, &open, suspects) {
            scale = scale.max(scatter.scale);
            found.push((open.remove(at), scatter));
            let daughters: Vec<usize> = found.iter().map(|(daughter, _)| *daughter).collect();
            self.subtract_changes(&at_first, channel, &daughters, scale);
        }
        (found, scale)
    }

    /// The daughter of `open` whose gain changes most, if significantly.
    fn most_variable(&self, channel: usize, open: &[usize], suspects: &[bool]) -> Option<(usize, Scatter)> {
        let scatter = |(at, n): (usize, &usize)| {
            let least = if suspects[channel * self.satellites + n] { SUSPECT_SIGMAS } else { SIGMAS };
            let factors = &self.model_factors[channel * self.satellites + n];
            (at, Scatter::of(&self.series(channel, *n), least, factors))
        };
        let each = open.iter().enumerate().map(scatter).filter(|(_, scatter)| scatter.is_significant());
        each.max_by(|(_, a), (_, b)| a.significance.total_cmp(&b.significance))
    }

    /// Excess of all gains (by channel, then daughter), and the fraction of the signal of each channel that is due to
    /// errors of the model, 0 where that may be noise.
    pub(super) fn excess(mut self, suspects: &[bool]) -> (Vec<Excess>, Vec<f64>) {
        let mut excess = vec![Excess::default(); self.satellites * self.channels];
        let mut parts = vec![0.0; self.channels];
        for (channel, part) in parts.iter_mut().enumerate() {
            let (changing, scale) = self.find_changes(channel, suspects);
            let fitted = (changing.len(), scale);
            let hidden = hidden_variance(&changing, self.satellites);
            for (daughter, scatter) in changing {
                excess[channel * self.satellites + daughter].scatter = scatter.variance;
            }
            let of_all = self.model_error_fractions(channel, None, fitted)[0];
            *part = of_all;
            for daughter in 0..self.satellites {
                let of_daughter = self.model_error_fractions(channel, Some(daughter), fitted);
                let most = of_all.max(of_daughter[0]);
                // What is left of a steady gain may look like a change because of the model.
                let is_steady = excess[channel * self.satellites + daughter].scatter == [0.0; 2];
                let apparent = match is_steady {
                    true => {
                        Scatter::of(&self.series(channel, daughter), SIGMAS, &[1.0; SCALES.len()]).variance
                    }
                    false => [0.0; 2],
                };
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
                excess.model = 0.5 * most * share + apparent[0].max(apparent[1]);
                if excess.scatter[1] < hidden {
                    excess.hidden = hidden;
                }
                excess.model_below_noise = 0.5 * of_daughter[1] * share;
                excess.model_full_power = 0.5 * share;
            }
        }
        (excess, parts)
    }

    /// Fraction of the signal, of all pairs or of one daughter's, that remains beyond noise (0 where it may be noise),
    /// and as much as noise may hide. So many gains were `fitted`, in so many parts.
    fn model_error_fractions(
        &self,
        channel: usize,
        daughter: Option<usize>,
        (fitted, fitted_parts): (usize, usize),
    ) -> [f64; 2] {
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
            let changes = 2.0 * (fitted * (fitted_parts.min(scale) - 1)) as f64;
            let degrees_of_freedom: f64 = (1.0 - (2.0 * gains - 1.0 + changes) / f64::max(all, 1.0)).max(0.0);
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
            let at_first = self.pairs_of(channel);
            let (mut open, mut passed) = ((0..self.satellites).collect::<Vec<_>>(), Vec::new());
            let mut scale = 1;
            while let Some((at, scatter)) = self.most_variable(channel, &open, &suspects) {
                let daughter = open.remove(at);
                let k = channel * self.satellites + daughter;
                let jump = largest_jump(&self.series(channel, daughter), &self.model_factors[k]);
                if let Some(jump) = jump.filter(|_| !drifting[k]) {
                    found.push((daughter, channel, jump));
                    break;
                }
                passed.push(daughter);
                scale = scale.max(scatter.scale);
                self.subtract_changes(&at_first, channel, &passed, scale);
            }
        }
        let (daughter, ..) = *found.iter().max_by(|a, b| a.2.total_cmp(&b.2))?;
        Some((daughter, found.iter().filter(|one| one.0 == daughter).map(|one| one.1).collect()))
    }
}

impl PairResiduals {
    /// Sums of one of `scale` groups of parts.
    fn part(&self, group: usize, scale: usize) -> PairPart {
        let parts = group * PARTS / scale..(group + 1) * PARTS / scale;
        PairPart {
            daughters: self.daughters,
            score: self.score[parts.clone()].iter().sum(),
            information: self.information[parts].iter().sum(),
        }
    }

    fn grouped(&self, scale: usize) -> impl Iterator<Item = (Complex64, f64)> + '_ {
        let parts_per_group = PARTS / scale;
        let scores = self.score.chunks(parts_per_group).map(|scores| scores.iter().sum());
        scores.zip(self.information.chunks(parts_per_group).map(|information| information.iter().sum()))
    }
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

    /// Computes the scatter; changes count from a significance of `least` beyond noise times `factors`.
    fn of(series: &Series, least: f64, factors: &ModelFactors) -> Self {
        let mut scatter = Self { scale: PARTS, ..Self::default() };
        let (sum, information) = total(series);
        if information <= 0.0 {
            return scatter;
        }
        for (scale, factor) in SCALES.into_iter().zip(factors) {
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
                let excess = squares[axis] - excess_power[axis] - factor * count;
                let significance = excess / (factor * (2.0 * count).sqrt());
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

/// Part of the usual variance of changes that the gain of a daughter may have unseen, where most daughters change: a change
/// that all share is seen of none, and each is judged beside what blurs the others.
const HIDDEN_PART: f64 = 0.25;

/// Variance of a phase's change that may be hidden by changes of most other daughters.
fn hidden_variance(changing: &[(usize, Scatter)], satellites: usize) -> f64 {
    let variances = changing.iter().map(|(_, scatter)| scatter.variance[1]).collect();
    if 2 * changing.len() > satellites { HIDDEN_PART * median(variances).unwrap_or(0.0) } else { 0.0 }
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

/// Chi-square of the largest jump between two parts, if the change is a jump; over the largest of the `factors`.
fn largest_jump(series: &Series, factors: &ModelFactors) -> Option<f64> {
    let factor = factors.iter().copied().fold(1.0, f64::max);
    let all = total(series);
    let own = |parts: &[(Complex64, f64)]| -> f64 {
        let squares = parts.iter().filter(|(_, information)| *information > 0.0);
        squares.map(|(score, information)| score.norm_sqr() / information - 2.0).sum()
    };
    let changes = own(series) - all.0.norm_sqr() / all.1;
    let chi_square = |at: usize| jump_between(&series[..at], &series[at..]).map_or(0.0, |jump| jump.1);
    let at = (1..PARTS).max_by(|a, b| chi_square(*a).total_cmp(&chi_square(*b)))?;
    let (jump, found) = jump_between(&series[..at], &series[at..])?;
    if found < JUMP_CHI2 * factor || found < EXPLAINED_FRACTION * changes {
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
    (near.fold(0.0, f64::max) > SUDDEN_FRACTION * jump.norm()).then_some(found / factor)
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
