//! Detection of instrument events, classified by their pattern over daughters, channels, pairs and time.
//!
//! | event | pattern |
//! |---|---|
//! | clock jump | phases of one daughter change in proportion to the frequency |
//! | phase step | phases of one daughter change otherwise |
//! | gain step | amplitudes of one daughter change |
//! | dead | a daughter delivers only noise |
//! | drift, gain drift | phases, amplitudes of one daughter change gradually within a pass |
//! | wrong model | residuals of pairs that gains cannot explain |
//! | wrong frequency, missing source | the same, and a model of another frequency, or with one more source, explains them |
//! | wrong strength | amplitudes of all daughters have a factor in common |
//! | weak signal | no daughter has a gain, as the known signal is too weak |
//! | interference | outliers in one channel, in most pairs and most of the time |
//! | burst | outliers at one time, in most pairs and channels |
//!
//! If the phases of most daughters relative to the reference change by the same amount, the reference itself changed.

use std::collections::BTreeSet;
use std::f64::consts::{PI, TAU};

use num_complex::Complex64;

use super::diagnosis::ModelFault;
use super::estimates::{GainEstimate, GainState};
use super::events::InstrumentEvent;
use super::solution::PassSolution;
use super::verdict::ModelVerdict;
use crate::numerics::SIGMA_OF_MEDIAN;

/// Threshold of a step, in standard deviations, which are raised to at least the scatter from pass to pass (see `inflate_sigmas`).
const JUMP_SIGMAS: f64 = 6.0;
/// Smallest change of a log amplitude, or of a phase (rad), that is reported.
const CHANGE_MIN: f64 = 0.01;
/// Fraction of outliers above which a channel or a time bin is disturbed.
const OUTLIER_FRACTION_MAX: f64 = 0.1;
/// Minimum number of channels to distinguish a clock jump from a phase step.
const CHANNELS_MIN: usize = 3;
/// Changes of a daughter's gains from one solution to the next.
struct Change {
    /// Index of the later solution.
    solution: usize,
    daughter: usize,
    /// Whether the later solution begins at a jump within a pass.
    is_within_pass: bool,
    /// Changes of phases, rad.
    phases: Vec<ChannelChange>,
    /// Changes of log amplitudes.
    amplitudes: Vec<ChannelChange>,
}

/// Change of a phase (rad) or log amplitude in a channel.
#[derive(Clone, Copy)]
struct ChannelChange {
    channel: usize,
    change: f64,
    sigma: f64,
}

/// Detects events in solutions of consecutive passes.
#[must_use]
pub fn instrument_events(solutions: &[PassSolution]) -> Vec<InstrumentEvent> {
    let mut changes = changes_between(solutions);
    inflate_sigmas(&mut changes, |change| &mut change.phases);
    inflate_sigmas(&mut changes, |change| &mut change.amplitudes);
    for (index, solution) in solutions.iter().enumerate().skip(1) {
        let mut solution_changes: Vec<&mut Change> =
            changes.iter_mut().filter(|change| change.solution == index).collect();
        attribute_to_reference(&mut solution_changes, solution.reference as usize - 1);
    }
    let mut events = Vec::new();
    let mut named = BTreeSet::new();
    for (index, solution) in solutions.iter().enumerate() {
        let of_solution: Vec<&Change> = changes.iter().filter(|change| change.solution == index).collect();
        let before = index.checked_sub(1).map(|previous| &solutions[previous]);
        let known = events.len();
        add_step_events(&of_solution, before, solution, &mut events);
        if events.len() == known {
            events.extend(before.and_then(|before| unclear_step(before, solution)));
        }
        add_state_events(before, solution, &mut events);
        add_model_events(before, solution, &mut named, &mut events);
        add_disturbance_events(solution, &mut events);
    }
    events
}

