//! Effective beams in given directions, from the maps of points, with their widths.

use std::fmt::Write;

use serde::Serialize;

use crate::sky::healpix::pixel_directions;
use crate::sky::{Cutout, Frame, MapError, PlaneProjection, SkyMap};

/// Side of the plane on which a beam is measured: in pixels of the map as solved, and in places.
const SIDE_PIXELS: f64 = 16.0;
const SIDE_PLACES: usize = 241;
/// Parts along a side of a pixel into which a map is split before its width is measured.
const SPLIT: usize = 8;

/// Widths of a beam: of the part above half its greatest value, which is an ellipse for a Gaussian one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct BeamWidths {
    /// Greatest value near the point, K: of a source that is 1 K in one pixel.
    pub peak_k: f64,
    /// Distance of the middle from the point, degrees.
    pub offset_deg: f64,
    /// Full width at half maximum along the longer axis, degrees.
    pub fwhm_major_deg: f64,
    /// Along the shorter one.
    pub fwhm_minor_deg: f64,
    /// Direction of the longer axis, from the ecliptic's north towards east, degrees from -90 to 90.
    pub angle_deg: f64,
}

impl BeamWidths {
    /// FWHM of the circle of the same area, degrees.
    #[must_use]
    pub fn fwhm_deg(&self) -> f64 {
        (self.fwhm_major_deg * self.fwhm_minor_deg).sqrt()
    }

    /// Around a pixel of a map of `nside`, of a map that is as fine or finer; `None` if nothing is above zero there.
    pub(super) fn around(fine: &SkyMap, nside: usize, centre_deg: [f64; 2]) -> Option<Self> {
        let pixel_deg = (std::f64::consts::PI / 3.0).sqrt().to_degrees() / nside as f64;
        let cutout = Cutout {
            projection: PlaneProjection::Gnomonic,
            frame: Frame::Ecliptic,
            centre_deg,
            // A small map's pixels are large, and the plane ends at 120 degrees.
            size_deg: (SIDE_PIXELS * pixel_deg).min(100.0),
            pixels: SIDE_PLACES,
        };
        let values = cutout.values(fine);
        let step_deg = cutout.size_deg / SIDE_PLACES as f64;
        let place = |k: usize| {
            let at = |k: usize| (k as f64 - 0.5 * (SIDE_PLACES as f64 - 1.0)) * step_deg;
            [at(k % SIDE_PLACES), at(k / SIDE_PLACES)]
        };
        // The greatest within a quarter of the plane's side: others are not this beam.
        let is_near = |k: usize| place(k)[0].hypot(place(k)[1]) < 0.25 * cutout.size_deg;
        let top =
            (0..values.len()).filter(|&k| is_near(k)).max_by(|&a, &b| values[a].total_cmp(&values[b]))?;
        let peak_k = values[top];
        if peak_k.is_nan() || peak_k <= 0.0 {
            return None;
        }
        let inside = connected(&values, top, 0.5 * peak_k);
        let count = inside.len() as f64;
        let mean = [0, 1].map(|axis| inside.iter().map(|&k| place(k)[axis]).sum::<f64>() / count);
        let moment = |a: usize, b: usize| {
            inside.iter().map(|&k| (place(k)[a] - mean[a]) * (place(k)[b] - mean[b])).sum::<f64>() / count
        };
        let (xx, yy, xy) = (moment(0, 0), moment(1, 1), moment(0, 1));
        let (middle, spread) = (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy));
        // The second moment of an ellipse's area along an axis is a quarter of its half axis squared.
        let width = |variance: f64| 4.0 * variance.max(0.0).sqrt();
        // From up towards the left, where east is.
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

/// Places around `top` that hold at least `least`, without a gap.
fn connected(values: &[f64], top: usize, least: f64) -> Vec<usize> {
    let mut seen = vec![false; values.len()];
    let (mut open, mut inside) = (vec![top], Vec::new());
    seen[top] = true;
    while let Some(k) = open.pop() {
        inside.push(k);
        let (column, row) = (k % SIDE_PLACES, k / SIDE_PLACES);
        let beside = [
            (column > 0).then(|| k - 1),
            (column + 1 < SIDE_PLACES).then(|| k + 1),
            (row > 0).then(|| k - SIDE_PLACES),
            (row + 1 < SIDE_PLACES).then(|| k + SIDE_PLACES),
        ];
        for next in beside.into_iter().flatten() {
            if !seen[next] && values[next] >= least {
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
    /// Ecliptic longitude of the pixel's centre, degrees.
    pub longitude_deg: f64,
    /// Ecliptic latitude of it.
    pub latitude_deg: f64,
    /// Of the map as solved; absent if nothing of the point is left.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub solved: Option<BeamWidths>,
    /// After post-processing, if there is any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub processed: Option<BeamWidths>,
}

impl PointBeamSummary {
    /// Of the map of a point at a pixel, as solved (harmonics up to `l_max`, or pixels) and as processed.
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
        // Harmonics have values between pixels; pixels are what they are.
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

/// Beams as a table (CSV).
#[must_use]
pub(super) fn beams_csv(beams: &[PointBeamSummary]) -> String {
    let mut text = "longitude_deg,latitude_deg,processed,peak_k,offset_deg,fwhm_deg,fwhm_major_deg,fwhm_minor_deg,angle_deg\n".to_owned();
    for beam in beams {
        for (is_processed, widths) in [(false, beam.solved), (true, beam.processed)] {
            let Some(widths) = widths else { continue };
            let BeamWidths { peak_k, offset_deg, fwhm_major_deg, fwhm_minor_deg, angle_deg } = widths;
            // Writing to a string does not fail.
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

    /// An elliptical Gaussian of known axes, at several places and angles.
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
            // Pixels of 0.11 degrees: the edge is uncertain by a small part of one (those of 0.23 degrees lose 1.3 %). On the tangent plane lengths are larger by
            // 1 / cos^2 of 2.6 degrees, 2e-3.
            assert!((found.fwhm_major_deg / major - 1.0).abs() < 0.01, "{found:?}");
            assert!((found.fwhm_minor_deg / minor - 1.0).abs() < 0.01, "{found:?}");
            assert!((found.angle_deg - angle_deg).abs() < 2.0 && found.offset_deg < 0.05, "{found:?}");
            // The nearest pixel's centre is up to 0.08 degrees off the middle: 4 ln 2 (0.08 / 3.9)^2 = 1.2e-3.
            assert!((found.peak_k / 0.7 - 1.0).abs() < 1.5e-3, "{found:?}");
        }
        let nothing = SkyMap::constant(16, Frame::Ecliptic, 0.0).unwrap();
        assert_eq!(BeamWidths::around(&nothing, 16, [0.0, 0.0]), None);
    }
}
