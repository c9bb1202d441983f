//! Coverage by direction: observing time of pairs, visibilities and projected baselines (the paper, Sect. 4.4).

use std::f64::consts::FRAC_PI_2;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::error::FigureError;
use super::exposure::{TimeSample, gather, limit_m};
use super::output::FigureParts;
use crate::array::{hidden_by_moon, integration_time_s};
use crate::pipeline::Plan;
use crate::products::ProductsError;
use crate::products::pictures::{ColourScale, MapPanel, Palette, Scaling, Sheet, View, draw_sheet};
use crate::sky::Frame;
use crate::sky::fits::{Card, Column, WriteOptions, write_columns};
use crate::sky::healpix::pixel_directions;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, cross, dot, norm, scale, sub};

/// nside of the maps. Pixels of 7 degrees are small compared with the visible part of the sky.
const NSIDE: usize = 8;
/// Time step, s, in which a daughter moves by five degrees.
const STEP_S: f64 = 120.0;
/// Cells along a side of the plane of projected baselines.
const CELLS: usize = 32;
const WORDS: usize = CELLS * CELLS / 64;
/// Edges of the latitude bands, from the ecliptic to the pole, degrees.
const BANDS_DEG: [[f64; 2]; 6] =
    [[0.0, 15.0], [15.0, 30.0], [30.0, 45.0], [45.0, 60.0], [60.0, 75.0], [75.0, 90.0]];

#[derive(Serialize)]
struct CoverageNumbers {
    nside: usize,
    channels: Vec<ChannelCoverageNumbers>,
    /// Minimum, mean and maximum over directions of the time of the first channel relative to each channel.
    first_over_channel: Vec<[f64; 3]>,
}

#[derive(Serialize)]
struct ChannelCoverageNumbers {
    frequency_hz: f64,
    limit_m: f64,
    limit_wavelengths: f64,
    // Mean, minimum and maximum over the sky.
    pair_h: [f64; 3],
    visibilities: [f64; 3],
    shortest_wavelengths: [f64; 3],
    uv_filled: [f64; 3],
    bands: Vec<BandNumbers>,
}

/// Means over directions in a latitude band, north and south.
#[derive(Serialize)]
struct BandNumbers {
    latitude_deg: [f64; 2],
    pair_h: f64,
    visibilities: f64,
    shortest_wavelengths: f64,
    uv_filled: f64,
}

/// A direction with the axes of its tangent plane.
struct Direction {
    n_hat: Vec3,
    axes: [Vec3; 2],
}

#[derive(Clone)]
struct ChannelMaps {
    limit_m: f64,
    pair_s: Vec<f64>,
    visibilities: Vec<f64>,
    shortest_square_m2: Vec<f64>,
    longest_square_m2: Vec<f64>,
    cells: Vec<[u64; WORDS]>,
}

impl ChannelMaps {
    fn new(limit_m: f64, pixels: usize) -> Self {
        Self {
            limit_m,
            pair_s: vec![0.0; pixels],
            visibilities: vec![0.0; pixels],
            shortest_square_m2: vec![f64::INFINITY; pixels],
            longest_square_m2: vec![0.0; pixels],
            cells: vec![[0; WORDS]; pixels],
        }
    }

    fn merge(&mut self, other: &Self) {
        for k in 0..self.pair_s.len() {
            self.pair_s[k] += other.pair_s[k];
            self.visibilities[k] += other.visibilities[k];
            self.shortest_square_m2[k] = self.shortest_square_m2[k].min(other.shortest_square_m2[k]);
            self.longest_square_m2[k] = self.longest_square_m2[k].max(other.longest_square_m2[k]);
            self.cells[k].iter_mut().zip(other.cells[k]).for_each(|(to, from)| *to |= from);
        }
    }

