//! Figures of runs from their summaries, and tables that compare several runs.

use std::fmt::Write;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::error::ProductsError;
use super::latitudes::LatitudeError;
use crate::imaging::{Estimate, Fit};

/// Figures of the maps of a run, from its `summary.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunFigures {
    /// Name of the run, or of a case of a study.
    #[serde(rename = "name")]
    pub label: String,
    /// Whether the run was cancelled.
    pub cancelled: bool,
    /// The engine of its maps, also where `map.engine = "auto"` chose it; `None` if it is not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub engine: Option<String>,
    /// Figures of each channel.
    pub channels: Vec<ChannelFigures>,
}

/// Figures of the final map of one channel. Spectra start at l = 0; unknown values are `None`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChannelFigures {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// nside of the map.
    pub nside: usize,
    /// Number of visibilities in the map.
    pub visibilities: u64,
    /// Mean of the map, K.
    pub mean_k: f64,
    /// RMS of the noise-only map, K; NaN of a map that was interrupted.
    #[serde(deserialize_with = "null_as_nan")]
    pub noise_rms_k: f64,
    /// Whether the visibilities contain thermal noise.
    pub thermal_noise: bool,
    /// Measured modes by degree, if R is from the data.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sky_power: Option<MeasuredModes>,
    /// Regularisation and traces.
    pub diagnostics: DiagnosticFigures,
    /// Correlation with the input, rho_l.
    pub rho: Option<Vec<Option<f64>>>,
    /// rho_l with the noise power subtracted.
    pub rho_noise_subtracted: Option<Vec<Option<f64>>>,
    /// Signal-to-noise ratio, SNR_l.
    pub snr: Option<Vec<Option<f64>>>,
    /// Angular power spectra.
    pub power: Option<PowerFigures>,
    /// The effective beam.
    pub beam: Option<BeamFigures>,
    /// Relative error by distance from the ecliptic.
    pub latitudes: Option<Vec<LatitudeError>>,
    /// Power relative to an ideal instrument, in a study of errors.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub power_kept: Option<RelativePower>,
}

/// Measured modes by degree from l = 0: the parts of Tr A (A + R)^-1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeasuredModes {
    /// Of each degree, at most 2 l + 1.
    pub constrained: Vec<f64>,
}

/// Power of a map relative to the map of an ideal instrument, by degree from l = 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RelativePower {
    /// C_l over C_l of the ideal map, including power added by errors.
    pub cl_ratio: Vec<Option<f64>>,
    /// Square of the cross power with the input over that of the ideal map, the fraction that is coherent with the sky.
    pub coherent: Vec<Option<f64>>,
}

impl RelativePower {
    /// The power of `map` relative to `ideal`; `None` if either has no spectra.
    fn new(map: &ChannelFigures, ideal: &ChannelFigures) -> Option<Self> {
        let (map, ideal) = (map.power.as_ref()?, ideal.power.as_ref()?);
        let ratios = |found: &[Option<f64>], ideal: &[Option<f64>], power: i32| {
            let ratio = |(found, ideal): (&Option<f64>, &Option<f64>)| {
                Some((*found)? / (*ideal)?).filter(|r| r.is_finite())
            };
            found.iter().zip(ideal).map(|pair| ratio(pair).map(|ratio| ratio.powi(power))).collect()
        };
        Some(Self {
            cl_ratio: ratios(&map.map_k2, &ideal.map_k2, 1),
            coherent: ratios(&map.cross_k2, &ideal.cross_k2, 2),
        })
    }
}

/// Regularisation and traces of a solution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DiagnosticFigures {
    /// epsilon of R = epsilon W_max I.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub epsilon: Option<f64>,
    /// W_max, K^-2; both absent if R is from the data.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub w_max: Option<f64>,
    /// Traces, if requested.
    pub traces: Option<TraceFigures>,
    /// Residuals of the data, if requested.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fit: Option<Fit>,
}

