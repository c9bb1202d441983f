//! What happened to the instrument, told apart by its pattern over daughters, channels, pairs and time.
//!
//! | event | pattern |
//! |---|---|
//! | clock jump | phases of one daughter change in proportion to the frequency; of all daughters alike: the reference's clock |
//! | phase step | phases of one daughter change otherwise |
//! | gain step | amplitudes of one daughter change |
//! | interference | outliers in one channel, of most pairs and most of the time |
//! | burst | outliers at one time, of most pairs and channels |

use std::f64::consts::{PI, TAU};
use std::fmt;

use serde::Serialize;

use super::solution::{GainEstimate, GainState, PassSolution};

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
        /// Pass after it.
        pass: u64,
        /// Daughter, from 1.
        daughter: u32,
        /// By this much, ns.
        change_ns: f64,
    },
    /// Phases changed.
    PhaseStep {
        /// Pass after it.
        pass: u64,
        /// Daughter, from 1.
        daughter: u32,
        /// Channels, from 0, and changes, deg.
        channels: Vec<(usize, f64)>,
    },
    /// Amplitudes changed.
    GainStep {
        /// Pass after it.
        pass: u64,
        /// Daughter, from 1.
        daughter: u32,
        /// Channels, from 0, and factors.
        channels: Vec<(usize, f64)>,
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
            Self::ClockJump { pass, daughter, change_ns } => {
                write!(f, "pass {pass}: the clock of daughter {daughter} jumped by {change_ns:.3} ns")
            }
            Self::PhaseStep { pass, daughter, channels } => {
                write!(f, "pass {pass}: phases of daughter {daughter} changed by {}", list(channels, " deg"))
            }
            Self::GainStep { pass, daughter, channels } => {
                let factors = list(channels, "");
                write!(f, "pass {pass}: amplitudes of daughter {daughter} changed by factors of {factors}")
            }
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
    let mut events = Vec::new();
    for (at, solution) in solutions.iter().enumerate() {
        let of_pass: Vec<&Change> = changes.iter().filter(|change| change.at == at).collect();
        daughters(&of_pass, solution, &mut events);
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
            // What outliers leave of a disturbed channel is no gain to judge the daughter by.
            let known = |gain: &GainEstimate| gain.state == GainState::Good;
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

/// Events of daughters between a pass and the one before.
fn daughters(changes: &[&Change], solution: &PassSolution, events: &mut Vec<InstrumentEvent>) {
    let pass = solution.pass;
    let mut clocks: Vec<(u32, f64)> = Vec::new();
    for change in changes {
        let daughter = change.daughter as u32 + 1;
        let list = |list: &[(usize, f64, f64)], of: fn(f64) -> f64| -> Vec<(usize, f64)> {
            list.iter().filter(jumped).map(|(channel, change, _)| (*channel, of(*change))).collect()
        };
        let amplitudes = list(&change.amplitudes, f64::exp);
        if !amplitudes.is_empty() {
            events.push(InstrumentEvent::GainStep { pass, daughter, channels: amplitudes });
        }
        let phases = list(&change.phases, f64::to_degrees);
        if phases.is_empty() {
            continue;
        }
        match clock_ns(change, solution) {
            Some(ns) => clocks.push((daughter, ns)),
            None => events.push(InstrumentEvent::PhaseStep { pass, daughter, channels: phases }),
        }
    }
    // All others against the reference, alike: it was the reference.
    let known = changes.iter().filter(|change| !change.phases.is_empty()).count();
    let mean_ns = clocks.iter().map(|(_, ns)| ns).sum::<f64>() / clocks.len().max(1) as f64;
    let alike = clocks.iter().all(|(_, ns)| (ns - mean_ns).abs() < 0.1 * mean_ns.abs());
    let reference = changes.iter().find(|change| {
        let gains = &solution.daughters[change.daughter].gains;
        !change.phases.is_empty() && gains.iter().all(|gain| gain.phase_sigma_deg == 0.0)
    });
    match reference {
        Some(reference) if clocks.len() >= 2 && clocks.len() + 1 == known && alike => {
            let daughter = reference.daughter as u32 + 1;
            events.push(InstrumentEvent::ClockJump { pass, daughter, change_ns: -mean_ns });
        }
        _ => {
            let jump = |(daughter, change_ns)| InstrumentEvent::ClockJump { pass, daughter, change_ns };
            events.extend(clocks.into_iter().map(jump));
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

/// Whether most of a list is spoilt, of what is known.
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
