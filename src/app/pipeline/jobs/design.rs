//! Search for an array with less noise at some degrees, and its check by runs that the search has not seen.

use std::path::Path;

use serde::Serialize;

use super::design_file::{Design, DesignLimits, DesignObjective, DesignParameter};
use super::event::JobEvent;
use super::sensitivity::ArraySensitivity;
use super::study::run_study;
use super::study_file::{Study, StudyCase, case_plan};
use crate::array::NodeMotion;
use crate::imaging::DegreeSensitivity;
use crate::pipeline::config::{PipelineError, Plan};
use crate::pipeline::graph::RunView;
use crate::pipeline::graph::run::write_pipeline;
use crate::products::{ChannelFigures, RunFigures, create_folder, write_product};
use crate::runtime::Cancel;
use crate::units::constants::YEAR_S;
use crate::units::vector::{norm, sub};

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
    /// Noise relative to the sky, 1 / SNR_l, of the design over that of the start: geometric mean over degrees and channels.
    pub noise_ratio: f64,
    /// Its relative standard deviation, as each noise-only map is one realisation of 2 l + 1 modes a degree.
    pub noise_sigma: f64,
    /// Each degree of each channel.
    pub by_degree: Vec<CheckedDegree>,
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

/// Searches a design; writes `design.toml`, the pipeline of the best one, and `trials.csv` into `out`, and, if `checks`, what a study of start
/// and design writes; `design.json` has what is returned.
///
/// # Errors
/// As [`run_study`]; no array within the limits.
pub fn run_design(
    design: &Design,
    out: &Path,
    checks: bool,
    cancel: &Cancel,
    watch: DesignWatcher<'_>,
) -> Result<DesignSummary, PipelineError> {
    create_folder(out)?;
    if checks {
        // An invalid setting of the check is told before a search of minutes.
        check_study(design, &[])?;
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
    search.start = search.objective(&design.plan)?;
    let best = search.find(watch)?;
    let settings = settings(design, &best.values);
    write_product(&out.join("trials.csv"), trials_csv(&search.parameters, &search.trials))?;
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
        trials: search.trials.len(),
        best,
        settings,
        check: None,
    };
    if checks && !summary.cancelled {
        let study = check_study(design, &summary.settings)?;
        let found = run_study(&study, out, false, cancel, &mut |event, view| {
            watch(DesignStep::Check(&study, event, Box::new(view)));
        })?;
        summary.cancelled = found.cancelled;
        if let [start, designed] = &found.cases[..] {
            summary.check = compared([&start.figures, &designed.figures], design);
        }
    }
    write_product(&out.join("design.json"), serde_json::to_vec_pretty(&summary).unwrap_or_default())?;
    Ok(summary)
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
    /// What is lowered, for a plan: the geometric mean over channels.
    fn objective(&mut self, plan: &Plan) -> Result<f64, PipelineError> {
        let [first, last] = self.design.degrees;
        let mut sum = 0.0;
        for estimator in &mut self.estimators {
            let found = estimator.of(plan)?;
            sum += objective(self.design.objective, &found[first..=last]).ln();
        }
        Ok((sum / self.estimators.len() as f64).exp())
    }

    /// Tries a point of the unit cube; returns its ratio, infinite outside the limits.
    fn attempt(&mut self, point: &[f64], watch: DesignWatcher<'_>) -> Result<f64, PipelineError> {
        let values: Vec<f64> =
            point.iter().zip(&self.parameters).map(|(x, parameter)| value_of(parameter, *x)).collect();
        let source = self.design.source(&settings(self.design, &values));
        let plan = case_plan(&source, None).map_err(|error| error.to_string());
        let plan = plan.and_then(|plan| outside(&plan, &self.design.limits).map_or(Ok(plan), Err));
        let (ratio, refused) = match plan {
            Ok(plan) => (Some(self.objective(&plan)? / self.start), None),
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
    fn find(&mut self, watch: DesignWatcher<'_>) -> Result<DesignTrial, PipelineError> {
        let of_start = self.parameters.iter().zip(&self.design.start_values);
        let mut best: Vec<f64> = of_start.map(|(parameter, value)| place_of(parameter, *value)).collect();
        let mut least = self.attempt(&best, watch)?;
        while self.trials.len() < self.design.evaluations / 3 && !self.is_over() {
            let point = spread(self.design.seed % (1 << 20) + self.trials.len() as u64, best.len());
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
        let ratio = |trial: &&DesignTrial| trial.ratio.unwrap_or(f64::INFINITY);
        let best = self.trials.iter().min_by(|a, b| ratio(a).total_cmp(&ratio(b)));
        match best {
            Some(best) if best.ratio.is_some() => Ok(best.clone()),
            other => {
                let reason = other.and_then(|trial| trial.refused.clone()).unwrap_or_default();
                Err(PipelineError::NoDesign { trials: self.trials.len(), reason })
            }
        }
    }
}

/// Point `number` of an even sequence in the unit cube: multiples of powers of the generalised golden ratio, x^(count + 1) = x + 1.
fn spread(number: u64, count: usize) -> Vec<f64> {
    let mut ratio = 2.0_f64;
    for _ in 0..50 {
        ratio = (1.0 + ratio).powf(1.0 / (count + 1) as f64);
    }
    (1..=count).map(|k| (0.5 + number as f64 * ratio.powi(-(k as i32))).fract()).collect()
}

/// What is lowered, of some degrees of a channel.
fn objective(objective: DesignObjective, degrees: &[DegreeSensitivity]) -> f64 {
    let sum = |of: fn(&DegreeSensitivity) -> f64| degrees.iter().map(of).sum::<f64>();
    match objective {
        DesignObjective::Noise => (sum(|degree| degree.relative_noise().ln()) / degrees.len() as f64).exp(),
        DesignObjective::Modes => sum(|degree| (2 * degree.l + 1) as f64 - degree.measured),
    }
}

/// Whether a range is searched in logarithms.
fn is_wide(parameter: &DesignParameter) -> bool {
    parameter.from > 0.0 && parameter.to / parameter.from >= 10.0
}

/// The value at `x` of 0 to 1 of the range, to four digits, as no array is built to more.
fn value_of(parameter: &DesignParameter, x: f64) -> f64 {
    let DesignParameter { from, to, .. } = parameter;
    let value = if is_wide(parameter) { from * (to / from).powf(x) } else { from + x * (to - from) };
    format!("{value:.3e}").parse().unwrap_or(value)
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

/// Why a plan is outside the limits, if it is.
fn outside(plan: &Plan, limits: &DesignLimits) -> Option<String> {
    let [closest_m, span_m] = distances_m(plan);
    // Arcs are told by their length, of which a chord lacks a little.
    if closest_m < limits.closest_m_min * (1.0 - 1e-6) {
        return Some(format!("two satellites come as close as {closest_m:.1} m"));
    }
    if span_m < limits.span_m_min || limits.span_m_max.is_some_and(|limit| span_m > limit) {
        return Some(format!("the greatest distance of two satellites is {span_m:.0} m"));
    }
    let keeping = breathing_m_s_per_year(plan)?;
    let limit = limits.keeping_m_s_per_year_max?;
    (keeping > limit).then(|| format!("breathing takes {keeping:.2} m/s a year"))
}

/// The least and the greatest distance of two satellites, m: in the middle of each window and, of a formation, at its turnarounds.
fn distances_m(plan: &Plan) -> [f64; 2] {
    let array = &plan.array;
    let middles = plan.windows.iter().map(|window| 0.5 * (window.start.seconds() + window.end.seconds()));
    let turns = array.formation().map(|formation| [0.0, 0.5 * formation.period_s()]);
    let mut found = [f64::INFINITY, 0.0_f64];
    for t_s in middles.chain(turns.into_iter().flatten()) {
        let places: Vec<_> = (0..array.satellites()).map(|n| array.position_m(n, t_s)).collect();
        for (k, first) in places.iter().enumerate() {
            for second in &places[k + 1..] {
                let apart_m = norm(sub(*first, *second));
                found = [found[0].min(apart_m), found[1].max(apart_m)];
            }
        }
    }
    found
}

/// Velocity change that breathing takes of the satellite that moves most, m/s a year; `None` without a formation.
///
/// A change dv along the track makes a satellite drift by -3 dv on average (Hill's equations), so that turning a drift v into -v takes 2 v / 3,
/// twice a period. Other forces on the orbit are not in it.
#[must_use]
pub fn breathing_m_s_per_year(plan: &Plan) -> Option<f64> {
    let formation = plan.array.formation()?;
    let drifts = (0..formation.satellites()).map(|n| formation.arc_m(n, 0.0).1.abs());
    Some(2.0 * YEAR_S / formation.period_s() * 2.0 / 3.0 * drifts.fold(0.0, f64::max))
}

/// The study of start and design with the settings of the check.
fn check_study(design: &Design, settings: &[String]) -> Result<Study, PipelineError> {
    let case = |(family, label, settings): (usize, &str, &[String])| {
        let source = design.source(&[settings, design.check.as_slice()].concat());
        Ok(StudyCase {
            labels: vec![label.to_owned()],
            plan: case_plan(&source, None)?,
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

/// Compares the maps of start and design at the degrees of the search; `None` if SNR_l is not known.
fn compared(runs: [&RunFigures; 2], design: &Design) -> Option<DesignCheck> {
    let [first, last] = design.degrees;
    let mut by_degree = Vec::new();
    for (start, designed) in runs[0].channels.iter().zip(&runs[1].channels) {
        by_degree.extend((first..=last).filter_map(|l| checked([start, designed], l)));
    }
    let count = by_degree.len() as f64;
    let ln = by_degree.iter().map(|degree| degree.noise_ratio.ln()).sum::<f64>() / count;
    // The logarithm of an amplitude from 2 l + 1 modes has a variance of 1 / (2 (2 l + 1)), in each of both.
    let variance: f64 = by_degree.iter().map(|degree| 1.0 / (2 * degree.l + 1) as f64).sum();
    (count > 0.0).then(|| DesignCheck {
        settings: design.check.clone(),
        noise_ratio: ln.exp(),
        noise_sigma: variance.sqrt() / count,
        by_degree,
    })
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
        modes: maps.map(|map| map.sky_power.as_ref()?.decided.get(l).copied()),
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
