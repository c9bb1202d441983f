//! Chooses epsilon by four rules, from runs that differ only in epsilon.
//!
//! epsilon scales the regularisation R. Let A be the normal matrix, `H = A (A + R)^-1`, n the number of real-valued data, and `rho^2 = |V - B T|^2` in units of their noise:
//!
//! - crossing: thermal-noise variance equals regularisation bias, `Tr Sigma_n = T^2 Tr Sigma_s` (the paper, Fig. 15);
//! - generalised cross-validation: the minimum of `n rho^2 / (n - Tr H)^2` (Golub, Heath & Wahba 1979, Technometrics 21, 215). Takes
//!   the noise level from the data;
//! - predictive risk: the minimum of `rho^2 + 2 Tr H - n` (Mallows' C_L, 1973, Technometrics 15, 661). Takes the noise level from
//!   the weights; only differences of `rho^2` matter;
//! - L-curve: the corner of `|T - T_p|^2` against `rho^2`, both logarithmic (Hansen 1992, SIAM Review 34, 561).
//!
//! The uncertainties of `rho^2` and of the traces limit the second and third rule. A choice comes with the range of epsilons whose
//! error bars overlap that of the minimum. If these are all epsilons, there is no choice.

use std::fmt::Write;

use serde::Serialize;

use super::pictures::{Axis, Curve, Picture, PictureError, Plot, draw_plots};
use super::runs::{ChannelFigures, RunFigures, crossings};

/// Maximum relative uncertainty of the residual for an L-curve.
const RESIDUAL_UNCERTAINTY_MAX: f64 = 0.1;

/// The quantities of one solution that the rules use.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct EpsilonPoint {
    /// epsilon of the solution.
    pub epsilon: f64,
    /// `rho^2`.
    pub residual: f64,
    /// Bound on the error of `residual`.
    pub residual_error: f64,
    /// `|T - T_p|^2` over pixels, K^2.
    pub solution_k2: f64,
    /// Effective number of parameters, `Tr H`.
    #[serde(rename = "measured")]
    pub effective_parameters: f64,
    /// `n rho^2 / (n - Tr H)^2`, 1 for noise alone; `None` if `n <= Tr H`.
    pub cross_validation: Option<f64>,
    /// Bound on the error of `cross_validation`.
    pub cross_validation_error: Option<f64>,
    /// `rho^2 + 2 Tr H - n`, the expected squared prediction error in units of the noise, if the noise is that of the weights.
    pub risk: f64,
    /// Bound on the error of `risk`.
    pub risk_error: f64,
    /// Curvature of the L-curve, positive at the corner; `None` at the ends.
    pub curvature: Option<f64>,
}

/// The choice of one rule.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct EpsilonChoice {
    /// The chosen epsilon, interpolated by a parabola; `None` if there is no choice.
    pub epsilon: Option<f64>,
    /// Range of epsilons that the error bars do not exclude.
    #[serde(rename = "open")]
    pub range: Option<[f64; 2]>,
    /// Reason why there is no choice, or a caveat on it.
    pub note: Option<String>,
}

/// The choices for one channel of runs that differ only in epsilon.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EpsilonChoices {
    /// Label of the first run.
    #[serde(rename = "of")]
    pub run_label: String,
    /// Frequency of the channel, Hz.
    pub frequency_hz: f64,
    /// Number of real-valued data, n.
    #[serde(rename = "numbers")]
    pub real_data: u64,
    /// `V'N^-1V / n`, which is 1 plus the square of the signal-to-noise ratio.
    #[serde(rename = "power_a_number")]
    pub power_per_datum: f64,
    /// Choice by the crossing of the traces.
    pub crossing: EpsilonChoice,
    /// Choice by generalised cross-validation.
    pub cross_validation: EpsilonChoice,
    /// Choice by the predictive risk.
    pub risk: EpsilonChoice,
    /// Choice by the corner of the L-curve.
    pub l_curve: EpsilonChoice,
    /// The quantities that the rules use, by epsilon.
    pub points: Vec<EpsilonPoint>,
}

