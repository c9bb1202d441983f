//! Comparison of a map with the input sky: spectra, correlation, signal-to-noise ratio, relative error.

use serde::Serialize;

use super::error::MapError;
use super::frame::Frame;
use super::harmonics::{Alm, AnalysisOptions, Transform};
use super::map::SkyMap;
use super::spectra::{auto_cl, cross_cl, normalised};
use crate::units::constants::HEALPIX_UNSEEN;

/// Result of a comparison. Arrays run over `l` = 0 .. l_max, including monopole and dipole.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// nside of the comparison: the coarsest of all maps.
    pub nside: usize,
    /// Common frame of all maps, or ecliptic if they differ.
    pub frame: Frame,
    /// Degrees.
    pub l: Vec<usize>,
    /// C_l of the map, K^2.
    pub cl_map: Vec<f64>,
    /// C_l of the truth, K^2.
    pub cl_truth: Vec<f64>,
    /// Cross C_l, K^2.
    pub cl_cross: Vec<f64>,
    /// Correlation rho_l = C_l^X / sqrt(C_l^in C_l^re) of the map including its noise; NaN where a spectrum is zero (null in JSON).
    pub rho: Vec<f64>,
    /// rho_l after the power of the noise-only map is subtracted from C_l^re; absent unless the map is known to contain noise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rho_noise_subtracted: Option<Vec<f64>>,
    /// C_l of the noise-only map, K^2, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cl_noise: Option<Vec<f64>>,
    /// Signal-to-noise ratio SNR_l = C_l^X / sqrt(C_l^in C_l^ns), if there is a noise map.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub snr: Option<Vec<f64>>,
    /// Statistics of the relative error.
    pub relative_error: ErrorSummary,
    /// Relative error (map - truth) / truth of each pixel; UNSEEN where the truth is zero.
    #[serde(skip)]
    pub relative_error_map: SkyMap,
}

/// Statistics of (map - truth) / truth over all pixels where the truth is not zero.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ErrorSummary {
    /// Mean.
    pub mean: f64,
    /// Root mean square.
    pub rms: f64,
    /// 5th percentile.
    pub percentile_5: f64,
    /// Median.
    pub median: f64,
    /// 95th percentile.
    pub percentile_95: f64,
}

/// Input sky to compare maps with: its pixels for the relative error, and its coefficients for the spectra.
#[derive(Clone, Debug, PartialEq)]
pub struct InputSky {
    /// The sky at the resolution of the maps.
    pub map: SkyMap,
    /// Coefficients of the sky at its own resolution, in the frame of `map`.
    pub alm: Alm,
}

impl InputSky {
    /// Prepares `sky` in its own frame or on ecliptic axes, averaged over the pixels of `nside` or split into them, with
    /// coefficients up to at most `l_max`.
    ///
    /// # Errors
    /// [`MapError::BadPixels`] for a sky with invalid pixels; [`MapError::Nside`].
    pub fn new(sky: &SkyMap, frame: Frame, nside: usize, l_max: usize) -> Result<Self, MapError> {
        let alm = harmonics(sky, frame, l_max.min(3 * sky.nside() - 1))?;
        Ok(Self { map: sky.rotate_pixels(frame).resized(nside)?, alm })
    }
}

/// Computes the coefficients of a map in its own frame or on ecliptic axes; the rotation of coefficients is exact.
fn harmonics(map: &SkyMap, frame: Frame, l_max: usize) -> Result<Alm, MapError> {
    let alm = map.harmonics(l_max, &AnalysisOptions::default())?;
    Ok(if map.frame() == frame { alm } else { alm.rotated(&map.frame().to_ecliptic()) })
}

