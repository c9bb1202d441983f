//! `lunarray study`: run a pipeline at every combination of some settings.

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::arguments::{default_out, output_path, size_bytes};
use super::interrupt::Interrupt;
use super::log::say;
use super::output::{CommandResult, print_json_line, print_notes, print_text};
use super::progress::{CalibrateLines, Progress};
use crate::files::ProtectedInputs;
use crate::pipeline::{
    INTEGRATE, JobEvent, MemoryLimit, READ, RunView, Segment, Study, StudySummary, run_study, use_threads,
};
use crate::products::{Crossing, EpsilonChoice, EpsilonChoices};

/// Run a pipeline at every combination of some settings, and show the results side by side.
///
/// A study names a pipeline file and axes: a key with values, or named cases of several settings. Cases that differ only in the
/// ground segment share one simulation, and those that differ only in epsilon or prior share their sums.
///
/// Leaves the products of every case, tables (study.csv, spectra.csv, study.json) and overlaid curves (study.png): rho_l, SNR_l,
/// C_l, and, with map.trace_probes, the traces of thermal noise and imperfection against epsilon, with their crossing, and
/// epsilon as cross-validation, predictive risk and L-curve choose it (epsilons.csv, epsilons.png).
///
/// With `realisations = N` each case is made for N realisations of noise and random errors, for maps of sigma and covariances of
/// C_l and of pixels (`covariance_at_deg`). With `calibrated = true` each case is made twice, from the data as sent and with
/// gains that are found from them; cases with errors of the instrument are compared with the one without.
///
/// To resume after an interruption, repeat the command: finished cases are not made again.
///
/// Example: lunarray study pipelines/paper/fig15-traces.toml --out out/fig15
#[derive(Debug, Args)]
pub(super) struct StudyArgs {
    /// Study file (TOML).
    #[arg(value_name = "STUDY.toml")]
    study: PathBuf,
    /// Output folder; by default out/NAME.
    #[arg(short, long, value_name = "DIR", value_parser = output_path())]
    out: Option<PathBuf>,
    /// Replace one setting in all cases, for example --set map.nside=16; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Keep the downlinks and states that cases share, so that cases can be added without simulating again.
    #[arg(long)]
    keep: bool,
    /// Maximum memory of a case, by the estimate, with a unit, such as 8GB or 16GiB; by default what the machine has available.
    #[arg(long, value_name = "SIZE", value_parser = size_bytes)]
    memory_max: Option<u64>,
    /// Print the results as one JSON object instead of a table.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &StudyArgs) -> CommandResult {
    let study = Study::read(&args.study, &args.overrides)?;
    let configs = study.cases.iter().flat_map(|case| case.plan.config.input_files());
    let _inputs = ProtectedInputs::of(configs.chain([args.study.clone()]));
    let limit = args.memory_max.map(MemoryLimit::of_user).or_else(MemoryLimit::of_machine);
    for case in &study.cases {
        case.plan.cost().require_memory(Segment::Whole, limit)?;
    }
    if let Some(first) = study.cases.first() {
        use_threads(&first.plan.config.runtime)?;
    }
    let out = args.out.clone().map_or_else(|| default_out(&study.name), Ok)?;
    let interrupt = Interrupt::default();
    let mut lines = StudyLines::default();
    let summary = run_study(&study, &out, args.keep, interrupt.cancel(), &mut |event, view| {
        lines.show(&study, event, view, &interrupt);
    })?;
    drop(lines);
    if summary.cancelled {
        let done = summary.cases.len();
        print_notes([format!(
            "{done} of {} cases are finished; repeat the command to go on",
            study.cases.len()
        )]);
    }
    interrupt.completion(summary.cancelled).after(if args.json {
        print_json_line(&summary)
    } else {
        print_text(&format!("{}\nTables, curves and products are in {}", table(&summary), out.display()))
    })
}

/// Shows the steps of a study.
#[derive(Default)]
pub(super) struct StudyLines {
    progress: Option<Progress>,
    gains: Option<(usize, CalibrateLines)>,
}

impl StudyLines {
    pub(super) fn show(
        &mut self,
        study: &Study,
        event: JobEvent,
        view: Option<RunView>,
        interrupt: &Interrupt,
    ) {
        interrupt.arm_or_note();
        let of = study.cases.len();
        let begin = |number: usize, what: &str| {
            let label = study.cases[number].label();
            let fields = json!({ "number": number + 1, "of": of, "what": what, "label": label });
            say("case", &fields, format_args!("case {} of {of}: {what} {label}", number + 1));
        };
        let (number, what, stage, total) = match event {
            JobEvent::Calibrate(number, calibration) => {
                drop(self.progress.take());
                if self.gains.as_ref().is_none_or(|(case, _)| *case != number) {
                    begin(number, "calibrating");
                    self.gains = Some((number, CalibrateLines::new()));
                }
                self.gains.iter_mut().for_each(|(_, lines)| lines.show(&calibration));
                return;
            }
            JobEvent::Simulate(number) => {
                (number, "simulating for", INTEGRATE, study.cases[number].plan.progress_windows())
            }
            JobEvent::Map(step) => (step.number, "mapping", READ, 0),
            JobEvent::Realise(number) => (number, "noise of", READ, 0),
            // The channels of a case are not in groups.
            JobEvent::Sky(_) | JobEvent::Merge => return,
        };
        // The bar of the previous step ends first.
        drop(self.progress.take());
        begin(number, what);
        self.progress = view.map(|view| Progress::watch(view, stage, total, interrupt.cancel()));
    }
}

