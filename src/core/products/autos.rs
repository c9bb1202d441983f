//! Products of auto-correlations: a table, statistics and a picture.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

use serde::Serialize;

use super::error::{ProductsError, write_product};
use super::pictures::{Axis, Curve, Picture, PictureError, Plot, draw_plots};
use crate::frames::AutoPower;

/// Maximum number of frequencies with a plot of power over time.
const PLOTS_MAX: usize = 8;

/// Maximum number of points per curve; more are averaged.
const POINTS_MAX: usize = 400;

/// Statistics of the auto-correlations of one daughter at one frequency.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AutoSummary {
    /// Daughter, from 1.
    pub daughter: u32,
    /// Centre frequency of the channel or sub-band, Hz.
    pub frequency_hz: f64,
    /// Width of the channel or sub-band, Hz.
    pub width_hz: f64,
    /// Number of integrations.
    pub count: usize,
    /// Mean over all samples, K sr.
    pub mean_k_sr: f64,
    /// Standard deviation of the mean from the noise of the integrations, K sr.
    pub sigma_k_sr: f64,
    /// Reduced chi-square of the powers about their mean, 1 if they vary only by noise.
    pub chi_square: f64,
}

/// Sort key: frequency, then daughter.
fn key(power: &AutoPower) -> (u64, u8) {
    (power.frequency_hz.to_bits(), power.daughter)
}

/// Statistics of auto-correlations by frequency and daughter.
#[must_use]
pub fn summarise(powers: &[AutoPower]) -> Vec<AutoSummary> {
    let mut series: BTreeMap<(u64, u8), Vec<&AutoPower>> = BTreeMap::new();
    for power in powers {
        series.entry(key(power)).or_default().push(power);
    }
    series.into_values().filter_map(|powers| statistics(&powers)).collect()
}

fn statistics(powers: &[&AutoPower]) -> Option<AutoSummary> {
    let first = powers.first()?;
    // Weights are numbers of samples. As sigma is proportional to the measured power, weights 1 / sigma^2 would favour low
    // powers.
    let samples = |power: &AutoPower| (power.power_k_sr / power.sigma_k_sr).powi(2);
    let total: f64 = powers.iter().map(|power| samples(power)).sum();
    if total <= 0.0 {
        return None;
    }
    let mean_k_sr = powers.iter().map(|power| samples(power) * power.power_k_sr).sum::<f64>() / total;
    let square = |power: &&AutoPower| (power.power_k_sr / mean_k_sr - 1.0).powi(2) * samples(power);
    Some(AutoSummary {
        daughter: u32::from(first.daughter) + 1,
        frequency_hz: first.frequency_hz,
        width_hz: first.width_hz,
        count: powers.len(),
        mean_k_sr,
        sigma_k_sr: mean_k_sr / total.sqrt(),
        chi_square: powers.iter().map(square).sum::<f64>() / powers.len().saturating_sub(1).max(1) as f64,
    })
}

/// Writes `autos.csv`, `autos.json` and, with `pictures`, `autos.png` into `folder`; nothing if there are no powers.
///
/// # Errors
/// A file that cannot be written.
pub fn write_autos(
    powers: &mut [AutoPower],
    folder: &Path,
    pictures: bool,
) -> Result<Vec<AutoSummary>, ProductsError> {
    if powers.is_empty() {
        return Ok(Vec::new());
    }
    // The order of arrival must not matter.
    powers.sort_unstable_by(|a, b| key(a).cmp(&key(b)).then(a.time_s.total_cmp(&b.time_s)));
    let path = folder.join("autos.csv");
    write_product(&path, table(powers).as_bytes())?;
    let summaries = summarise(powers);
    let path = folder.join("autos.json");
    let text = serde_json::to_vec_pretty(&summaries)
        .map_err(|error| ProductsError::Encode { path: path.clone(), reason: error.to_string() })?;
    write_product(&path, &text)?;
    if pictures {
        draw(powers, &summaries)?.write(&folder.join("autos.png"))?;
    }
    Ok(summaries)
}

/// Comma-separated values, one line per integration.
fn table(powers: &[AutoPower]) -> String {
    let mut text = String::from("frequency_hz,width_hz,daughter,time_s,power_k_sr,sigma_k_sr\n");
    for power in powers {
        let AutoPower { daughter, frequency_hz, width_hz, time_s, power_k_sr, sigma_k_sr } = power;
        let daughter = u32::from(*daughter) + 1;
        let _ = writeln!(
            text,
            "{frequency_hz},{width_hz},{daughter},{time_s:.6},{power_k_sr:.7e},{sigma_k_sr:.3e}"
        );
    }
    text
}

/// Draws the spectrum of each daughter, and its power over time at some frequencies.
fn draw(powers: &[AutoPower], summaries: &[AutoSummary]) -> Result<Picture, PictureError> {
    let mut spectra: BTreeMap<u32, Vec<(f64, f64)>> = BTreeMap::new();
    for summary in summaries {
        spectra.entry(summary.daughter).or_default().push((summary.frequency_hz / 1e6, summary.mean_k_sr));
    }
    let named = |(daughter, points)| Curve { label: format!("daughter {daughter}"), points, dashed: false };
    let y = Axis { label: "power (K sr)".to_owned(), ..Axis::default() };
    let mut plots = vec![Plot {
        title: "Spectra".to_owned(),
        x: Axis { label: "frequency (MHz)".to_owned(), ..Axis::default() },
        y: Axis { log: true, ..y.clone() },
        curves: spectra.into_iter().map(named).collect(),
        levels: Vec::new(),
    }];
    let mut frequencies: Vec<f64> = summaries.iter().map(|summary| summary.frequency_hz).collect();
    frequencies.dedup();
    let start_s = powers.iter().map(|power| power.time_s).fold(f64::INFINITY, f64::min);
    for k in 0..frequencies.len().min(PLOTS_MAX) {
        let frequency_hz = frequencies[k * frequencies.len() / frequencies.len().min(PLOTS_MAX)];
        let mut curves: BTreeMap<u32, Vec<(f64, f64)>> = BTreeMap::new();
        for power in powers.iter().filter(|power| power.frequency_hz == frequency_hz) {
            let point = (power.time_s - start_s, power.power_k_sr);
            curves.entry(u32::from(power.daughter) + 1).or_default().push(point);
        }
        plots.push(Plot {
            title: format!("{:.4} MHz", frequency_hz / 1e6),
            x: Axis { label: format!("time after {start_s:.0} s (s)"), ..Axis::default() },
            y: y.clone(),
            curves: curves
                .into_iter()
                .map(|(daughter, points)| named((daughter, thinned(&points))))
                .collect(),
            levels: Vec::new(),
        });
    }
    draw_plots("Powers of the daughters", &plots, 3)
}

/// Averages adjacent points so that at most `POINTS_MAX` are left.
fn thinned(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mean = |chunk: &[(f64, f64)]| {
        let n = chunk.len() as f64;
        (chunk.iter().map(|p| p.0).sum::<f64>() / n, chunk.iter().map(|p| p.1).sum::<f64>() / n)
    };
    points.chunks(points.len().div_ceil(POINTS_MAX).max(1)).map(mean).collect()
}
