//! What maps scatter by over realisations of noise and of the instrument's errors: pixels, power, and the covariance of C_l.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::case::CaseSummary;
use super::noise_maps::noise_file;
use super::study_file::direction_name;
use crate::files::write_atomically;
use crate::pipeline::config::PipelineError;
use crate::products::{ChannelFigures, ProductsError};
use crate::sky::fits::{Column, ReadOptions, WriteOptions, read_whole_map, write_columns, write_map};
use crate::sky::harmonics::AnalysisOptions;
use crate::sky::healpix::{pixel_count, pixel_of};
use crate::sky::spectra::auto_cl;
use crate::sky::{Frame, SkyMap};
use crate::units::InvalidValue;
use crate::units::vector::direction;

/// Realisations of one channel of one case.
#[derive(Clone, Debug, Serialize)]
pub struct RealisationSpread {
    /// Label of the case; empty if it is the only one.
    pub case: String,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Number of realisations.
    pub count: usize,
    /// Root mean square over the sphere of the standard deviation of a pixel of the noise-only map, K.
    pub sigma_rms_k: f64,
    /// Scatter of that standard deviation over the sphere, relative to its mean.
    pub sigma_scatter: f64,
    /// Angular power of the noise-only maps.
    pub noise: PowerSpread,
    /// Angular power of the maps, if they differ and were compared with their input.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub map: Option<PowerSpread>,
    /// Its files, in the study's folder.
    pub files: Vec<PathBuf>,
}

/// Products of a study's realisations.
#[derive(Clone, Copy)]
pub(in crate::pipeline) struct SpreadProducts<'a> {
    /// Where the noise's covariance with all pixels is wanted: longitude and latitude in the maps' frame, degrees.
    pub(in crate::pipeline) covariance_at_deg: &'a [[f64; 2]],
    pub(in crate::pipeline) folder: &'a Path,
}

/// Products of the noise with itself, summed over realisations: of each pixel, and of some with all others.
struct PixelProducts {
    count: f64,
    squares: Vec<f64>,
    /// Pixels, and their products with all.
    rows: Vec<(usize, Vec<f64>)>,
}

impl PixelProducts {
    fn new(nside: usize, at_deg: &[[f64; 2]]) -> Self {
        let none = vec![0.0; pixel_count(nside)];
        let row = |&[longitude_deg, latitude_deg]: &[f64; 2]| {
            (pixel_of(nside, direction(longitude_deg, latitude_deg)), none.clone())
        };
        Self { count: 0.0, squares: none.clone(), rows: at_deg.iter().map(row).collect() }
    }

    /// Adds a map; `false` if it has another number of pixels.
    fn add(&mut self, noise_k: &[f64]) -> bool {
        if noise_k.len() != self.squares.len() {
            return false;
        }
        self.count += 1.0;
        self.squares.iter_mut().zip(noise_k).for_each(|(sum, value)| *sum += value * value);
        for (pixel, row) in &mut self.rows {
            let here = noise_k[*pixel];
            row.iter_mut().zip(noise_k).for_each(|(sum, value)| *sum += here * value);
        }
        true
    }

    /// Standard deviation by pixel, K: noise has no mean.
    fn sigma_k(&self) -> Vec<f64> {
        self.squares.iter().map(|sum| (sum / self.count).sqrt()).collect()
    }

    /// Covariance of all pixels with each of those wanted, K^2.
    fn covariances_k2(&self) -> impl Iterator<Item = Vec<f64>> {
        self.rows.iter().map(|(_, row)| row.iter().map(|sum| sum / self.count).collect())
    }
}

/// Angular power over realisations, l = 0, 1, ...
#[derive(Clone, Debug, Serialize)]
pub struct PowerSpread {
    /// Mean of C_l, K^2.
    pub mean_k2: Vec<f64>,
    /// Standard deviation of C_l, K^2.
    pub deviation_k2: Vec<f64>,
    /// Covariance of C_l and C_l', K^4; in files of its own.
    #[serde(skip)]
    covariance_k4: Vec<Vec<f64>>,
}

