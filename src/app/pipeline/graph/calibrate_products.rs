//! The products of a calibration: tables, a picture, and the file of gains.

use std::path::Path;

use serde::Serialize;

use super::found_solutions::{CalibrateSummary, FoundSolutions};
use crate::calibration::solver::{GainEstimate, GainState, PassSolution, solutions_csv};
use crate::pipeline::config::PipelineError;
use crate::products::pictures::{Axis, Curve, Plot, draw_plots};
use crate::products::{ProductsError, write_product};
use crate::units::constants::DAY_S;

pub(in crate::pipeline) fn write_json(path: &Path, value: &impl Serialize) -> Result<(), PipelineError> {
    let text = serde_json::to_vec(value)
        .map_err(|error| ProductsError::Encode { path: path.to_owned(), reason: error.to_string() })?;
    Ok(write_product(path, text)?)
}

/// Content of `solutions.json`.
#[derive(Serialize)]
struct SolutionsFile<'a> {
    summary: &'a CalibrateSummary,
    solutions: &'a [PassSolution],
}

/// Writes all products; `gains.json` last.
pub(in crate::pipeline) fn write_products(
    out: &Path,
    found: &FoundSolutions,
    summary: &CalibrateSummary,
    pictures: bool,
) -> Result<(), PipelineError> {
    let solutions = &found.solutions[..];
    write_product(&out.join("solutions.csv"), solutions_csv(solutions))?;
    write_json(&out.join("solutions.json"), &SolutionsFile { summary, solutions })?;
    if pictures && !solutions.is_empty() {
        let channels = found.instrument.as_ref().map_or(0, |instrument| instrument.channels.len());
        let plots: Vec<Plot> = (0..channels).flat_map(|channel| plots(solutions, channel)).collect();
        let picture = draw_plots("Gains by daughter and day", &plots, 2).map_err(ProductsError::from)?;
        picture.write(&out.join("solutions.png")).map_err(ProductsError::from)?;
    }
    // If it exists, all other products do.
    match found.gains(false) {
        Some(gains) => write_json(&out.join("gains.json"), &gains),
        // Gains of an earlier command would be taken for the result of this one.
        None => match std::fs::remove_file(out.join("gains.json")) {
            Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
                Err(ProductsError::Write { path: out.join("gains.json"), source }.into())
            }
            _ => Ok(()),
        },
    }
}

fn plots(solutions: &[PassSolution], channel: usize) -> [Plot; 2] {
    let satellites = solutions.first().map_or(0, |solution| solution.daughters.len());
    let frequency_hz =
        solutions.first().map_or(0.0, |solution| solution.daughters[0].gains[channel].frequency_hz);
    let plot = |name: &str, label: &str, quantity: &dyn Fn(&GainEstimate) -> f64| {
        let curve = |n: usize| {
            let point = |solution: &PassSolution| {
                let gain = &solution.daughters[n].gains[channel];
                let value = if gain.state == GainState::Good { quantity(gain) } else { f64::NAN };
                (0.5 * (solution.from_s + solution.until_s) / DAY_S, value)
            };
            let points = solutions.iter().map(point).collect();
            Curve { label: format!("daughter {}", n + 1), points, dashed: false }
        };
        Plot {
            title: format!("{name} at {:.3} MHz", frequency_hz / 1e6),
            x: Axis { label: "day of the mission".to_owned(), ..Axis::default() },
            y: Axis { label: label.to_owned(), ..Axis::default() },
            curves: (0..satellites).map(curve).collect(),
            levels: Vec::new(),
        }
    };
    [
        plot("Phase", "phase (deg)", &|gain| gain.phase_deg),
        plot("Amplitude", "amplitude", &|gain| gain.amplitude),
    ]
}
