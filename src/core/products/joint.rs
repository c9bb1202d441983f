//! Products of joint maps: FITS maps, pictures, spectra and `joint.json`.

use std::fmt;
use std::path::Path;

use serde::Serialize;

use super::error::{ProductsError, create_folder, write_product};
use super::pictures::{ColourScale, MapPanel, Palette, Sampling, Scaling, View, draw_map};
use crate::imaging::joint::{
    Agreement, Correlation, JointMap, JointSolution, PowerAgreement, PowerPriors, SpectralMaps,
};
use crate::sky::Frame;
use crate::sky::fits::{Card, Column, WriteOptions, write_columns};
use crate::units::constants::HEALPIX_UNSEEN as UNSEEN;
use crate::units::frequency_folder;

/// Name of the folder of joint maps among the products of `run`.
pub const JOINT: &str = "joint";

/// What joint maps say of themselves: the content of `joint.json`.
#[derive(Clone, Debug, Serialize)]
pub struct JointReport {
    /// Correlation of the channels at degrees an octave apart; empty for one channel alone.
    pub likeness: Vec<Correlation>,
    /// Priors of the total powers; `None` if no channel has any, or they are left out.
    pub power_priors: Option<PowerPriors>,
    /// Iterations of the solution.
    pub iterations: usize,
    /// Residual at its end.
    pub residual: f64,
    /// Whether it reached `map.residual_max`.
    pub converged: bool,
    /// Number of posterior samples, from which errors of means and spectra are.
    pub samples: usize,
    /// Relative standard deviation of those errors: 1 / sqrt(2 samples).
    pub sigma_uncertainty: f64,
    /// The maps, in order of frequency.
    pub maps: Vec<JointMapReport>,
    /// File of spectral index and curvature; `None` for a channel alone.
    pub spectra: Option<String>,
}

/// A joint map.
#[derive(Clone, Debug, Serialize)]
pub struct JointMapReport {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Folder of its files.
    pub folder: String,
    /// Mean, K.
    pub mean_k: f64,
    /// Standard deviation of the mean, K.
    pub mean_sigma_k: f64,
    /// Root mean square of the pixels' standard deviations.
    pub sigma_rms_k: f64,
    /// Agreement of the channel's data with the map; `None` between channels.
    pub agreement: Option<Agreement>,
    /// Total powers in the fit; `None` without any.
    pub powers: Option<PowerAgreement>,
}

/// Writes joint maps, their spectra and `joint.json` into a folder; pictures in the given frame, if any.
///
/// # Errors
/// A file that cannot be written.
pub fn write_joint(
    out: &Path,
    solved: &JointSolution,
    priors: Option<PowerPriors>,
    pictures: Option<Frame>,
) -> Result<JointReport, ProductsError> {
    let power_priors = priors.filter(|_| solved.maps.iter().any(|map| map.powers.is_some()));
    let mut maps = Vec::new();
    for map in &solved.maps {
        let folder = out.join(frequency_folder(map.frequency_hz));
        create_folder(&folder)?;
        write_map(&folder, map, power_priors.as_ref(), solved.convergence.converged)?;
        let report = map_report(&folder, map);
        if let Some(frame) = pictures {
            draw(&folder, map, report.mean_k, solved.convergence.converged, frame)?;
        }
        maps.push(report);
    }
    let spectra = out.join("spectra.fits");
    solved.spectra.iter().try_for_each(|spectral| write_spectra(&spectra, spectral))?;
    let report = JointReport {
        likeness: solved.likeness.clone(),
        power_priors,
        iterations: solved.convergence.iterations,
        residual: solved.convergence.residual,
        converged: solved.convergence.converged,
        samples: solved.samples,
        sigma_uncertainty: sigma_uncertainty(solved.samples),
        maps,
        spectra: solved.spectra.is_some().then(|| spectra.display().to_string()),
    };
    let path = out.join("joint.json");
    let text = serde_json::to_vec_pretty(&report)
        .map_err(|error| ProductsError::Encode { path: path.clone(), reason: error.to_string() })?;
    write_product(&path, text)?;
    Ok(report)
}

/// Relative standard deviation of a standard deviation that is the scatter of Gaussian samples about a known mean.
#[must_use]
pub fn sigma_uncertainty(samples: usize) -> f64 {
    (2.0 * samples as f64).sqrt().recip()
}

/// A sentence on the uncertainty of errors of `what`.
#[must_use]
pub fn uncertainty_line(what: &str, samples: usize) -> String {
    let percent = 100.0 * sigma_uncertainty(samples);
    format!(
        "errors of {what}, from {samples} samples, are uncertain by {percent:.0} %: 1 / sqrt(2 N) of N samples"
    )
}

fn write_map(
    folder: &Path,
    map: &JointMap,
    priors: Option<&PowerPriors>,
    converged: bool,
) -> Result<(), ProductsError> {
    let columns = [
        Column { name: "TEMPERATURE", unit: "K", values: &map.map_k },
        Column { name: "SIGMA", unit: "K", values: &map.sigma_k },
    ];
    let mut cards = vec![
        Card::real("FREQ", map.frequency_hz, "Hz"),
        Card::text("WHAT", "joint map", "posterior mean and standard deviation"),
        Card::logical("CONVERGD", converged, "the iteration reached map.residual_max"),
        Card::logical("POWERS", map.powers.is_some(), "total powers are in the fit"),
    ];
    if let Some((found, priors)) = map.powers.zip(priors) {
        cards.extend([
            Card::integer("PWROWS", found.rows as i64, "averages of total powers"),
            Card::integer("PWPASSES", found.passes as i64, "passes of daughters, each with its own gain"),
            Card::real("PWCHISQ", found.chi_square, "reduced chi-square of the total powers"),
            Card::real("PWGAIN", priors.gain, "prior standard deviation of gains"),
            Card::real("PWOFFSET", priors.offset, "prior of offsets, of the mean power"),
            Card::real("PWSLOPE", priors.slope, "prior of slopes over a pass, of the mean power"),
        ]);
    }
    let options = WriteOptions { cards, ..WriteOptions::default() };
    write_columns(&folder.join("map.fits"), Frame::Ecliptic, &columns, &options)?;
    Ok(())
}

