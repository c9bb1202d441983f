//! Whether a daughter delivers any of the known signal in a channel.
//!
//! With the gains of all others as they are, the data say by themselves what the gain of one daughter is, in amplitude and phase, without
//! prior: `above / below`, with the noise `1 / below` of either part. `|above|^2 / below` is the square of its signal-to-noise ratio;
//! noise alone exceeds x with a probability of exp(-x / 2). A daughter that is not seen has no part in the solution of the others.

use num_complex::Complex64;

use super::config::SolverConfig;
use super::layout::{ParameterLayout, Values};
use super::sums::{MODEL_TERMS, PairSums};

/// Square of the signal-to-noise ratio of a gain from which it is seen: noise alone has it in 4 of a million cases, and a phase is known to
/// 11.5 deg.
pub(super) const SEEN: f64 = 25.0;

/// By so much the square of the ratio of all pairs together has to be above it for each daughter beyond two: gains of all that are fitted to
/// noise reach some ten a daughter.
const SEEN_MORE: f64 = 10.0;

/// Square of the signal-to-noise ratio that a receiver that works has to have before one that is not seen is dead.
const TOLD: f64 = 100.0;

/// Standard deviations of its prior that the amplitude of a receiver that works is below one, at most.
const PRIOR_SIGMAS: f64 = 3.0;

/// Standard deviations of the power of noise.
const SIGNIFICANT: f64 = 3.0;

/// What the data say of a gain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SignalPresence {
    /// No data.
    None,
    /// The known signal is there.
    Seen,
    /// Too few data to tell.
    Weak,
    /// Noise, where a receiver that works would deliver signal.
    Dead,
    /// A signal that is not the known one.
    Other,
}

/// The gain of a daughter in a channel, from its own data and the gains of the others.
#[derive(Clone, Copy, Debug)]
pub(super) struct OwnGain {
    pub(super) gain: Complex64,
    /// Inverse variance of either part.
    pub(super) information: f64,
    /// The same if the gains of the others were one.
    ideal: f64,
    /// The same with all daughters, whether they take part or not, and noise alone.
    of_all: f64,
    pub(super) presence: SignalPresence,
}

impl OwnGain {
    /// What one is that is not seen, by what a receiver that works would deliver.
    fn unseen(&self, config: &SolverConfig) -> SignalPresence {
        if self.is_visible(config) { SignalPresence::Other } else { SignalPresence::Weak }
    }

    /// Least square of the signal-to-noise ratio of a receiver that works.
    pub(super) fn expected(&self, config: &SolverConfig) -> f64 {
        let least = (-PRIOR_SIGMAS * config.amplitude_sigma).exp().max(config.dead_amplitude);
        self.ideal * least * least
    }

    /// Whether a receiver that works would be seen, if all others do.
    pub(super) fn is_visible(&self, config: &SolverConfig) -> bool {
        Self { ideal: self.of_all, ..*self }.expected(config) >= TOLD
    }

    /// Square of the signal-to-noise ratio.
    pub(super) fn signal(&self) -> f64 {
        self.gain.norm_sqr() * self.information
    }
}

/// By channel, then daughter: which have no part in the solution.
pub(super) type DroppedDaughters = Vec<bool>;

/// Whether a pair takes part.
pub(super) fn takes_part(layout: &ParameterLayout, dropped: &[bool], sums: &PairSums) -> bool {
    let [i, j] = [sums.pair.i, sums.pair.j].map(usize::from);
    let at = sums.channel * layout.satellites;
    !dropped[at + i] && !dropped[at + j]
}

/// The gains of all daughters, by channel, then daughter, each from its pairs with daughters that take part.
pub(super) fn own_gains(
    config: &SolverConfig,
    layout: &ParameterLayout,
    values: &Values,
    sums: &[PairSums],
    dropped: &[bool],
) -> Vec<OwnGain> {
    let n = layout.satellites;
    let mut found = vec![Sums::default(); n * layout.channels()];
    // Where nobody takes part all do.
    let mut left_out = dropped.to_vec();
    for channel in left_out.chunks_mut(n.max(1)).filter(|channel| channel.iter().all(|dropped| *dropped)) {
        channel.fill(false);
    }
    let dropped = &left_out[..];
    for sums in sums {
        let [i, j] = [sums.pair.i, sums.pair.j].map(usize::from);
        let at = sums.channel * n;
        let (_, u) = layout.pair(values, sums.channel, sums.pair);
        let gram = sums.gram_of(&u);
        let along: Complex64 = (0..MODEL_TERMS).map(|k| u[k] * sums.cross[k]).sum();
        let model: f64 = (0..MODEL_TERMS).map(|k| u[k] * gram[k].re).sum();
        for (own, other, along) in [(i, j, along), (j, i, along.conj())] {
            found[at + own].has_data |= sums.count > 0.0;
            found[at + own].of_all += model * sums.spread;
            if !dropped[at + other] {
                let gain = layout.gain(values, sums.channel, other);
                found[at + own].add(along * gain, [model * gain.norm_sqr(), model], sums);
            }
        }
    }
    let mut own: Vec<OwnGain> = found.into_iter().map(|sums| sums.gain(config)).collect();
    for (c, channel) in own.chunks_mut(n.max(1)).enumerate() {
        // Gains of all that are fitted to noise agree with it.
        let part = channel.iter().enumerate().filter(|(n_own, _)| !dropped[c * n + n_own]);
        let part = part.filter(|(_, own)| own.presence != SignalPresence::None).count();
        let least = SEEN + SEEN_MORE * part.saturating_sub(2) as f64;
        if signal_of(layout, values, sums, dropped, c) < least {
            let seen = channel.iter_mut().filter(|own| own.presence == SignalPresence::Seen);
            seen.for_each(|own| own.presence = own.unseen(config));
        }
        // Where nobody is seen it is not the daughters.
        if channel.iter().all(|own| own.presence != SignalPresence::Seen) {
            let dead = channel.iter_mut().filter(|own| own.presence == SignalPresence::Dead);
            dead.for_each(|own| own.presence = SignalPresence::Other);
        }
    }
    own
}