fn changes_between(solutions: &[PassSolution]) -> Vec<Change> {
    let mut found = Vec::new();
    let disturbed: Vec<Vec<bool>> = solutions.iter().map(disturbed_channels).collect();
    let is_disturbed = |index: usize, channel: usize| disturbed[index].get(channel) == Some(&true);
    for (index, two) in solutions.windows(2).enumerate() {
        for (n, (before, after)) in two[0].daughters.iter().zip(&two[1].daughters).enumerate() {
            // Gains of disturbed channels are unreliable. Phases relative to different references cannot be compared.
            let has_same_reference = two[0].reference == two[1].reference;
            let is_comparable = |gain: &GainEstimate| has_same_reference && gain.state == GainState::Good;
            let pairs = before.gains.iter().zip(&after.gains).enumerate();
            let pairs: Vec<_> = pairs
                .filter(|(c, (a, b))| {
                    is_comparable(a)
                        && is_comparable(b)
                        && !is_disturbed(index, *c)
                        && !is_disturbed(index + 1, *c)
                })
                .collect();
            let phase = |(c, (a, b)): &(usize, (&GainEstimate, &GainEstimate))| {
                let change = wrapped((b.phase_deg - a.phase_deg).to_radians());
                let sigma = a.phase_sigma_deg.hypot(b.phase_sigma_deg).to_radians();
                ChannelChange { channel: *c, change, sigma }
            };
            let amplitude = |(c, (a, b)): &(usize, (&GainEstimate, &GainEstimate))| {
                let change = (b.amplitude / a.amplitude).ln();
                ChannelChange { channel: *c, change, sigma: a.amplitude_sigma.hypot(b.amplitude_sigma) }
            };
            found.push(Change {
                solution: index + 1,
                daughter: n,
                is_within_pass: two[1].begins_with_jump,
                phases: pairs.iter().map(phase).collect(),
                amplitudes: pairs.iter().map(amplitude).collect(),
            });
        }
    }
    found
}

/// Raises standard deviations to the usual scatter of the daughter and channel from pass to pass; within a pass gains have none.
fn inflate_sigmas(changes: &mut [Change], select: impl Fn(&mut Change) -> &mut Vec<ChannelChange>) {
    let mut sizes: std::collections::BTreeMap<(usize, usize), Vec<f64>> = Default::default();
    for change in changes.iter_mut().filter(|change| !change.is_within_pass) {
        let daughter = change.daughter;
        for ChannelChange { channel, change, .. } in select(change) {
            sizes.entry((daughter, *channel)).or_default().push(change.abs());
        }
    }
    for list in sizes.values_mut() {
        list.sort_unstable_by(f64::total_cmp);
    }
    for change in changes.iter_mut().filter(|change| !change.is_within_pass) {
        let daughter = change.daughter;
        for ChannelChange { channel, sigma, .. } in select(change) {
            let list = &sizes[&(daughter, *channel)];
            // A median of fewer than three values says nothing about outliers.
            if list.len() >= 3 {
                *sigma = sigma.max(SIGMA_OF_MEDIAN * list[list.len() / 2]);
            }
        }
    }
}

fn wrapped(rad: f64) -> f64 {
    (rad + PI).rem_euclid(TAU) - PI
}

fn is_jump(change: &&ChannelChange) -> bool {
    change.change.abs() > (JUMP_SIGMAS * change.sigma).max(CHANGE_MIN)
}

/// Relative difference within which two changes count as equal.
const EQUAL_FRACTION: f64 = 0.05;

/// Difference within which two changes count as equal, in standard deviations.
const EQUAL_SIGMAS: f64 = 4.0;

