//! Observing time of pairs by baseline length for several breathings, and the number of visibilities (the paper, Sect. 3.1 and Fig. 4).

use std::fmt::Write;
use std::sync::Arc;

use serde::Serialize;

use super::error::FigureError;
use super::exposure::{TimeSample, gather, limit_m};
use super::output::FigureParts;
use crate::array::{Array, integration_time_s};
use crate::pipeline::Plan;
use crate::products::pictures::{Axis, Curve, Plot, draw_plots};
use crate::units::all_pairs;
use crate::units::vector::{norm, sub};

/// Lower edge of the first bin of baseline length, m.
const FIRST_M: f64 = 50.0;
/// Number of bins per decade.
const PER_DECADE: f64 = 20.0;
/// Number of bins, up to 500 km.
const BINS: usize = 80;
/// Ratios R_2 and R of other breathings to compare with; of the first no baseline lies between 300 m and 500 m.
const BREATHINGS: [[f64; 2]; 4] = [[3.0, 3.0], [6.0, 3.0], [9.0, 3.0], [6.0, 6.0]];
/// Time step, s. Lengths change slowly, by millimetres per second.
const STEP_S: f64 = 60.0;

#[derive(Serialize)]
struct PairTimeNumbers {
    /// Number of observing windows, and their total duration.
    windows: usize,
    observed_s: f64,
    /// Observing time summed over pairs, without pairs that see the Earth if these are flagged.
    pair_s: f64,
    shortest_m: f64,
    longest_m: f64,
    bins: Vec<LengthBin>,
    /// Other breathings of the same formation; empty for an array that has none.
    breathings: Vec<BreathingTime>,
    channels: Vec<ChannelTime>,
}

#[derive(Serialize)]
struct LengthBin {
    from_m: f64,
    to_m: f64,
    pair_s: f64,
}

#[derive(Serialize)]
struct BreathingTime {
    first_ratio: f64,
    ratio: f64,
    /// Observing time by length, as in `bins`, s.
    pair_s: Vec<f64>,
}

#[derive(Serialize)]
struct ChannelTime {
    frequency_hz: f64,
    /// Limit on the baselines of the map, m and wavelengths.
    limit_m: f64,
    limit_wavelengths: f64,
    /// Number of pairs that are within the limit at some time.
    pairs: usize,
    /// Observing time within the limit.
    pair_s: f64,
    visibilities: f64,
    /// Number of visibilities without the limit.
    visibilities_all: f64,
    /// Fraction of the observing time in which the motion of the baseline shortens integrations.
    cut_by_motion: f64,
    /// Number of visibilities by length, as in `bins`.
    visibilities_by_length: Vec<f64>,
}

/// Partial sums over windows.
struct Counts {
    bins_s: Vec<f64>,
    pair_s: f64,
    observed_s: f64,
    range_m: [f64; 2],
    channels: Vec<ChannelCounts>,
}

struct ChannelCounts {
    pair_s: f64,
    within: f64,
    all: f64,
    cut: f64,
    seen: Vec<bool>,
    by_length: Vec<f64>,
}

impl Counts {
    fn new(channels: usize, pairs: usize) -> Self {
        let channel = || ChannelCounts {
            pair_s: 0.0,
            within: 0.0,
            all: 0.0,
            cut: 0.0,
            seen: vec![false; pairs],
            by_length: vec![0.0; BINS],
        };
        Self {
            bins_s: vec![0.0; BINS],
            pair_s: 0.0,
            observed_s: 0.0,
            range_m: [f64::INFINITY, 0.0],
            channels: (0..channels).map(|_| channel()).collect(),
        }
    }

    fn add(&mut self, plan: &Plan, limits_m: &[f64], sample: &TimeSample<'_>) {
        self.observed_s += sample.length_s;
        let all = all_pairs(sample.states.len());
        for pair in sample.pairs {
            let [i, j] = [pair.i, pair.j].map(|n| sample.states[usize::from(n)]);
            let length_m = norm(sub(i.position_m, j.position_m));
            let bin = bin_of(length_m);
            self.pair_s += sample.length_s;
            self.bins_s[bin] += sample.length_s;
            self.range_m = [self.range_m[0].min(length_m), self.range_m[1].max(length_m)];
            let number = all.iter().position(|other| other == pair).unwrap_or(0);
            for ((counts, schedule), limit_m) in self.channels.iter_mut().zip(&plan.schedules).zip(limits_m) {
                let rule = schedule.rule;
                let dt_s = integration_time_s(rule, schedule.frequency_hz, i.velocity_m_s, j.velocity_m_s);
                let count = sample.length_s / dt_s;
                counts.all += count;
                counts.by_length[bin] += count;
                if dt_s < rule.duration_s_max {
                    counts.cut += sample.length_s;
                }
                if length_m < *limit_m {
                    counts.pair_s += sample.length_s;
                    counts.within += count;
                    counts.seen[number] = true;
                }
            }
        }
    }

    fn merge(&mut self, other: Self) {
        let add = |to: &mut [f64], from: &[f64]| to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
        add(&mut self.bins_s, &other.bins_s);
        self.pair_s += other.pair_s;
        self.observed_s += other.observed_s;
        self.range_m = [self.range_m[0].min(other.range_m[0]), self.range_m[1].max(other.range_m[1])];
        for (to, from) in self.channels.iter_mut().zip(other.channels) {
            to.pair_s += from.pair_s;
            to.within += from.within;
            to.all += from.all;
            to.cut += from.cut;
            add(&mut to.by_length, &from.by_length);
            to.seen.iter_mut().zip(from.seen).for_each(|(to, from)| *to |= from);
        }
    }
}

fn bin_of(length_m: f64) -> usize {
    let bin = (length_m / FIRST_M).log10() * PER_DECADE;
    (bin.max(0.0) as usize).min(BINS - 1)
}

