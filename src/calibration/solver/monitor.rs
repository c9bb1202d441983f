//! What happened to the instrument, told apart by its pattern over daughters, channels, pairs and time.
//!
//! | event | pattern |
//! |---|---|
//! | clock jump | phases of one daughter change in proportion to the frequency |
//! | phase step | phases of one daughter change otherwise |
//! | gain step | amplitudes of one daughter change |
//! | dead | a daughter delivers noise |
//! | drift | a gain changes within an interval, and not at once |
//! | wrong model | pairs have residuals that no gains explain |
//! | interference | outliers in one channel, of most pairs and most of the time |
//! | burst | outliers at one time, of most pairs and channels |
//!
//! Phases of all daughters against the reference that change alike are a change of the reference's.

use std::f64::consts::{PI, TAU};
use std::fmt;

use serde::Serialize;

use super::estimates::{GainEstimate, GainState};
use super::solution::PassSolution;

/// A change counts beyond this many times its standard deviation, and the usual change from pass to pass.
const JUMP_SIGMAS: f64 = 6.0;
/// Least change of a logarithmic amplitude, and of a phase (rad), that is told.
const CHANGE_MIN: f64 = 0.01;
/// Part of visibilities that are outliers in a channel or a time that is spoilt.
const SPOILT: f64 = 0.1;
/// Channels that tell a clock from phases.
const CHANNELS_MIN: usize = 3;
/// Mean squared residual of a fit that holds, in units of the variance.
const FIT: f64 = 9.0;

/// Something that happened.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
pub enum InstrumentEvent {
    /// A clock jumped.
    ClockJump {
        /// Pass after it, or in which it happened.
        pass: u64,
        /// Last time before it and first time after it, s since the epoch.
        between_s: [f64; 2],
        /// Daughter, from 1.
        daughter: u32,
        /// By this much, ns.
        change_ns: f64,
    },
    /// Phases changed.
    PhaseStep {
        /// Pass after it, or in which it happened.
        pass: u64,
        /// Last time before it and first time after it, s since the epoch.
        between_s: [f64; 2],
        /// Daughter, from 1.
        daughter: u32,
        /// Channels, from 0, and changes, deg.
        channels: Vec<(usize, f64)>,
    },
    /// Amplitudes changed.
    GainStep {
        /// Pass after it, or in which it happened.
        pass: u64,
        /// Last time before it and first time after it, s since the epoch.
        between_s: [f64; 2],
        /// Daughter, from 1.
        daughter: u32,
        /// Channels, from 0, and factors.
        channels: Vec<(usize, f64)>,
    },
    /// A daughter delivers noise from this pass on.
    Dead {
        /// First such pass.
        pass: u64,
        /// Daughter, from 1.
        daughter: u32,
        /// Channels, from 0.
        channels: Vec<usize>,
    },
    /// A phase changes within an interval, and not at once.
    Drift {
        /// Pass.
        pass: u64,
        /// Daughter, from 1.
        daughter: u32,
        /// Channels, from 0, and root mean square changes, deg.
        channels: Vec<(usize, f64)>,
    },
    /// The model is not that of the data: the sky's, or the artificial signal's.
    WrongModel {
        /// First such pass.
        pass: u64,
        /// Channel, from 0.
        channel: usize,
        /// Part of the signal that no gains explain.
        unexplained: f64,
    },
    /// A channel is disturbed.
    Interference {
        /// Pass.
        pass: u64,
        /// Channel, from 0.
        channel: usize,
        /// Part of its visibilities that are outliers.
        outliers: f64,
    },
    /// All channels are disturbed for a time.
    Burst {
        /// Pass.
        pass: u64,
        /// Start, s since the epoch.
        from_s: f64,
        /// End, s.
        until_s: f64,
    },
}

impl InstrumentEvent {
    /// The pass of it, or after it.
    #[must_use]
    pub fn pass(&self) -> u64 {
        match self {
            Self::ClockJump { pass, .. }
            | Self::PhaseStep { pass, .. }
            | Self::GainStep { pass, .. }
            | Self::Dead { pass, .. }
            | Self::Drift { pass, .. }
            | Self::WrongModel { pass, .. }
            | Self::Interference { pass, .. }
            | Self::Burst { pass, .. } => *pass,
        }
    }
}