/// If the phases of most daughters change equally relative to the reference, attributes the change to the reference.
fn attribute_to_reference(changes: &mut [&mut Change], reference: usize) {
    let mut channels: Vec<usize> =
        changes.iter().flat_map(|change| change.phases.iter().map(|phase| phase.channel)).collect();
    channels.sort_unstable();
    channels.dedup();
    for channel in channels {
        let phase = |change: &Change| change.phases.iter().find(|phase| phase.channel == channel).copied();
        let others: Vec<ChannelChange> = changes
            .iter()
            .filter(|change| change.daughter != reference)
            .filter_map(|change| phase(change))
            .collect();
        let is_equal = |phase: &&ChannelChange, centre: &ChannelChange| {
            let tolerance =
                (EQUAL_FRACTION * centre.change.abs()).max(EQUAL_SIGMAS * phase.sigma.hypot(centre.sigma));
            wrapped(phase.change - centre.change).abs() < tolerance
        };
        let count = |centre: &ChannelChange| others.iter().filter(|phase| is_equal(phase, centre)).count();
        // The reference's own phase is zero by definition: its change is only inferred from the others.
        let of_reference = changes.iter_mut().filter(|change| change.daughter == reference);
        of_reference.for_each(|change| change.phases.retain(|phase| phase.channel != channel));
        let Some(common) = others.iter().filter(is_jump).max_by_key(|jump| count(jump)) else { continue };
        let jumps = others.iter().filter(is_jump).filter(|phase| is_equal(phase, common));
        let equal: Vec<(f64, f64)> =
            jumps.map(|jump| (wrapped(jump.change - common.change), jump.sigma)).collect();
        // With two daughters alone it is undetermined which of them changed.
        if equal.len() < 2 || 2 * count(common) <= others.len() {
            continue;
        }
        let weight: f64 = equal.iter().map(|(_, sigma)| sigma.max(1e-6).powi(-2)).sum();
        let mean = equal.iter().map(|(difference, sigma)| difference * sigma.max(1e-6).powi(-2)).sum::<f64>()
            / weight;
        let (common_change, common_sigma) = (common.change + mean, weight.recip().sqrt());
        for change in &mut *changes {
            if change.daughter == reference {
                change.phases.push(ChannelChange {
                    channel,
                    change: -wrapped(common_change),
                    sigma: common_sigma,
                });
                continue;
            }
            for phase in change.phases.iter_mut().filter(|phase| phase.channel == channel) {
                phase.change = wrapped(phase.change - common_change);
                phase.sigma = phase.sigma.hypot(common_sigma);
            }
        }
    }
}

/// Adds the clock jumps, phase steps and gain steps between a solution and the one before.
fn add_step_events(
    changes: &[&Change],
    before: Option<&PassSolution>,
    solution: &PassSolution,
    events: &mut Vec<InstrumentEvent>,
) {
    let pass = solution.pass;
    let between_s = [before.map_or(solution.from_s, |before| before.until_s), solution.from_s];
    for change in changes {
        let daughter = change.daughter as u32 + 1;
        let jumps = |changes: &[ChannelChange], convert: fn(&ChannelChange) -> Step| -> Vec<Step> {
            changes.iter().filter(is_jump).map(convert).collect()
        };
        let amplitudes = jumps(&change.amplitudes, gain_step);
        if !amplitudes.is_empty() {
            events.push(InstrumentEvent::GainStep { pass, daughter, channels: amplitudes, between_s });
        }
        let phases = jumps(&change.phases, phase_step);
        if phases.is_empty() {
            continue;
        }
        events.push(match fit_clock_jump_ns(change, solution) {
            Some(change_ns) => InstrumentEvent::ClockJump { pass, daughter, change_ns, between_s },
            None => InstrumentEvent::PhaseStep { pass, daughter, channels: phases, between_s },
        });
    }
}

/// Channel, size of a step and its standard deviation, as events tell it.
type Step = (usize, f64, f64);

fn gain_step(of: &ChannelChange) -> Step {
    (of.channel, of.change.exp(), of.change.exp() * of.sigma)
}

fn phase_step(of: &ChannelChange) -> Step {
    (of.channel, of.change.to_degrees(), of.sigma.to_degrees())
}

