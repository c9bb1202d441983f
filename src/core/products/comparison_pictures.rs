//! Draws the comparison of a map with the input sky.

use super::pictures::{
    Axis, ColourScale, Curve, MapPanel, Picture, PictureError, Plot, Sampling, View, draw_map, draw_plots,
};
use crate::sky::{Comparison, Frame, is_unseen};

/// Draws (map - truth) / truth over the sky, percent, in a celestial frame.
///
/// # Errors
/// [`PictureError::Size`], which cannot occur for one map.
pub fn draw_relative_error(
    title: &str,
    subtitle: &str,
    comparison: &Comparison,
    frame: Frame,
) -> Result<Picture, PictureError> {
    let map = &comparison.relative_error_map;
    let percent = |&value: &f64| if is_unseen(value) { value } else { 100.0 * value };
    let values: Vec<f64> = map.values().iter().map(percent).collect();
    let panel = MapPanel {
        values: &values,
        caption: title.to_owned(),
        scale: ColourScale::symmetric(&values),
        unit: "% of the truth".to_owned(),
    };
    let view = View { sampling: Sampling::Interpolated, ..View::of(frame, map.frame()) };
    draw_map(&panel, subtitle, &view)
}

/// Draws rho_l, the angular power spectra and SNR_l as curves.
///
/// # Errors
/// [`PictureError::Size`], which cannot occur for three plots.
pub fn draw_comparison(title: &str, comparison: &Comparison) -> Result<Picture, PictureError> {
    let curve = |label: &str, values: &[f64], dashed: bool| Curve {
        label: label.to_owned(),
        points: comparison.l.iter().map(|&l| l as f64).zip(values.iter().copied()).collect(),
        dashed,
    };
    let correlations = match &comparison.rho_noise_subtracted {
        None => vec![curve("", &comparison.rho, false)],
        Some(rho_noise_subtracted) => vec![
            curve("with the map's noise", &comparison.rho, false),
            curve("noise power subtracted", rho_noise_subtracted, true),
        ],
    };
    let l = Axis { label: "degree l".to_owned(), ..Axis::default() };
    let mut plots = vec![
        Plot {
            title: "Correlation with the input".to_owned(),
            x: l.clone(),
            y: Axis { label: "rho_{l}".to_owned(), limits: Some((0.0, 1.05)), log: false },
            curves: correlations,
            levels: vec![1.0],
        },
        Plot {
            title: "Angular power".to_owned(),
            x: l.clone(),
            y: Axis { label: "C_{l} (K²)".to_owned(), log: true, limits: None },
            curves: vec![
                curve("map", &comparison.cl_map, false),
                curve("input", &comparison.cl_truth, true),
                curve("cross", &comparison.cl_cross, false),
            ],
            levels: Vec::new(),
        },
    ];
    if let Some(snr) = &comparison.snr {
        plots.push(Plot {
            title: "Signal to noise".to_owned(),
            x: l,
            y: Axis { label: "SNR_{l}".to_owned(), log: true, limits: None },
            curves: vec![curve("", snr, false)],
            levels: vec![1.0],
        });
    }
    draw_plots(title, &plots, plots.len())
}
