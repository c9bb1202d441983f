//! Square cutouts of a map on a plane, in gnomonic or cartesian projection as in healpy's `gnomview` and `cartview`.

use serde::{Deserialize, Serialize};

use super::frame::{Frame, Rotation, product, rotate, transpose};
use super::healpix::pixel_of;
use super::map::SkyMap;
use crate::units::vector::{Vec3, direction};

/// Projection of the sphere onto a plane around the centre of a cutout.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PlaneProjection {
    /// Gnomonic projection from the centre of the sphere onto the tangent plane: great circles are straight.
    #[default]
    Gnomonic,
    /// Longitude and latitude in a system whose equator passes through the centre (plate carree).
    Cartesian,
}

/// Square cutout of the sky; east is to the left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cutout {
    /// Projection.
    pub projection: PlaneProjection,
    /// Frame whose north is up.
    pub frame: Frame,
    /// Longitude and latitude of the centre in that frame, degrees.
    pub centre_deg: [f64; 2],
    /// Length of a side, degrees at the centre; below 120.
    pub size_deg: f64,
    /// Number of pixels along a side.
    pub pixels: usize,
}

impl Cutout {
    /// Samples the map at the centres of the cutout's pixels, row by row from the lowest, each from east to west.
    #[must_use]
    pub fn values(&self, map: &SkyMap) -> Vec<f64> {
        let rotation = product(&self.frame.to_frame(map.frame()), &self.plane_axes());
        let step_deg = self.size_deg / self.pixels as f64;
        let at = |k: usize| (k as f64 - 0.5 * (self.pixels as f64 - 1.0)) * step_deg;
        let value = |k: usize| {
            let direction = self.direction_of(at(k % self.pixels), at(k / self.pixels));
            map.values()[pixel_of(map.nside(), rotate(&rotation, direction))]
        };
        (0..self.pixels * self.pixels).map(value).collect()
    }

    /// Position of a direction on the plane, degrees to the right of the centre and above it; `None` if it does not project.
    #[must_use]
    pub fn place_deg(&self, longitude_deg: f64, latitude_deg: f64) -> Option<[f64; 2]> {
        let [x, y, z] = rotate(&transpose(&self.plane_axes()), direction(longitude_deg, latitude_deg));
        match self.projection {
            PlaneProjection::Gnomonic => (x > 1e-6).then(|| [(-y / x).to_degrees(), (z / x).to_degrees()]),
            PlaneProjection::Cartesian => {
                Some([-y.atan2(x).to_degrees(), z.clamp(-1.0, 1.0).asin().to_degrees()])
            }
        }
    }

    /// Rotation from the plane's axes (x towards the centre, z up) to those of the frame.
    fn plane_axes(&self) -> Rotation {
        let ((sin_l, cos_l), (sin_b, cos_b)) =
            (self.centre_deg[0].to_radians().sin_cos(), self.centre_deg[1].to_radians().sin_cos());
        [[cos_l * cos_b, -sin_l, -cos_l * sin_b], [sin_l * cos_b, cos_l, -sin_l * sin_b], [sin_b, 0.0, cos_b]]
    }

    /// Direction, on the plane's axes, of a position on the plane, degrees.
    fn direction_of(&self, right_deg: f64, up_deg: f64) -> Vec3 {
        let (right, up) = (right_deg.to_radians(), up_deg.to_radians());
        match self.projection {
            PlaneProjection::Gnomonic => {
                let length = (1.0 + right * right + up * up).sqrt();
                [1.0 / length, -right / length, up / length]
            }
            PlaneProjection::Cartesian => {
                let ((sin_l, cos_l), (sin_b, cos_b)) = ((-right).sin_cos(), up.sin_cos());
                [cos_l * cos_b, sin_l * cos_b, sin_b]
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::healpix::pixel_directions;

    #[test]
    fn east_is_left_and_north_is_up() {
        for projection in [PlaneProjection::Gnomonic, PlaneProjection::Cartesian] {
            let cutout = Cutout {
                projection,
                frame: Frame::Galactic,
                centre_deg: [75.0, 40.0],
                size_deg: 20.0,
                pixels: 21,
            };
            let [right, up] = cutout.place_deg(75.0, 40.0).unwrap();
            assert!(right.abs() < 1e-12 && up.abs() < 1e-12);
            assert!(cutout.place_deg(76.0, 40.0).unwrap()[0] < 0.0);
            assert!(cutout.place_deg(75.0, 41.0).unwrap()[1] > 0.0);
            // A map whose values rise to the north, or to the east.
            for (axis, rises) in [(2, "up"), (1, "left")] {
                let values = pixel_directions(64).iter().map(|n| n[axis]).collect();
                let map = SkyMap::new(Frame::Galactic, values).unwrap();
                let flat = Cutout { centre_deg: [0.0, 0.0], ..cutout };
                let values = flat.values(&map);
                let (first, last) = if rises == "up" { (10, 430) } else { (220, 230 - 20) };
                assert!(values[first] < values[last], "{rises}");
            }
        }
    }

    #[test]
    fn places_are_those_of_the_pixels() {
        let cutout = Cutout {
            projection: PlaneProjection::Gnomonic,
            frame: Frame::Ecliptic,
            centre_deg: [310.0, -35.0],
            size_deg: 20.0,
            pixels: 40,
        };
        // On the meridian of the centre the position is the tangent of the distance.
        let [right, up] = cutout.place_deg(310.0, -30.0).unwrap();
        assert!(right.abs() < 1e-9 && (up - 5_f64.to_radians().tan().to_degrees()).abs() < 1e-9);
        // The projections are inverses.
        for (right, up) in [(3.0, -7.0), (-9.0, 9.0), (0.5, 0.5)] {
            let n = rotate(&cutout.plane_axes(), cutout.direction_of(right, up));
            let found = cutout.place_deg(n[1].atan2(n[0]).to_degrees(), n[2].asin().to_degrees()).unwrap();
            assert!((found[0] - right).abs() < 1e-9 && (found[1] - up).abs() < 1e-9, "{found:?}");
        }
    }
}
