//! Search for an array with less noise at some degrees, and its check by runs that the search has not seen.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;

use super::design_file::{Design, DesignObjective, DesignParameter};
use super::design_limits::outside;
use super::event::JobEvent;
use super::sensitivity::ArraySensitivity;
use super::study::run_study;
use super::study_file::{Study, StudyCase, case_plan};
use crate::array::NodeMotion;
use crate::imaging::DegreeSensitivity;
use crate::pipeline::config::{MemoryLimit, PipelineError, Plan};
use crate::pipeline::cost::Segment;
use crate::pipeline::graph::RunView;
use crate::pipeline::graph::run::write_pipeline;
use crate::products::{ChannelFigures, ProductsError, RunFigures, create_folder, write_product};
use crate::runtime::Cancel;
use crate::units::InvalidValue;
use crate::units::constants::YEAR_S;

/// An array that the search tried.
#[derive(Clone, Debug, Serialize)]
pub struct DesignTrial {
    /// Values of the parameters, in the units of their keys.
    pub values: Vec<f64>,
    /// The objective over that of the start; absent outside the limits.
    pub ratio: Option<f64>,
    /// Why it cannot be, if so.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
}

/// What a search found.
#[derive(Clone, Debug, Serialize)]
pub struct DesignSummary {
    /// Name.
    pub name: String,
    /// Whether it was interrupted.
    pub cancelled: bool,
    /// What was lowered.
    pub objective: DesignObjective,
    /// At the first to the last of these degrees.
    pub degrees: [usize; 2],
    /// Number of arrays that were tried.
    pub trials: usize,
    /// The best one.
    pub best: DesignTrial,
    /// Its settings.
    pub settings: Vec<String>,
    /// What runs say of it; absent if they were not made.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub check: Option<DesignCheck>,
}

/// The maps of start and design with settings that the search has not seen.
#[derive(Clone, Debug, Serialize)]
pub struct DesignCheck {
    /// The settings of both.
    pub settings: Vec<String>,
    /// Noise relative to the sky, 1 / SNR_l, of the design over that of the start: geometric mean over the compared degrees and channels; absent
    /// if there are none.
    pub noise_ratio: Option<f64>,
    /// Its relative standard deviation, as each noise-only map is one realisation of 2 l + 1 modes a degree.
    pub noise_sigma: Option<f64>,
    /// Each compared degree of each channel.
    pub by_degree: Vec<CheckedDegree>,
    /// Degrees of the search without SNR_l in both maps.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub not_compared: Vec<NotCompared>,
}

/// Degrees of a channel that are not compared.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct NotCompared {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Degrees l.
    pub l: Vec<usize>,
}

/// One degree of the maps of start and design.
#[derive(Clone, Debug, Serialize)]
pub struct CheckedDegree {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Degree l.
    pub l: usize,
    /// 1 / SNR_l of the design over that of the start.
    pub noise_ratio: f64,
    /// rho_l of start and design.
    pub rho: [Option<f64>; 2],
    /// Measured modes of start and design, of 2 l + 1, if R is from the data.
    pub modes: [Option<f64>; 2],
}