impl fmt::Display for InstrumentEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let list = |channels: &[(usize, f64)], unit: &str| {
            let each =
                channels.iter().map(|(channel, value)| format!("{value:.4}{unit} in channel {channel}"));
            each.collect::<Vec<_>>().join(", ")
        };
        match self {
            Self::ClockJump { pass, daughter, change_ns, between_s } => {
                let when = when(between_s);
                write!(f, "pass {pass}: the clock of daughter {daughter} jumped by {change_ns:.3} ns{when}")
            }
            Self::PhaseStep { pass, daughter, channels, between_s } => {
                let (list, when) = (list(channels, " deg"), when(between_s));
                write!(f, "pass {pass}: phases of daughter {daughter} changed by {list}{when}")
            }
            Self::GainStep { pass, daughter, channels, between_s } => {
                let (factors, when) = (list(channels, ""), when(between_s));
                write!(
                    f,
                    "pass {pass}: amplitudes of daughter {daughter} changed by factors of {factors}{when}"
                )
            }
            Self::Dead { pass, daughter, channels } => {
                let channels: Vec<String> = channels.iter().map(usize::to_string).collect();
                write!(
                    f,
                    "pass {pass}: daughter {daughter} delivers noise in channels {}",
                    channels.join(", ")
                )
            }
            Self::Drift { pass, daughter, channels } => {
                let list = list(channels, " deg");
                write!(f, "pass {pass}: phases of daughter {daughter} drift within the pass by {list} rms")
            }
            Self::WrongModel { pass, channel, unexplained } => write!(
                f,
                "pass {pass}: the model is not that of the data in channel {channel}: no gains explain {:.1} % of the signal",
                100.0 * unexplained
            ),
            Self::Interference { pass, channel, outliers } => write!(
                f,
                "pass {pass}: interference in channel {channel}, {:.1} % of its visibilities are outliers",
                100.0 * outliers
            ),
            Self::Burst { pass, from_s, until_s } => {
                write!(f, "pass {pass}: a burst in all channels from {from_s:.1} s to {until_s:.1} s")
            }
        }
    }
}

/// When something happened within a pass.
fn when([from_s, until_s]: &[f64; 2]) -> String {
    if until_s - from_s > 1.0 { String::new() } else { format!(", at {:.1} s", 0.5 * (from_s + until_s)) }
}

/// Changes of a daughter from one solution to the next, by channel.
struct Change {
    /// Place of the later solution.
    at: usize,
    daughter: usize,
    /// Channel, change (rad), its standard deviation.
    phases: Vec<(usize, f64, f64)>,
    /// The same of logarithmic amplitudes.
    amplitudes: Vec<(usize, f64, f64)>,
}

/// Events in solutions that follow each other.
#[must_use]
pub fn instrument_events(solutions: &[PassSolution]) -> Vec<InstrumentEvent> {
    let mut changes = changes(solutions);
    widen(&mut changes, |change| &mut change.phases);
    widen(&mut changes, |change| &mut change.amplitudes);
    for (at, solution) in solutions.iter().enumerate().skip(1) {
        let mut of_pass: Vec<&mut Change> = changes.iter_mut().filter(|change| change.at == at).collect();
        find_reference(&mut of_pass, solution.reference as usize - 1);
    }
    let mut events = Vec::new();
    for (at, solution) in solutions.iter().enumerate() {
        let of_pass: Vec<&Change> = changes.iter().filter(|change| change.at == at).collect();
        let before = at.checked_sub(1).map(|before| &solutions[before]);
        daughters(&of_pass, before, solution, &mut events);
        states(before, solution, &mut events);
        disturbances(solution, &mut events);
    }
    events
}

