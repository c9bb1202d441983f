//! What residuals show beyond noise: gains that change within the interval, and a model that is wrong.
//!
//! The residuals of a pair in a channel, projected on what the solution predicts, are summed over parts of the interval: `score`, whose
//! variance is the `information` of the part. A gain of daughter n that is off by a factor `1 + d` during a part adds `information * d`
//! to all of its pairs, so that the sum over them says how the gain changes; the rest comes from the model, not from gains.

use num_complex::Complex64;

use super::layout::{ParameterLayout, Values};
use super::sums::ModelledBlock;

/// Parts of an interval.
const PARTS: usize = 32;

/// Parts that are taken together, from the slowest change to the fastest.
const SCALES: [usize; 5] = [2, 4, 8, 16, 32];

/// Parts in which errors of the model are sought.
const MODEL_SCALES: [usize; 2] = [1, 4];

/// Standard deviations of noise beyond which scatter counts.
const SIGNIFICANT: f64 = 4.0;

/// The same of a gain that has jumped in the pass: what jumps may drift as well.
const SUSPECT: f64 = 1.5;

/// Sums of one pair in one channel by part.
#[derive(Clone)]
struct PairResiduals {
    channel: usize,
    /// Both daughters.
    of: [usize; 2],
    score: [Complex64; PARTS],
    information: [f64; PARTS],
}

/// Sums by pair, channel and part.
pub(super) struct Residuals {
    satellites: usize,
    channels: usize,
    pairs: Vec<PairResiduals>,
}

/// What a gain lacks of being known as well as noise alone allows. Variances of its logarithm, by amplitude and phase (rad).
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Excess {
    /// Of the change within the interval.
    pub(super) scatter: [f64; 2],
    /// Of either, by errors of the model that are seen to stay.
    pub(super) model: f64,
    /// The same by as much as may stay unseen in noise.
    pub(super) model_unseen: f64,
    /// Of either, by a model whose errors have the power of the signal.
    pub(super) model_whole: f64,
}

/// Part of the visibilities of an instant that are outliers when something else is wrong than a gain.
const BURST: f64 = 0.4;

/// Score and information of a daughter's gain in each part.
type Series = [(Complex64, f64); PARTS];

impl Residuals {
    /// Of blocks that take part, without outliers. With a `cut` outliers are kept, with residuals cut at so many standard deviations, as
    /// what is off after a jump may be one; but not where most visibilities of an instant are.
    pub(super) fn of(
        layout: &ParameterLayout,
        values: &Values,
        blocks: &[ModelledBlock],
        (spreads, takes_part): (&[f64], &[bool]),
        span_s: [f64; 2],
        cut: Option<f64>,
    ) -> Self {
        let [from_s, until_s] = data_span_s(blocks, span_s);
        let step_s = (until_s - from_s) / PARTS as f64;
        let part = |time_s: f64| (((time_s - from_s) / step_s) as usize).min(PARTS - 1);
        let chosen = blocks.iter().zip(spreads).zip(takes_part).filter(|(_, takes_part)| **takes_part);
        let mut outliers = [[0_u64; 2]; PARTS];
        for ((block, _), _) in chosen.clone() {
            for (time_s, is_out) in block.time_s.iter().zip(&block.is_out) {
                if (span_s[0]..span_s[1]).contains(time_s) {
                    let [out, all] = &mut outliers[part(*time_s)];
                    (*out, *all) = (*out + u64::from(*is_out), *all + 1);
                }
            }
        }
        let is_hit = outliers.map(|[out, all]| out as f64 > BURST * all as f64);
        let pairs = chosen.map(|((block, spread), _)| {
            let mut sums = PairResiduals {
                channel: block.channel,
                of: [block.pair.i, block.pair.j].map(usize::from),
                score: [Complex64::ZERO; PARTS],
                information: [0.0; PARTS],
            };
            for_each_score(layout, values, (block, *spread), (span_s, cut), |time_s, score, information| {
                if cut.is_none() || !is_hit[part(time_s)] {
                    sums.score[part(time_s)] += score;
                    sums.information[part(time_s)] += information;
                }
            });
            sums
        });
        Self { satellites: layout.satellites, channels: layout.channels(), pairs: pairs.collect() }
    }