/// The most significant change at a jump that divides a pass, also of gains that are not good; `None` if the pass is not divided there.
fn unclear_step(before: &PassSolution, solution: &PassSolution) -> Option<InstrumentEvent> {
    if !solution.begins_with_jump || solution.pass != before.pass {
        return None;
    }
    // Phases relative to one daughter, that of the part before.
    let common = &solution.daughters.get((before.reference as usize).checked_sub(1)?)?.gains;
    // A weak signal has an event of its own, and its gains are guesses.
    let is_weak = |channel: usize| {
        [before, solution].iter().any(|of| of.models.get(channel) == Some(&ModelVerdict::Weak))
    };
    let (mut best, mut most) = (None, 0.0);
    for (n, (earlier, later)) in before.daughters.iter().zip(&solution.daughters).enumerate() {
        for (channel, (a, b)) in earlier.gains.iter().zip(&later.gains).enumerate() {
            let is_known = |gain: &GainEstimate| !matches!(gain.state, GainState::NoData | GainState::Dead);
            let reference = &common[channel];
            if is_weak(channel) || !is_known(a) || !is_known(b) || !is_known(reference) {
                continue;
            }
            let change = wrapped((b.phase_deg - reference.phase_deg - a.phase_deg).to_radians());
            let sigma =
                a.phase_sigma_deg.hypot(b.phase_sigma_deg).hypot(reference.phase_sigma_deg).to_radians();
            let phase = ChannelChange { channel, change, sigma };
            let sigma = a.amplitude_sigma.hypot(b.amplitude_sigma);
            let amplitude = ChannelChange { channel, change: (b.amplitude / a.amplitude).ln(), sigma };
            for (of, is_phase) in [(phase, true), (amplitude, false)] {
                let significance = of.change.abs() / of.sigma;
                if significance.is_finite() && significance > most {
                    (best, most) = (Some((n as u32 + 1, of, is_phase)), significance);
                }
            }
        }
    }
    let (pass, between_s) = (solution.pass, [before.until_s, solution.from_s]);
    best.map(|(daughter, of, is_phase)| match is_phase {
        true => InstrumentEvent::PhaseStep { pass, daughter, channels: vec![phase_step(&of)], between_s },
        false => InstrumentEvent::GainStep { pass, daughter, channels: vec![gain_step(&of)], between_s },
    })
}

/// Smallest rms phase change within a pass that is reported, deg.
const DRIFT_MIN_DEG: f64 = 4.0;

/// The same of a log amplitude: equal changes of a gain along and across it.
const GAIN_DRIFT_MIN: f64 = DRIFT_MIN_DEG * PI / 180.0;

/// Smallest fraction of the variance of a phase or log amplitude that a reported drift contributes.
const DRIFT_FRACTION: f64 = 0.92;

/// Adds events that follow from the state of a solution's gains: onsets of states (dead, wrong model), and drifts.
fn add_state_events(
    before: Option<&PassSolution>,
    solution: &PassSolution,
    events: &mut Vec<InstrumentEvent>,
) {
    let pass = solution.pass;
    let channels = solution.models.len();
    let disturbed = disturbed_channels(solution);
    // What a known signal too weak to be seen leaves says nothing of daughters.
    let is_disturbed = |c: usize| disturbed.get(c) == Some(&true);
    let tells = |c: usize| !is_disturbed(c) && !matches!(solution.models[c], ModelVerdict::Weak);
    for (n, daughter) in solution.daughters.iter().enumerate() {
        let number = daughter.daughter;
        let is_dead =
            |solution: &PassSolution, c: usize| solution.daughters[n].gains[c].state == GainState::Dead;
        let dead = (0..channels).filter(|c| is_dead(solution, *c) && tells(*c));
        let dead: Vec<usize> = dead.filter(|c| before.is_none_or(|before| !is_dead(before, *c))).collect();
        if !dead.is_empty() {
            events.push(InstrumentEvent::Dead { pass, daughter: number, channels: dead });
        }
        let drifting = |rms_and_sigma: fn(&GainEstimate) -> [f64; 2], least: f64| -> Vec<(usize, f64)> {
            // What a named fault of the model leaves changes with time, as drifts do.
            let is_of_model =
                |c: usize| matches!(solution.models[c], ModelVerdict::Wrong { fault: Some(_), .. });
            let gains = daughter.gains.iter().enumerate().filter(|(c, _)| tells(*c) && !is_of_model(*c));
            let drifts = gains.filter_map(|(c, gain)| {
                let [rms, sigma] = rms_and_sigma(gain);
                // A drift is reported only if it dominates the variance: with noise alone the estimated scatter can reach
                // 0.9 of it.
                (rms > least && (rms / sigma.max(rms)).powi(2) > DRIFT_FRACTION).then_some((c, rms))
            });
            drifts.collect()
        };
        let channels = drifting(|gain| [gain.phase_scatter_deg, gain.phase_sigma_deg], DRIFT_MIN_DEG);
        if !channels.is_empty() {
            events.push(InstrumentEvent::Drift { pass, daughter: number, channels });
        }
        let channels = drifting(|gain| [gain.amplitude_scatter, gain.amplitude_sigma], GAIN_DRIFT_MIN);
        if !channels.is_empty() {
            events.push(InstrumentEvent::GainDrift { pass, daughter: number, channels });
        }
    }
}