/// A step of a search.
#[derive(Clone, Debug)]
pub enum DesignStep<'a> {
    /// An array was tried: how many were, the array, and the least ratio so far.
    Trial(usize, &'a DesignTrial, f64),
    /// A step of the study of start and design.
    Check(&'a Study, JobEvent, Box<Option<RunView>>),
}

/// Callback that receives each step.
pub type DesignWatcher<'a> = &'a mut dyn FnMut(DesignStep<'_>);

/// The runs that check a design.
#[derive(Clone, Copy, Debug)]
pub enum DesignRuns {
    /// None.
    Without,
    /// Those of start and design, if the memory of each is within a limit.
    Within(Option<MemoryLimit>),
}

/// Searches a design; writes `design.toml`, the pipeline of the best one, and `trials.csv` into `out`, and, with `runs`, what a study of start
/// and design writes; `design.json` has what is returned.
///
/// # Errors
/// As [`run_study`]; a start of which nothing is measured; no array within the limits; runs that need more memory than their limit.
pub fn run_design(
    design: &Design,
    out: &Path,
    runs: DesignRuns,
    cancel: &Cancel,
    watch: DesignWatcher<'_>,
) -> Result<DesignSummary, PipelineError> {
    create_folder(out)?;
    if let DesignRuns::Within(limit) = runs {
        // What prevents the check is told before a search of minutes.
        check_study(design, &[], limit)?;
    }
    let channels = 0..design.plan.schedules.len();
    let estimators: Result<Vec<_>, PipelineError> =
        channels.map(|channel| ArraySensitivity::new(&design.plan, channel)).collect();
    let mut search = Search {
        design,
        parameters: design.parameter_of_each().collect(),
        estimators: estimators?,
        trials: Vec::new(),
        start: 1.0,
        cancel,
    };
    search.start = search.objective(&design.plan)?.map_err(|found| InvalidValue {
        key: "degrees".to_owned(),
        value: format!("{:?}", design.degrees),
        expected: format!("degrees and channels that the array to start from measures: {found}").into(),
    })?;
    let table = out.join("trials.csv");
    let best = search.find(watch);
    write_product(&table, trials_csv(&search.parameters, &search.trials))?;
    let (trials, reasons) = (search.trials.len(), reasons(&search.trials));
    let best = best?.ok_or(PipelineError::NoDesign { trials, reasons, table })?;
    let settings = settings(design, &best.values);
    let mut config = design.source(&settings).load()?;
    config.name = format!("{}-design", design.name);
    let version = env!("CARGO_PKG_VERSION");
    let head = format!("Found by `lunarray design`, lunarray {version}: {}", settings.join(", "));
    write_pipeline(&config, &head, &out.join("design.toml"))?;
    let mut summary = DesignSummary {
        name: design.name.clone(),
        cancelled: cancel.is_cancelled(),
        objective: design.objective,
        degrees: design.degrees,
        trials,
        best,
        settings,
        check: None,
    };
    write_summary(&summary, out)?;
    if let (DesignRuns::Within(limit), false) = (runs, summary.cancelled) {
        let study = check_study(design, &summary.settings, limit)?;
        let found = run_study(&study, out, false, cancel, &mut |event, view| {
            watch(DesignStep::Check(&study, event, Box::new(view)));
        })?;
        summary.cancelled = found.cancelled;
        if let [start, designed] = &found.cases[..] {
            summary.check = Some(compared([&start.figures, &designed.figures], design));
        }
        write_summary(&summary, out)?;
    }
    Ok(summary)
}

fn write_summary(summary: &DesignSummary, out: &Path) -> Result<(), PipelineError> {
    let path = out.join("design.json");
    let json = serde_json::to_vec_pretty(summary)
        .map_err(|error| ProductsError::Encode { path: path.clone(), reason: error.to_string() })?;
    Ok(write_product(&path, json)?)
}

/// The commonest reasons of refusal, with counts and an example of each.
fn reasons(trials: &[DesignTrial]) -> String {
    let mut by_kind = BTreeMap::new();
    for reason in trials.iter().filter_map(|trial| trial.refused.as_deref()) {
        // Reasons that differ in numbers are one.
        let kind: String = reason.chars().filter(|character| character.is_alphabetic()).collect();
        by_kind.entry(kind).or_insert((0, reason)).0 += 1;
    }
    let mut commonest: Vec<(usize, &str)> = by_kind.into_values().collect();
    commonest.sort_by_key(|(count, _)| std::cmp::Reverse(*count));
    let told = commonest.iter().take(3).map(|(count, reason)| format!("{count} as, for example, {reason}"));
    told.collect::<Vec<_>>().join("; ")
}

struct Search<'a> {
    design: &'a Design,
    /// The parameter of each value.
    parameters: Vec<&'a DesignParameter>,
    estimators: Vec<ArraySensitivity>,
    trials: Vec<DesignTrial>,
    /// Objective of the start.
    start: f64,
    cancel: &'a Cancel,
}

impl Search<'_> {
    /// What is lowered, for a plan: the geometric mean over channels; or what is not measured.
    fn objective(&mut self, plan: &Plan) -> Result<Result<f64, String>, PipelineError> {
        let [first, last] = self.design.degrees;
        let mut sum = 0.0;
        for (estimator, channel) in self.estimators.iter_mut().zip(&plan.instrument.channels) {
            let degrees = &estimator.of(plan)?[first..=last];
            let Some(value) = objective(self.design.objective, degrees) else {
                let unmeasured = degrees.iter().find(|degree| !degree.is_measured());
                let (l, longest_m) =
                    (unmeasured.map_or(first, |degree| degree.l), estimator.baseline_m_max(plan));
                let mhz = channel.frequency_hz / 1e6;
                return Ok(Err(format!(
                    "nothing is measured at l = {l} at {mhz} MHz by baselines below {longest_m:.1} m, the longest of estimates"
                )));
            };
            sum += value.ln();
        }
        Ok(Ok((sum / self.estimators.len() as f64).exp()))
    }

    /// Tries a point of the unit cube; returns its ratio, infinite if it is refused.
    fn attempt(&mut self, point: &[f64], watch: DesignWatcher<'_>) -> Result<f64, PipelineError> {
        let values =
            point.iter().zip(&self.parameters).map(|(x, parameter)| value_of(parameter, *x)).collect();
        self.attempt_values(values, watch)
    }

    fn attempt_values(&mut self, values: Vec<f64>, watch: DesignWatcher<'_>) -> Result<f64, PipelineError> {
        let source = self.design.source(&settings(self.design, &values));
        let plan = case_plan(&source, None).map_err(|error| error.to_string());
        let plan = plan.and_then(|plan| outside(&plan, &self.design.limits).map_or(Ok(plan), Err));
        let found = match plan {
            Ok(plan) => self.objective(&plan)?,
            Err(reason) => Err(reason),
        };
        let (ratio, refused) = match found.map(|value| value / self.start) {
            Ok(ratio) if ratio.is_finite() && ratio > 0.0 => (Some(ratio), None),
            Ok(ratio) => (None, Some(format!("its estimate over that of the start is {ratio}"))),
            Err(reason) => (None, Some(reason)),
        };
        self.trials.push(DesignTrial { values, ratio, refused });
        let least = self.trials.iter().filter_map(|trial| trial.ratio).fold(f64::INFINITY, f64::min);
        if let Some(trial) = self.trials.last() {
            watch(DesignStep::Trial(self.trials.len(), trial, least));
        }
        Ok(ratio.unwrap_or(f64::INFINITY))
    }

    fn is_over(&self) -> bool {
        self.trials.len() >= self.design.evaluations || self.cancel.is_cancelled()
    }

    /// Tries the start and spread points, a third of all trials; then, from the best of them, each parameter up and down by steps that are
    /// halved when none helps.
    fn find(&mut self, watch: DesignWatcher<'_>) -> Result<Option<DesignTrial>, PipelineError> {
        let of_start = self.parameters.iter().zip(&self.design.start_values);
        let start: Vec<f64> = of_start.map(|(one, value)| value.clamp(one.from, one.to)).collect();
        let of_start = self.parameters.iter().zip(&start);
        let mut best: Vec<f64> = of_start.map(|(parameter, value)| place_of(parameter, *value)).collect();
        let mut least = self.attempt_values(start, watch)?;
        while self.trials.len() < self.design.evaluations / 3 && !self.is_over() {
            let point = spread(self.design.seed, self.trials.len() as u64, best.len());
            let found = self.attempt(&point, watch)?;
            if found < least {
                (best, least) = (point, found);
            }
        }
        let mut step = 0.2;
        while step > 1e-3 && !self.is_over() {
            let before = least;
            for (k, sign) in (0..best.len()).flat_map(|k| [(k, 1.0), (k, -1.0)]) {
                let mut point = best.clone();
                point[k] = (point[k] + sign * step).clamp(0.0, 1.0);
                if self.is_over() || point == best {
                    continue;
                }
                let found = self.attempt(&point, watch)?;
                if found < least {
                    (best, least) = (point, found);
                }
            }
            if least >= before {
                step *= 0.5;
            }
        }
        let possible = self.trials.iter().filter_map(|trial| Some((trial.ratio?, trial)));
        Ok(possible.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, trial)| trial.clone()))
    }
}