    fn series(&self, channel: usize, daughter: usize) -> Series {
        let mut series = [(Complex64::ZERO, 0.0); PARTS];
        for pair in self.pairs.iter().filter(|pair| pair.channel == channel && pair.of.contains(&daughter)) {
            for (part, (score, information)) in series.iter_mut().enumerate() {
                let own = pair.score[part];
                *score += if pair.of[0] == daughter { own } else { own.conj() };
                *information += pair.information[part];
            }
        }
        series
    }

    /// Takes the change of a daughter's gain off its pairs, at parts of a scale.
    fn take(&mut self, channel: usize, daughter: usize, series: &Series, scale: usize) {
        let together = PARTS / scale;
        let change: Vec<Complex64> = series.chunks(together).map(mean).collect();
        let of = |pair: &&mut PairResiduals| pair.channel == channel && pair.of.contains(&daughter);
        for pair in self.pairs.iter_mut().filter(of) {
            for part in 0..PARTS {
                let change = change[part / together];
                let change = if pair.of[0] == daughter { change } else { change.conj() };
                pair.score[part] -= pair.information[part] * change;
            }
        }
    }

    /// Daughters and channels whose gains change, the worst of a channel first; each is taken off before the next is judged.
    fn take_changes(&mut self, suspects: &[bool]) -> Vec<(usize, usize, Scatter)> {
        let mut found = Vec::new();
        for channel in 0..self.channels {
            let mut open: Vec<usize> = (0..self.satellites).collect();
            while let Some((at, scatter)) = self.worst(channel, &open, suspects) {
                let daughter = open.remove(at);
                let series = self.series(channel, daughter);
                self.take(channel, daughter, &series, scatter.scale);
                found.push((channel, daughter, scatter));
            }
        }
        found
    }

    /// The one of `open` whose gain changes most, if more than by noise.
    fn worst(&self, channel: usize, open: &[usize], suspects: &[bool]) -> Option<(usize, Scatter)> {
        let scatter = |(at, n): (usize, &usize)| {
            let least = if suspects[channel * self.satellites + n] { SUSPECT } else { SIGNIFICANT };
            (at, Scatter::of(&self.series(channel, *n), least))
        };
        let each = open.iter().enumerate().map(scatter).filter(|(_, scatter)| scatter.is_seen());
        each.max_by(|(_, a), (_, b)| a.significance.total_cmp(&b.significance))
    }

    /// Excess of all gains, by channel, then daughter, over what noise alone leaves; and of each channel the part of the signal that
    /// errors of the model are, 0 where that may be noise.
    pub(super) fn excess(mut self, suspects: &[bool]) -> (Vec<Excess>, Vec<f64>) {
        let mut excess = vec![Excess::default(); self.satellites * self.channels];
        for (channel, daughter, scatter) in self.take_changes(suspects) {
            excess[channel * self.satellites + daughter].scatter = scatter.variance;
        }
        let mut parts = vec![0.0; self.channels];
        for (channel, part) in parts.iter_mut().enumerate() {
            let of_all = self.model_part(channel, None);
            *part = of_all;
            for daughter in 0..self.satellites {
                let most = of_all.max(self.model_part(channel, Some(daughter)));
                let own = self.pairs.iter().filter(|p| p.channel == channel && p.of.contains(&daughter));
                let (sum, square) = own.fold((0.0, 0.0), |(sum, square), pair| {
                    let information: f64 = pair.information.iter().sum();
                    (sum + information, square + information * information)
                });
                // Of either part; an error of the model stays for the pass and is another one for each pair.
                let share = if sum > 0.0 { square / (sum * sum) } else { 0.0 };
                let excess = &mut excess[channel * self.satellites + daughter];
                excess.model = 0.5 * most * share;
                excess.model_unseen = 0.5 * self.model_parts(channel, Some(daughter))[1] * share;
                excess.model_whole = 0.5 * share;
            }
        }
        (excess, parts)
    }

    /// Part of the signal, of all or of one daughter's pairs, that is left beyond noise; 0 where it may be noise.
    fn model_part(&self, channel: usize, daughter: Option<usize>) -> f64 {
        self.model_parts(channel, daughter)[0]
    }

