//! The table of a proposal: what designs measure, what they send and what they take, each value with its source.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::coverage::{WholeCoverage, whole_coverage};
use super::error::FigureError;
use crate::array::earth_in_sight_s;
use crate::imaging::{DegreeSensitivity, EngineKind};
use crate::pipeline::{ArraySensitivity, ConfigSource, Plan, SENSITIVITY_L_MAX, breathing_m_s_per_year};
use crate::products::{ChannelFigures, RunFigures};
use crate::units::constants::{DAY_S, SPEED_OF_LIGHT_M_S};
use crate::units::{ChannelId, PerChannel};

/// Where a value is from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ValueSource {
    /// A setting.
    Set,
    /// Follows from the orbits.
    Computed,
    /// Estimated without a map.
    Estimated,
    /// From the map of a run, its noise-only map or its downlink.
    Measured,
}

/// A value of the table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ProposalValue {
    /// What it is.
    pub quantity: String,
    /// Its unit; empty for none.
    pub unit: &'static str,
    /// The value and where it is from; absent if it is not known.
    pub value: Option<(f64, ValueSource)>,
}

/// One channel of one design.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ProposalColumn {
    /// Name of the design: the folder of the run, or the pipeline file.
    pub design: String,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// The values, in the same order in all columns.
    pub values: Vec<ProposalValue>,
}

/// A design: a run's folder, whose settings and figures are read, or a pipeline that has not been run.
struct Source {
    label: String,
    plan: Plan,
    /// The mission without what a simulation leaves out.
    whole: Plan,
    run: Option<RunFigures>,
}

impl Source {
    fn read(path: &Path) -> Result<Self, FigureError> {
        let (label, is_run) = (path.display().to_string(), path.is_dir());
        let file = if is_run { path.join("pipeline.toml") } else { path.to_owned() };
        let config = ConfigSource { file: Some(file), ..ConfigSource::default() }.load();
        let plan = config.map_err(crate::pipeline::PipelineError::from).and_then(Plan::new)?;
        let run = if is_run { Some(RunFigures::read(path)?) } else { None };
        let mut whole = plan.config.clone();
        whole.spacecraft.thin = 1;
        whole.spacecraft.every_nth_window = 1;
        whole.spacecraft.every_nth_integration = PerChannel::All(1);
        Ok(Self { label, whole: Plan::new(whole)?, plan, run })
    }
}

/// Makes the columns of a proposal's table from folders of runs and pipeline files, with rho_l, SNR_l and measured modes at `degrees`.
///
/// # Errors
/// A path that is neither; a sky that cannot be made.
pub fn proposal(paths: &[PathBuf], degrees: &[usize]) -> Result<Vec<ProposalColumn>, FigureError> {
    let mut columns = Vec::new();
    for path in paths {
        let source = Source::read(path)?;
        let coverage = whole_coverage(&source.plan);
        let mission = mission_values(&source);
        for (channel, coverage) in coverage.iter().enumerate() {
            let mut values = mission.clone();
            values.extend(channel_values(&source, channel, coverage.as_ref(), degrees)?);
            let frequency_hz = source.plan.config.spacecraft.channels_hz[channel];
            columns.push(ProposalColumn { design: source.label.clone(), frequency_hz, values });
        }
    }
    Ok(columns)
}

fn row(quantity: impl Into<String>, unit: &'static str, value: Option<(f64, ValueSource)>) -> ProposalValue {
    let value = value.filter(|(value, _)| value.is_finite());
    ProposalValue { quantity: quantity.into(), unit, value }
}

