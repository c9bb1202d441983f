//! Point-spread functions of a map: effective beams in some directions, with their widths.

use std::fmt::Write;

use serde::Serialize;

use crate::sky::healpix::pixel_directions;
use crate::sky::{Cutout, Frame, MapError, PlaneProjection, SkyMap};

/// Side of the cutout on which a beam is measured, in pixels of the map as solved.
const SIDE_PIXELS: f64 = 16.0;
/// Side of the cutout in pixels of its own.
const SIDE_SAMPLES: usize = 241;
/// Number of parts into which the side of a pixel is split before beams are measured.
const SPLIT: usize = 8;

/// Widths of a beam, from the second moments of the region above half its maximum, which is an ellipse for a Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct BeamWidths {
    /// Maximum near the point, K, for a source of 1 K in one pixel.
    pub peak_k: f64,
    /// Distance of the centroid from the point, degrees.
    pub offset_deg: f64,
    /// Full width at half maximum along the longer axis, degrees.
    pub fwhm_major_deg: f64,
    /// Full width at half maximum along the shorter axis, degrees.
    pub fwhm_minor_deg: f64,
    /// Position angle of the longer axis, from ecliptic north towards east, -90 to 90 degrees.
    pub angle_deg: f64,
}

impl BeamWidths {
    /// FWHM of a circular beam of the same area, degrees.
    #[must_use]
    pub fn fwhm_deg(&self) -> f64 {
        (self.fwhm_major_deg * self.fwhm_minor_deg).sqrt()
    }

    /// Measures the beam around a pixel of a map of `nside`, on the same or a finer map; `None` if no value there is positive.
    pub(super) fn around(fine: &SkyMap, nside: usize, centre_deg: [f64; 2]) -> Option<Self> {
        let pixel_deg = (std::f64::consts::PI / 3.0).sqrt().to_degrees() / nside as f64;
        let cutout = Cutout {
            projection: PlaneProjection::Gnomonic,
            frame: Frame::Ecliptic,
            centre_deg,
            // Pixels of a coarse map are large, and the projection ends at 120 degrees.
            size_deg: (SIDE_PIXELS * pixel_deg).min(100.0),
            pixels: SIDE_SAMPLES,
        };
        let values = cutout.values(fine);
        let step_deg = cutout.size_deg / SIDE_SAMPLES as f64;
        let position_deg = |k: usize| {
            let offset_deg = |k: usize| (k as f64 - 0.5 * (SIDE_SAMPLES as f64 - 1.0)) * step_deg;
            [offset_deg(k % SIDE_SAMPLES), offset_deg(k / SIDE_SAMPLES)]
        };
        // Maxima farther away than a quarter of the side are not of this beam.
        let is_near = |k: usize| position_deg(k)[0].hypot(position_deg(k)[1]) < 0.25 * cutout.size_deg;
        let top =
            (0..values.len()).filter(|&k| is_near(k)).max_by(|&a, &b| values[a].total_cmp(&values[b]))?;
        let peak_k = values[top];
        if peak_k.is_nan() || peak_k <= 0.0 {
            return None;
        }
        let inside = connected(&values, top, 0.5 * peak_k);
        let count = inside.len() as f64;
        let mean = [0, 1].map(|axis| inside.iter().map(|&k| position_deg(k)[axis]).sum::<f64>() / count);
        let moment = |a: usize, b: usize| {
            inside
                .iter()
                .map(|&k| (position_deg(k)[a] - mean[a]) * (position_deg(k)[b] - mean[b]))
                .sum::<f64>()
                / count
        };
        let (xx, yy, xy) = (moment(0, 0), moment(1, 1), moment(0, 1));
        let (middle, spread) = (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy));
        // The second moment of an ellipse along an axis is a quarter of the square of the semi-axis.
        let width = |variance: f64| 4.0 * variance.max(0.0).sqrt();
        // From up (north) towards left (east).
        let angle = 0.5 * (-2.0 * xy).atan2(yy - xx);
        Some(Self {
            peak_k,
            offset_deg: mean[0].hypot(mean[1]),
            fwhm_major_deg: width(middle + spread),
            fwhm_minor_deg: width(middle - spread),
            angle_deg: angle.to_degrees(),
        })
    }
}

/// The connected region around `top` with values of at least `threshold`.
fn connected(values: &[f64], top: usize, threshold: f64) -> Vec<usize> {
    let mut seen = vec![false; values.len()];
    let (mut open, mut inside) = (vec![top], Vec::new());
    seen[top] = true;
    while let Some(k) = open.pop() {
        inside.push(k);
        let (column, row) = (k % SIDE_SAMPLES, k / SIDE_SAMPLES);
        let neighbours = [
            (column > 0).then(|| k - 1),
            (column + 1 < SIDE_SAMPLES).then(|| k + 1),
            (row > 0).then(|| k - SIDE_SAMPLES),
            (row + 1 < SIDE_SAMPLES).then(|| k + SIDE_SAMPLES),
        ];
        for next in neighbours.into_iter().flatten() {
            if !seen[next] && values[next] >= threshold {
                seen[next] = true;
                open.push(next);
            }
        }
    }
    inside
}