    /// Hours, visibilities, shortest projected baseline in wavelengths, and filled fraction of the uv plane.
    fn columns(&self, frequency_hz: f64) -> [Vec<f64>; 4] {
        let wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz;
        let inside = (0..CELLS * CELLS).filter(|&cell| is_inside(cell)).count() as f64;
        let filled =
            |cells: &[u64; WORDS]| cells.iter().map(|word| word.count_ones()).sum::<u32>() as f64 / inside;
        [
            self.pair_s.iter().map(|s| s / 3600.0).collect(),
            self.visibilities.clone(),
            self.shortest_square_m2.iter().map(|square| square.sqrt() / wavelength_m).collect(),
            self.cells.iter().map(filled).collect(),
        ]
    }
}

fn add(maps: &mut [ChannelMaps], plan: &Plan, directions: &[Direction], sample: &TimeSample<'_>) {
    let moon_m = plan.array.moon_radius_m();
    let sees: Vec<Vec<bool>> = sample
        .states
        .iter()
        .map(|state| directions.iter().map(|p| !hidden_by_moon(state.position_m, p.n_hat, moon_m)).collect())
        .collect();
    for pair in sample.pairs {
        let [i, j] = [pair.i, pair.j].map(usize::from);
        let (a, b) = (sample.states[i], sample.states[j]);
        let baseline_m = sub(a.position_m, b.position_m);
        let square_m2 = dot(baseline_m, baseline_m);
        for (maps, schedule) in maps.iter_mut().zip(&plan.schedules) {
            if square_m2 >= maps.limit_m * maps.limit_m {
                continue;
            }
            let dt_s =
                integration_time_s(schedule.rule, schedule.frequency_hz, a.velocity_m_s, b.velocity_m_s);
            let per_m = 0.5 * CELLS as f64 / maps.limit_m;
            for (k, direction) in directions.iter().enumerate().filter(|&(k, _)| sees[i][k] && sees[j][k]) {
                maps.pair_s[k] += sample.length_s;
                maps.visibilities[k] += sample.length_s / dt_s;
                let along_m = dot(baseline_m, direction.n_hat);
                let across_m2 = square_m2 - along_m * along_m;
                maps.shortest_square_m2[k] = maps.shortest_square_m2[k].min(across_m2);
                maps.longest_square_m2[k] = maps.longest_square_m2[k].max(across_m2);
                let u = direction.axes.map(|axis| per_m * dot(baseline_m, axis));
                for sign in [1.0, -1.0] {
                    let [x, y] = u.map(|u| {
                        let cell = sign * u + 0.5 * CELLS as f64;
                        (cell.max(0.0) as usize).min(CELLS - 1)
                    });
                    let cell = y * CELLS + x;
                    if is_inside(cell) {
                        maps.cells[k][cell / 64] |= 1 << (cell % 64);
                    }
                }
            }
        }
    }
}

/// Whether the centre of a cell is within the limit.
fn is_inside(cell: usize) -> bool {
    let coordinate = |k: usize| 2.0 * (k as f64 + 0.5) / CELLS as f64 - 1.0;
    coordinate(cell % CELLS).hypot(coordinate(cell / CELLS)) < 1.0
}

/// Coverage of one channel over the whole sky.
pub(super) struct WholeCoverage {
    /// Shortest and longest projected baseline that maps use, m.
    pub projected_m: [f64; 2],
    /// Observing time of pairs in the best direction over that in the worst.
    pub most_over_least: f64,
}

/// Coverage of each channel; `None` where no baseline is short enough for the map.
pub(super) fn whole_coverage(plan: &Plan) -> Vec<Option<WholeCoverage>> {
    let extreme = |values: &[f64], take: fn(f64, f64) -> f64| values.iter().copied().reduce(take);
    let of_channel = |maps: &ChannelMaps| {
        let shortest_m2 = extreme(&maps.shortest_square_m2, f64::min).filter(|found| found.is_finite())?;
        let longest_m2 = extreme(&maps.longest_square_m2, f64::max)?;
        let [least, most] = [f64::min, f64::max].map(|take| extreme(&maps.pair_s, take));
        let projected_m = [shortest_m2.max(0.0).sqrt(), longest_m2.sqrt()];
        Some(WholeCoverage { projected_m, most_over_least: most? / least? })
    };
    let (_, maps) = gathered(plan);
    maps.iter().map(of_channel).collect()
}