fn map_report(folder: &Path, map: &JointMap) -> JointMapReport {
    let pixels = map.map_k.len() as f64;
    JointMapReport {
        frequency_hz: map.frequency_hz,
        folder: folder.display().to_string(),
        mean_k: map.map_k.iter().sum::<f64>() / pixels,
        mean_sigma_k: map.mean_sigma_k,
        sigma_rms_k: (map.sigma_k.iter().map(|sigma| sigma * sigma).sum::<f64>() / pixels).sqrt(),
        agreement: map.agreement,
        powers: map.powers,
    }
}

fn draw(
    folder: &Path,
    map: &JointMap,
    mean_k: f64,
    converged: bool,
    frame: Frame,
) -> Result<(), ProductsError> {
    let panel = MapPanel {
        values: &map.map_k,
        caption: format!("Joint map at {} MHz", map.frequency_hz / 1e6),
        scale: ColourScale::robust(&map.map_k, Scaling::Log, Palette::default()),
        unit: "K".to_owned(),
    };
    let ending = if converged { "" } else { "; not converged" };
    let subtitle = format!("mean ({mean_k:.4e} +- {:.1e}) K{ending}", map.mean_sigma_k);
    let view = View { sampling: Sampling::Interpolated, ..View::of(frame, Frame::Ecliptic) };
    Ok(draw_map(&panel, &subtitle, &view)?.write(&folder.join("map.png"))?)
}

fn write_spectra(path: &Path, found: &SpectralMaps) -> Result<(), ProductsError> {
    let with_unseen = |values: &[f64]| -> Vec<f64> {
        values.iter().map(|value| if value.is_finite() { *value } else { UNSEEN }).collect()
    };
    let named: Vec<(&str, Vec<f64>)> = [
        ("INDEX", &found.index),
        ("INDEX_SIGMA", &found.index_sigma),
        ("CURVATURE", &found.curvature),
        ("CURVATURE_SIGMA", &found.curvature_sigma),
    ]
    .into_iter()
    .filter(|(_, values)| !values.is_empty())
    .map(|(name, values)| (name, with_unseen(values)))
    .collect();
    let columns: Vec<Column<'_>> =
        named.iter().map(|(name, values)| Column { name, unit: "", values }).collect();
    let cards = vec![Card::real("FREQ", found.reference_hz, "Hz, of index and curvature")];
    let options = WriteOptions { cards, ..WriteOptions::default() };
    write_columns(path, Frame::Ecliptic, &columns, &options)?;
    Ok(())
}

impl fmt::Display for JointReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut lines = Vec::new();
        if !self.likeness.is_empty() {
            let listed = |of: &dyn Fn(&Correlation) -> String| {
                self.likeness.iter().map(of).collect::<Vec<_>>().join(", ")
            };
            lines.push(format!(
                "at l = {} channels stay alike over {} e-foldings of frequency; {} % of the power is each channel's own",
                listed(&|at| at.degree.to_string()),
                listed(&|at| format!("{:.2}", at.length)),
                listed(&|at| format!("{:.2}", 100.0 * at.own_share)),
            ));
        }
        if let Some(PowerPriors { gain, offset, slope, .. }) = &self.power_priors {
            let [gain, offset, slope] = [gain, offset, slope].map(|fraction| 100.0 * fraction);
            lines.push(format!(
            "total powers: in every pass of a daughter gain, offset and slope are free within {gain}, {offset} and {slope} %"
        ));
        }
        for map in &self.maps {
            let agreement = map.agreement.map_or("between channels".to_owned(), |found| {
                format!(
                    "chi-square {:.4} alone, {:.4} together (strain {:.2})",
                    found.chi_square_alone, found.chi_square, found.strain
                )
            });
            let powers = map.powers.map_or(String::new(), |PowerAgreement { rows, passes, chi_square }| {
                format!("; {rows} rows of total powers in {passes} passes, chi-square {chi_square:.4}")
            });
            lines.push(format!(
                "{:>8.3} MHz  mean ({:.4e} +- {:.1e}) K, pixels +- {:.2e} K rms; {agreement}{powers}; {}",
                map.frequency_hz / 1e6,
                map.mean_k,
                map.mean_sigma_k,
                map.sigma_rms_k,
                map.folder
            ));
        }
        lines.push(uncertainty_line("means and spectra", self.samples));
        lines.extend(self.spectra.iter().map(|path| format!("spectral index and curvature: {path}")));
        if !self.converged {
            lines.push(format!(
                "not converged: residual {:.1e} after {} products",
                self.residual, self.iterations
            ));
        }
        f.write_str(&lines.join("\n"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_few_samples_are_uncertain() {
        // Of N Gaussian numbers about a known mean, the variance has the relative variance 2 / N, and its root a quarter of that.
        for (samples, percent) in [(2, "50 %"), (8, "25 %"), (16, "18 %"), (200, "5 %")] {
            let line = uncertainty_line("means", samples);
            assert!(line.contains(&format!("from {samples} samples, are uncertain by {percent}")), "{line}");
        }
    }
}
