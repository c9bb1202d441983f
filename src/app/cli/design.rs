//! `lunarray design`: search an array with less noise.

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::arguments::{default_out, output_path, size_bytes};
use super::interrupt::Interrupt;
use super::log::say;
use super::output::{CommandResult, print_json_line, print_text};
use super::study::StudyLines;
use crate::files::ProtectedInputs;
use crate::pipeline::{
    Design, DesignObjective, DesignRuns, DesignStep, DesignSummary, MemoryLimit, NotCompared, run_design,
    use_threads,
};

/// Search spacings, orbits or other settings of array and spacecraft for less noise at chosen degrees.
///
/// The design file (TOML) names a pipeline to start from, settings with their ranges in the units of their keys, and limits:
///
/// pipeline = "six.toml"; degrees = [2, 17]; objective = "noise"; evaluations = 150; seed = 0
/// [[parameter]] with key = "array.arcs_m" (all arcs, in ascending order), "array.altitude_m" or "array.kepler[0].eccentricity"; from, to
/// [limits] closest_m_min = 100, span_m_min = 5e4, span_m_max = 1e5, keeping_m_s_per_year_max = 10 (velocity changes for breathing)
/// check = ["seed=7", "spacecraft.thin=300"]: settings of the runs that check the result; by default another sky, noise and epoch
///
/// It lowers the geometric mean of 1 / SNR_l, or, with objective = "modes", the modes that are not measured; both follow from positions and
/// weights of baselines below 4.9 wavelengths, for a map with R from the sky's own power; longer ones, which see less of these degrees (a quarter
/// of the information at l = 18, 6 % at 10, if as many), are left out. Values spread
/// over the ranges come first, then steps of each from the best; ranges of a factor of ten or more are searched in logarithms. The orbital
/// period and that of the node follow altitude and inclination. Off one circle, distances are taken at 64 instants of each orbit, or of 256
/// orbits of a mission with more: satellites may come closer between them.
///
/// Leaves design.toml, the pipeline of the design, design.json and trials.csv, and what a study of start and design leaves, both with the
/// settings of the check, which the search has not seen.
///
/// Example: lunarray design better.toml --out out/better
#[derive(Debug, Args)]
pub(super) struct DesignArgs {
    /// Design file (TOML).
    #[arg(value_name = "DESIGN.toml")]
    design: PathBuf,
    /// Output folder; by default out/NAME.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: Option<PathBuf>,
    /// Replace one setting of the pipeline to start from, for example --set map.nside=16; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Do not run start and design to check the result.
    #[arg(long)]
    no_check: bool,
    /// Maximum memory of a run that checks the result, by the estimate, with a unit, such as 8GB or 16GiB; by default what the machine has available.
    #[arg(long, value_name = "SIZE", value_parser = size_bytes)]
    memory_max: Option<u64>,
    /// Print the result as one JSON object.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &DesignArgs) -> CommandResult {
    let design = Design::read(&args.design, &args.overrides)?;
    let _inputs =
        ProtectedInputs::of(design.plan.config.input_files().into_iter().chain([args.design.clone()]));
    let limit = args.memory_max.map(MemoryLimit::of_user).or_else(MemoryLimit::of_machine);
    let runs = if args.no_check { DesignRuns::Without } else { DesignRuns::Within(limit) };
    use_threads(&design.plan.config.runtime)?;
    let out = args.out.clone().map_or_else(|| default_out(&design.name), Ok)?;
    let interrupt = Interrupt::default();
    let (mut lines, mut shown) = (StudyLines::default(), f64::INFINITY);
    let summary = run_design(&design, &out, runs, interrupt.cancel(), &mut |step| match step {
        DesignStep::Trial(number, trial, least) => {
            interrupt.arm_or_note();
            if least < shown || number % 25 == 0 {
                let of = design.evaluations;
                let fields = json!({ "number": number, "of": of, "values": trial.values, "least": least });
                let what = named(design.objective);
                let told = match least.is_finite() {
                    true => format!("{what} {least:.3} of the start's"),
                    false => "none is within the limits yet".to_owned(),
                };
                say("trial", &fields, format_args!("array {number} of {of}: {told}"));
            }
            shown = shown.min(least);
        }
        DesignStep::Check(study, event, view) => lines.show(study, event, *view, &interrupt),
    })?;
    drop(lines);
    interrupt.completion(summary.cancelled).after(if args.json {
        print_json_line(&summary)
    } else {
        print_text(&format!("{}\n\nThe pipeline is {}", report(&summary), out.join("design.toml").display()))
    })
}

fn named(objective: DesignObjective) -> &'static str {
    match objective {
        DesignObjective::Noise => "noise relative to the sky",
        DesignObjective::Modes => "modes not measured",
    }
}

fn report(summary: &DesignSummary) -> String {
    let [first, last] = summary.degrees;
    let change = |ratio: f64| format!("{:+.1} %", 100.0 * (ratio - 1.0));
    let mut lines = vec![format!("{} arrays were tried. The best:", summary.trials)];
    lines.extend(summary.settings.iter().map(|set| format!("  {set}")));
    let estimated = summary.best.ratio.map_or_else(String::new, change);
    let what = named(summary.objective);
    lines.push(format!(
        "{what} at l = {first} to {last}, against the start's: {estimated} by the search's estimate"
    ));
    let Some(check) = &summary.check else {
        lines.push("It was not checked by runs.".to_owned());
        return lines.join("\n");
    };
    let settings = check.settings.join(", ");
    lines.push(match check.noise_ratio.zip(check.noise_sigma) {
        Some((ratio, sigma)) => {
            let percent = 100.0 * ratio * sigma;
            format!("noise relative to the sky: {} +- {percent:.1} % by runs with {settings}", change(ratio))
        }
        None => format!("runs with {settings} have no SNR_l to compare"),
    });
    for NotCompared { frequency_hz, l } in &check.not_compared {
        let degrees = l.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
        lines.push(format!(
            "not compared, as SNR_l is not known: {:.3} MHz, l = {degrees}",
            frequency_hz / 1e6
        ));
    }
    if check.by_degree.is_empty() {
        return lines.join("\n");
    }
    lines.push(format!("{:>9} {:>4} {:>9}  {:<17}  {}", "MHz", "l", "noise", "rho_l", "measured modes"));
    for degree in &check.by_degree {
        let pair = |values: [Option<f64>; 2], decimals: usize| {
            let text = values.map(|v| v.map_or_else(|| "-".to_owned(), |v| format!("{v:.decimals$}")));
            text.join(" > ")
        };
        lines.push(format!(
            "{:>9.3} {:>4} {:>9}  {:<17}  {}",
            degree.frequency_hz / 1e6,
            degree.l,
            change(degree.noise_ratio),
            pair(degree.rho, 4),
            pair(degree.modes, 2)
        ));
    }
    lines.join("\n")
}