/// What holds for all channels: the array, and what it sends.
fn mission_values(source: &Source) -> Vec<ProposalValue> {
    use ValueSource::{Computed, Estimated, Set};
    let (Plan { config, array, .. }, whole) = (&source.plan, &source.whole);
    let on_circle = (!config.array.has_own_orbits()).then_some(&config.array);
    let bytes = whole.cost().downlink_bytes;
    let duration_s = config.spacecraft.duration_s;
    let rate = Some(config.downlink.rate_bits_per_s_max).filter(|rate| *rate > 0.0);
    let sight_s = earth_in_sight_s(array, 0.0, duration_s);
    let sending_s = rate.map(|rate| 8.0 * bytes / rate);
    vec![
        row("satellites", "", Some((array.satellites() as f64, Set))),
        row("altitude", "km", on_circle.map(|array| (array.altitude_m / 1e3, Set))),
        row("inclination", "deg", on_circle.map(|array| (array.inclination_deg, Set))),
        row("mission", "d", Some((duration_s / DAY_S, Set))),
        row("observing", "d", Some((observing_s(whole) / DAY_S, Computed))),
        row("data, whole mission", "GB", Some((bytes / 1e9, Estimated))),
        row("downlink time, whole mission", "h", sending_s.map(|s| (s / 3600.0, Estimated))),
        row(
            "downlink time / Earth in sight of the first",
            "%",
            sending_s.map(|s| (100.0 * s / sight_s, Estimated)),
        ),
        row(
            "station keeping for breathing alone",
            "m/s a year",
            breathing_m_s_per_year(&source.plan).filter(|_| on_circle.is_some()).map(|dv| (dv, Estimated)),
        ),
        row("station keeping against other forces", "m/s a year", None),
    ]
}

fn observing_s(plan: &Plan) -> f64 {
    plan.windows.iter().map(|window| window.end.seconds() - window.start.seconds()).sum()
}

fn channel_values(
    source: &Source,
    channel: usize,
    coverage: Option<&WholeCoverage>,
    degrees: &[usize],
) -> Result<Vec<ProposalValue>, FigureError> {
    use ValueSource::{Computed, Estimated, Measured, Set};
    let Source { plan, whole, run, .. } = source;
    let frequency_hz = plan.config.spacecraft.channels_hz[channel];
    let figures = run.as_ref().and_then(|run| {
        run.channels.iter().find(|figures| (figures.frequency_hz / frequency_hz - 1.0).abs() < 1e-9)
    });
    let beam = figures.and_then(|figures| figures.beam.as_ref());
    let projected_m = |which: usize| coverage.map(|coverage| (coverage.projected_m[which], Computed));
    let fringe_deg = projected_m(1)
        .map(|(longest_m, source)| ((SPEED_OF_LIGHT_M_S / frequency_hz / longest_m).to_degrees(), source));
    let (mapped, all) = (plan.visibilities()[channel].mapped, whole.visibilities()[channel].sent);
    let mut values = vec![
        row("frequency", "MHz", Some((frequency_hz / 1e6, Set))),
        row("part of the visibilities in the map", "%", Some((100.0 * mapped / all, Estimated))),
        row(
            "visibilities",
            "",
            Some(figures.map_or((mapped, Estimated), |figures| (figures.visibilities as f64, Measured))),
        ),
        row("shortest projected baseline", "m", projected_m(0)),
        row("longest projected baseline", "m", projected_m(1)),
        row("finest fringe: wavelength / longest projected baseline", "deg", fringe_deg),
        row(
            "observing time of directions, most / least",
            "",
            coverage.map(|coverage| (coverage.most_over_least, Computed)),
        ),
        row(
            "resolution: FWHM of the effective beam",
            "deg",
            beam.and_then(|beam| beam.fwhm_deg).map(|deg| (deg, Measured)),
        ),
        row("noise of a pixel", "K", figures.map(|figures| (figures.noise_rms_k, Measured))),
        row("noise per beam", "Jy", beam.and_then(|beam| beam.noise_rms_jy).map(|noise| (noise, Measured))),
    ];
    let estimates = estimates(plan, channel, figures, degrees)?;
    for &l in degrees {
        values.extend(degree_values(l, figures, estimates.get(l)));
    }
    Ok(values)
}

/// Estimates by degree, if a value at one of `degrees` needs them.
fn estimates(
    plan: &Plan,
    channel: usize,
    figures: Option<&ChannelFigures>,
    degrees: &[usize],
) -> Result<Vec<DegreeSensitivity>, FigureError> {
    let is_measured = figures.is_some_and(|figures| figures.snr.is_some() && figures.sky_power.is_some());
    // Beyond the map's degrees nothing is known.
    let map = &plan.config.map;
    let l_max = if map.engine == EngineKind::Harmonic { map.degree() } else { 3 * map.nside - 1 };
    let is_mapped = map.is_mapped(ChannelId(channel as u16));
    if is_measured || !is_mapped || degrees.iter().all(|l| *l > SENSITIVITY_L_MAX.min(l_max)) {
        return Ok(Vec::new());
    }
    let mut found = ArraySensitivity::new(plan, channel)?.of(plan)?;
    found.truncate(l_max + 1);
    Ok(found)
}