/// Chooses epsilon for groups of runs that differ only in epsilon, if at least three have traces.
#[must_use]
pub fn epsilon_choices(groups: &[Vec<&RunFigures>]) -> Vec<EpsilonChoices> {
    let mut found = Vec::new();
    for group in groups {
        for channel in 0..group.first().map_or(0, |run| run.channels.len()) {
            let channels: Vec<&ChannelFigures> =
                group.iter().filter_map(|run| run.channels.get(channel)).collect();
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
        run_label: group.first()?.label.clone(),
        frequency_hz: first.frequency_hz,
        real_data: fit.numbers,
        power_per_datum: fit.data_power / fit.numbers as f64,
        crossing: EpsilonChoice {
            epsilon: crossing,
            range: None,
            note: crossing
                .is_none()
                .then(|| "the traces do not cross within the computed epsilons".to_owned()),
        },
        cross_validation: choose_minimum(&points, |p| p.cross_validation.zip(p.cross_validation_error), true),
        risk: with_noise_caveat(
            choose_minimum(&points, |p| Some((p.risk, p.risk_error)), false),
            first.thermal_noise,
        ),
        l_curve: corner(&points),
        points,
    })
}

fn point(channel: &ChannelFigures) -> Option<EpsilonPoint> {
    let (fit, traces) = (channel.diagnostics.fit.as_ref()?, channel.diagnostics.traces.as_ref()?);
    let measured = traces.measured?;
    let (n, residual) = (fit.numbers as f64, fit.residual);
    // A single probe gives no error estimate of a trace.
    let (residual_error, measured_error) = (residual.error, measured.error);
    if residual_error.is_infinite() {
        return None;
    }
    let degrees_of_freedom = n - measured.value;
    let square = degrees_of_freedom * degrees_of_freedom;
    let score = (degrees_of_freedom > 0.0).then(|| n * residual.value / square);
    let score_error = score
        .map(|score| n * residual_error / square + 2.0 * score.abs() * measured_error / degrees_of_freedom);
    Some(EpsilonPoint {
        epsilon: channel.diagnostics.epsilon?,
        residual: residual.value,
        residual_error,
        solution_k2: fit.solution_k2,
        effective_parameters: measured.value,
        cross_validation: score,
        cross_validation_error: score_error,
        risk: residual.value + 2.0 * measured.value - n,
        risk_error: residual_error + 2.0 * measured_error,
        curvature: None,
    })
}

/// Chooses the epsilon with the minimum score, and the range that the error bars do not exclude. Positive scores are interpolated
/// as logarithms.
fn choose_minimum(
    points: &[EpsilonPoint],
    score: impl Fn(&EpsilonPoint) -> Option<(f64, f64)>,
    is_positive: bool,
) -> EpsilonChoice {
    let scores: Vec<(f64, f64, f64)> =
        points.iter().filter_map(|p| score(p).map(|(value, error)| (p.epsilon, value, error))).collect();
    let values: Vec<f64> = scores.iter().map(|s| s.1).collect();
    let Some(at) = (0..values.len()).min_by(|&a, &b| values[a].total_cmp(&values[b])) else {
        return EpsilonChoice {
            note: Some("fewer data than effective parameters (n <= Tr H)".to_owned()),
            ..EpsilonChoice::default()
        };
    };
    let bound = scores.iter().map(|(_, value, error)| value + error).fold(f64::INFINITY, f64::min);
    let not_excluded = scores.iter().filter(|(_, value, error)| value - error <= bound).map(|s| s.0);
    let range = not_excluded.fold([f64::INFINITY, 0.0], |[low, high], e| [e.min(low), e.max(high)]);
    let is_all = range[0] <= scores[0].0 && range[1] >= scores[scores.len() - 1].0;
    if is_all || (is_positive && values[at] <= 0.0) {
        let note = "the error bars exclude none of the computed epsilons: the signal-to-noise ratio is too high for the precision of the sums";
        return EpsilonChoice { epsilon: None, range: Some(range), note: Some(note.to_owned()) };
    }
    let is_end = at == 0 || at + 1 == scores.len();
    let fitted = |k: usize| if is_positive { values[k].ln() } else { values[k] };
    let epsilon = if is_end {
        scores[at].0
    } else {
        vertex([at - 1, at, at + 1].map(|k| (scores[k].0.ln(), fitted(k)))).exp()
    };
    let note = is_end.then(|| "at the edge of the computed epsilons: the minimum may lie outside".to_owned());
    EpsilonChoice { epsilon: Some(epsilon), range: Some(range), note }
}

