//! Epsilon as each of four rules would choose it, from runs that differ in nothing else.
//!
//! With `H = A (A + R)^-1` for A the normal matrix, n real numbers of data and `rho^2 = |V - B T|^2` in units of their noise:
//!
//! - crossing: thermal noise and imperfection are alike, `Tr Sigma_n = T^2 Tr Sigma_s` (the paper, Fig. 15);
//! - generalised cross-validation: the least `n rho^2 / (n - Tr H)^2` (Golub, Heath & Wahba 1979, Technometrics 21, 215). Takes the
//!   level of the noise from the data;
//! - predictive risk: the least `rho^2 + 2 Tr H - n` (Mallows' C_L, 1973, Technometrics 15, 661). Takes the noise to be that of the
//!   weights; `rho^2` enters by differences alone;
//! - L-curve: the corner of `|T - T_p|^2` against `rho^2`, both logarithmic (Hansen 1992, SIAM Review 34, 561).
//!
//! What is not known of `rho^2` and of traces bounds what the second and third can tell: a choice comes with the range of epsilons
//! whose bars reach below the least upper end of all bars. Where that is all of them, there is no choice.

use std::fmt::Write;

use serde::Serialize;

use super::pictures::{Axis, Curve, Picture, PictureError, Plot, draw_plots};
use super::runs::{ChannelFigures, RunFigures, crossings};

/// Greatest part of the residual that may be unknown for an L-curve.
const OPEN_MAX: f64 = 0.1;

/// What the rules see of one solution.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct EpsilonPoint {
    /// epsilon.
    pub epsilon: f64,
    /// `rho^2`.
    pub residual: f64,
    /// What it may be off by.
    pub residual_error: f64,
    /// `|T - T_p|^2` over pixels, K^2.
    pub solution_k2: f64,
    /// `Tr H`.
    pub measured: f64,
    /// `n rho^2 / (n - Tr H)^2`, 1 for noise alone; `None` if the data are fewer than what they decide.
    pub cross_validation: Option<f64>,
    /// What it may be off by.
    pub cross_validation_error: Option<f64>,
    /// `rho^2 + 2 Tr H - n`: the square of what the map of the data is expected to be off by, in units of noise, for noise of the weights.
    pub risk: f64,
    /// What it may be off by.
    pub risk_error: f64,
    /// Curvature of the L-curve, positive at its corner; `None` at its ends.
    pub curvature: Option<f64>,
}

/// The choice of one rule.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct EpsilonChoice {
    /// epsilon, between the given ones as a parabola has it; `None` if there is no choice.
    pub epsilon: Option<f64>,
    /// The epsilons that the bars leave open.
    pub open: Option<[f64; 2]>,
    /// Why there is none, or what is to be known of it.
    pub note: Option<String>,
}

/// The choices for one channel of runs that differ in epsilon alone.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EpsilonChoices {
    /// Label of the first of the runs.
    pub of: String,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Real numbers in the data, n.
    pub numbers: u64,
    /// `V'N^-1V / n`: the square of their signal-to-noise ratio, and 1.
    pub power_a_number: f64,
    /// By crossing of the traces.
    pub crossing: EpsilonChoice,
    /// By generalised cross-validation.
    pub cross_validation: EpsilonChoice,
    /// By the predictive risk.
    pub risk: EpsilonChoice,
    /// By the corner of the L-curve.
    pub l_curve: EpsilonChoice,
    /// What they see, by epsilon.
    pub points: Vec<EpsilonPoint>,
}

/// Choices of groups of runs that differ in epsilon alone, where at least three have traces.
#[must_use]
pub fn epsilon_choices(groups: &[Vec<&RunFigures>]) -> Vec<EpsilonChoices> {
    let mut found = Vec::new();
    for group in groups {
        for place in 0..group.first().map_or(0, |run| run.channels.len()) {
            let channels: Vec<&ChannelFigures> =
                group.iter().filter_map(|run| run.channels.get(place)).collect();
            found.extend(choices(group, &channels));
        }
    }
    found
}