/// Traces of the covariances (the paper, Sect. 5.1).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TraceFigures {
    /// Trace of the noise covariance, Tr Sigma_n, K^2.
    pub sigma_n_k2: Estimate,
    /// Trace for the regularisation bias, Tr Sigma_s.
    pub sigma_s: Estimate,
    /// Effective number of parameters, Tr A (A + R)^-1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub measured: Option<Estimate>,
}

/// The effective beam of a map and its noise.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BeamFigures {
    /// FWHM of the beam, degrees.
    pub fwhm_deg: Option<f64>,
    /// Solid angle of the beam, sr.
    pub area_sr: Option<f64>,
    /// RMS of the noise-only map as compared, K.
    pub noise_rms_k: f64,
    /// RMS of the noise per beam, Jy.
    pub noise_rms_jy: Option<f64>,
}

/// Angular power spectra, K^2.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PowerFigures {
    /// C_l of the map.
    pub map_k2: Vec<Option<f64>>,
    /// C_l of the input.
    pub input_k2: Vec<Option<f64>>,
    /// C_l of map times input.
    pub cross_k2: Vec<Option<f64>>,
    /// C_l of the noise-only map.
    pub noise_k2: Option<Vec<Option<f64>>>,
}

/// A number that is not known is null.
fn null_as_nan<'de, D: serde::Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(from)?.unwrap_or(f64::NAN))
}

impl RunFigures {
    /// Reads the `summary.json` in the folder of a run.
    ///
    /// # Errors
    /// A file that cannot be read, or is not the summary of a run.
    pub fn read(folder: &Path) -> Result<Self, ProductsError> {
        let path = folder.join("summary.json");
        let bytes =
            std::fs::read(&path).map_err(|source| ProductsError::Read { path: path.clone(), source })?;
        serde_json::from_slice(&bytes)
            .map_err(|error| ProductsError::NotASummary { path, reason: error.to_string() })
    }
}

impl ChannelFigures {
    /// Mean of the input, K: `C_0 = 4 pi mean^2`.
    #[must_use]
    pub fn input_mean_k(&self) -> Option<f64> {
        let power = self.power.as_ref()?.input_k2.first().copied().flatten()?;
        Some((power / (4.0 * std::f64::consts::PI)).sqrt())
    }

    /// Mean of rho_l over 20 <= l <= 120, or to 2 nside if that is less.
    #[must_use]
    pub fn rho_mean(&self) -> Option<f64> {
        self.mean(self.rho.as_ref()?)
    }

    /// Means over 20 <= l <= 120, or to 2 nside if that is less, of the power and the coherent power relative to the ideal instrument.
    #[must_use]
    pub fn power_kept_means(&self) -> [Option<f64>; 2] {
        let kept = self.power_kept.as_ref();
        [kept.and_then(|kept| self.mean(&kept.cl_ratio)), kept.and_then(|kept| self.mean(&kept.coherent))]
    }

    /// Mean over 20 <= l <= 120, or to 2 nside if that is less; `None` if any of these is unknown.
    fn mean(&self, of_degrees: &[Option<f64>]) -> Option<f64> {
        let values: Option<Vec<f64>> =
            of_degrees.get(20..=120.min(2 * self.nside))?.iter().copied().collect();
        values
            .filter(|values| !values.is_empty())
            .map(|values| values.iter().sum::<f64>() / values.len() as f64)
    }
}

impl RunFigures {
    /// Sets the power of each channel's map relative to the run of an ideal instrument.
    pub fn set_power_kept(&mut self, ideal: &Self) {
        for channel in &mut self.channels {
            let same = ideal.channels.iter().find(|ideal| ideal.frequency_hz == channel.frequency_hz);
            channel.power_kept = same.and_then(|ideal| RelativePower::new(channel, ideal));
        }
    }
}

/// The epsilon at which thermal-noise variance equals regularisation bias, for runs that differ only in epsilon (the paper, Fig. 15).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Crossing {
    /// What the labels of the runs have in common.
    #[serde(rename = "of")]
    pub run_label: String,
    /// Frequency of the channel, Hz.
    pub frequency_hz: f64,
    /// The smallest and the largest epsilon of the runs.
    pub epsilon_tried: [f64; 2],
    /// epsilon at which Tr Sigma_n = T^2 Tr Sigma_s, with T the mean of the input.
    pub epsilon: Option<f64>,
    /// epsilon at which Tr Sigma_n in K^2 and T Tr Sigma_s in K are numerically equal.
    pub epsilon_first_power: Option<f64>,
}