    /// [`Self::model_part`], and as much as noise may hide.
    fn model_parts(&self, channel: usize, daughter: Option<usize>) -> [f64; 2] {
        let own: Vec<&PairResiduals> = self.pairs.iter().filter(|pair| pair.channel == channel).collect();
        let mut present = vec![false; self.satellites];
        own.iter().flat_map(|pair| pair.of).for_each(|n| present[n] = true);
        let gains = present.iter().filter(|one| **one).count() as f64;
        let part = |scale: usize| {
            let (mut square, mut count, mut information, mut all) = (0.0, 0.0, 0.0, 0.0);
            for pair in &own {
                let counts = daughter.is_none_or(|n| pair.of.contains(&n));
                for (score, of_part) in pair.grouped(scale).filter(|(_, of_part)| *of_part > 0.0) {
                    all += 2.0;
                    if counts {
                        square += score.norm_sqr() / of_part;
                        information += of_part;
                        count += 2.0;
                    }
                }
            }
            // Gains are solved for: residuals of noise have less than its variance.
            let freedom: f64 = (1.0 - (2.0 * gains - 1.0) / f64::max(all, 1.0)).max(0.0);
            let beyond = square - count * freedom;
            let noise = SIGNIFICANT * (2.0 * count).sqrt();
            if information > 0.0 {
                [
                    if beyond > noise { beyond / information } else { 0.0 },
                    (beyond + noise).max(0.0) / information,
                ]
            } else {
                [0.0; 2]
            }
        };
        let parts = MODEL_SCALES.map(part);
        [0, 1].map(|k| parts.iter().map(|part| part[k]).fold(0.0, f64::max))
    }

    /// The daughter, with the channels, whose gain jumps rather than drifts; the one with the largest jump. Those of `drifting` do not
    /// jump, by channel, then daughter.
    pub(super) fn jumping(&mut self, drifting: &[bool]) -> Option<(usize, Vec<usize>)> {
        let mut found: Vec<(usize, usize, f64)> = Vec::new();
        let suspects = vec![false; drifting.len()];
        for channel in 0..self.channels {
            let mut open: Vec<usize> = (0..self.satellites).collect();
            while let Some((at, scatter)) = self.worst(channel, &open, &suspects) {
                let daughter = open.remove(at);
                let series = self.series(channel, daughter);
                let jump = largest_jump(&series).filter(|_| !drifting[channel * self.satellites + daughter]);
                if let Some(jump) = jump {
                    found.push((daughter, channel, jump));
                    break;
                }
                self.take(channel, daughter, &series, scatter.scale);
            }
        }
        let (daughter, ..) = *found.iter().max_by(|a, b| a.2.total_cmp(&b.2))?;
        Some((daughter, found.iter().filter(|one| one.0 == daughter).map(|one| one.1).collect()))
    }
}

impl PairResiduals {
    fn grouped(&self, scale: usize) -> impl Iterator<Item = (Complex64, f64)> + '_ {
        let together = PARTS / scale;
        let scores = self.score.chunks(together).map(|scores| scores.iter().sum());
        scores.zip(self.information.chunks(together).map(|information| information.iter().sum()))
    }
}

fn mean(parts: &[(Complex64, f64)]) -> Complex64 {
    let (score, information) = total(parts);
    if information > 0.0 { score / information } else { Complex64::ZERO }
}

fn total(parts: &[(Complex64, f64)]) -> (Complex64, f64) {
    parts.iter().fold((Complex64::ZERO, 0.0), |(a, b), (score, information)| (a + score, b + information))
}

/// How much a gain changes within an interval.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Scatter {
    /// Standard deviations of what noise does.
    pub(super) significance: f64,
    /// Parts at which it is most significant.
    scale: usize,
    /// Variance of the change beyond noise, of amplitude and phase.
    pub(super) variance: [f64; 2],
}

impl Scatter {
    fn is_seen(&self) -> bool {
        self.variance.iter().any(|variance| *variance > 0.0)
    }