/// The directions, and the coverage of each in each channel.
fn gathered(plan: &Plan) -> (Vec<Direction>, Vec<ChannelMaps>) {
    let directions: Vec<Direction> = pixel_directions(NSIDE).into_iter().map(with_axes).collect();
    let empty = || -> Vec<ChannelMaps> {
        (0..plan.schedules.len()).map(|k| ChannelMaps::new(limit_m(plan, k), directions.len())).collect()
    };
    let maps = gather(
        plan,
        STEP_S,
        empty,
        |maps, sample| add(maps, plan, &directions, sample),
        |maps, other| maps.iter_mut().zip(&other).for_each(|(to, from)| to.merge(from)),
    );
    (directions, maps)
}

pub(super) fn make(plan: &Plan, folder: &Path) -> Result<FigureParts, FigureError> {
    let (directions, maps) = gathered(plan);
    if let Some(bare) = maps.iter().find(|maps| maps.pair_s.iter().all(|&s| s == 0.0)) {
        return Err(FigureError::NoBaseline { limit_m: bare.limit_m });
    }
    let columns: Vec<[Vec<f64>; 4]> = maps
        .iter()
        .zip(&plan.schedules)
        .map(|(maps, schedule)| maps.columns(schedule.frequency_hz))
        .collect();
    let channels = maps.iter().zip(&plan.schedules).zip(&columns);
    let numbers = CoverageNumbers {
        nside: NSIDE,
        channels: channels
            .map(|((maps, schedule), columns)| {
                channel_numbers(maps.limit_m, schedule.frequency_hz, columns, &directions)
            })
            .collect(),
        first_over_channel: columns
            .iter()
            .map(|channel| {
                let ratio: Vec<f64> = columns[0][0].iter().zip(&channel[0]).map(|(a, b)| a / b).collect();
                let [mean, minimum, maximum] = mean_and_range(&ratio);
                [minimum, mean, maximum]
            })
            .collect(),
    };
    let mut extra_files = Vec::new();
    for (columns, channel) in columns.iter().zip(&numbers.channels) {
        extra_files.push(write_maps(columns, channel.frequency_hz, folder)?);
    }
    let picture = draw(&columns, &numbers)?;
    Ok(FigureParts {
        extra_files,
        ..FigureParts::new(&numbers, table(&numbers, &columns, &directions), picture)
    })
}

/// Adds the axes of the tangent plane to a direction. Pixel centres are never at a pole.
fn with_axes(n_hat: Vec3) -> Direction {
    let east = cross([0.0, 0.0, 1.0], n_hat);
    let east = scale(1.0 / norm(east), east);
    Direction { n_hat, axes: [east, cross(n_hat, east)] }
}

fn mean_and_range(values: &[f64]) -> [f64; 3] {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let minimum = values.iter().copied().fold(f64::INFINITY, f64::min);
    let maximum = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    [mean, minimum, maximum]
}

fn channel_numbers(
    limit_m: f64,
    frequency_hz: f64,
    columns: &[Vec<f64>; 4],
    directions: &[Direction],
) -> ChannelCoverageNumbers {
    let band = |latitude_deg: [f64; 2]| {
        let mean = |column: &Vec<f64>| {
            let within = |n_hat: Vec3| {
                let pixel_latitude_deg = (FRAC_PI_2 - n_hat[2].abs().acos()).to_degrees();
                (latitude_deg[0]..latitude_deg[1]).contains(&pixel_latitude_deg)
            };
            let values = directions.iter().zip(column).filter(|(direction, _)| within(direction.n_hat));
            let (sum, count) = values.fold((0.0, 0.0), |(sum, count), (_, v)| (sum + v, count + 1.0));
            sum / count
        };
        let [pair_h, visibilities, shortest_wavelengths, uv_filled] = columns.each_ref().map(mean);
        BandNumbers { latitude_deg, pair_h, visibilities, shortest_wavelengths, uv_filled }
    };
    let [pair_h, visibilities, shortest_wavelengths, uv_filled] =
        columns.each_ref().map(|column| mean_and_range(column));
    ChannelCoverageNumbers {
        frequency_hz,
        limit_m,
        limit_wavelengths: limit_m * frequency_hz / SPEED_OF_LIGHT_M_S,
        pair_h,
        visibilities,
        shortest_wavelengths,
        uv_filled,
        bands: BANDS_DEG.into_iter().map(band).collect(),
    }
}