fn choices(group: &[&RunFigures], channels: &[&ChannelFigures]) -> Option<EpsilonChoices> {
    let first = channels.first()?;
    let fit = channels.iter().find_map(|channel| channel.diagnostics.fit.as_ref())?;
    let mut points: Vec<EpsilonPoint> = channels.iter().filter_map(|channel| point(channel)).collect();
    points.sort_by(|a, b| a.epsilon.total_cmp(&b.epsilon));
    points.dedup_by_key(|point| point.epsilon);
    if points.len() < 3 {
        return None;
    }
    let curve: Vec<(f64, f64)> = points.iter().map(|p| (p.residual.ln(), p.solution_k2.ln())).collect();
    for k in 1..points.len() - 1 {
        points[k].curvature = curvature(&curve[k - 1..=k + 1]);
    }
    let crossing = crossings(std::slice::from_ref(&group.to_vec()))
        .into_iter()
        .find(|crossing| crossing.frequency_hz == first.frequency_hz)
        .and_then(|crossing| crossing.epsilon);
    Some(EpsilonChoices {
        of: group.first()?.label.clone(),
        frequency_hz: first.frequency_hz,
        numbers: fit.numbers,
        power_a_number: fit.data_power / fit.numbers as f64,
        crossing: EpsilonChoice {
            epsilon: crossing,
            open: None,
            note: crossing.is_none().then(|| "the traces do not cross within these epsilons".to_owned()),
        },
        cross_validation: least(&points, |p| p.cross_validation.zip(p.cross_validation_error), true),
        risk: noted(least(&points, |p| Some((p.risk, p.risk_error)), false), first.thermal_noise),
        l_curve: corner(&points),
        points,
    })
}

fn point(channel: &ChannelFigures) -> Option<EpsilonPoint> {
    let (fit, traces) = (channel.diagnostics.fit.as_ref()?, channel.diagnostics.traces.as_ref()?);
    let measured = traces.measured?;
    let (n, residual) = (fit.numbers as f64, fit.residual);
    // What is not known of a trace is infinite for a single probe.
    let (residual_error, measured_error) = (residual.error?, measured.error.unwrap_or(f64::INFINITY));
    let left = n - measured.value;
    let score = (left > 0.0).then(|| n * residual.value / (left * left));
    let score_error =
        score.map(|score| n * residual_error / (left * left) + 2.0 * score.abs() * measured_error / left);
    Some(EpsilonPoint {
        epsilon: channel.diagnostics.epsilon?,
        residual: residual.value,
        residual_error,
        solution_k2: fit.solution_k2,
        measured: measured.value,
        cross_validation: score,
        cross_validation_error: score_error,
        risk: residual.value + 2.0 * measured.value - n,
        risk_error: residual_error + 2.0 * measured_error,
        curvature: None,
    })
}

/// Where a score is least, and how far its bars leave that open. Positive scores are fitted as logarithms.
fn least(
    points: &[EpsilonPoint],
    score: impl Fn(&EpsilonPoint) -> Option<(f64, f64)>,
    is_positive: bool,
) -> EpsilonChoice {
    let scores: Vec<(f64, f64, f64)> =
        points.iter().filter_map(|p| score(p).map(|(value, error)| (p.epsilon, value, error))).collect();
    let values: Vec<f64> = scores.iter().map(|s| s.1).collect();
    let Some(at) = (0..values.len()).min_by(|&a, &b| values[a].total_cmp(&values[b])) else {
        return EpsilonChoice {
            note: Some("the data are fewer than what they decide".to_owned()),
            ..EpsilonChoice::default()
        };
    };
    let bound = scores.iter().map(|(_, value, error)| value + error).fold(f64::INFINITY, f64::min);
    let reached = scores.iter().filter(|(_, value, error)| value - error <= bound).map(|s| s.0);
    let open = reached.fold([f64::INFINITY, 0.0], |[low, high], e| [e.min(low), e.max(high)]);
    let is_all = open[0] <= scores[0].0 && open[1] >= scores[scores.len() - 1].0;
    if is_all || (is_positive && values[at] <= 0.0) {
        let note = "bars leave all of these epsilons open: the data are too bright for the accuracy of the engine's sums";
        return EpsilonChoice { epsilon: None, open: Some(open), note: Some(note.to_owned()) };
    }
    let is_end = at == 0 || at + 1 == scores.len();
    let fitted = |k: usize| if is_positive { values[k].ln() } else { values[k] };
    let epsilon = if is_end {
        scores[at].0
    } else {
        vertex([at - 1, at, at + 1].map(|k| (scores[k].0.ln(), fitted(k)))).exp()
    };
    let note = is_end.then(|| "at the end of these epsilons: it may lie beyond".to_owned());
    EpsilonChoice { epsilon: Some(epsilon), open: Some(open), note }
}