impl PowerSpread {
    /// The spread of at least two spectra of one length.
    fn of(spectra: &[Vec<f64>]) -> Self {
        let (count, degrees) = (spectra.len() as f64, spectra.first().map_or(0, Vec::len));
        let mean = |l: usize| spectra.iter().map(|c| c[l]).sum::<f64>() / count;
        let mean_k2: Vec<f64> = (0..degrees).map(mean).collect();
        let covariance = |a: usize, b: usize| {
            let products = spectra.iter().map(|c| (c[a] - mean_k2[a]) * (c[b] - mean_k2[b]));
            products.sum::<f64>() / (count - 1.0)
        };
        let row = |a: usize| (0..degrees).map(|b| covariance(a, b)).collect();
        let covariance_k4: Vec<Vec<f64>> = (0..degrees).map(row).collect();
        let deviation_k2 = (0..degrees).map(|l| covariance_k4[l][l].sqrt()).collect();
        Self { mean_k2, deviation_k2, covariance_k4 }
    }

    fn csv(&self) -> String {
        let line = |row: &Vec<f64>| row.iter().map(|x| format!("{x:e}")).collect::<Vec<_>>().join(",") + "\n";
        self.covariance_k4.iter().map(line).collect()
    }
}

/// Spreads of the cases of a study that differ in their realisation alone, `groups` with their labels; leaves for each channel maps of
/// sigma and of covariances, and tables of those of C_l. Groups of fewer than two realisations are left out.
///
/// # Errors
/// Maps that cannot be read; files that cannot be written.
pub(in crate::pipeline) fn spreads(
    groups: &[(String, Vec<&CaseSummary>)],
    products: SpreadProducts<'_>,
) -> Result<Vec<RealisationSpread>, PipelineError> {
    let mut found = Vec::new();
    let are_many =
        |members: &[&CaseSummary]| members.iter().map(|member| member.realisations).sum::<usize>() > 1;
    for (case, members) in groups.iter().filter(|(_, members)| are_many(members)) {
        for place in 0..members[0].figures.channels.len() {
            let of_channel: Vec<(&CaseSummary, &ChannelFigures)> = members
                .iter()
                .filter_map(|member| Some((*member, member.figures.channels.get(place)?)))
                .collect();
            if of_channel.len() == members.len() {
                let number = found.len() + 1;
                found.push(channel_spread(case, number, &of_channel, products)?);
            }
        }
    }
    Ok(found)
}

