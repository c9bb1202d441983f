//! Scatter of maps over realisations of noise and instrument errors: standard deviation of pixels, spread and covariance of `C_l`.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::case::CaseSummary;
use super::noise_maps::noise_file;
use super::study_file::direction_name;
use crate::pipeline::config::PipelineError;
use crate::products::{ChannelFigures, write_product};
use crate::sky::fits::{Column, ReadOptions, WriteOptions, read_whole_map, write_columns, write_map};
use crate::sky::harmonics::AnalysisOptions;
use crate::sky::healpix::{pixel_count, pixel_of};
use crate::sky::spectra::auto_cl;
use crate::sky::{Frame, SkyMap};
use crate::units::vector::direction;
use crate::units::{InvalidValue, frequency_folder};

/// Scatter over the realisations of one case, for one channel.
#[derive(Clone, Debug, Serialize)]
pub struct RealisationSpread {
    /// Label of the case; empty if it is the only one.
    pub case: String,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Number of realisations.
    pub count: usize,
    /// Standard deviation of a pixel of the noise-only map, root mean square over the sphere, K.
    pub sigma_rms_k: f64,
    /// Scatter of the pixels' standard deviation over the sphere, relative to its mean.
    pub sigma_scatter: f64,
    /// Spread of the angular power of the noise-only maps.
    pub noise: PowerSpread,
    /// Spread of the angular power of the maps, if they differ and were compared with their input.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub map: Option<PowerSpread>,
    /// Files of the scatter, in the study's folder.
    pub files: Vec<PathBuf>,
}

/// Requested covariances, and the folder for the products.
#[derive(Clone, Copy)]
pub(in crate::pipeline) struct SpreadProducts<'a> {
    /// Directions whose covariance with all pixels is computed: longitude and latitude in the maps' frame, degrees.
    pub(in crate::pipeline) covariance_at_deg: &'a [[f64; 2]],
    pub(in crate::pipeline) folder: &'a Path,
}

/// Accumulated second moments of the noise over realisations: of each pixel, and of some pixels with all others.
struct SecondMoments {
    count: f64,
    squares: Vec<f64>,
    /// Chosen pixels, and sums of their products with all pixels.
    rows: Vec<(usize, Vec<f64>)>,
}

impl SecondMoments {
    fn new(nside: usize, at_deg: &[[f64; 2]]) -> Self {
        let zeros = vec![0.0; pixel_count(nside)];
        let row = |&[longitude_deg, latitude_deg]: &[f64; 2]| {
            (pixel_of(nside, direction(longitude_deg, latitude_deg)), zeros.clone())
        };
        Self { count: 0.0, squares: zeros.clone(), rows: at_deg.iter().map(row).collect() }
    }

    /// Adds a map; `false` if it has another number of pixels.
    fn add(&mut self, noise_k: &[f64]) -> bool {
        if noise_k.len() != self.squares.len() {
            return false;
        }
        self.count += 1.0;
        self.squares.iter_mut().zip(noise_k).for_each(|(sum, value)| *sum += value * value);
        for (pixel, row) in &mut self.rows {
            let pixel_k = noise_k[*pixel];
            row.iter_mut().zip(noise_k).for_each(|(sum, value)| *sum += pixel_k * value);
        }
        true
    }

    /// Standard deviation of each pixel, K. The noise has zero mean.
    fn sigma_k(&self) -> Vec<f64> {
        self.squares.iter().map(|sum| (sum / self.count).sqrt()).collect()
    }

    /// Covariance of each chosen pixel with all pixels, K^2.
    fn covariances_k2(&self) -> impl Iterator<Item = Vec<f64>> {
        self.rows.iter().map(|(_, row)| row.iter().map(|sum| sum / self.count).collect())
    }
}

/// Mean and spread of the angular power over realisations, for l = 0, 1, ...
#[derive(Clone, Debug, Serialize)]
pub struct PowerSpread {
    /// Mean of C_l, K^2.
    pub mean_k2: Vec<f64>,
    /// Standard deviation of C_l, K^2.
    pub deviation_k2: Vec<f64>,
    /// Covariance of C_l and C_l', K^4; written to a separate file.
    #[serde(skip)]
    covariance_k4: Vec<Vec<f64>>,
}