fn table(numbers: &CoverageNumbers, columns: &[[Vec<f64>; 4]], directions: &[Direction]) -> String {
    let mut csv =
        "frequency_hz,pixel,longitude_deg,latitude_deg,pair_h,visibilities,shortest_wavelengths,uv_filled\n"
            .to_owned();
    for (channel, [hours, visibilities, shortest, filled]) in numbers.channels.iter().zip(columns) {
        for (k, Direction { n_hat: [x, y, z], .. }) in directions.iter().enumerate() {
            let longitude_deg = y.atan2(*x).to_degrees().rem_euclid(360.0);
            let latitude_deg = z.asin().to_degrees();
            let _ = writeln!(
                csv,
                "{},{k},{longitude_deg:.4},{latitude_deg:.4},{:.4},{:.0},{:.4},{:.4}",
                channel.frequency_hz, hours[k], visibilities[k], shortest[k], filled[k]
            );
        }
    }
    csv
}

fn write_maps(columns: &[Vec<f64>; 4], frequency_hz: f64, folder: &Path) -> Result<PathBuf, FigureError> {
    let path = folder.join(format!("coverage-{:.3}MHz.fits", frequency_hz / 1e6));
    let [hours, visibilities, shortest, filled] = columns;
    let column = |name, unit, values: &'_ Vec<f64>| (name, unit, values.clone());
    let columns = [
        column("PAIRTIME", "h", hours),
        column("HITS", "", visibilities),
        column("SHORTEST", "wavelengths", shortest),
        column("UVFILL", "", filled),
    ];
    let columns: Vec<Column<'_>> =
        columns.iter().map(|(name, unit, values)| Column { name, unit, values }).collect();
    let options =
        WriteOptions { cards: vec![Card::real("FREQ", frequency_hz, "Hz")], ..WriteOptions::default() };
    write_columns(&path, Frame::Ecliptic, &columns, &options).map_err(ProductsError::from)?;
    Ok(path)
}

fn draw(
    columns: &[[Vec<f64>; 4]],
    numbers: &CoverageNumbers,
) -> Result<crate::products::pictures::Picture, FigureError> {
    let kinds = [
        ("observing time of pairs", "h"),
        ("visibilities", ""),
        ("shortest projected baseline", "wavelengths"),
        ("filled fraction of the uv plane", ""),
    ];
    let mut panels = Vec::new();
    for (kind, (what, unit)) in kinds.into_iter().enumerate() {
        for (columns, channel) in columns.iter().zip(&numbers.channels).take(4) {
            let values = &columns[kind];
            panels.push(MapPanel {
                values,
                caption: format!("{} MHz: {what}", channel.frequency_hz / 1e6),
                scale: ColourScale::robust(values, Scaling::Linear, Palette::default()),
                unit: unit.to_owned(),
            });
        }
    }
    let columns = numbers.channels.len().min(4);
    let sheet = Sheet {
        title: "Coverage by direction".to_owned(),
        columns,
        width_px: 900 * columns,
        view: View { sampling: crate::products::pictures::Sampling::Interpolated, ..View::default() },
        ..Sheet::default()
    };
    Ok(draw_sheet(&panels, &sheet)?)
}