fn changes(solutions: &[PassSolution]) -> Vec<Change> {
    let mut found = Vec::new();
    let spoilt: Vec<Vec<bool>> = solutions.iter().map(spoilt_channels).collect();
    let is_spoilt = |at: usize, channel: usize| spoilt[at].get(channel) == Some(&true);
    for (at, two) in solutions.windows(2).enumerate() {
        for (n, (before, after)) in two[0].daughters.iter().zip(&two[1].daughters).enumerate() {
            // What outliers leave of a disturbed channel is no gain to judge the daughter by; phases against another reference are others.
            let is_same = two[0].reference == two[1].reference;
            let known = |gain: &GainEstimate| is_same && gain.state == GainState::Good;
            let pairs = before.gains.iter().zip(&after.gains).enumerate();
            let pairs: Vec<_> = pairs
                .filter(|(c, (a, b))| known(a) && known(b) && !is_spoilt(at, *c) && !is_spoilt(at + 1, *c))
                .collect();
            let phase = |(c, (a, b)): &(usize, (&GainEstimate, &GainEstimate))| {
                let change = wrapped((b.phase_deg - a.phase_deg).to_radians());
                (*c, change, a.phase_sigma_deg.hypot(b.phase_sigma_deg).to_radians())
            };
            let amplitude = |(c, (a, b)): &(usize, (&GainEstimate, &GainEstimate))| {
                (*c, (b.amplitude / a.amplitude).ln(), a.amplitude_sigma.hypot(b.amplitude_sigma))
            };
            found.push(Change {
                at: at + 1,
                daughter: n,
                phases: pairs.iter().map(phase).collect(),
                amplitudes: pairs.iter().map(amplitude).collect(),
            });
        }
    }
    found
}

/// Widens standard deviations to what is usual from pass to pass for the daughter and channel.
fn widen(changes: &mut [Change], of: impl Fn(&mut Change) -> &mut Vec<(usize, f64, f64)>) {
    let mut sizes: std::collections::BTreeMap<(usize, usize), Vec<f64>> = Default::default();
    for change in &mut *changes {
        let daughter = change.daughter;
        for (channel, change, _) in of(change) {
            sizes.entry((daughter, *channel)).or_default().push(change.abs());
        }
    }
    for list in sizes.values_mut() {
        list.sort_unstable_by(f64::total_cmp);
    }
    for change in changes {
        let daughter = change.daughter;
        for (channel, _, sigma) in of(change) {
            let list = &sizes[&(daughter, *channel)];
            // Two values have no usual one.
            if list.len() >= 3 {
                *sigma = sigma.max(1.4826 * list[list.len() / 2]);
            }
        }
    }
}

fn wrapped(rad: f64) -> f64 {
    (rad + PI).rem_euclid(TAU) - PI
}

fn jumped((_, change, sigma): &&(usize, f64, f64)) -> bool {
    change.abs() > (JUMP_SIGMAS * sigma).max(CHANGE_MIN)
}

/// Part of a common change by which changes may differ, and standard deviations.
const ALIKE: f64 = 0.05;
const ALIKE_SIGMAS: f64 = 4.0;

/// Takes phases of most daughters that change alike, against the reference, for a change of the reference.
fn find_reference(changes: &mut [&mut Change], reference: usize) {
    let mut channels: Vec<usize> = changes.iter().flat_map(|one| one.phases.iter().map(|p| p.0)).collect();
    channels.sort_unstable();
    channels.dedup();
    for channel in channels {
        let phase = |one: &Change| one.phases.iter().find(|phase| phase.0 == channel).copied();
        let others: Vec<(usize, f64, f64)> =
            changes.iter().filter(|one| one.daughter != reference).filter_map(|one| phase(one)).collect();
        let is_alike = |one: &&(usize, f64, f64), about: &(usize, f64, f64)| {
            let most = (ALIKE * about.1.abs()).max(ALIKE_SIGMAS * one.2.hypot(about.2));
            wrapped(one.1 - about.1).abs() < most
        };
        let count = |about: &(usize, f64, f64)| others.iter().filter(|one| is_alike(one, about)).count();
        // Of the reference nothing is known but by all others.
        let of_reference = changes.iter_mut().filter(|one| one.daughter == reference);
        of_reference.for_each(|one| one.phases.retain(|phase| phase.0 != channel));
        let Some(most) = others.iter().filter(jumped).max_by_key(|jump| count(jump)) else { continue };
        let jumps = others.iter().filter(jumped).filter(|one| is_alike(one, most));
        let alike: Vec<(f64, f64)> = jumps.map(|jump| (wrapped(jump.1 - most.1), jump.2)).collect();
        // Two daughters alone cannot say which of them it was.
        if alike.len() < 2 || 2 * count(most) <= others.len() {
            continue;
        }
        let weight: f64 = alike.iter().map(|one| one.1.max(1e-6).powi(-2)).sum();
        let mean = alike.iter().map(|one| one.0 * one.1.max(1e-6).powi(-2)).sum::<f64>() / weight;
        let (change, sigma) = (most.1 + mean, weight.recip().sqrt());
        for one in &mut *changes {
            if one.daughter == reference {
                one.phases.push((channel, -wrapped(change), sigma));
                continue;
            }
            for phase in one.phases.iter_mut().filter(|phase| phase.0 == channel) {
                *phase = (channel, wrapped(phase.1 - change), phase.2.hypot(sigma));
            }
        }
    }
}

