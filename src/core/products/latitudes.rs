//! The relative error of a map by distance from the ecliptic, as the baselines of an inclined orbit constrain the poles least.

use serde::{Deserialize, Serialize};

use crate::sky::{Comparison, is_unseen};

const EDGES_DEG: [f64; 7] = [0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0];

/// Relative error of a map, (map - truth) / truth, in the northern and southern band at a distance from the ecliptic.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, bincode::Encode, bincode::Decode)]
pub struct LatitudeError {
    /// Minimum distance from the ecliptic, degrees.
    pub from_deg: f64,
    /// Maximum distance from the ecliptic, degrees.
    pub to_deg: f64,
    /// Mean of the relative error.
    pub mean: f64,
    /// Root mean square of the relative error.
    pub rms: f64,
}

/// Relative errors by latitude, without bands that contain no pixel.
#[must_use]
pub(super) fn latitude_errors(comparison: &Comparison) -> Vec<LatitudeError> {
    let map = &comparison.relative_error_map;
    let directions = map.directions_ecliptic();
    let band = |edges: &[f64]| {
        let [from, to] = [edges[0], edges[1]].map(|deg| deg.to_radians().sin());
        // The pole itself belongs to the last band.
        let inside = |z: f64| from <= z && (z < to || to == 1.0);
        let pixels = directions.iter().zip(map.values());
        let values: Vec<f64> = pixels
            .filter(|(n, value)| inside(n[2].abs()) && !is_unseen(**value))
            .map(|(_, value)| *value)
            .collect();
        let count = values.len() as f64;
        (!values.is_empty()).then(|| LatitudeError {
            from_deg: edges[0],
            to_deg: edges[1],
            mean: values.iter().sum::<f64>() / count,
            rms: (values.iter().map(|x| x * x).sum::<f64>() / count).sqrt(),
        })
    };
    EDGES_DEG.windows(2).filter_map(band).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::healpix::pixel_directions;
    use crate::sky::{Frame, SkyMap, compare};

    #[test]
    fn a_dark_pole_is_reported() {
        let truth = SkyMap::constant(16, Frame::Ecliptic, 10.0).unwrap();
        // Half the truth beyond 75 degrees, a tenth too bright elsewhere.
        let limit = 75_f64.to_radians().sin();
        let value = |n: &[f64; 3]| if n[2].abs() >= limit { 5.0 } else { 11.0 };
        let map = SkyMap::new(Frame::Ecliptic, pixel_directions(16).iter().map(value).collect()).unwrap();
        let found = latitude_errors(&compare(&map, &truth, None, None).unwrap());
        assert_eq!(found.len(), 6);
        for band in &found {
            let expected = if band.from_deg == 75.0 { -0.5 } else { 0.1 };
            assert!((band.mean - expected).abs() < 1e-12 && (band.rms - expected.abs()).abs() < 1e-12);
        }
    }
}
