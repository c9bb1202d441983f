//! Visibilities of one pair over time and frequency, for the sky, and for the sky in pixels of the map with averaged rows and with
//! rows at pixel centres (the paper, Fig. 8).

use std::fmt::Write;

use num_complex::Complex64;
use rayon::prelude::*;
use serde::Serialize;

use super::error::FigureError;
use super::output::FigureParts;
use super::request::FigureRequest;
use super::rows::PairMoment;
use crate::pipeline::Plan;
use crate::pipeline::graph::space_segment::sky;
use crate::products::pictures::{Axis, ColourScale, Raster, draw_rasters};
use crate::response::pixel::{Comb, Directions, PairGeometry, PixelMethod, RowMaker, comb_sums};
use crate::sky::SkyMap;
use crate::sky::healpix::pixel_area_sr;
use crate::units::ChannelId;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{norm, sub};

const TIMES: usize = 60;
const FREQUENCIES: usize = 60;
/// Lowest and highest frequency relative to the channel: baselines in units of b_p differ as much.
const BAND: [f64; 2] = [0.9, 1.1];
/// Least nside of the sky over that of the map: 16 of its pixels in one of the map.
const FINENESS_MIN: usize = 4;
/// A finer `sky.file` is averaged to this, for memory.
const NSIDE_MAX: usize = 1024;

#[derive(Serialize)]
struct WaterfallNumbers {
    pair: String,
    /// Start and end of the window, s.
    window_s: [f64; 2],
    /// Lowest and highest frequency, Hz.
    band_hz: [f64; 2],
    nside: usize,
    nside_fine: usize,
    /// Shortest and longest baseline, in units of b_p.
    length_bp: [f64; 2],
    /// Error of the visibilities with rows at pixel centres, rms over the rms of the sky's visibilities.
    centre: f64,
    /// The same with averaged rows.
    average: f64,
}

/// One cell of the waterfall, with the visibilities of three methods.
struct Cell {
    t_s: f64,
    frequency_hz: f64,
    length_bp: f64,
    /// Visibilities of the fine sky, with averaged rows, and with rows at pixel centres, K sr.
    values: [Complex64; 3],
}

pub(super) fn make(plan: &Plan, request: &FigureRequest) -> Result<FigureParts, FigureError> {
    let moment = PairMoment::new(plan, request)?;
    let nside = plan.config.map.nside;
    let fine = fine_sky(plan)?;
    let window =
        plan.windows.iter().find(|window| window.end.seconds() > moment.t_s).unwrap_or(&plan.windows[0]);
    let [start_s, end_s] = [window.start, window.end].map(|time| time.seconds());
    let cells = cells(plan, &moment, &fine, [start_s, end_s])?;
    let error_of = |method| error(&cells, method).ok_or(FigureError::DarkSky { pair: moment.pair });
    let numbers = WaterfallNumbers {
        pair: moment.pair.to_string(),
        window_s: [start_s, end_s],
        band_hz: BAND.map(|factor| factor * moment.geometry.frequency_hz),
        nside,
        nside_fine: fine.nside(),
        length_bp: cells.iter().fold([f64::INFINITY, 0.0], |[least, most], cell| {
            [cell.length_bp.min(least), cell.length_bp.max(most)]
        }),
        centre: error_of(2)?,
        average: error_of(1)?,
    };
    let mut csv =
        "t_s,frequency_hz,length_bp,fine_re,fine_im,average_re,average_im,centre_re,centre_im\n".to_owned();
    for Cell { t_s, frequency_hz, length_bp, values: [fine, average, centre] } in &cells {
        let _ = writeln!(
            csv,
            "{t_s:.3},{frequency_hz:.0},{length_bp:.4},{:.6e},{:.6e},{:.6e},{:.6e},{:.6e},{:.6e}",
            fine.re, fine.im, average.re, average.im, centre.re, centre.im
        );
    }
    let picture = draw(&numbers, &cells)?;
    Ok(FigureParts::new(&numbers, csv, picture))
}

/// The sky of the first channel, finer than the map: pixels of the map's own size would have no error at their centres.
fn fine_sky(plan: &Plan) -> Result<SkyMap, FigureError> {
    let map = plan.config.map.nside;
    let expected = FINENESS_MIN * map;
    let mut fine = sky(plan, ChannelId(0))?;
    let most = NSIDE_MAX.max(expected);
    if plan.config.sky.file.is_some() && fine.nside() > most {
        fine = fine.degrade(most)?;
    }
    if fine.nside() < expected {
        return Err(FigureError::CoarseSky { sky: fine.nside(), map, expected });
    }
    Ok(fine.to_ecliptic())
}