/// Events of daughters between a solution and the one before.
fn daughters(
    changes: &[&Change],
    before: Option<&PassSolution>,
    solution: &PassSolution,
    events: &mut Vec<InstrumentEvent>,
) {
    let pass = solution.pass;
    let between_s = [before.map_or(solution.from_s, |before| before.until_s), solution.from_s];
    for change in changes {
        let daughter = change.daughter as u32 + 1;
        let list = |list: &[(usize, f64, f64)], of: fn(f64) -> f64| -> Vec<(usize, f64)> {
            list.iter().filter(jumped).map(|(channel, change, _)| (*channel, of(*change))).collect()
        };
        let amplitudes = list(&change.amplitudes, f64::exp);
        if !amplitudes.is_empty() {
            events.push(InstrumentEvent::GainStep { pass, daughter, channels: amplitudes, between_s });
        }
        let phases = list(&change.phases, f64::to_degrees);
        if phases.is_empty() {
            continue;
        }
        events.push(match clock_ns(change, solution) {
            Some(change_ns) => InstrumentEvent::ClockJump { pass, daughter, change_ns, between_s },
            None => InstrumentEvent::PhaseStep { pass, daughter, channels: phases, between_s },
        });
    }
}

/// Least change of a phase within an interval, deg, least part of the variance of a phase that it is, and least part of the signal that a
/// model leaves, that are told.
const DRIFT_MIN_DEG: f64 = 4.0;
const DRIFT_PART: f64 = 0.92;
const MODEL_MIN: f64 = 0.01;

/// What solutions say of themselves, where the one before did not.
fn states(before: Option<&PassSolution>, solution: &PassSolution, events: &mut Vec<InstrumentEvent>) {
    let pass = solution.pass;
    let channels = solution.model_error.len();
    let spoilt = spoilt_channels(solution);
    let is_spoilt = |c: usize| spoilt.get(c) == Some(&true);
    for (n, daughter) in solution.daughters.iter().enumerate() {
        let number = daughter.daughter;
        let is_dead = |of: &PassSolution, c: usize| of.daughters[n].gains[c].state == GainState::Dead;
        let dead = (0..channels).filter(|c| is_dead(solution, *c));
        let dead: Vec<usize> = dead.filter(|c| before.is_none_or(|before| !is_dead(before, *c))).collect();
        if !dead.is_empty() {
            events.push(InstrumentEvent::Dead { pass, daughter: number, channels: dead });
        }
        // Where it is most of what is not known of the phase: noise alone seems to be as much as nine tenths of it.
        let drifts = |gain: &GainEstimate| {
            let known = gain.phase_sigma_deg.max(gain.phase_scatter_deg);
            gain.phase_scatter_deg > DRIFT_MIN_DEG && (gain.phase_scatter_deg / known).powi(2) > DRIFT_PART
        };
        let drifting = daughter.gains.iter().enumerate().filter(|(c, gain)| drifts(gain) && !is_spoilt(*c));
        let drifting: Vec<(usize, f64)> = drifting.map(|(c, gain)| (c, gain.phase_scatter_deg)).collect();
        if !drifting.is_empty() {
            events.push(InstrumentEvent::Drift { pass, daughter: number, channels: drifting });
        }
    }
    let part = |of: &PassSolution, c: usize| {
        // A good part of the daughters: one alone may have another trouble.
        let gains: Vec<&GainEstimate> = of.daughters.iter().map(|daughter| &daughter.gains[c]).collect();
        let known = |gain: &&&GainEstimate| !matches!(gain.state, GainState::NoData | GainState::Dead);
        let known = gains.iter().filter(known).count();
        let poor = gains.iter().filter(|gain| gain.state == GainState::PoorFit).count();
        let mut parts: Vec<f64> = gains.iter().map(|gain| gain.unexplained).collect();
        parts.sort_unstable_by(f64::total_cmp);
        let median = parts.get(parts.len() / 2).copied().unwrap_or(0.0);
        let is_foreign = known > 0 && 2 * poor > known;
        let part = of.model_error[c].max(median);
        (is_foreign || part > MODEL_MIN).then_some(part)
    };
    for channel in (0..channels).filter(|c| !is_spoilt(*c)) {
        let was = before.and_then(|before| part(before, channel)).is_some();
        if let Some(unexplained) = part(solution, channel).filter(|_| !was) {
            events.push(InstrumentEvent::WrongModel { pass, channel, unexplained });
        }
    }
}

