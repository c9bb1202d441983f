//! A row of the beam matrix, at pixel centres and averaged over pixels (the paper, Fig. 7, which is without the Moon, as the picture here).

use std::fmt::Write;

use serde::Serialize;

use super::error::FigureError;
use super::output::FigureParts;
use super::request::FigureRequest;
use crate::pipeline::Plan;
use crate::products::pictures::{ColourScale, MapPanel, Palette, Sampling, Scaling, Sheet, View, draw_sheet};
use crate::response::pixel::{PairGeometry, PixelMethod, RowMaker};
use crate::sky::healpix::pixel_area_sr;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, norm, sub};
use crate::units::{Pair, all_pairs};

#[derive(Serialize)]
struct RowNumbers {
    frequency_hz: f64,
    nside: usize,
    pair: String,
    t_s: f64,
    r_i_m: Vec3,
    r_j_m: Vec3,
    length_m: f64,
    /// Length in units of b_p = lambda / theta_p.
    length_bp: f64,
    /// Fraction of pixels that the Moon does not occult.
    seen: f64,
    /// Mean square of the row over visible pixels.
    centre_power: f64,
    average_power: f64,
}

/// Geometry of a pair at a time.
pub(super) struct PairMoment {
    pub pair: Pair,
    pub t_s: f64,
    pub geometry: PairGeometry,
    pub length_m: f64,
    /// Length in units of b_p.
    pub length_bp: f64,
}

impl PairMoment {
    /// The requested pair and time, at the frequency of the first channel. The defaults are the middle of the first window, and
    /// the pair whose baseline is closest to 2 b_p.
    pub fn new(plan: &Plan, request: &FigureRequest) -> Result<Self, FigureError> {
        let satellites = plan.array.satellites();
        let window = plan.windows[0];
        let t_s = request.at_s.unwrap_or(0.5 * (window.start.seconds() + window.end.seconds()));
        if let Some(known_s) = plan.array.known_s()
            && !(known_s[0]..=known_s[1]).contains(&t_s)
        {
            return Err(FigureError::NoTime { at_s: t_s, known_s });
        }
        let frequency_hz = plan.schedules[0].frequency_hz;
        let bp_m = SPEED_OF_LIGHT_M_S / frequency_hz / pixel_area_sr(plan.config.map.nside).sqrt();
        let moment_of = |pair: Pair| {
            let [r_i_m, r_j_m] = [pair.i, pair.j].map(|n| plan.array.position_m(n.into(), t_s));
            let length_m = norm(sub(r_i_m, r_j_m));
            let geometry = PairGeometry {
                r_i_m,
                r_j_m,
                frequency_hz,
                moon_radius_m: plan.array.moon_radius_m(),
                response: plan.config.spacecraft.antenna.into(),
            };
            Self { pair, t_s, geometry, length_m, length_bp: length_m / bp_m }
        };
        if let Some(pair) = request.pair {
            if usize::from(pair.j) >= satellites {
                return Err(FigureError::NoPair { pair, satellites });
            }
            return Ok(moment_of(pair));
        }
        let distance = |moment: &Self| (moment.length_bp / 2.0).ln().abs();
        let moments = all_pairs(satellites).into_iter().map(moment_of);
        let best = moments.min_by(|a, b| distance(a).total_cmp(&distance(b)));
        best.ok_or(FigureError::NoBaseline { limit_m: 2.0 * bp_m })
    }
}

pub(super) fn make(plan: &Plan, request: &FigureRequest) -> Result<FigureParts, FigureError> {
    let moment = PairMoment::new(plan, request)?;
    let nside = plan.config.map.nside;
    let row = |method: PixelMethod, moon_radius_m: f64| -> Result<[Vec<f64>; 2], FigureError> {
        let maker = RowMaker::new(nside, method)?;
        let geometry = PairGeometry { moon_radius_m, ..moment.geometry };
        maker.prepare(&geometry);
        let (mut re, mut im) = (vec![0.0_f64; maker.pixels()], vec![0.0_f64; maker.pixels()]);
        maker.fill(&geometry, 1.0, &mut re, &mut im);
        Ok([re, im])
    };
    let rows = |moon_radius_m: f64| -> Result<[[Vec<f64>; 2]; 2], FigureError> {
        Ok([row(PixelMethod::Centre, moon_radius_m)?, row(PixelMethod::Average, moon_radius_m)?])
    };
    let [centre, average] = rows(moment.geometry.moon_radius_m)?;
    let square = |[re, im]: &[Vec<f64>; 2], k: usize| re[k] * re[k] + im[k] * im[k];
    let pixels = centre[0].len();
    let seen: Vec<usize> = (0..pixels).filter(|&k| square(&centre, k) > 0.0).collect();
    let power = |row: &[Vec<f64>; 2]| seen.iter().map(|&k| square(row, k)).sum::<f64>() / seen.len() as f64;
    let numbers = RowNumbers {
        frequency_hz: moment.geometry.frequency_hz,
        nside,
        pair: moment.pair.to_string(),
        t_s: moment.t_s,
        r_i_m: moment.geometry.r_i_m,
        r_j_m: moment.geometry.r_j_m,
        length_m: moment.length_m,
        length_bp: moment.length_bp,
        seen: seen.len() as f64 / pixels as f64,
        centre_power: power(&centre),
        average_power: power(&average),
    };
    let mut csv = "pixel,centre_re,centre_im,average_re,average_im\n".to_owned();
    for k in 0..pixels {
        let _ = writeln!(
            csv,
            "{k},{:.7},{:.7},{:.7},{:.7}",
            centre[0][k], centre[1][k], average[0][k], average[1][k]
        );
    }
    let picture = draw(&numbers, &rows(0.0)?)?;
    Ok(FigureParts::new(&numbers, csv, picture))
}

fn draw(
    numbers: &RowNumbers,
    rows: &[[Vec<f64>; 2]; 2],
) -> Result<crate::products::pictures::Picture, FigureError> {
    let scale = ColourScale::new(-1.0, 1.0, Scaling::Linear, Palette::Diverging)?;
    let panel = |row: usize, caption: &str| MapPanel {
        values: &rows[row][0],
        caption: caption.to_owned(),
        scale,
        unit: String::new(),
    };
    let panels = [panel(0, "at pixel centres"), panel(1, "averaged over pixels")];
    let sheet = Sheet {
        title: format!(
            "A row of B without the Moon, real part: pair {}, {:.0} m = {:.2} b_{{p}}, {} MHz, nside {}",
            numbers.pair,
            numbers.length_m,
            numbers.length_bp,
            numbers.frequency_hz / 1e6,
            numbers.nside
        ),
        columns: 2,
        width_px: 1800,
        bars: crate::products::pictures::Bars::Shared,
        view: View { sampling: Sampling::Pixels, ..View::default() },
        ..Sheet::default()
    };
    Ok(draw_sheet(&panels, &sheet)?)
}