fn noted(choice: EpsilonChoice, thermal_noise: bool) -> EpsilonChoice {
    if thermal_noise || choice.note.is_some() {
        return choice;
    }
    let note = Some("for noise of the weights, which these data are without".to_owned());
    EpsilonChoice { note, ..choice }
}

fn corner(points: &[EpsilonPoint]) -> EpsilonChoice {
    if points.iter().any(|p| p.residual_error > OPEN_MAX * p.residual) {
        let note = Some("the residual is not known well enough".to_owned());
        return EpsilonChoice { note, ..EpsilonChoice::default() };
    }
    let sharpest = points
        .iter()
        .filter_map(|p| Some((p.epsilon, p.curvature.filter(|c| *c > 0.0)?)))
        .max_by(|a, b| a.1.total_cmp(&b.1));
    match sharpest {
        Some((epsilon, _)) => EpsilonChoice { epsilon: Some(epsilon), ..EpsilonChoice::default() },
        None => {
            EpsilonChoice { note: Some("the curve has no corner".to_owned()), ..EpsilonChoice::default() }
        }
    }
}

/// Place of the vertex of the parabola through three points, of which the middle one is lowest.
fn vertex([(x0, y0), (x1, y1), (x2, y2)]: [(f64, f64); 3]) -> f64 {
    let (left, right) = ((y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1));
    let bend = (right - left) / (x2 - x0);
    if bend > 0.0 { (0.5 * (x0 + x1 - left / bend)).clamp(x0, x2) } else { x1 }
}

/// Curvature of the circle through three points, positive if the way turns left; `None` if it has no size.
fn curvature(points: &[(f64, f64)]) -> Option<f64> {
    let [a, b, c] = points else { return None };
    let side = |p: &(f64, f64), q: &(f64, f64)| (q.0 - p.0).hypot(q.1 - p.1);
    let cross = (b.0 - a.0) * (c.1 - b.1) - (b.1 - a.1) * (c.0 - b.0);
    let curvature = 2.0 * cross / (side(a, b) * side(b, c) * side(a, c));
    curvature.is_finite().then_some(curvature)
}

/// Choices as a table (CSV), a line an epsilon.
#[must_use]
pub fn epsilons_csv(all: &[EpsilonChoices]) -> String {
    let mut text =
        "of,frequency_hz,numbers,epsilon,residual,residual_error,solution_k2,measured,cross_validation,\
                    cross_validation_error,risk,risk_error,l_curve_curvature\n"
            .to_owned();
    let number = |value: Option<f64>| value.map_or_else(String::new, |value| format!("{value:e}"));
    for choices in all {
        let of = choices.of.replace(['"', ',', '\n'], " ");
        for p in &choices.points {
            let values = [
                Some(p.epsilon),
                Some(p.residual),
                Some(p.residual_error),
                Some(p.solution_k2),
                Some(p.measured),
                p.cross_validation,
                p.cross_validation_error,
                Some(p.risk),
                Some(p.risk_error),
                p.curvature,
            ];
            // Writing to a string does not fail.
            let _ = writeln!(
                text,
                "{of},{},{},{}",
                choices.frequency_hz,
                choices.numbers,
                values.map(number).join(",")
            );
        }
    }
    text
}