/// Adds onsets of verdicts on models; what is wrong is told once for each channel and kind if it is found later. `named` has these.
fn add_model_events(
    before: Option<&PassSolution>,
    solution: &PassSolution,
    named: &mut BTreeSet<(usize, bool)>,
    events: &mut Vec<InstrumentEvent>,
) {
    let (pass, disturbed) = (solution.pass, disturbed_channels(solution));
    for (channel, verdict) in solution.models.iter().copied().enumerate() {
        let fault = match verdict {
            ModelVerdict::Wrong { fault, .. } => fault,
            _ => None,
        };
        if disturbed.get(channel) == Some(&true) {
            continue;
        }
        let is_named =
            fault.is_some_and(|fault| named.insert((channel, matches!(fault, ModelFault::Source { .. }))));
        if !is_named && before.is_some_and(|before| before.models[channel].is_like(verdict)) {
            continue;
        }
        match verdict {
            ModelVerdict::Right => {}
            ModelVerdict::Wrong { unexplained, fault } => events.push(match fault {
                None => InstrumentEvent::WrongModel { pass, channel, unexplained },
                Some(ModelFault::Frequency { ratio }) => {
                    InstrumentEvent::WrongFrequency { pass, channel, unexplained, ratio }
                }
                Some(ModelFault::Source { position_deg, flux_jy }) => {
                    InstrumentEvent::MissingSource { pass, channel, unexplained, position_deg, flux_jy }
                }
            }),
            ModelVerdict::Weak => events.push(InstrumentEvent::WeakSignal { pass, channel }),
            ModelVerdict::OtherStrength { factor } => {
                events.push(InstrumentEvent::WrongStrength { pass, channel, factor });
            }
        }
    }
}

/// Cost of each free parameter of an explanation, as a chi-square.
const PARAMETER_COST: f64 = 9.0;

/// Cost of a delay beyond half a turn of the highest frequency: there are many, of which one may fit any step.
const TURN_COST: f64 = 6.0;