fn degree_values(
    l: usize,
    figures: Option<&ChannelFigures>,
    estimate: Option<&DegreeSensitivity>,
) -> [ProposalValue; 3] {
    use ValueSource::{Estimated, Measured};
    let estimate = estimate.filter(|estimate| estimate.is_measured());
    let of = |curve: Option<&Vec<Option<f64>>>| Some((curve?.get(l).copied()??, Measured));
    let rho = figures.and_then(|figures| of(figures.rho.as_ref()));
    let snr = figures.and_then(|figures| of(figures.snr.as_ref()));
    let modes = figures.and_then(|figures| figures.sky_power.as_ref()?.constrained.get(l).copied());
    let snr = snr.or_else(|| Some((estimate?.relative_noise().recip(), Estimated)));
    let rho = rho.or_else(|| Some((estimate?.rho(), Estimated)));
    let modes = modes.map(|modes| (modes, Measured)).or_else(|| Some((estimate?.measured, Estimated)));
    [
        row(format!("rho_{l}"), "", rho),
        row(format!("SNR_{l}"), "", snr),
        row(format!("measured modes at l = {l}, of {}", 2 * l + 1), "", modes),
    ]
}

/// Three digits, as text and as mantissa and exponent where an exponent is shorter.
fn digits(value: f64) -> (String, Option<(String, i32)>) {
    // What is missing to one is what counts.
    if (0.99..1.0).contains(&value) {
        return (format!("{value:.5}"), None);
    }
    let exponent = if value == 0.0 { 0 } else { value.abs().log10().floor() as i32 };
    if (-3..5).contains(&exponent) {
        let scale = 10_f64.powi(2 - exponent);
        let decimals = (2 - exponent).max(0) as usize;
        let text = format!("{:.decimals$}", (value * scale).round() / scale);
        let text = if text.contains('.') {
            text.trim_end_matches('0').trim_end_matches('.').to_owned()
        } else {
            text
        };
        return (text, None);
    }
    let text = format!("{value:.2e}");
    let parts =
        text.split_once('e').and_then(|(mantissa, power)| Some((mantissa.to_owned(), power.parse().ok()?)));
    (text, parts)
}

const UNKNOWN: &str = "not known";

/// The table as CSV, a line a value.
#[must_use]
pub fn proposal_csv(columns: &[ProposalColumn]) -> String {
    let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
    let mut text = "design,frequency_hz,quantity,unit,value,source\n".to_owned();
    for column in columns {
        for value in &column.values {
            let (number, source) = match value.value {
                Some((number, source)) => (number.to_string(), format!("{source:?}").to_lowercase()),
                None => (String::new(), UNKNOWN.to_owned()),
            };
            let start = format!("{},{}", quoted(&column.design), column.frequency_hz);
            text.push_str(&format!("{start},{},{},{number},{source}\n", quoted(&value.quantity), value.unit));
        }
    }
    text
}

fn mark(source: ValueSource) -> &'static str {
    match source {
        ValueSource::Set => "",
        ValueSource::Computed => "c",
        ValueSource::Estimated => "e",
        ValueSource::Measured => "m",
    }
}

const KEY: &str = "c: follows from the orbits; e: estimated without a map; m: measured in a simulated run; without a letter: a setting. \
                   Baselines, coverage, noise, rho, SNR and measured modes are those of the part of the visibilities in the map, data and times of the whole mission. Estimates of rho, SNR and measured modes use baselines up to 5 wavelengths alone, and are too low where few are so short, at 10 MHz up to four times. The effective beam is measured in a map; it is not the finest fringe that the baselines see.";

/// The table as Markdown, a row a quantity.
#[must_use]
pub fn proposal_markdown(columns: &[ProposalColumn]) -> String {
    let head: Vec<String> = columns.iter().map(|column| column.design.replace('|', "\\|")).collect();
    let mut text = format!("| | {} |\n|---|{}\n", head.join(" | "), "---:|".repeat(columns.len()));
    let cell = |value: &ProposalValue| match value.value {
        Some((number, ValueSource::Set)) => digits(number).0,
        Some((number, source)) => format!("{} {}", digits(number).0, mark(source)),
        None => UNKNOWN.to_owned(),
    };
    for (k, first) in columns.first().map_or(&[][..], |column| &column.values).iter().enumerate() {
        let unit = if first.unit.is_empty() { String::new() } else { format!(", {}", first.unit) };
        let cells: Vec<String> = columns.iter().map(|column| cell(&column.values[k])).collect();
        text.push_str(&format!("| {}{unit} | {} |\n", first.quantity, cells.join(" | ")));
    }
    format!("{text}\n{KEY}\n")
}