fn edge_m(bin: usize) -> f64 {
    FIRST_M * 10f64.powf(bin as f64 / PER_DECADE)
}

/// Counts over the mission, of as many channels as there are limits.
fn count(plan: &Plan, limits_m: &[f64]) -> Counts {
    let pairs = all_pairs(plan.array.satellites()).len();
    let empty = || Counts::new(limits_m.len(), pairs);
    gather(plan, STEP_S, empty, |counts, sample| counts.add(plan, limits_m, sample), Counts::merge)
}

/// Observing time with other breathings; none for an array that has no progression.
fn breathings(plan: &Plan) -> Result<Vec<BreathingTime>, FigureError> {
    if !plan.config.array.arcs_m.is_empty() || plan.array.formation().is_none() {
        return Ok(Vec::new());
    }
    let time = |[first_ratio, ratio]: [f64; 2]| {
        let mut config = plan.config.array.clone();
        (config.breathing.first_ratio, config.breathing.ratio) = (first_ratio, ratio);
        let plan = Plan { array: Arc::new(Array::new(&config)?), ..plan.clone() };
        Ok(BreathingTime { first_ratio, ratio, pair_s: count(&plan, &[]).bins_s })
    };
    BREATHINGS.into_iter().map(time).collect()
}

pub(super) fn make(plan: &Plan) -> Result<FigureParts, FigureError> {
    let limits_m: Vec<f64> = (0..plan.schedules.len()).map(|channel| limit_m(plan, channel)).collect();
    let counts = count(plan, &limits_m);
    let bin = |(k, &pair_s): (usize, &f64)| LengthBin { from_m: edge_m(k), to_m: edge_m(k + 1), pair_s };
    let all_s = counts.pair_s;
    let channel = |((counts, schedule), &limit_m): ((ChannelCounts, _), &f64)| {
        let &crate::mother::Schedule { frequency_hz, .. } = schedule;
        ChannelTime {
            frequency_hz,
            limit_m,
            limit_wavelengths: limit_m * frequency_hz / crate::units::constants::SPEED_OF_LIGHT_M_S,
            pairs: counts.seen.iter().filter(|seen| **seen).count(),
            pair_s: counts.pair_s,
            visibilities: counts.within,
            visibilities_all: counts.all,
            cut_by_motion: counts.cut / all_s,
            visibilities_by_length: counts.by_length,
        }
    };
    let numbers = PairTimeNumbers {
        windows: plan.windows.len(),
        observed_s: counts.observed_s,
        pair_s: counts.pair_s,
        shortest_m: counts.range_m[0],
        longest_m: counts.range_m[1],
        bins: counts.bins_s.iter().enumerate().map(bin).collect(),
        breathings: breathings(plan)?,
        channels: counts.channels.into_iter().zip(&plan.schedules).zip(&limits_m).map(channel).collect(),
    };
    let picture = draw_plots("", &plots(&numbers), 1)?;
    Ok(FigureParts::new(&numbers, table(&numbers), picture))
}

fn table(numbers: &PairTimeNumbers) -> String {
    let mut csv = "from_m,to_m,pair_s".to_owned();
    for channel in &numbers.channels {
        let _ = write!(csv, ",visibilities_{}hz", channel.frequency_hz);
    }
    csv.push('\n');
    for (k, bin) in numbers.bins.iter().enumerate() {
        let _ = write!(csv, "{:.3},{:.3},{:.1}", bin.from_m, bin.to_m, bin.pair_s);
        for channel in &numbers.channels {
            let _ = write!(csv, ",{:.0}", channel.visibilities_by_length[k]);
        }
        csv.push('\n');
    }
    csv
}

fn plots(numbers: &PairTimeNumbers) -> [Plot; 2] {
    let x = Axis {
        label: "baseline length (m)".to_owned(),
        log: true,
        limits: Some((0.95 * numbers.shortest_m, numbers.longest_m)),
    };
    // Both ends of every bin, for a step curve.
    let steps = |value: &dyn Fn(usize, &LengthBin) -> f64| {
        let corners =
            |(k, bin): (usize, &LengthBin)| [(bin.from_m, value(k, bin)), (bin.to_m, value(k, bin))];
        numbers.bins.iter().enumerate().flat_map(corners).collect::<Vec<_>>()
    };
    // The last bin ends with the longest baseline.
    let density =
        |pair_s: f64, bin: &LengthBin| pair_s / 3600.0 / (bin.to_m.min(numbers.longest_m) - bin.from_m);
    let curve = |label: String, points| Curve { label, points, dashed: false };
    let mut densities = vec![curve("this array".to_owned(), steps(&|_, bin| density(bin.pair_s, bin)))];
    densities.extend(numbers.breathings.iter().map(|breathing| Curve {
        label: format!("R_{{2}} = {}, R = {}", breathing.first_ratio, breathing.ratio),
        points: steps(&|k, bin| density(breathing.pair_s[k], bin)),
        dashed: true,
    }));
    let by_channel = numbers.channels.iter().map(|channel| {
        let label = format!("{} MHz", channel.frequency_hz / 1e6);
        curve(label, steps(&|k, _| channel.visibilities_by_length[k]))
    });
    [
        Plot {
            title: format!("Observing time of all pairs, {} windows", numbers.windows),
            x: x.clone(),
            y: Axis { label: "pair hours per metre".to_owned(), log: true, limits: None },
            curves: densities,
            levels: Vec::new(),
        },
        Plot {
            title: "Visibilities".to_owned(),
            x,
            y: Axis { label: "per twentieth of a decade".to_owned(), log: true, limits: None },
            curves: by_channel.collect(),
            levels: Vec::new(),
        },
    ]
}