/// Clock jump that explains the changes of the phases better than one step of all channels, or steps of those channels that jump, ns.
fn fit_clock_jump_ns(change: &Change, solution: &PassSolution) -> Option<f64> {
    let gains = &solution.daughters[change.daughter].gains;
    let hz = |channel: usize| gains[channel].frequency_hz;
    let highest = change.phases.iter().map(|phase| hz(phase.channel)).fold(0.0, f64::max);
    let lowest = change.phases.iter().map(|phase| hz(phase.channel)).fold(f64::INFINITY, f64::min);
    if change.phases.len() < CHANNELS_MIN || lowest <= 0.0 || highest < 1.1 * lowest {
        return None;
    }
    // Candidates span half a turn of the lowest frequency either way, in steps of a hundredth of a turn of the
    // highest.
    let step_s = 0.01 / highest;
    let steps = (0.5 / lowest / step_s) as i64;
    let square = |phase: &ChannelChange, expected: f64| -> f64 {
        (wrapped(phase.change - expected) / phase.sigma.max(1e-4)).powi(2)
    };
    let cost = |delay_s: f64| -> f64 {
        let expected = |phase: &ChannelChange| -TAU * hz(phase.channel) * delay_s;
        let chi_square: f64 = change.phases.iter().map(|phase| square(phase, expected(phase))).sum();
        chi_square + PARAMETER_COST + if (delay_s * highest).abs() > 0.5 { TURN_COST } else { 0.0 }
    };
    let of_channel =
        |phase: &ChannelChange| if is_jump(&phase) { PARAMETER_COST } else { square(phase, 0.0) };
    let cost_of_steps: f64 = change.phases.iter().map(of_channel).sum();
    let weighted =
        |phase: &ChannelChange| Complex64::from_polar(phase.sigma.max(1e-4).powi(-2), phase.change);
    let common = change.phases.iter().map(weighted).sum::<Complex64>().arg();
    let cost_of_one: f64 =
        change.phases.iter().map(|phase| square(phase, common)).sum::<f64>() + PARAMETER_COST;
    let best = |from_s: f64, step_s: f64, steps: i64| {
        let candidates = (-steps..=steps).map(|k| from_s + step_s * k as f64);
        candidates.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(from_s)
    };
    let coarse_s = best(0.0, step_s, steps);
    let delay_s = best(coarse_s, 0.01 * step_s, 100);
    (cost(delay_s) < cost_of_steps.min(cost_of_one)).then_some(1e9 * delay_s)
}

/// Whether more than half of the finite outlier fractions of a list exceed the threshold.
fn is_mostly_disturbed(fractions: &[f64]) -> bool {
    let finite: Vec<&f64> = fractions.iter().filter(|fraction| fraction.is_finite()).collect();
    finite.iter().filter(|fraction| ***fraction > OUTLIER_FRACTION_MAX).count() * 2 > finite.len()
}

/// Whether each channel is disturbed most of the time.
fn disturbed_channels(solution: &PassSolution) -> Vec<bool> {
    solution.outlier_fractions.by_channel_and_time.iter().map(|times| is_mostly_disturbed(times)).collect()
}

/// Adds interference and bursts within a pass.
fn add_disturbance_events(solution: &PassSolution, events: &mut Vec<InstrumentEvent>) {
    let (pass, parts) = (solution.pass, &solution.outlier_fractions);
    let channels = parts.by_channel_and_time.len();
    let disturbed = disturbed_channels(solution);
    for (channel, _) in disturbed.iter().enumerate().filter(|(_, disturbed)| **disturbed) {
        let times: Vec<f64> =
            parts.by_channel_and_time[channel].iter().copied().filter(|part| part.is_finite()).collect();
        let outliers = times.iter().sum::<f64>() / times.len() as f64;
        events.push(InstrumentEvent::Interference { pass, channel, outliers });
    }
    let bins = parts.by_channel_and_time.first().map_or(0, Vec::len);
    let is_hit = |bin: usize| {
        let column: Vec<f64> = (0..channels)
            .filter(|channel| !disturbed[*channel])
            .map(|channel| parts.by_channel_and_time[channel][bin])
            .collect();
        !column.is_empty() && is_mostly_disturbed(&column)
    };
    let bin_s = (solution.until_s - solution.from_s) / bins.max(1) as f64;
    let mut first_bin = None;
    for bin in 0..=bins {
        match (first_bin, bin < bins && is_hit(bin)) {
            (None, true) => first_bin = Some(bin),
            (Some(first), false) => {
                let at = |bin: usize| solution.from_s + bin_s * bin as f64;
                events.push(InstrumentEvent::Burst { pass, from_s: at(first), until_s: at(bin) });
                first_bin = None;
            }
            _ => {}
        }
    }
}