/// The table as LaTeX, for a document with the package booktabs.
#[must_use]
pub fn proposal_latex(columns: &[ProposalColumn]) -> String {
    let head: Vec<String> = columns.iter().map(|column| escaped(&column.design)).collect();
    let mut text = format!(
        "% \\usepackage{{booktabs}}\n\\begin{{tabular}}{{l{}}}\n\\toprule\n & {} \\\\\n\\midrule\n",
        "r".repeat(columns.len()),
        head.join(" & ")
    );
    let cell = |value: &ProposalValue| {
        let Some((number, source)) = value.value else { return UNKNOWN.to_owned() };
        let number = match digits(number) {
            (_, Some((mantissa, power))) => format!("{{{mantissa} \\times 10^{{{power}}}}}"),
            (text, None) => text,
        };
        match mark(source) {
            "" => format!("${number}$"),
            mark => format!("${number}^\\mathrm{{{mark}}}$"),
        }
    };
    for (k, first) in columns.first().map_or(&[][..], |column| &column.values).iter().enumerate() {
        let unit = if first.unit.is_empty() { String::new() } else { format!(", {}", escaped(first.unit)) };
        let name = match first.quantity.split_once('_') {
            Some(("rho", l)) => format!("$\\rho_{{{l}}}$"),
            Some(("SNR", l)) => format!("$\\mathrm{{SNR}}_{{{l}}}$"),
            _ => escaped(&first.quantity),
        };
        let cells: Vec<String> = columns.iter().map(|column| cell(&column.values[k])).collect();
        text.push_str(&format!("{name}{unit} & {} \\\\\n", cells.join(" & ")));
    }
    format!("{text}\\bottomrule\n\\end{{tabular}}\n\n\\smallskip\\noindent {}\n", escaped(KEY))
}

/// Text with LaTeX's own characters written out.
fn escaped(text: &str) -> String {
    let of = |character: char| match character {
        '\\' => "\\textbackslash{}".to_owned(),
        '~' => "\\textasciitilde{}".to_owned(),
        '^' => "\\textasciicircum{}".to_owned(),
        '&' | '%' | '$' | '#' | '_' | '{' | '}' => format!("\\{character}"),
        character => character.to_string(),
    };
    text.chars().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_digits_are_kept() {
        for (value, text) in [
            (0.0, "0"),
            (8.0, "8"),
            (30.0, "30"),
            (0.012_345, "0.0123"),
            (123.456, "123"),
            (0.999_87, "0.99987"),
            (45_678.0, "45700"),
            (1.2345e6, "1.23e6"),
            (-2.5e-5, "-2.50e-5"),
        ] {
            assert_eq!(digits(value).0, text);
        }
    }

    #[test]
    fn tables_say_what_is_not_known_and_escape_names() {
        let values = vec![
            row("noise_of 50 %", "K", Some((1.5e6, ValueSource::Measured))),
            row("rho_2", "", Some((0.5, ValueSource::Estimated))),
            row("station keeping", "m/s a year", Some((f64::NAN, ValueSource::Computed))),
        ];
        let columns = [ProposalColumn { design: "a_b|c".to_owned(), frequency_hz: 3e6, values }];
        let markdown = proposal_markdown(&columns);
        assert!(
            markdown.starts_with(
                "| | a_b\\|c |\n|---|---:|\n| noise_of 50 %, K | 1.50e6 m |\n| rho_2 | 0.5 e |\n"
            )
        );
        assert!(markdown.contains("| station keeping, m/s a year | not known |"), "{markdown}");
        let latex = proposal_latex(&columns);
        assert!(
            latex.contains("a\\_b|c") && latex.contains("$\\rho_{2}$ & $0.5^\\mathrm{e}$ \\\\"),
            "{latex}"
        );
        assert!(latex.contains("noise\\_of 50 \\%, K & ${1.50 \\times 10^{6}}^\\mathrm{m}$"), "{latex}");
        let csv = proposal_csv(&columns);
        assert!(csv.contains("\"a_b|c\",3000000,\"station keeping\",m/s a year,,not known\n"), "{csv}");
    }
}