/// Lines on the power that imperfect instruments preserve, one per case and channel.
fn power_lines(summary: &StudySummary) -> Vec<String> {
    let channels = summary
        .cases
        .iter()
        .flat_map(|case| case.figures.channels.iter().map(move |channel| (&case.figures.label, channel)));
    let number = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.4}"));
    channels
        .filter(|(_, channel)| channel.power_kept.is_some())
        .map(|(label, channel)| {
            let name = format!("{label}, {:.3} MHz", channel.frequency_hz / 1e6);
            let last = 120.min(2 * channel.nside);
            if last < 20 {
                return format!("{name}: the map ends at l = {last}, before l = 20: spectra.csv has C_l and rho_l by degree");
            }
            let [ratio, coherent] = channel.power_kept_means();
            format!(
                "{name}: C_l {} of the ideal instrument's, coherent with the sky {}, rho_l {} (means, l = 20 to {last})",
                number(ratio),
                number(coherent),
                number(channel.rho_mean()),
            )
        })
        .collect()
}

fn table(summary: &StudySummary) -> String {
    let widest =
        summary.cases.iter().map(|case| case.figures.label.chars().count()).max().unwrap_or(4).max(4);
    let mut lines = vec![format!(
        "{:<widest$}  {:>8}  {:>10}  {:>12}  {:>9}  {:>10}  {:>10}  {:>10}",
        "case", "engine", "MHz", "visibilities", "epsilon", "noise, K", "Tr Sigma_n", "Tr Sigma_s"
    )];
    for case in &summary.cases {
        for channel in &case.figures.channels {
            let traces = channel.diagnostics.traces.as_ref();
            let [n, s] = [traces.map(|t| t.sigma_n_k2.value), traces.map(|t| t.sigma_s.value)]
                .map(|value| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.3e}")));
            lines.push(format!(
                "{:<widest$}  {:>8}  {:>10.3}  {:>12}  {:>9}  {:>10.3e}  {n:>10}  {s:>10}",
                case.figures.label,
                case.figures.engine.as_deref().unwrap_or("-"),
                channel.frequency_hz / 1e6,
                channel.visibilities,
                channel
                    .diagnostics
                    .epsilon
                    .map_or_else(|| "-".to_owned(), |epsilon| format!("{epsilon:.1e}")),
                channel.noise_rms_k
            ));
        }
    }
    for spread in &summary.spreads {
        let case = if spread.case.is_empty() { String::new() } else { format!("{}, ", spread.case) };
        lines.push(format!(
            "{case}{:.3} MHz: {} realisations; noise of a pixel {:.3e} K rms, which scatters by {:.1} % over the sphere",
            spread.frequency_hz / 1e6,
            spread.count,
            spread.sigma_rms_k,
            100.0 * spread.sigma_scatter
        ));
    }
    lines.extend(power_lines(summary));
    lines.extend(summary.crossings.iter().map(crossing_line));
    lines.extend(summary.epsilons.iter().flat_map(epsilon_lines));
    lines.join("\n")
}

/// Where the two traces of a group cross.
fn crossing_line(crossing: &Crossing) -> String {
    let of = match crossing.run_label.as_str() {
        "" => String::new(),
        label => format!("{label}, "),
    };
    let name = format!(
        "{of}{:.3} MHz: Tr Sigma_n and T² Tr Sigma_s, T the mean of the input,",
        crossing.frequency_hz / 1e6
    );
    let first = match crossing.epsilon_first_power {
        Some(epsilon) => format!("; with T in place of T² at {epsilon:.2e}"),
        None => String::new(),
    };
    let [from, to] = crossing.epsilon_tried;
    match crossing.epsilon {
        Some(epsilon) => format!("{name} cross at epsilon {epsilon:.2e}{first}"),
        None => format!(
            "{name} do not cross between epsilon {from:.1e} and {to:.1e}{first}: add smaller or larger ones"
        ),
    }
}

/// Lines on the choice of epsilon, one for each rule.
fn epsilon_lines(choices: &EpsilonChoices) -> Vec<String> {
    let name = format!("{}, {:.3} MHz", choices.run_label, choices.frequency_hz / 1e6);
    let rules = [
        ("crossing of the traces", &choices.crossing),
        ("generalised cross-validation", &choices.cross_validation),
        ("predictive risk", &choices.risk),
        ("L-curve", &choices.l_curve),
    ];
    let line = |(rule, choice): (&str, &EpsilonChoice)| {
        let chosen = choice.epsilon.map_or_else(|| "none".to_owned(), |epsilon| format!("{epsilon:.2e}"));
        let open = choice.range.filter(|[low, high]| low < high);
        let open =
            open.map_or_else(String::new, |[low, high]| format!(", {low:.0e} to {high:.0e} not excluded"));
        let note = choice.note.as_ref().map_or_else(String::new, |note| format!(" ({note})"));
        format!("epsilon by {rule}: {chosen}{open}{note}")
    };
    std::iter::once(format!("{name}: V'N^-1V is {:.3e} per datum", choices.power_per_datum))
        .chain(rules.map(line))
        .collect()
}