impl PowerSpread {
    /// The spread of at least two spectra of the same length.
    fn new(spectra: &[Vec<f64>]) -> Self {
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

/// Computes the scatter of each group of cases that differ only in their realisation, and writes its products for each channel: maps of
/// the standard deviation and of covariances, and tables of the covariance of C_l. Groups with a single realisation are left out.
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
        for channel in 0..members[0].figures.channels.len() {
            let figures: Vec<(&CaseSummary, &ChannelFigures)> = members
                .iter()
                .filter_map(|member| Some((*member, member.figures.channels.get(channel)?)))
                .collect();
            if figures.len() == members.len() {
                let number = found.len() + 1;
                found.push(channel_spread(case, number, &figures, products)?);
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
    let mhz = frequency_folder(first.frequency_hz);
    let mut noise_k2 = Vec::new();
    let mut pixels: Option<(Frame, SecondMoments)> = None;
    let files = members.iter().flat_map(|(member, _)| {
        let folder = out.join(&member.folder);
        (1..=member.realisations).map(move |number| noise_file(&folder, first.frequency_hz, number))
    });
    for path in files {
        let noise = read_whole_map(&path, &ReadOptions::default())?;
        let (frame, pixels) = pixels
            .get_or_insert_with(|| (noise.frame(), SecondMoments::new(noise.nside(), covariance_at_deg)));
        if *frame != noise.frame() || !pixels.add(noise.values()) {
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
    let mean_square = sigma_k.iter().map(|sigma| sigma * sigma).sum::<f64>() / sigma_k.len() as f64;
    let mean = sigma_k.iter().sum::<f64>() / sigma_k.len() as f64;
    let noise = PowerSpread::new(&noise_k2);
    let map_k2: Option<Vec<Vec<f64>>> = members
        .iter()
        .map(|(_, figures)| Some(figures.power.as_ref()?.map_k2.iter().map(|c| c.unwrap_or(0.0)).collect()))
        .collect();
    // Realisations that differ only in the noise map share one map of the sky.
    let map = map_k2.filter(|spectra| spectra.len() > 1).map(|spectra| PowerSpread::new(&spectra));
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
    for (kind, spread) in [("noise", Some(&noise)), ("map", map.as_ref())] {
        let Some(spread) = spread else { continue };
        let name = PathBuf::from(format!("covariance-{kind}-{number}-{mhz}.csv"));
        write_product(&out.join(&name), spread.csv())?;
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

pub(in crate::pipeline) fn spreads_csv(spreads: &[RealisationSpread]) -> String {
    let mut out =
        "case,frequency_hz,realisations,l,noise_mean_k2,noise_deviation_k2,map_mean_k2,map_deviation_k2\n"
            .to_owned();
    for spread in spreads {
        let case = spread.case.replace('"', "\"\"");
        for (l, (mean, deviation)) in spread.noise.mean_k2.iter().zip(&spread.noise.deviation_k2).enumerate()
        {
            let map_value = |values: fn(&PowerSpread) -> &[f64]| {
                let value = spread.map.as_ref().and_then(|map| values(map).get(l));
                value.map_or_else(String::new, |value| format!("{value:e}"))
            };
            // Writing to a string cannot fail.
            let _ = writeln!(
                out,
                "\"{case}\",{},{},{l},{mean:e},{deviation:e},{},{}",
                spread.frequency_hz,
                spread.count,
                map_value(|map| &map.mean_k2),
                map_value(|map| &map.deviation_k2)
            );
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_deviations_and_covariances_match_their_definitions() {
        let spread = PowerSpread::new(&[vec![1.0, 4.0], vec![3.0, 0.0], vec![5.0, 2.0]]);
        assert_eq!(spread.mean_k2, [3.0, 2.0]);
        // Sums of squares: 8 and 8; sum of products: -4; divided by n - 1 = 2.
        assert_eq!(spread.covariance_k4, [[4.0, -2.0], [-2.0, 4.0]]);
        assert_eq!(spread.deviation_k2, [2.0, 2.0]);
        assert_eq!(spread.csv(), "4e0,-2e0\n-2e0,4e0\n");
    }
}