/// The jump of a clock that explains changes of phases, ns; `None` if none does.
fn clock_ns(change: &Change, solution: &PassSolution) -> Option<f64> {
    let gains = &solution.daughters[change.daughter].gains;
    let hz = |channel: usize| gains[channel].frequency_hz;
    let highest = change.phases.iter().map(|(c, ..)| hz(*c)).fold(0.0, f64::max);
    let lowest = change.phases.iter().map(|(c, ..)| hz(*c)).fold(f64::INFINITY, f64::min);
    if change.phases.len() < CHANNELS_MIN || lowest <= 0.0 || highest < 1.1 * lowest {
        return None;
    }
    // Half a turn of the lowest frequency either way, in steps of a hundredth of a turn of the highest.
    let step_s = 0.01 / highest;
    let reach = (0.5 / lowest / step_s) as i64;
    let cost = |late_s: f64| -> f64 {
        let square = |(c, change, sigma): &(usize, f64, f64)| {
            (wrapped(change + TAU * hz(*c) * late_s) / sigma.max(1e-4)).powi(2)
        };
        change.phases.iter().map(square).sum::<f64>() / change.phases.len() as f64
    };
    let best = |from_s: f64, step_s: f64, reach: i64| {
        let candidates = (-reach..=reach).map(|k| from_s + step_s * k as f64);
        candidates.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(from_s)
    };
    let coarse_s = best(0.0, step_s, reach);
    let late_s = best(coarse_s, 0.01 * step_s, 100);
    (cost(late_s) < FIT).then_some(1e9 * late_s)
}

/// Whether most known values of a list are spoilt.
fn most(list: &[f64]) -> bool {
    let known: Vec<&f64> = list.iter().filter(|part| part.is_finite()).collect();
    known.iter().filter(|part| ***part > SPOILT).count() * 2 > known.len()
}

/// Whether each channel is disturbed most of the time.
fn spoilt_channels(solution: &PassSolution) -> Vec<bool> {
    solution.outlier_parts.by_channel_and_time.iter().map(|times| most(times)).collect()
}

/// Disturbances within a pass.
fn disturbances(solution: &PassSolution, events: &mut Vec<InstrumentEvent>) {
    let (pass, parts) = (solution.pass, &solution.outlier_parts);
    let channels = parts.by_channel_and_time.len();
    let spoilt = spoilt_channels(solution);
    for (channel, _) in spoilt.iter().enumerate().filter(|(_, spoilt)| **spoilt) {
        let times: Vec<f64> =
            parts.by_channel_and_time[channel].iter().copied().filter(|part| part.is_finite()).collect();
        let outliers = times.iter().sum::<f64>() / times.len() as f64;
        events.push(InstrumentEvent::Interference { pass, channel, outliers });
    }
    let bins = parts.by_channel_and_time.first().map_or(0, Vec::len);
    let is_hit = |bin: usize| {
        let column: Vec<f64> = (0..channels)
            .filter(|channel| !spoilt[*channel])
            .map(|channel| parts.by_channel_and_time[channel][bin])
            .collect();
        !column.is_empty() && most(&column)
    };
    let bin_s = (solution.until_s - solution.from_s) / bins.max(1) as f64;
    let mut begun = None;
    for bin in 0..=bins {
        match (begun, bin < bins && is_hit(bin)) {
            (None, true) => begun = Some(bin),
            (Some(first), false) => {
                let at = |bin: usize| solution.from_s + bin_s * bin as f64;
                events.push(InstrumentEvent::Burst { pass, from_s: at(first), until_s: at(bin) });
                begun = None;
            }
            _ => {}
        }
    }
}