/// Crossings of the traces in groups of runs that differ only in epsilon.
#[must_use]
pub fn crossings(groups: &[Vec<&RunFigures>]) -> Vec<Crossing> {
    let mut found = Vec::new();
    for group in groups {
        for (k, first) in group.first().map_or(&[][..], |run| &run.channels).iter().enumerate() {
            let points = trace_points(group, k);
            if points.len() < 2 {
                continue;
            }
            found.push(Crossing {
                run_label: common_label(group),
                frequency_hz: first.frequency_hz,
                epsilon_tried: [points[0][0], points[points.len() - 1][0]],
                epsilon: crossing(&points, 2),
                epsilon_first_power: crossing(&points, 1),
            });
        }
    }
    found
}

/// epsilon, Tr Sigma_n (K^2), Tr Sigma_s and the mean of the input (K) of a channel in each of `group`, in order of epsilon.
pub(super) fn trace_points(group: &[&RunFigures], channel: usize) -> Vec<[f64; 4]> {
    let point = |run: &&RunFigures| {
        let channel = run.channels.get(channel)?;
        let traces = channel.diagnostics.traces.as_ref()?;
        let (n, s) = (traces.sigma_n_k2.value, traces.sigma_s.value);
        Some([channel.diagnostics.epsilon?, n, s, channel.input_mean_k()?])
    };
    let mut points: Vec<[f64; 4]> = group.iter().filter_map(point).collect();
    points.sort_by(|a, b| a[0].total_cmp(&b[0]));
    points
}

/// What the labels of all of `group` have in common: the settings besides epsilon.
pub(super) fn common_label(group: &[&RunFigures]) -> String {
    let Some((first, others)) = group.split_first() else { return String::new() };
    let is_common = |part: &&str| others.iter().all(|run| run.label.split(", ").any(|other| other == *part));
    first.label.split(", ").filter(is_common).collect::<Vec<_>>().join(", ")
}

/// The epsilon at which `n = mean^power s`, by linear interpolation of logarithms.
fn crossing(points: &[[f64; 4]], power: i32) -> Option<f64> {
    let excess = |[epsilon, n, s, mean]: &[f64; 4]| (epsilon.ln(), (n / (s * mean.powi(power))).ln());
    points.windows(2).find_map(|two| {
        let ((x0, y0), (x1, y1)) = (excess(&two[0]), excess(&two[1]));
        (y0 >= 0.0 && y1 < 0.0).then(|| (x0 + (x1 - x0) * y0 / (y0 - y1)).exp())
    })
}

