//! Draws the figures of several runs as overlaid curves.

use super::pictures::{Axis, Curve, Picture, PictureError, Plot, draw_plots};
use super::runs::{ChannelFigures, RunFigures, common_label, trace_points};

/// Maximum number of overlaid curves; more cannot be distinguished.
const DRAWN_MAX: usize = 14;

/// Draws overlaid curves of runs: rho_l, SNR_l, C_l of the maps and, for groups of runs that differ only in epsilon, the traces
/// against it.
///
/// # Errors
/// [`PictureError::Size`], which cannot occur for six plots.
pub fn draw_runs(
    title: &str,
    runs: &[&RunFigures],
    groups: &[Vec<&RunFigures>],
) -> Result<Picture, PictureError> {
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
    let correlations = of_degrees(&|c| c.rho.as_ref());
    // Errors can make a map's harmonics the opposite of the input's.
    let lowest = correlations.iter().flat_map(|curve| &curve.points).map(|point| point.1).fold(0.0, f64::min);
    let low = if lowest < 0.0 { lowest - 0.05 } else { 0.0 };
    let rho = Axis { label: "rho_{l}".to_owned(), limits: Some((low, 1.05)), log: false };
    plot("Correlation with the input", rho, correlations, vec![1.0]);
    let snr = Axis { label: "SNR_{l}".to_owned(), log: true, limits: None };
    plot("Signal to noise", snr, of_degrees(&|c| c.snr.as_ref()), vec![1.0]);
    let mut powers = of_degrees(&|c| c.power.as_ref().map(|power| &power.map_k2));
    let drawn = channels.iter().take(DRAWN_MAX);
    let mut inputs: Vec<(f64, Curve)> = Vec::new();
    for (_, channel) in drawn {
        let Some(power) = &channel.power else { continue };
        if inputs.iter().all(|(frequency_hz, _)| *frequency_hz != channel.frequency_hz) {
            let points =
                power.input_k2.iter().enumerate().map(|(l, y)| (l as f64, y.unwrap_or(f64::NAN))).collect();
            let label = format!("input, {:.3} MHz", channel.frequency_hz / 1e6);
            inputs.push((channel.frequency_hz, Curve { label, points, dashed: true }));
        }
    }
    powers.extend(inputs.into_iter().map(|(_, curve)| curve));
    let power = Axis { label: "C_{l} (K²)".to_owned(), log: true, limits: None };
    plot("Angular power of the maps", power, powers, Vec::new());
    // The ratio may be far above one, as errors also add power.
    let ratio = Axis { label: "C_{l} / C_{l} ideal".to_owned(), log: true, limits: None };
    let kept = of_degrees(&|c| c.power_kept.as_ref().map(|kept| &kept.cl_ratio));
    plot("Power relative to the ideal instrument", ratio, kept, vec![0.95, 1.0]);
    let ratio = Axis { label: "coherent power".to_owned(), limits: Some((0.0, 1.2)), log: false };
    let coherent = of_degrees(&|c| c.power_kept.as_ref().map(|kept| &kept.coherent));
    plot("Coherent power relative to the ideal instrument", ratio, coherent, vec![0.95, 1.0]);
    plots.extend(trace_plot(groups));
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

/// Plots the traces against epsilon, two curves for each group and channel; `None` for fewer than two points.
fn trace_plot(groups: &[Vec<&RunFigures>]) -> Option<Plot> {
    let mut curves: Vec<Curve> = Vec::new();
    for group in groups {
        for (k, channel) in group.first().map_or(&[][..], |run| &run.channels).iter().enumerate() {
            let points = trace_points(group, k);
            // Runs that differ in something else than epsilon are no curve.
            let is_curve = points.len() > 1 && points.windows(2).all(|two| two[0][0] < two[1][0]);
            if !is_curve || curves.len() + 2 > DRAWN_MAX {
                continue;
            }
            let frequency = format!("{:.3} MHz", channel.frequency_hz / 1e6);
            let label = common_label(group);
            let of = match groups.len() == 1 || label.is_empty() {
                true => frequency,
                false => format!("{label}, {frequency}"),
            };
            let noise = points.iter().map(|point| (point[0], point[1])).collect();
            let bias = points.iter().map(|point| (point[0], point[3].powi(2) * point[2])).collect();
            curves.push(Curve { label: format!("Tr Sigma_{{n}}, {of}"), points: noise, dashed: false });
            let label = format!("mean(T)² Tr Sigma_{{s}}, {of}");
            curves.push(Curve { label, points: bias, dashed: true });
        }
    }
    (!curves.is_empty()).then(|| Plot {
        title: "Thermal noise and regularisation bias".to_owned(),
        x: Axis { label: "epsilon".to_owned(), log: true, limits: None },
        y: Axis { label: "trace (K²)".to_owned(), log: true, limits: None },
        curves,
        levels: Vec::new(),
    })
}

#[cfg(test)]
mod tests {
    use super::super::runs::tests::run;
    use super::*;

    #[test]
    fn each_group_has_traces_of_its_own() {
        let labels = ["noise = 0", "noise = 3e8"]
            .map(|noise| [1e-6, 1e-4].map(|e| (format!("{noise}, epsilon = {e}"), e)));
        let runs =
            labels.map(|group| group.map(|(label, epsilon)| run(&label, epsilon, 1.0 / epsilon, epsilon)));
        let groups: Vec<Vec<&RunFigures>> = runs.iter().map(|group| group.iter().collect()).collect();
        let plot = trace_plot(&groups).unwrap();
        let names: Vec<&str> = plot.curves.iter().map(|curve| curve.label.as_str()).collect();
        assert_eq!(
            names,
            [
                "Tr Sigma_{n}, noise = 0, 10.000 MHz",
                "mean(T)² Tr Sigma_{s}, noise = 0, 10.000 MHz",
                "Tr Sigma_{n}, noise = 3e8, 10.000 MHz",
                "mean(T)² Tr Sigma_{s}, noise = 3e8, 10.000 MHz"
            ]
        );
        assert!(
            plot.curves.iter().all(|curve| curve.points.len() == 2 && curve.points[0].0 < curve.points[1].0)
        );
        // Runs that differ in something else have two values at an epsilon, which no curve can show.
        let all: Vec<&RunFigures> = runs.iter().flatten().collect();
        assert!(trace_plot(&[all]).is_none());
    }
}