/// Compares a map with the truth, and with a noise-only map for SNR_l.
///
/// Spectra are computed from each map's own pixels, so that rho_l refers to the truth at full resolution, as in the paper. A
/// truth averaged over the map's pixels would lack the scales that the map lacks, and correlate better. Coefficients are
/// those of healpy's `anafast`; the default `l_max` is 3 nside - 1 of the coarsest map. For the relative error all maps are
/// averaged to the coarsest nside. Maps of different frames are compared in ecliptic coordinates.
///
/// # Errors
/// [`MapError::BadPixels`] for a map with invalid pixels; [`MapError::Harmonics`] for `l_max` above
/// 3 nside - 1.
pub fn compare(
    map: &SkyMap,
    truth: &SkyMap,
    noise: Option<&SkyMap>,
    l_max: Option<usize>,
) -> Result<Comparison, MapError> {
    let all: Vec<&SkyMap> = [Some(map), Some(truth), noise].into_iter().flatten().collect();
    let coarsest = all.iter().map(|map| map.nside()).fold(map.nside(), usize::min);
    let one_frame = all.iter().all(|other| other.frame() == map.frame());
    let frame = if one_frame { map.frame() } else { Frame::Ecliptic };
    let l_max = l_max.unwrap_or(3 * coarsest - 1);
    // A degree that one of the maps does not determine is an error, and does not shorten the spectrum.
    Transform::new(coarsest, l_max)?;
    compare_with(map, &InputSky::new(truth, frame, coarsest, l_max)?, noise, Some(l_max))
}

/// Compares maps as [`compare`] with a truth whose coefficients are known, in its frame, which must be that of the maps or ecliptic.
///
/// # Errors
/// As [`compare`].
pub fn compare_with(
    map: &SkyMap,
    input: &InputSky,
    noise: Option<&SkyMap>,
    l_max: Option<usize>,
) -> Result<Comparison, MapError> {
    let InputSky { map: truth, alm: truth_alm } = input;
    let frame = truth.frame();
    let others: Vec<&SkyMap> = [Some(map), noise].into_iter().flatten().collect();
    for map in &others {
        map.check_whole()?;
    }
    let nside = others.iter().map(|map| map.nside()).fold(truth.nside(), usize::min);
    let l_max = l_max.unwrap_or(3 * nside - 1);
    let map_alm = harmonics(map, frame, l_max)?;
    // The truth may have degrees beyond `l_max`, or fewer.
    let cl_cross = cross_cl(&map_alm, truth_alm);
    let l_max = cl_cross.len() - 1;
    let cl = |alm: &Alm| auto_cl(alm).into_iter().take(l_max + 1).collect::<Vec<f64>>();
    let (cl_map, cl_truth) = (cl(&map_alm), cl(truth_alm));
    let cl_noise = noise.map(|noise| Ok::<_, MapError>(cl(&harmonics(noise, frame, l_max)?))).transpose()?;
    let snr = cl_noise.as_ref().map(|cl_noise| normalised(&cl_cross, &cl_truth, cl_noise));
    let (map, truth) = (map.rotate_pixels(frame).degrade(nside)?, truth.degrade(nside)?);
    let errors: Vec<f64> = map.values().iter().zip(truth.values()).map(relative_error).collect();
    Ok(Comparison {
        nside,
        frame,
        l: (0..=l_max).collect(),
        rho: normalised(&cl_cross, &cl_truth, &cl_map),
        rho_noise_subtracted: None,
        cl_map,
        cl_truth,
        cl_cross,
        cl_noise,
        snr,
        relative_error: summary(&errors, truth.values()),
        relative_error_map: map.with_values(frame, errors),
    })
}

impl Comparison {
    /// Adds the correlation of the noise-free part of the map, whose power is that of the map minus that of the noise-only map at
    /// each degree. NaN where noise exceeds the map's power.
    #[must_use]
    pub fn with_noise_subtracted(mut self) -> Self {
        if let Some(cl_noise) = &self.cl_noise {
            let noise_free: Vec<f64> =
                self.cl_map.iter().zip(cl_noise).map(|(map, noise)| map - noise).collect();
            self.rho_noise_subtracted = Some(normalised(&self.cl_cross, &self.cl_truth, &noise_free));
        }
        self
    }
}

fn relative_error((value, truth): (&f64, &f64)) -> f64 {
    if *truth == 0.0 { HEALPIX_UNSEEN } else { (value - truth) / truth }
}