fn channel_spread(
    case: &str,
    number: usize,
    members: &[(&CaseSummary, &ChannelFigures)],
    products: SpreadProducts<'_>,
) -> Result<RealisationSpread, PipelineError> {
    let (SpreadProducts { folder: out, covariance_at_deg }, (_, first)) = (products, members[0]);
    let mhz = format!("{:.3}MHz", first.frequency_hz / 1e6);
    let mut noise_k2 = Vec::new();
    let mut pixels: Option<(Frame, PixelProducts)> = None;
    let files = members.iter().flat_map(|(member, _)| {
        let folder = out.join(&member.folder);
        (1..=member.realisations).map(move |number| noise_file(&folder, first.frequency_hz, number))
    });
    for path in files {
        let noise = read_whole_map(&path, &ReadOptions::default())?;
        let new = || (noise.frame(), PixelProducts::new(noise.nside(), covariance_at_deg));
        let (known, pixels) = pixels.get_or_insert_with(new);
        if *known != noise.frame() || !pixels.add(noise.values()) {
            let expected =
                "noise maps of one nside and frame: remove the folder of the case to make it again";
            let found = format!("nside {}, {}", noise.nside(), noise.frame());
            return Err(InvalidValue {
                key: path.display().to_string(),
                value: found,
                expected: expected.into(),
            }
            .into());
        }
        let l_max = 3 * noise.nside() - 1;
        noise_k2.push(auto_cl(&noise.harmonics(l_max, &AnalysisOptions::default())?));
    }
    let sigma_k = pixels.as_ref().map(|(_, pixels)| pixels.sigma_k()).unwrap_or_default();
    let mean_of = |of: fn(f64) -> f64| sigma_k.iter().map(|s| of(*s)).sum::<f64>() / sigma_k.len() as f64;
    let (mean_square, mean) = (mean_of(|s| s * s), mean_of(|s| s));
    let noise = PowerSpread::of(&noise_k2);
    let map_k2: Option<Vec<Vec<f64>>> = members
        .iter()
        .map(|(_, figures)| Some(figures.power.as_ref()?.map_k2.iter().map(|c| c.unwrap_or(0.0)).collect()))
        .collect();
    // Realisations of noise alone share a map.
    let map = map_k2.filter(|spectra| spectra.len() > 1).map(|spectra| PowerSpread::of(&spectra));
    let (count, mut files) = (noise_k2.len(), Vec::new());
    if let Some((frame, pixels)) = pixels {
        let name = PathBuf::from(format!("sigma-{number}-{mhz}.fits"));
        write_map(&out.join(&name), &SkyMap::new(frame, sigma_k)?, &WriteOptions::default())?;
        files.push(name);
        for (at_deg, values) in covariance_at_deg.iter().zip(pixels.covariances_k2()) {
            let name =
                PathBuf::from(format!("covariance-at-{}-{number}-{mhz}.fits", direction_name(*at_deg)));
            let column = Column { name: "COVARIANCE", unit: "K^2", values: &values };
            write_columns(&out.join(&name), frame, &[column], &WriteOptions::default())?;
            files.push(name);
        }
    }
    for (what, spread) in [("noise", Some(&noise)), ("map", map.as_ref())] {
        let Some(spread) = spread else { continue };
        let name = PathBuf::from(format!("covariance-{what}-{number}-{mhz}.csv"));
        write(&out.join(&name), spread.csv().as_bytes())?;
        files.push(name);
    }
    Ok(RealisationSpread {
        case: case.to_owned(),
        frequency_hz: first.frequency_hz,
        count,
        sigma_rms_k: mean_square.sqrt(),
        sigma_scatter: (mean_square - mean * mean).max(0.0).sqrt() / mean,
        noise,
        map,
        files,
    })
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), PipelineError> {
    let failed = |source| ProductsError::Write { path: path.to_owned(), source };
    Ok(write_atomically(path, bytes).map_err(failed)?)
}

/// Means and deviations as a table (CSV).
pub(in crate::pipeline) fn csv_of(spreads: &[RealisationSpread]) -> String {
    let mut out =
        "case,frequency_hz,realisations,l,noise_mean_k2,noise_deviation_k2,map_mean_k2,map_deviation_k2\n"
            .to_owned();
    for spread in spreads {
        let case = spread.case.replace('"', "\"\"");
        for (l, (mean, deviation)) in spread.noise.mean_k2.iter().zip(&spread.noise.deviation_k2).enumerate()
        {
            let of_map = |of: fn(&PowerSpread) -> &[f64]| {
                let value = spread.map.as_ref().and_then(|map| of(map).get(l));
                value.map_or_else(String::new, |value| format!("{value:e}"))
            };
            // Writing to a string cannot fail.
            let _ = writeln!(
                out,
                "\"{case}\",{},{},{l},{mean:e},{deviation:e},{},{}",
                spread.frequency_hz,
                spread.count,
                of_map(|map| &map.mean_k2),
                of_map(|map| &map.deviation_k2)
            );
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_deviations_and_covariances_are_those_of_the_textbook() {
        let spread = PowerSpread::of(&[vec![1.0, 4.0], vec![3.0, 0.0], vec![5.0, 2.0]]);
        assert_eq!(spread.mean_k2, [3.0, 2.0]);
        // Sums of squares 8 and 8, of products -4, over n - 1 = 2.
        assert_eq!(spread.covariance_k4, [[4.0, -2.0], [-2.0, 4.0]]);
        assert_eq!(spread.deviation_k2, [2.0, 2.0]);
        assert_eq!(spread.csv(), "4e0,-2e0\n-2e0,4e0\n");
    }
}