    /// Of changes beyond `least` standard deviations of noise.
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
            let beyond = [sum.re, sum.im].map(|sum| sum * sum / information);
            for axis in [0, 1] {
                let excess = squares[axis] - beyond[axis] - count;
                let significance = excess / (2.0 * count).sqrt();
                // The more parts there are, the more of the change may be none.
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

/// Chi-square (two degrees of freedom) of a jump that is sure: noise has it at none of a hundred million instants.
const JUMP: f64 = 40.0;

/// Part of the change of a gain that a jump has to explain, and part of the jump that has to happen at once.
const EXPLAINED: f64 = 0.6;
const AT_ONCE: f64 = 0.7;

/// Parts on either side of a jump at which it has to show.
const NEAR: usize = 3;

/// Chi-square of the largest jump between two parts, if the change is one.
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
    if found < JUMP || found < EXPLAINED * changes {
        return None;
    }
    // The jump may be within a part on either side.
    let near = (at.saturating_sub(1)..=(at + 1).min(PARTS)).filter_map(|at| {
        let (before, after) = (&series[at.saturating_sub(NEAR)..at], &series[at..(at + NEAR).min(PARTS)]);
        let (near, chi_square) = jump_between(before, after)?;
        let sigma = if chi_square > 0.0 { near.norm() / (0.5 * chi_square).sqrt() } else { f64::INFINITY };
        // Along the jump.
        Some((near * jump.conj()).re / jump.norm() + sigma)
    });
    (near.fold(0.0, f64::max) > AT_ONCE * jump.norm()).then_some(found)
}

/// The change of the mean from parts to others, and its chi-square.
fn jump_between(before: &[(Complex64, f64)], after: &[(Complex64, f64)]) -> Option<(Complex64, f64)> {
    let ((a, of_a), (b, of_b)) = (total(before), total(after));
    if of_a <= 0.0 || of_b <= 0.0 {
        return None;
    }
    let jump = b / of_b - a / of_a;
    Some((jump, jump.norm_sqr() / (of_a.recip() + of_b.recip())))
}

/// First and last instant of data within an interval.
fn data_span_s(blocks: &[ModelledBlock], [from_s, until_s]: [f64; 2]) -> [f64; 2] {
    let times = blocks.iter().flat_map(|block| &block.time_s);
    let inside = times.filter(|time_s| (from_s..until_s).contains(*time_s));
    let span_s = inside.fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], t| [a.min(*t), b.max(*t)]);
    // One instant is an interval, too.
    [span_s[0], span_s[1].max(span_s[0] + 1e-6)]
}

/// Calls `each` with time, score and information of each visibility of a block.
fn for_each_score(
    layout: &ParameterLayout,
    values: &Values,
    (block, spread): (&ModelledBlock, f64),
    ([from_s, until_s], cut): ([f64; 2], Option<f64>),
    mut each: impl FnMut(f64, Complex64, f64),
) {
    let (gain, u) = layout.pair(values, block.channel, block.pair);
    for k in (0..block.time_s.len()).filter(|&k| (from_s..until_s).contains(&block.time_s[k])) {
        let model: Complex64 = block.model[k].iter().zip(&u).map(|(term, factor)| term * factor).sum();
        let (predicted, weight) = (gain * model, block.weight[k] / spread);
        let residual = block.value_k_sr[k] - predicted;
        let size = residual.norm() * weight.sqrt();
        if !size.is_finite() || (cut.is_none() && block.is_out[k]) {
            continue;
        }
        let kept = cut.filter(|cut| size > *cut).map_or(1.0, |cut| cut / size);
        each(block.time_s[k], weight * kept * predicted.conj() * residual, weight * predicted.norm_sqr());
    }
}

/// Instant at which a gain jumps, from every visibility of the daughter in the channels: half-way between the last before it and the
/// first after it.
pub(super) fn jump_s(
    layout: &ParameterLayout,
    values: &Values,
    blocks: &[ModelledBlock],
    (spreads, takes_part): (&[f64], &[bool]),
    span_s: [f64; 2],
    (cut, daughter, channels): (f64, usize, &[usize]),
) -> Option<f64> {
    let mut seen: Vec<(f64, usize, Complex64, f64)> = Vec::new();
    for ((block, spread), takes_part) in blocks.iter().zip(spreads).zip(takes_part) {
        let of = [block.pair.i, block.pair.j].map(usize::from);
        let Some(place) = channels.iter().position(|c| *c == block.channel) else { continue };
        if *takes_part && of.contains(&daughter) {
            for_each_score(
                layout,
                values,
                (block, *spread),
                (span_s, Some(cut)),
                |time_s, score, information| {
                    let score = if of[0] == daughter { score } else { score.conj() };
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