fn summary(errors: &[f64], truth: &[f64]) -> ErrorSummary {
    let known = errors.iter().zip(truth).filter(|(_, truth)| **truth != 0.0);
    let mut sorted: Vec<f64> = known.map(|(error, _)| *error).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let mean_of =
        |function: fn(f64) -> f64| sorted.iter().copied().map(function).sum::<f64>() / sorted.len() as f64;
    let percentile = |percent: usize| {
        let index = percent * sorted.len().saturating_sub(1) / 100;
        sorted.get(index).copied().unwrap_or(f64::NAN)
    };
    ErrorSummary {
        mean: mean_of(|error| error),
        rms: mean_of(|error| error * error).sqrt(),
        percentile_5: percentile(5),
        median: percentile(50),
        percentile_95: percentile(95),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::healpix::pixel_directions;

    fn field(nside: usize, frame: Frame) -> SkyMap {
        let value = |[x, y, z]: [f64; 3]| 3.0 + x + 0.5 * y * z + 0.2 * (9.0 * z + 4.0 * x).sin();
        SkyMap::new(frame, pixel_directions(nside).into_iter().map(value).collect()).unwrap()
    }

    fn scaled(map: &SkyMap, factor: f64) -> SkyMap {
        let mut map = map.clone();
        map.values_mut().iter_mut().for_each(|value| *value *= factor);
        map
    }

    #[test]
    fn a_scaled_copy_correlates_wholly() {
        let truth = field(16, Frame::Ecliptic);
        let noise = scaled(&truth, 0.1);
        let found = compare(&scaled(&truth, 1.25), &truth, Some(&noise), Some(20)).unwrap();
        assert_eq!((found.nside, found.l.len(), found.l[20]), (16, 21, 20));
        // Coefficients are as small as 1e-6 beside a monopole of 10, with errors of some 1e-16 of the monopole.
        for l in 0..=20 {
            assert!((found.rho[l] - 1.0).abs() < 1e-7, "l {l}: {}", found.rho[l]);
            assert!((found.cl_map[l] / found.cl_truth[l] - 1.5625).abs() < 1e-7);
            assert!((found.snr.as_ref().unwrap()[l] - 12.5).abs() < 1e-6);
        }
        for error in found.relative_error_map.values() {
            assert!((error - 0.25).abs() < 1e-14);
        }
        assert!((found.relative_error.rms - 0.25).abs() < 1e-14);
        assert!((found.relative_error.median - 0.25).abs() < 1e-14);
    }

    #[test]
    fn maps_of_other_nside_and_frame_are_brought_together() {
        let truth = field(64, Frame::Galactic);
        let map = truth.to_ecliptic().degrade(16).unwrap();
        let found = compare(&map, &truth, None, None).unwrap();
        assert_eq!((found.nside, found.frame, found.l.len()), (16, Frame::Ecliptic, 48));
        // The truth keeps its small scales; averages over pixels of nside 16 change them by the pixel window, 1 - l^2 / 24 nside^2,
        // at most 2 % at l = 12.
        // At even l above 2 the field is zero up to rounding.
        let mut powers = (0..12).filter(|l| l % 2 == 1 || *l <= 2).map(|l| found.rho[l]);
        assert!(powers.all(|rho| (rho - 1.0).abs() < 1e-3), "{:?}", &found.rho[..12]);
        assert!(found.snr.is_none());
        let same = compare(&truth, &field(32, Frame::Galactic), None, Some(4)).unwrap();
        assert_eq!((same.nside, same.frame), (32, Frame::Galactic));
    }

    #[test]
    fn json_has_the_promised_names() {
        let truth = field(4, Frame::Ecliptic);
        let found = compare(&truth, &truth, Some(&truth), None).unwrap();
        let json = serde_json::to_value(&found).unwrap();
        for name in ["l", "cl_map", "cl_truth", "cl_cross", "rho", "snr"] {
            assert_eq!(json[name].as_array().map(Vec::len), Some(12), "{name}");
        }
    }

    #[test]
    fn unusable_maps_are_refused() {
        let truth = field(4, Frame::Ecliptic);
        let mut holed = truth.clone();
        holed.values_mut()[9] = HEALPIX_UNSEEN;
        assert!(matches!(compare(&holed, &truth, None, None), Err(MapError::BadPixels { first: 9, .. })));
        assert!(matches!(compare(&truth, &truth, Some(&holed), None), Err(MapError::BadPixels { .. })));
        assert!(matches!(compare(&truth, &truth, None, Some(12)), Err(MapError::Harmonics(_))));
    }
}