/// Point `number` of an even sequence in the unit cube: multiples of powers of the generalised golden ratio, x^(count + 1) = x + 1, from a random
/// point of the seed.
fn spread(seed: u64, number: u64, count: usize) -> Vec<f64> {
    let mut ratio = 2.0_f64;
    for _ in 0..50 {
        ratio = (1.0 + ratio).powf(1.0 / (count + 1) as f64);
    }
    let place = |k: usize| (offset(seed, k as u64) + number as f64 * ratio.powi(-(k as i32))).fract();
    (1..=count).map(place).collect()
}

/// Number `k` of a seed, 0 to 1, by SplitMix64 (Steele et al. 2014).
fn offset(seed: u64, k: u64) -> f64 {
    let mixed = seed.wrapping_add(k.wrapping_mul(0x9e37_79b9_7f4a_7c15));
    let mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((mixed ^ (mixed >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

/// What is lowered, of some degrees of a channel; `None` if it is not a positive number, as at a degree of which nothing is measured.
fn objective(objective: DesignObjective, degrees: &[DegreeSensitivity]) -> Option<f64> {
    let sum = |of: fn(&DegreeSensitivity) -> f64| degrees.iter().map(of).sum::<f64>();
    let (value, is_measured) = match objective {
        DesignObjective::Noise => (
            (sum(|degree| degree.relative_noise().ln()) / degrees.len() as f64).exp(),
            degrees.iter().all(DegreeSensitivity::is_measured),
        ),
        DesignObjective::Modes => (
            sum(|degree| (2 * degree.l + 1) as f64 - degree.measured),
            degrees.iter().any(DegreeSensitivity::is_measured),
        ),
    };
    (is_measured && value.is_finite() && value > 0.0).then_some(value)
}

/// Whether a range is searched in logarithms.
fn is_wide(parameter: &DesignParameter) -> bool {
    parameter.from > 0.0 && parameter.to / parameter.from >= 10.0
}

/// The value at `x` of 0 to 1 of the range, rounded by up to 1e-4 of the value where the range is searched in logarithms, else of the range.
fn value_of(parameter: &DesignParameter, x: f64) -> f64 {
    let DesignParameter { from, to, .. } = parameter;
    let value = match is_wide(parameter) {
        true => {
            let value = from * (to / from).powf(x);
            format!("{value:.4e}").parse().unwrap_or(value)
        }
        false => {
            let (value, digits) = (from + x * (to - from), (1e-4 * (to - from)).log10().floor());
            let (unit, decimals) = (10_f64.powf(digits), (-digits).max(0.0) as usize);
            let value = if digits > 0.0 { (value / unit).round() * unit } else { value };
            format!("{value:.decimals$}").parse().unwrap_or(value)
        }
    };
    value.clamp(*from, *to)
}

/// Where a value is in the range, 0 to 1.
fn place_of(parameter: &DesignParameter, value: f64) -> f64 {
    let DesignParameter { from, to, .. } = parameter;
    let value = value.clamp(*from, *to);
    if is_wide(parameter) { (value / from).ln() / (to / from).ln() } else { (value - from) / (to - from) }
}

/// The settings of a design: its values, and the periods that follow from altitude and inclination.
fn settings(design: &Design, values: &[f64]) -> Vec<String> {
    let mut sets = design.settings(values);
    let array = &design.plan.config.array;
    let of = |key: &str| {
        design.parameter_of_each().zip(values).find(|(one, _)| one.key == key).map(|(_, value)| *value)
    };
    let (altitude, inclination) = (of("array.altitude_m"), of("array.inclination_deg"));
    if array.has_own_orbits() || altitude.is_none() && inclination.is_none() {
        return sets;
    }
    // Kepler's third law, and the node's rate by J2, n (R / a)^2 cos i, both relative to the start.
    let axis = |altitude_m: f64| array.moon_radius_m + altitude_m;
    let ratio = axis(altitude.unwrap_or(array.altitude_m)) / axis(array.altitude_m);
    let cos = |deg: f64| if deg == 90.0 { 0.0 } else { deg.to_radians().cos() };
    let (cos_start, cos_now) =
        (cos(array.inclination_deg), cos(inclination.unwrap_or(array.inclination_deg)));
    sets.push(format!("array.orbital_period_s={:?}", array.orbital_period_s * ratio.powf(1.5)));
    if cos_start != 0.0 {
        // A polar orbit does not precess: a million years.
        let factor = (ratio.powf(3.5) * cos_start / cos_now).abs();
        let period_s = (array.precession_period_s * factor).min(1e6 * YEAR_S);
        sets.push(format!("array.precession_period_s={period_s:?}"));
        let turns = cos_start.signum() != cos_now.signum() && cos_now != 0.0;
        let motion = match (array.node_motion, turns) {
            (NodeMotion::Regress, false) | (NodeMotion::Advance, true) => "regress",
            _ => "advance",
        };
        sets.push(format!("array.node_motion={motion}"));
    }
    sets
}

/// The study of start and design with the settings of the check, each within a limit of memory.
fn check_study(
    design: &Design,
    settings: &[String],
    limit: Option<MemoryLimit>,
) -> Result<Study, PipelineError> {
    let case = |(family, label, settings): (usize, &str, &[String])| {
        let source = design.source(&[settings, design.check.as_slice()].concat());
        let plan = case_plan(&source, None)?;
        plan.cost().require_memory(Segment::Whole, limit)?;
        Ok(StudyCase {
            labels: vec![label.to_owned()],
            plan,
            overrides: source.overrides,
            calibrated: false,
            noise_seeds: Vec::new(),
            family,
            models_hash: 0,
        })
    };
    let cases = [(0, "start", &[][..]), (1, "design", settings)].into_iter().map(case);
    Ok(Study {
        name: design.name.clone(),
        cases: cases.collect::<Result<_, PipelineError>>()?,
        realisations: 1,
        covariance_at_deg: Vec::new(),
        models: Vec::new(),
        model_files: Vec::new(),
    })
}

/// Compares the maps of start and design at the degrees of the search, where both have SNR_l.
fn compared(runs: [&RunFigures; 2], design: &Design) -> DesignCheck {
    let [first, last] = design.degrees;
    let (mut by_degree, mut not_compared) = (Vec::new(), Vec::new());
    let is_at = |a_hz: f64, b_hz: f64| (a_hz / b_hz - 1.0).abs() < 1e-9;
    // A run has no figures of a channel without a map, and the check may have other channels.
    let mut channels_hz = design.plan.config.spacecraft.channels_hz.clone();
    for channel in runs.iter().flat_map(|run| &run.channels) {
        if !channels_hz.iter().any(|hz| is_at(*hz, channel.frequency_hz)) {
            channels_hz.push(channel.frequency_hz);
        }
    }
    for frequency_hz in channels_hz {
        let maps = runs.map(|run| run.channels.iter().find(|map| is_at(map.frequency_hz, frequency_hz)));
        let mut without = Vec::new();
        for l in first..=last {
            let [start, designed] = maps;
            match start.zip(designed).and_then(|(start, designed)| checked([start, designed], l)) {
                Some(degree) => by_degree.push(degree),
                None => without.push(l),
            }
        }
        if !without.is_empty() {
            not_compared.push(NotCompared { frequency_hz, l: without });
        }
    }
    let count = by_degree.len() as f64;
    let ln = by_degree.iter().map(|degree| degree.noise_ratio.ln()).sum::<f64>() / count;
    // The logarithm of an amplitude from 2 l + 1 modes has a variance of 1 / (2 (2 l + 1)), in each of both.
    let variance: f64 = by_degree.iter().map(|degree| 1.0 / (2 * degree.l + 1) as f64).sum();
    let of_any = |value: f64| (count > 0.0).then_some(value);
    DesignCheck {
        settings: design.check.clone(),
        noise_ratio: of_any(ln.exp()),
        noise_sigma: of_any(variance.sqrt() / count),
        by_degree,
        not_compared,
    }
}

fn checked(maps: [&ChannelFigures; 2], l: usize) -> Option<CheckedDegree> {
    let of = |curve: &Option<Vec<Option<f64>>>| curve.as_ref()?.get(l).copied().flatten();
    let [start, designed] = maps.map(|map| of(&map.snr));
    let noise_ratio = start? / designed?;
    (noise_ratio.is_finite() && noise_ratio > 0.0).then(|| CheckedDegree {
        frequency_hz: maps[0].frequency_hz,
        l,
        noise_ratio,
        rho: maps.map(|map| of(&map.rho)),
        modes: maps.map(|map| map.sky_power.as_ref()?.constrained.get(l).copied()),
    })
}

fn trials_csv(parameters: &[&DesignParameter], trials: &[DesignTrial]) -> String {
    let keys: Vec<&str> = parameters.iter().map(|parameter| parameter.key.as_str()).collect();
    let mut text = format!("{},ratio,refused\n", keys.join(","));
    for trial in trials {
        let values: Vec<String> = trial.values.iter().map(f64::to_string).collect();
        let ratio = trial.ratio.map_or_else(String::new, |ratio| format!("{ratio:.5}"));
        let refused = trial.refused.as_deref().unwrap_or("").replace(['"', '\n'], " ");
        text.push_str(&format!("{},{ratio},\"{refused}\"\n", values.join(",")));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_rounded_within_their_range() {
        for (from, to) in
            [(1234.5678, 1234.6789), (0.012_345, 0.067_891), (12_345.67, 987_654.3), (-3.3, 4e6)]
        {
            let parameter = DesignParameter { key: String::new(), from, to };
            for k in 0..=1000 {
                let x = f64::from(k) / 1000.0;
                let value = value_of(&parameter, x);
                assert!((from..=to).contains(&value), "{value}");
                // Steps of the search are at least 1e-3 of the range, or of ln(to / from) >= 2.3.
                assert!((place_of(&parameter, value) - x).abs() <= 1.01e-4, "{from} {to} {x} {value}");
            }
        }
    }

    #[test]
    fn seeds_share_no_points() {
        let points = |seed: u64| (0..500).map(move |n| spread(seed, n, 2));
        for point in points(0) {
            assert!(point.iter().all(|x| (0.0..1.0).contains(x)));
            let is_near = |other: Vec<f64>| point.iter().zip(&other).all(|(a, b)| (a - b).abs() < 1e-9);
            assert!(!points(1).any(is_near));
        }
    }
}