/// Curves of what each rule sees.
///
/// # Errors
/// Nothing to draw.
pub fn draw_epsilons(title: &str, all: &[EpsilonChoices]) -> Result<Picture, PictureError> {
    let curves = |get: &dyn Fn(&EpsilonPoint) -> (f64, f64)| -> Vec<Curve> {
        let one = |choices: &EpsilonChoices| Curve {
            label: format!("{}, {:.3} MHz", choices.of, choices.frequency_hz / 1e6),
            points: choices.points.iter().map(get).collect(),
            dashed: false,
        };
        all.iter().take(7).map(one).collect()
    };
    let log = |label: &str| Axis { label: label.to_owned(), log: true, limits: None };
    let plot = |title: &str, x: Axis, y: Axis, curves: Vec<Curve>| Plot {
        title: title.to_owned(),
        x,
        y,
        curves,
        levels: Vec::new(),
    };
    let least_risk =
        |choices: &EpsilonChoices| choices.points.iter().map(|p| p.risk).fold(f64::INFINITY, f64::min);
    let mut risks = curves(&|p| (p.epsilon, p.risk));
    for (curve, choices) in risks.iter_mut().zip(all) {
        let least = least_risk(choices);
        // A logarithm has no place for the least itself.
        curve.points.iter_mut().for_each(|point| point.1 += 1.0 - least);
    }
    let plots = [
        plot(
            "Generalised cross-validation",
            log("epsilon"),
            log("n rho² / (n - Tr H)²"),
            curves(&|p| (p.epsilon, p.cross_validation.unwrap_or(f64::NAN))),
        ),
        plot("Predictive risk above the least", log("epsilon"), log("rho² + 2 Tr H - least + 1"), risks),
        plot(
            "L-curve",
            log("rho², units of noise"),
            log("square of the solution (K²)"),
            curves(&|p| (p.residual, p.solution_k2)),
        ),
        plot(
            "Unknowns that the data decide",
            log("epsilon"),
            log("Tr H"),
            curves(&|p| (p.epsilon, p.measured)),
        ),
    ];
    draw_plots(title, &plots, 2)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(epsilon: f64, score: f64, error: f64) -> EpsilonPoint {
        EpsilonPoint {
            epsilon,
            residual: 1.0,
            residual_error: 0.0,
            solution_k2: 1.0,
            measured: 0.0,
            cross_validation: Some(score),
            cross_validation_error: Some(error),
            risk: score,
            risk_error: error,
            curvature: None,
        }
    }

    #[test]
    fn the_least_of_a_parabola_is_found_between_the_points() {
        // (ln epsilon - ln 3e-4)^2 is least at 3e-4.
        let score = |epsilon: f64| (epsilon / 3e-4).ln().powi(2);
        let points: Vec<EpsilonPoint> =
            [1e-6, 1e-5, 1e-4, 1e-3, 1e-2].map(|e| at(e, score(e), 1e-3)).to_vec();
        let found = least(&points, |p| Some((p.risk, p.risk_error)), false);
        assert!((found.epsilon.unwrap() / 3e-4 - 1.0).abs() < 1e-9, "{found:?}");
        // (ln 3)^2 and (ln 10/3)^2 are further apart than the bars, and other decades much more.
        assert_eq!((found.open, found.note), (Some([1e-4, 1e-4]), None));
        // Bars of 1 do not tell 1e-4 from 1e-3; those of 100 nothing at all.
        let with =
            |error: f64| points.iter().map(|p| EpsilonPoint { risk_error: error, ..*p }).collect::<Vec<_>>();
        let wide = least(&with(1.0), |p| Some((p.risk, p.risk_error)), false);
        assert_eq!(wide.open, Some([1e-4, 1e-3]));
        let lost = least(&with(100.0), |p| Some((p.risk, p.risk_error)), false);
        assert!(lost.epsilon.is_none() && lost.note.unwrap().contains("too bright"));
        // At an end it says so.
        let end = least(&points[3..], |p| Some((p.risk, p.risk_error)), false);
        assert!(end.epsilon == Some(1e-3) && end.note.unwrap().contains("beyond"));
    }

    #[test]
    fn the_corner_is_where_the_curve_turns_left_most() {
        // On a circle of radius 2 the curvature is 1 / 2, whichever points; turning right it is negative.
        let circle = |angle: f64| (2.0 * angle.cos(), 2.0 * angle.sin());
        let three = [3.5, 4.0, 4.2].map(circle);
        assert!((curvature(&three).unwrap() - 0.5).abs() < 1e-12);
        let back = [three[2], three[1], three[0]];
        assert!((curvature(&back).unwrap() + 0.5).abs() < 1e-12);
        assert_eq!(curvature(&[three[0], three[0], three[1]]), None);
        let mut points: Vec<EpsilonPoint> = [1e-3, 1e-2, 1e-1].map(|e| at(e, 1.0, 0.0)).to_vec();
        points[1].curvature = Some(3.0);
        points[0].curvature = Some(1.0);
        assert_eq!(corner(&points).epsilon, Some(1e-2));
        points[2].residual_error = 0.5;
        assert!(corner(&points).note.unwrap().contains("not known"));
    }
}
