//! The step ratio q0 of the formation against the ratios R and R_2 of its breathing (the paper, Sect. 3.1 and Fig. 3).

use std::fmt::Write;

use serde::Serialize;

use super::error::FigureError;
use super::output::FigureParts;
use crate::array::Progression;
use crate::pipeline::Plan;
use crate::products::pictures::{Axis, Curve, Plot, draw_plots};

/// Values of R_2, one for each curve: the paper's.
const FIRST_RATIOS: [f64; 3] = [3.0, 6.0, 9.0];
/// Number of values of R, from 1 to 10.
const RATIO_STEPS: usize = 91;

#[derive(Serialize)]
struct SpacingNumbers {
    ratio: f64,
    first_ratio: f64,
    q0: f64,
    scale_m: f64,
    offset_m: f64,
    /// Curves of q0 against R, one for each R_2.
    curves: Vec<SpacingCurve>,
}

#[derive(Serialize)]
struct SpacingCurve {
    first_ratio: f64,
    ratio: Vec<f64>,
    /// Values of q0; `None` if no progression has these spacings.
    q0: Vec<Option<f64>>,
}

pub(super) fn make(plan: &Plan) -> Result<FigureParts, FigureError> {
    let config = &plan.config.array;
    if !config.arcs_m.is_empty() || plan.array.formation().is_none() {
        return Err(FigureError::NoProgression);
    }
    let configured = Progression::new(config)?;
    let q0 = |ratio: f64, first_ratio: f64| {
        let mut config = config.clone();
        (config.breathing.ratio, config.breathing.first_ratio) = (ratio, first_ratio);
        Progression::new(&config).ok().map(|progression| progression.step_ratio)
    };
    let ratios: Vec<f64> = (0..RATIO_STEPS).map(|k| 1.0 + k as f64 / 10.0).collect();
    let curve = |first_ratio: f64| SpacingCurve {
        first_ratio,
        ratio: ratios.clone(),
        q0: ratios.iter().map(|&ratio| q0(ratio, first_ratio)).collect(),
    };
    let curves: Vec<SpacingCurve> = FIRST_RATIOS.into_iter().map(curve).collect();
    let breathing = &config.breathing;
    let numbers = SpacingNumbers {
        ratio: breathing.ratio,
        first_ratio: breathing.first_ratio,
        q0: configured.step_ratio,
        scale_m: configured.scale_m,
        offset_m: configured.offset_m,
        curves,
    };
    let mut csv = "ratio,first_ratio,q0\n".to_owned();
    for curve in &numbers.curves {
        for (ratio, q0) in curve.ratio.iter().zip(&curve.q0) {
            let q0 = q0.map_or_else(String::new, |q0| format!("{q0:.10}"));
            let _ = writeln!(csv, "{ratio},{},{q0}", curve.first_ratio);
        }
    }
    let drawn = |curve: &SpacingCurve| Curve {
        label: format!("R_{{2}} = {}", curve.first_ratio),
        points: curve.ratio.iter().zip(&curve.q0).map(|(r, q0)| (*r, q0.unwrap_or(f64::NAN))).collect(),
        dashed: false,
    };
    let plot = Plot {
        title: format!(
            "Steps of {} daughters over {:.0} km; here R = {}, R_{{2}} = {}: q_{{0}} = {:.5}",
            config.satellites,
            breathing.span_m_max / 1e3,
            breathing.ratio,
            breathing.first_ratio,
            configured.step_ratio
        ),
        x: Axis { label: "R".to_owned(), ..Axis::default() },
        y: Axis { label: "q_{0}".to_owned(), ..Axis::default() },
        curves: numbers.curves.iter().map(drawn).collect(),
        levels: vec![configured.step_ratio],
    };
    let picture = draw_plots("", &[plot], 1)?;
    Ok(FigureParts::new(&numbers, csv, picture))
}