/// Quotes a text as a field of a CSV table.
fn field(text: &str) -> String {
    if text.contains([',', '"', '\n']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

fn number(value: Option<f64>) -> String {
    value.map_or_else(String::new, |value| format!("{value:e}"))
}

/// Formats runs as a CSV table with one line per channel.
#[must_use]
pub fn runs_csv(runs: &[&RunFigures]) -> String {
    let mut text =
        "run,frequency_hz,nside,visibilities,epsilon,w_max,mean_k,input_mean_k,noise_rms_k,tr_sigma_n_k2,\
                    tr_sigma_n_error_k2,tr_sigma_s,tr_sigma_s_error,rho_mean_20_120,beam_fwhm_deg,noise_rms_jy_beam,\
                    cl_ratio_20_120,coherent_power_20_120,engine\n"
            .to_owned();
    for (run, channel) in runs.iter().flat_map(|run| run.channels.iter().map(move |channel| (run, channel))) {
        let DiagnosticFigures { epsilon, w_max, traces, .. } = &channel.diagnostics;
        let [n, s] = [|t: &TraceFigures| t.sigma_n_k2, |t: &TraceFigures| t.sigma_s]
            .map(|trace| traces.as_ref().map(trace));
        let [cl_ratio, coherent] = channel.power_kept_means();
        let start = [
            field(&run.label),
            format!("{}", channel.frequency_hz),
            channel.nside.to_string(),
            channel.visibilities.to_string(),
        ];
        let numbers = [
            *epsilon,
            *w_max,
            Some(channel.mean_k),
            channel.input_mean_k(),
            Some(channel.noise_rms_k),
            n.map(|n| n.value),
            n.map(|n| n.error).filter(|error| error.is_finite()),
            s.map(|s| s.value),
            s.map(|s| s.error).filter(|error| error.is_finite()),
            channel.rho_mean(),
            channel.beam.as_ref().and_then(|beam| beam.fwhm_deg),
            channel.beam.as_ref().and_then(|beam| beam.noise_rms_jy),
            cl_ratio,
            coherent,
        ];
        let engine = run.engine.clone().unwrap_or_default();
        let fields: Vec<String> = start.into_iter().chain(numbers.map(number)).chain([engine]).collect();
        text.push_str(&fields.join(","));
        text.push('\n');
    }
    text
}

/// Formats spectra of runs as a CSV table with one line per degree.
#[must_use]
pub fn spectra_csv(runs: &[&RunFigures]) -> String {
    let mut text =
        "run,frequency_hz,l,rho,rho_noise_subtracted,snr,map_k2,input_k2,cross_k2,noise_k2,cl_ratio,coherent_power\n".to_owned();
    for (run, channel) in runs.iter().flat_map(|run| run.channels.iter().map(move |channel| (run, channel))) {
        let power = channel.power.as_ref();
        let columns = [
            channel.rho.as_ref(),
            channel.rho_noise_subtracted.as_ref(),
            channel.snr.as_ref(),
            power.map(|power| &power.map_k2),
            power.map(|power| &power.input_k2),
            power.map(|power| &power.cross_k2),
            power.and_then(|power| power.noise_k2.as_ref()),
            channel.power_kept.as_ref().map(|kept| &kept.cl_ratio),
            channel.power_kept.as_ref().map(|kept| &kept.coherent),
        ];
        let degrees = columns.iter().flatten().map(|column| column.len()).max().unwrap_or(0);
        for l in 0..degrees {
            let values =
                columns.map(|column| number(column.and_then(|column| column.get(l).copied().flatten())));
            let _ = writeln!(text, "{},{},{l},{}", field(&run.label), channel.frequency_hz, values.join(","));
        }
    }
    text
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(in crate::products) fn run(label: &str, epsilon: f64, n: f64, s: f64) -> RunFigures {
        let estimate = |value| Estimate { value, error: f64::INFINITY };
        let traces = TraceFigures { sigma_n_k2: estimate(n), sigma_s: estimate(s), measured: None };
        // A mean of 10 K.
        let c0 = 4.0 * std::f64::consts::PI * 100.0;
        let power = PowerFigures {
            map_k2: vec![Some(c0), None],
            input_k2: vec![Some(c0), Some(2.0)],
            cross_k2: vec![Some(c0), Some(1.0)],
            noise_k2: None,
        };
        let channel = ChannelFigures {
            frequency_hz: 1e7,
            nside: 8,
            visibilities: 5,
            mean_k: 9.5,
            noise_rms_k: 0.5,
            thermal_noise: true,
            sky_power: None,
            diagnostics: DiagnosticFigures {
                epsilon: Some(epsilon),
                w_max: Some(2.0),
                traces: Some(traces),
                fit: None,
            },
            rho: Some(vec![Some(1.0), None]),
            rho_noise_subtracted: None,
            snr: None,
            power: Some(power),
            beam: None,
            latitudes: None,
            power_kept: None,
        };
        RunFigures {
            label: label.to_owned(),
            cancelled: false,
            engine: Some("pixel".to_owned()),
            channels: vec![channel],
        }
    }

    #[test]
    fn traces_cross_where_their_order_changes() {
        // n = 1 / epsilon and s = epsilon: with 100 K^2 at epsilon = 0.1, with 10 K at epsilon = 1 / sqrt 10.
        let runs: Vec<RunFigures> =
            [1e-3, 1e-2, 1e-1, 1.0].map(|epsilon| run("a", epsilon, 1.0 / epsilon, epsilon)).into();
        let found = crossings(&[runs.iter().rev().collect()]);
        let [crossing] = &found[..] else { panic!("{found:?}") };
        // Power laws are straight lines between logarithms.
        assert!((crossing.epsilon.unwrap() / 0.1 - 1.0).abs() < 1e-9, "{crossing:?}");
        let first_power = crossing.epsilon_first_power.unwrap();
        assert!((first_power / 0.1_f64.sqrt() - 1.0).abs() < 1e-9, "{crossing:?}");
        assert_eq!(crossings(&[vec![&runs[0]]]), []);
        // Traces that do not cross give no epsilon.
        let none = crossings(&[runs[..2].iter().collect()]);
        assert_eq!((none[0].epsilon, none[0].epsilon_first_power), (None, None));
        assert_eq!(none[0].epsilon_tried, [1e-3, 1e-2]);
    }

    #[test]
    fn groups_are_named_by_what_their_runs_have_in_common() {
        let labels = ["receiver_noise = 0, epsilon = 1e-6", "receiver_noise = 0, epsilon = 1e-4"];
        let runs = labels.map(|label| run(label, 1e-6, 1.0, 1.0));
        assert_eq!(common_label(&[&runs[0], &runs[1]]), "receiver_noise = 0");
        assert_eq!(common_label(&[&runs[1]]), labels[1]);
    }

    #[test]
    fn tables_quote_labels_and_leave_unknown_fields_empty() {
        let runs = [run("b < b_p, \"all\"", 1e-4, 3.0, 0.5)];
        let all: Vec<&RunFigures> = runs.iter().collect();
        let table = runs_csv(&all);
        let lines: Vec<&str> = table.lines().collect();
        assert_eq!(lines.len(), 2);
        assert!(
            lines[1].starts_with("\"b < b_p, \"\"all\"\"\",10000000,8,5,1e-4,2e0,9.5e0,1e1,5e-1,3e0,,5e-1,,")
        );
        assert!(lines[0].ends_with(",engine") && lines[1].ends_with(",pixel"), "{table}");
        let spectra = spectra_csv(&all);
        assert_eq!(spectra.lines().nth(2).unwrap(), "\"b < b_p, \"\"all\"\"\",10000000,1,,,,,2e0,1e0,,,");
        for text in [&table, &spectra] {
            let fields = |line: usize| text.lines().nth(line).unwrap().replace(", ", " ").split(',').count();
            assert_eq!(fields(0), fields(1), "{text}");
        }
        assert!(crate::products::draw_runs("runs", &all, &[]).is_ok());
    }
    #[test]
    fn power_kept_is_relative_to_the_ideal_map() {
        let ideal = run("ideal", 1e-4, 1.0, 1.0);
        let mut spoilt = run("spoilt", 1e-4, 1.0, 1.0);
        let power = spoilt.channels[0].power.as_mut().unwrap();
        power.map_k2 = vec![power.map_k2[0].map(|c| 3.0 * c), Some(1.0)];
        power.cross_k2 = vec![power.cross_k2[0].map(|c| 0.5 * c), Some(0.25)];
        spoilt.set_power_kept(&ideal);
        let kept = spoilt.channels[0].power_kept.as_ref().unwrap();
        // The ratio is unknown if the power of the ideal map is.
        assert!((kept.cl_ratio[0].unwrap() - 3.0).abs() < 1e-12 && kept.cl_ratio[1].is_none());
        assert!((kept.coherent[0].unwrap() - 0.25).abs() < 1e-12 && kept.coherent[1] == Some(0.0625));
        // Two degrees are no mean over 20 <= l <= 120, and other frequencies are not compared.
        assert_eq!(spoilt.channels[0].power_kept_means(), [None, None]);
        let mut other = ideal.clone();
        other.channels[0].frequency_hz = 2e7;
        spoilt.set_power_kept(&other);
        assert!(spoilt.channels[0].power_kept.is_none());
    }
}