/// Adds a caveat to a choice that assumes thermal noise, if the data have none.
fn with_noise_caveat(choice: EpsilonChoice, thermal_noise: bool) -> EpsilonChoice {
    if thermal_noise || choice.note.is_some() {
        return choice;
    }
    let note = Some("assumes the thermal noise of the weights, but these data are noiseless".to_owned());
    EpsilonChoice { note, ..choice }
}

fn corner(points: &[EpsilonPoint]) -> EpsilonChoice {
    if points.iter().any(|p| p.residual_error > RESIDUAL_UNCERTAINTY_MAX * p.residual) {
        let note = Some("the uncertainty of the residual is too large".to_owned());
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

/// Position of the vertex of the parabola through three points, of which the middle one is lowest.
fn vertex([(x0, y0), (x1, y1), (x2, y2)]: [(f64, f64); 3]) -> f64 {
    let (left, right) = ((y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1));
    let bend = (right - left) / (x2 - x0);
    if bend > 0.0 { (0.5 * (x0 + x1 - left / bend)).clamp(x0, x2) } else { x1 }
}

/// Signed curvature of the circle through three points, positive if counter-clockwise; `None` if points coincide.
fn curvature(points: &[(f64, f64)]) -> Option<f64> {
    let [a, b, c] = points else { return None };
    let side = |p: &(f64, f64), q: &(f64, f64)| (q.0 - p.0).hypot(q.1 - p.1);
    let cross = (b.0 - a.0) * (c.1 - b.1) - (b.1 - a.1) * (c.0 - b.0);
    let curvature = 2.0 * cross / (side(a, b) * side(b, c) * side(a, c));
    curvature.is_finite().then_some(curvature)
}

/// Formats the choices as a CSV table with one line per epsilon.
#[must_use]
pub fn epsilons_csv(all: &[EpsilonChoices]) -> String {
    let mut text =
        "of,frequency_hz,numbers,epsilon,residual,residual_error,solution_k2,measured,cross_validation,\
                    cross_validation_error,risk,risk_error,l_curve_curvature\n"
            .to_owned();
    let number = |value: Option<f64>| value.map_or_else(String::new, |value| format!("{value:e}"));
    for choices in all {
        let label = choices.run_label.replace(['"', ',', '\n'], " ");
        for p in &choices.points {
            let values = [
                Some(p.epsilon),
                Some(p.residual),
                Some(p.residual_error),
                Some(p.solution_k2),
                Some(p.effective_parameters),
                p.cross_validation,
                p.cross_validation_error,
                Some(p.risk),
                Some(p.risk_error),
                p.curvature,
            ];
            let _ = writeln!(
                text,
                "{label},{},{},{}",
                choices.frequency_hz,
                choices.real_data,
                values.map(number).join(",")
            );
        }
    }
    text
}

/// Draws the quantities that the rules use against epsilon.
///
/// # Errors
/// Nothing to draw.
pub fn draw_epsilons(title: &str, all: &[EpsilonChoices]) -> Result<Picture, PictureError> {
    let curves = |get: &dyn Fn(&EpsilonPoint) -> (f64, f64)| -> Vec<Curve> {
        let curve = |choices: &EpsilonChoices| Curve {
            label: format!("{}, {:.3} MHz", choices.run_label, choices.frequency_hz / 1e6),
            points: choices.points.iter().map(get).collect(),
            dashed: false,
        };
        all.iter().take(7).map(curve).collect()
    };
    let log = |label: &str| Axis { label: label.to_owned(), log: true, limits: None };
    let plot = |title: &str, x: Axis, y: Axis, curves: Vec<Curve>| Plot {
        title: title.to_owned(),
        x,
        y,
        curves,
        levels: Vec::new(),
    };
    let minimum_risk =
        |choices: &EpsilonChoices| choices.points.iter().map(|p| p.risk).fold(f64::INFINITY, f64::min);
    let mut risks = curves(&|p| (p.epsilon, p.risk));
    for (curve, choices) in risks.iter_mut().zip(all) {
        let minimum = minimum_risk(choices);
        // Offset by 1, so that the minimum itself is visible on a logarithmic axis.
        curve.points.iter_mut().for_each(|point| point.1 += 1.0 - minimum);
    }
    let plots = [
        plot(
            "Generalised cross-validation",
            log("epsilon"),
            log("n rho² / (n - Tr H)²"),
            curves(&|p| (p.epsilon, p.cross_validation.unwrap_or(f64::NAN))),
        ),
        plot("Predictive risk minus its minimum", log("epsilon"), log("rho² + 2 Tr H - minimum + 1"), risks),
        plot(
            "L-curve",
            log("rho², units of noise"),
            log("square of the solution (K²)"),
            curves(&|p| (p.residual, p.solution_k2)),
        ),
        plot(
            "Effective number of parameters",
            log("epsilon"),
            log("Tr H"),
            curves(&|p| (p.epsilon, p.effective_parameters)),
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
            effective_parameters: 0.0,
            cross_validation: Some(score),
            cross_validation_error: Some(error),
            risk: score,
            risk_error: error,
            curvature: None,
        }
    }

    #[test]
    fn the_minimum_of_a_parabola_is_found_between_the_points() {
        // (ln epsilon - ln 3e-4)^2 is smallest at 3e-4.
        let score = |epsilon: f64| (epsilon / 3e-4).ln().powi(2);
        let points: Vec<EpsilonPoint> =
            [1e-6, 1e-5, 1e-4, 1e-3, 1e-2].map(|e| at(e, score(e), 1e-3)).to_vec();
        let found = choose_minimum(&points, |p| Some((p.risk, p.risk_error)), false);
        assert!((found.epsilon.unwrap() / 3e-4 - 1.0).abs() < 1e-9, "{found:?}");
        // (ln 3)^2 and (ln 10/3)^2 differ by more than the error bars, and other decades by much more.
        assert_eq!((found.range, found.note), (Some([1e-4, 1e-4]), None));
        // Error bars of 1 do not separate 1e-4 from 1e-3; those of 100 exclude nothing.
        let with =
            |error: f64| points.iter().map(|p| EpsilonPoint { risk_error: error, ..*p }).collect::<Vec<_>>();
        let wide = choose_minimum(&with(1.0), |p| Some((p.risk, p.risk_error)), false);
        assert_eq!(wide.range, Some([1e-4, 1e-3]));
        let lost = choose_minimum(&with(100.0), |p| Some((p.risk, p.risk_error)), false);
        assert!(lost.epsilon.is_none() && lost.note.unwrap().contains("exclude none"));
        // A minimum at the edge has a caveat.
        let end = choose_minimum(&points[3..], |p| Some((p.risk, p.risk_error)), false);
        assert!(end.epsilon == Some(1e-3) && end.note.unwrap().contains("outside"));
    }

    #[test]
    fn the_corner_has_the_largest_positive_curvature() {
        // On a circle of radius 2 the curvature is 1 / 2, and negative clockwise.
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
        assert!(corner(&points).note.unwrap().contains("too large"));
    }
}
