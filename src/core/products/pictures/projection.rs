//! The Mollweide projection, with longitude growing to the left.

use std::f64::consts::{FRAC_PI_2, PI};

/// Position (x to the right, y up) on the ellipse with semi-axes 2 and 1, for a longitude relative to the centre of the
/// map and a latitude, rad.
pub(super) fn forward(longitude: f64, latitude: f64) -> (f64, f64) {
    // Newton's method on 2 t + sin 2t = pi sin(latitude). It stops near the pole, where the slope vanishes.
    let target = PI * latitude.sin();
    let mut t = latitude * 0.9;
    for _ in 0..50 {
        let slope = 2.0 + 2.0 * (2.0 * t).cos();
        if slope < 1e-9 {
            break;
        }
        let step = (2.0 * t + (2.0 * t).sin() - target) / slope;
        t = (t - step).clamp(-FRAC_PI_2, FRAC_PI_2);
        if step.abs() < 1e-12 {
            break;
        }
    }
    (-2.0 * longitude / PI * t.cos(), t.sin())
}

/// A parallel of latitude, which is a horizontal line of the ellipse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LatitudeLine {
    /// Sine of the latitude.
    pub sin_latitude: f64,
    /// Cosine of the latitude.
    pub cos_latitude: f64,
    /// Length of the line relative to the equator.
    relative_length: f64,
}

impl LatitudeLine {
    /// The parallel at height `y` of the ellipse; `None` outside it.
    pub fn at_height(y: f64) -> Option<Self> {
        if y.abs() > 1.0 {
            return None;
        }
        let t = y.asin();
        let relative_length = t.cos();
        let sin_latitude = ((2.0 * t + (2.0 * t).sin()) / PI).clamp(-1.0, 1.0);
        let cos_latitude = ((1.0 - sin_latitude) * (1.0 + sin_latitude)).sqrt();
        Some(Self { sin_latitude, cos_latitude, relative_length })
    }

    /// Longitude relative to the centre, rad, at `x`; `None` outside the ellipse.
    pub fn longitude(&self, x: f64) -> Option<f64> {
        (x.abs() <= 2.0 * self.relative_length && self.relative_length > 0.0)
            .then(|| -PI * x / (2.0 * self.relative_length))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_and_back() {
        for i in -17..=17 {
            for j in -8..=8 {
                let (longitude, latitude) = (f64::from(i) * 10.0, f64::from(j) * 11.0);
                let (x, y) = forward(longitude.to_radians(), latitude.to_radians());
                let parallel = LatitudeLine::at_height(y).unwrap();
                let (l, b) = (parallel.longitude(x).unwrap(), parallel.sin_latitude.asin());
                assert!(
                    (l.to_degrees() - longitude).abs() < 1e-6 && (b.to_degrees() - latitude).abs() < 1e-6
                );
            }
        }
        // East is left, north is up.
        assert!(forward(0.1, 0.0).0 < 0.0 && forward(0.0, 0.1).1 > 0.0);
        assert_eq!(LatitudeLine::at_height(0.0).unwrap().longitude(2.1), None);
        assert_eq!(LatitudeLine::at_height(1.1), None);
    }

    #[test]
    fn areas_are_kept() {
        // The fraction of the sphere in a cap equals its fraction of the ellipse, counted on a grid.
        let n = 800;
        let mut inside = 0;
        for i in 0..2 * n {
            for j in 0..n {
                let (x, y) = (
                    2.0 * (f64::from(i) + 0.5) / f64::from(n) - 2.0,
                    2.0 * (f64::from(j) + 0.5) / f64::from(n) - 1.0,
                );
                let seen = LatitudeLine::at_height(y).filter(|p| p.longitude(x).is_some());
                inside += i32::from(seen.is_some_and(|p| p.sin_latitude > 0.5_f64.sin()));
            }
        }
        let fraction = f64::from(inside) * (2.0 / f64::from(n)).powi(2) / (2.0 * PI);
        // The tolerance is for edge pixels of the grid.
        assert!((fraction - 0.5 * (1.0 - 0.5_f64.sin())).abs() < 2e-3, "{fraction}");
    }
}
