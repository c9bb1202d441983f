//! Draws the figures of several runs as overlaid curves.

use super::pictures::{Axis, Curve, Picture, PictureError, Plot, draw_plots};
use super::runs::{ChannelFigures, RunFigures};

/// Maximum number of overlaid curves; more cannot be distinguished.
const DRAWN_MAX: usize = 14;

/// Draws overlaid curves of runs: rho_l, SNR_l, C_l of the maps and, if available, the traces against epsilon.
///
/// # Errors
/// [`PictureError::Size`], which cannot occur for six plots.
pub fn draw_runs(title: &str, runs: &[&RunFigures]) -> Result<Picture, PictureError> {
    let channels: Vec<(String, &ChannelFigures)> = runs
        .iter()
        .flat_map(|run| {
            run.channels.iter().map(|channel| {
                let several = run.channels.len() > 1;
                let frequency = format!("{:.3} MHz", channel.frequency_hz / 1e6);
                let label = if several { format!("{}, {frequency}", run.label) } else { run.label.clone() };
                (label, channel)
            })
        })
        .collect();
    let of_degrees = |get: &dyn Fn(&ChannelFigures) -> Option<&Vec<Option<f64>>>| -> Vec<Curve> {
        channels
            .iter()
            .take(DRAWN_MAX)
            .enumerate()
            .filter_map(|(number, (label, channel))| {
                // Unknown values interrupt the curve.
                let points = get(channel)?
                    .iter()
                    .enumerate()
                    .map(|(l, y)| (l as f64, y.unwrap_or(f64::NAN)))
                    .collect();
                Some(Curve { label: label.clone(), points, dashed: number >= 7 })
            })
            .collect()
    };
    let l = Axis { label: "degree l".to_owned(), ..Axis::default() };
    let mut plots = Vec::new();
    let mut plot = |title: &str, y: Axis, curves: Vec<Curve>, levels: Vec<f64>| {
        if !curves.is_empty() {
            plots.push(Plot { title: title.to_owned(), x: l.clone(), y, curves, levels });
        }
    };
    let rho = Axis { label: "rho_{l}".to_owned(), limits: Some((0.0, 1.05)), log: false };
    plot("Correlation with the input", rho, of_degrees(&|c| c.rho.as_ref()), vec![1.0]);
    let snr = Axis { label: "SNR_{l}".to_owned(), log: true, limits: None };
    plot("Signal to noise", snr, of_degrees(&|c| c.snr.as_ref()), vec![1.0]);
    let mut powers = of_degrees(&|c| c.power.as_ref().map(|power| &power.map_k2));
    if let Some((_, first)) = channels.first()
        && let Some(power) = &first.power
        && powers.len() < DRAWN_MAX
    {
        let points =
            power.input_k2.iter().enumerate().map(|(l, y)| (l as f64, y.unwrap_or(f64::NAN))).collect();
        powers.push(Curve { label: "input".to_owned(), points, dashed: true });
    }
    let power = Axis { label: "C_{l} (K²)".to_owned(), log: true, limits: None };
    plot("Angular power of the maps", power, powers, Vec::new());
    // The ratio may be far above one, as errors also add power.
    let ratio = Axis { label: "C_{l} / C_{l} ideal".to_owned(), log: true, limits: None };
    let kept = of_degrees(&|c| c.power_kept.as_ref().map(|kept| &kept.cl_ratio));
    plot("Power relative to the ideal instrument", ratio, kept, vec![0.95, 1.0]);
    let ratio = Axis { label: "coherent power".to_owned(), limits: Some((0.0, 1.2)), log: false };
    let coherent = of_degrees(&|c| c.power_kept.as_ref().map(|kept| &kept.coherent));
    plot("Coherent power relative to the ideal instrument", ratio, coherent, vec![0.95, 1.0]);
    plots.extend(trace_plot(&channels));
    if plots.is_empty() {
        plots.push(Plot {
            title: "Nothing to draw: no input to compare with, and no traces".to_owned(),
            ..Plot::default()
        });
    }
    let columns = plots.len().min(2);
    let more = channels.len() > DRAWN_MAX;
    let title = if more {
        format!("{title} (the first {DRAWN_MAX} of {})", channels.len())
    } else {
        title.to_owned()
    };
    draw_plots(title.trim_start(), &plots, columns)
}

/// Plots the traces against epsilon; `None` for fewer than two points.
fn trace_plot(channels: &[(String, &ChannelFigures)]) -> Option<Plot> {
    let mut curves: Vec<Curve> = Vec::new();
    let mut frequencies: Vec<f64> = channels.iter().map(|(_, channel)| channel.frequency_hz).collect();
    frequencies.dedup();
    for &frequency_hz in frequencies.iter().take(3) {
        let mut points: Vec<(f64, f64, f64)> = channels
            .iter()
            .filter(|(_, channel)| channel.frequency_hz == frequency_hz)
            .filter_map(|(_, channel)| {
                let traces = channel.diagnostics.traces.as_ref()?;
                let square = channel.input_mean_k()?.powi(2);
                Some((channel.diagnostics.epsilon?, traces.sigma_n_k2.value, square * traces.sigma_s.value))
            })
            .collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        if points.len() < 2 {
            continue;
        }
        let at = format!("{:.3} MHz", frequency_hz / 1e6);
        let noise = points.iter().map(|point| (point.0, point.1)).collect();
        let bias = points.iter().map(|point| (point.0, point.2)).collect();
        curves.push(Curve { label: format!("Tr Sigma_{{n}}, {at}"), points: noise, dashed: false });
        let label = format!("mean(T)² Tr Sigma_{{s}}, {at}");
        curves.push(Curve { label, points: bias, dashed: true });
    }
    (!curves.is_empty()).then(|| Plot {
        title: "Thermal noise and regularisation bias".to_owned(),
        x: Axis { label: "epsilon".to_owned(), log: true, limits: None },
        y: Axis { label: "trace (K²)".to_owned(), log: true, limits: None },
        curves,
        levels: Vec::new(),
    })
}