/// The cells of the waterfall, by time and then by frequency.
fn cells(
    plan: &Plan,
    moment: &PairMoment,
    fine: &SkyMap,
    [start_s, end_s]: [f64; 2],
) -> Result<Vec<Cell>, FigureError> {
    let nside = plan.config.map.nside;
    let coarse = fine.degrade(nside)?;
    let directions = Directions::from(fine.directions_ecliptic().as_slice());
    let fine_k: Vec<f32> = fine.values().iter().map(|&value| value as f32).collect();
    let makers = [PixelMethod::Average, PixelMethod::Centre].map(|method| RowMaker::new(nside, method));
    let [average, centre] = makers;
    let makers = [average?, centre?];
    let bp_per_wavelength = pixel_area_sr(nside).sqrt();
    let comb = Comb {
        first: BAND[0] - 1.0,
        step: (BAND[1] - BAND[0]) / (FREQUENCIES - 1) as f64,
        count: FREQUENCIES,
    };
    let factor = |k: usize| 1.0 + comb.first + comb.step * k as f64;
    // Builds tables before the parallel tasks need them.
    for k in 0..FREQUENCIES {
        let geometry =
            PairGeometry { frequency_hz: factor(k) * moment.geometry.frequency_hz, ..moment.geometry };
        makers[0].prepare(&geometry);
    }
    let cells_at = |n: usize| -> Result<Vec<Cell>, FigureError> {
        let t_s = start_s + (n as f64 + 0.5) / TIMES as f64 * (end_s - start_s);
        let [r_i_m, r_j_m] = [moment.pair.i, moment.pair.j].map(|n| plan.array.position_m(n.into(), t_s));
        let geometry = PairGeometry { r_i_m, r_j_m, ..moment.geometry };
        let length_m = norm(sub(r_i_m, r_j_m));
        let fine_values = comb_sums(&[geometry], comb, &directions, &fine_k, pixel_area_sr(fine.nside()))?;
        let mut row = [vec![0.0_f64; makers[0].pixels()], vec![0.0_f64; makers[0].pixels()]];
        let from_rows = |maker: &RowMaker, geometry: &PairGeometry, [re, im]: &mut [Vec<f64>; 2]| {
            maker.fill(geometry, pixel_area_sr(nside), re, im);
            let sum = |part: &[f64]| part.iter().zip(coarse.values()).map(|(b, t)| b * t).sum::<f64>();
            Complex64::new(sum(re), sum(im))
        };
        Ok((0..FREQUENCIES)
            .map(|k| {
                let frequency_hz = factor(k) * moment.geometry.frequency_hz;
                let geometry = PairGeometry { frequency_hz, ..geometry };
                let [average, centre] = makers.each_ref().map(|maker| from_rows(maker, &geometry, &mut row));
                let length_bp = length_m * frequency_hz / SPEED_OF_LIGHT_M_S * bp_per_wavelength;
                Cell { t_s, frequency_hz, length_bp, values: [fine_values[k], average, centre] }
            })
            .collect())
    };
    let columns: Vec<Vec<Cell>> = (0..TIMES).into_par_iter().map(cells_at).collect::<Result<_, _>>()?;
    Ok(columns.into_iter().flatten().collect())
}

/// Error of the visibilities of a method, rms over the rms of the sky's; `None` if these are all 0.
fn error(cells: &[Cell], method: usize) -> Option<f64> {
    let power: f64 = cells.iter().map(|cell| cell.values[0].norm_sqr()).sum();
    let square: f64 = cells.iter().map(|cell| (cell.values[method] - cell.values[0]).norm_sqr()).sum();
    (power > 0.0).then(|| (square / power).sqrt())
}

fn draw(
    numbers: &WaterfallNumbers,
    cells: &[Cell],
) -> Result<crate::products::pictures::Picture, FigureError> {
    // Rows of the picture are times, columns frequencies.
    let real_part = |k: usize| cells.iter().map(|cell| cell.values[k].re).collect::<Vec<f64>>();
    let drawn = [
        (format!("nside {}", numbers.nside_fine), real_part(0)),
        (format!("nside {}, averaged", numbers.nside), real_part(1)),
        (format!("nside {}, at centres", numbers.nside), real_part(2)),
    ];
    let scale = ColourScale::symmetric(&drawn[0].1);
    let minutes = (numbers.window_s[1] - numbers.window_s[0]) / 60.0;
    let rasters: Vec<Raster<'_>> = drawn
        .iter()
        .map(|(title, values)| Raster {
            title: title.clone(),
            x: Axis {
                label: "frequency (MHz)".to_owned(),
                log: false,
                limits: Some((numbers.band_hz[0] / 1e6, numbers.band_hz[1] / 1e6)),
            },
            y: Axis {
                label: "time into the window (min)".to_owned(),
                log: false,
                limits: Some((0.0, minutes)),
            },
            values,
            columns: FREQUENCIES,
            scale,
            unit: "K sr".to_owned(),
        })
        .collect();
    Ok(draw_rasters(&format!("Visibilities of pair {}, real part", numbers.pair), &rasters, 3)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(values: [f64; 3]) -> Cell {
        let values = values.map(|value| Complex64::new(0.0, value));
        Cell { t_s: 0.0, frequency_hz: 10e6, length_bp: 1.0, values }
    }

    #[test]
    fn a_dark_sky_has_no_relative_error() {
        assert_eq!(error(&[cell([0.0; 3])], 1), None);
        // By hand: the root of (1 + 9) / (9 + 16).
        let bright = [cell([3.0, 4.0, 3.0]), cell([-4.0, -1.0, -4.0])];
        assert!((error(&bright, 1).unwrap() - 0.4_f64.sqrt()).abs() < 1e-15);
        assert_eq!(error(&bright, 2), Some(0.0));
    }
}