/// The effective beam in one direction.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct PointBeamSummary {
    /// Ecliptic longitude of the pixel centre, degrees.
    pub longitude_deg: f64,
    /// Ecliptic latitude of the pixel centre, degrees.
    pub latitude_deg: f64,
    /// Widths in the map as solved; absent if the point is not visible.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub solved: Option<BeamWidths>,
    /// Widths after post-processing; absent without it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub processed: Option<BeamWidths>,
}

impl PointBeamSummary {
    /// Measures the beam in the map of a point source in a pixel, as solved (harmonic up to `l_max`, or pixels) and as processed.
    pub(super) fn new(
        pixel: usize,
        solved: &SkyMap,
        l_max: Option<usize>,
        processed: Option<&SkyMap>,
    ) -> Result<Self, MapError> {
        let nside = solved.nside();
        let [x, y, z] = pixel_directions(nside)[pixel];
        let (longitude_deg, latitude_deg) =
            (y.atan2(x).to_degrees().rem_euclid(360.0), z.clamp(-1.0, 1.0).asin().to_degrees());
        let measure = |map: &SkyMap| BeamWidths::around(map, nside, [longitude_deg, latitude_deg]);
        // Harmonic maps can be evaluated between pixels.
        let fine = match l_max {
            Some(l_max) => solved.band_limited(SPLIT * nside, l_max)?,
            None => solved.clone(),
        };
        let processed = match processed {
            Some(map) => measure(&map.band_limited(2 * map.nside(), 2 * map.nside())?),
            None => None,
        };
        Ok(Self { longitude_deg, latitude_deg, solved: measure(&fine), processed })
    }
}

#[must_use]
pub(super) fn beams_csv(beams: &[PointBeamSummary]) -> String {
    let mut text = "longitude_deg,latitude_deg,processed,peak_k,offset_deg,fwhm_deg,fwhm_major_deg,fwhm_minor_deg,angle_deg\n".to_owned();
    for beam in beams {
        for (is_processed, widths) in [(false, beam.solved), (true, beam.processed)] {
            let Some(widths) = widths else { continue };
            let BeamWidths { peak_k, offset_deg, fwhm_major_deg, fwhm_minor_deg, angle_deg } = widths;
            let _ = writeln!(
                text,
                "{},{},{is_processed},{peak_k:e},{offset_deg},{},{fwhm_major_deg},{fwhm_minor_deg},{angle_deg}",
                beam.longitude_deg,
                beam.latitude_deg,
                widths.fwhm_deg()
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An elliptical Gaussian of known axes, at several positions and angles.
    #[test]
    fn widths_of_a_gaussian_are_found_again() {
        for (centre_deg, angle_deg) in [([40.0, 10.0], 30.0), ([250.0, -62.0], -70.0)] {
            let (major, minor) = (5.2_f64, 3.9_f64);
            let nside = 16;
            let plane = Cutout {
                projection: PlaneProjection::Gnomonic,
                frame: Frame::Ecliptic,
                centre_deg,
                size_deg: 90.0,
                pixels: 3,
            };
            let value = |n: &[f64; 3]| {
                let at = plane.place_deg(n[1].atan2(n[0]).to_degrees(), n[2].asin().to_degrees());
                let Some([right, up]) = at else { return 0.0 };
                // North is up, east to the left.
                let (sin, cos) = f64::to_radians(angle_deg).sin_cos();
                let (along, across) = (up * cos - right * sin, up * sin + right * cos);
                let square = (along / major).powi(2) + (across / minor).powi(2);
                0.7 * (-4.0 * std::f64::consts::LN_2 * square).exp()
            };
            let map =
                SkyMap::new(Frame::Ecliptic, pixel_directions(512).iter().map(value).collect()).unwrap();
            let found = BeamWidths::around(&map, nside, centre_deg).unwrap();
            // The edge is uncertain by a small fraction of a pixel of 0.11 degrees (pixels of 0.23 degrees lose 1.3 %). On the
            // tangent plane lengths are larger by 1 / cos^2 of 2.6 degrees, 2e-3.
            assert!((found.fwhm_major_deg / major - 1.0).abs() < 0.01, "{found:?}");
            assert!((found.fwhm_minor_deg / minor - 1.0).abs() < 0.01, "{found:?}");
            assert!((found.angle_deg - angle_deg).abs() < 2.0 && found.offset_deg < 0.05, "{found:?}");
            // The nearest pixel centre is up to 0.08 degrees from the centre: 4 ln 2 (0.08 / 3.9)^2 = 1.2e-3.
            assert!((found.peak_k / 0.7 - 1.0).abs() < 1.5e-3, "{found:?}");
        }
        let nothing = SkyMap::constant(16, Frame::Ecliptic, 0.0).unwrap();
        assert_eq!(BeamWidths::around(&nothing, 16, [0.0, 0.0]), None);
    }
}