/// Square of the signal-to-noise ratio of all pairs of a channel together, with the gains of all.
fn signal_of(
    layout: &ParameterLayout,
    values: &Values,
    sums: &[PairSums],
    dropped: &[bool],
    channel: usize,
) -> f64 {
    let of_channel = sums.iter().filter(|sums| sums.channel == channel);
    let (mut along, mut model) = (0.0, 0.0);
    for sums in of_channel.filter(|sums| takes_part(layout, dropped, sums)) {
        let (gain, u) = layout.pair(values, channel, sums.pair);
        let gram = sums.gram_of(&u);
        along += (0..MODEL_TERMS).map(|k| (gain.conj() * u[k] * sums.cross[k]).re).sum::<f64>();
        model += gain.norm_sqr() * (0..MODEL_TERMS).map(|k| u[k] * gram[k].re).sum::<f64>();
    }
    if model > 0.0 && along > 0.0 { along * along / model } else { 0.0 }
}

#[derive(Clone, Copy, Default)]
struct Sums {
    above: Complex64,
    below: f64,
    ideal: f64,
    power: f64,
    count: f64,
    has_data: bool,
    of_all: f64,
}

impl Sums {
    fn add(&mut self, above: Complex64, [below, ideal]: [f64; 2], sums: &PairSums) {
        self.above += above;
        self.below += below;
        self.ideal += ideal;
        self.power += sums.power;
        self.count += sums.count;
    }

    fn gain(self, config: &SolverConfig) -> OwnGain {
        let Self { above, below, ideal, power, count, has_data, of_all } = self;
        if below <= 0.0 || count == 0.0 {
            let presence = if has_data { SignalPresence::Weak } else { SignalPresence::None };
            return OwnGain { gain: Complex64::ONE, information: 0.0, ideal: 0.0, of_all, presence };
        }
        let gain = above / below;
        let own = OwnGain { gain, information: below, ideal, of_all, presence: SignalPresence::Weak };
        let expected = own.expected(config);
        // Of |V|^2 in units of its noise, beyond that of noise.
        let beyond = power - 2.0 * count;
        let presence = match () {
            () if own.signal() >= SEEN && gain.norm() >= config.dead_amplitude => SignalPresence::Seen,
            () if own.signal() >= SEEN => SignalPresence::Dead,
            () if expected < TOLD => own.unseen(config),
            () if beyond > 0.5 * expected + SIGNIFICANT * 2.0 * count.sqrt() => SignalPresence::Other,
            () => SignalPresence::Dead,
        };
        OwnGain { presence, ..own }
    }
}

/// Which daughters have no part in a solution: all that are not seen, but those that others of their channels tell of.
pub(super) fn dropped(layout: &ParameterLayout, own: &[OwnGain]) -> DroppedDaughters {
    // A clock or a position is found from all channels together.
    let is_joint = layout.channels() > 1 && layout.clock_sigma_ns > 0.0 || layout.terms() > 1;
    own.iter()
        .map(|own| match own.presence {
            SignalPresence::Seen | SignalPresence::None => false,
            SignalPresence::Weak => !is_joint,
            // With positions that are not known yet little of the signal is seen.
            SignalPresence::Other => layout.terms() == 1,
            SignalPresence::Dead => true,
        })
        .collect()
}

/// The daughter that phases are relative to: the one of the settings, unless another is seen in more channels.
pub(super) fn reference(layout: &ParameterLayout, own: &[OwnGain], wanted: usize) -> usize {
    let n = layout.satellites;
    let seen = |daughter: usize| {
        (0..layout.channels()).filter(|c| own[c * n + daughter].presence == SignalPresence::Seen).count()
    };
    let best = (0..n).map(seen).max().unwrap_or(0);
    if seen(wanted) == best {
        wanted
    } else {
        (0..n).find(|daughter| seen(*daughter) == best).unwrap_or(wanted)
    }
}
