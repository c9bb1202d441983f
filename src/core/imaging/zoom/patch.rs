//! The patch of sky: its axes, its pixels' directions, and what the Moon hides of it.

use std::f64::consts::TAU;

use crate::sky::{Frame, rotate};
use crate::units::vector::{Vec3, cross, direction, dot, norm};

/// A round patch of sky about a direction, with axes towards equatorial east and north (J2000) across it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Patch {
    centre: Vec3,
    east: Vec3,
    north: Vec3,
    radius_rad: f64,
}

/// What a satellite sees of a patch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PatchView {
    /// All of it.
    Whole,
    /// A part: the Moon's limb crosses it.
    Limb,
    /// Nothing: it is behind the Moon.
    Hidden,
}

impl Patch {
    /// A patch about a right ascension and declination (J2000), degrees.
    #[must_use]
    pub fn new([ra_deg, dec_deg]: [f64; 2], radius_deg: f64) -> Self {
        let to_ecliptic = |equatorial| rotate(&Frame::Equatorial.to_ecliptic(), equatorial);
        let (sin, cos) = ra_deg.to_radians().sin_cos();
        let centre = to_ecliptic(direction(ra_deg, dec_deg));
        let east = to_ecliptic([-sin, cos, 0.0]);
        Self { centre, east, north: cross(centre, east), radius_rad: radius_deg.to_radians() }
    }

    /// Radius, rad.
    #[must_use]
    pub fn radius_rad(&self) -> f64 {
        self.radius_rad
    }

    /// Direction of the centre, on ecliptic axes.
    #[must_use]
    pub fn centre(&self) -> Vec3 {
        self.centre
    }

    /// A vector on ecliptic axes, on those of the patch: east, north, and towards the centre. A direction gives its cosines l, m, n.
    #[must_use]
    pub fn on_axes(&self, v: Vec3) -> Vec3 {
        [dot(v, self.east), dot(v, self.north), dot(v, self.centre)]
    }

    /// Right ascension (0 to 360) and declination, degrees, of direction cosines l and m.
    #[must_use]
    pub fn equatorial_deg(&self, [l, m]: [f64; 2]) -> [f64; 2] {
        let n = (1.0 - l * l - m * m).max(0.0).sqrt();
        Self::equatorial_of(std::array::from_fn(|k| {
            l * self.east[k] + m * self.north[k] + n * self.centre[k]
        }))
    }

    /// Right ascension (0 to 360) and declination, degrees, of a direction on ecliptic axes.
    #[must_use]
    pub fn equatorial_of(ecliptic: Vec3) -> [f64; 2] {
        let [x, y, z] = rotate(&Frame::Ecliptic.to_frame(Frame::Equatorial), ecliptic);
        [y.atan2(x).rem_euclid(TAU).to_degrees(), z.clamp(-1.0, 1.0).asin().to_degrees()]
    }

    /// Maximum turns by which the fringe at the patch's edge changes against that at its centre, for a change of the baseline
    /// (wavelengths, on the patch's axes).
    #[must_use]
    pub fn edge_turns(&self, [u, v, w]: Vec3) -> f64 {
        u.hypot(v) * self.radius_rad.sin() + w.abs() * (1.0 - self.radius_rad.cos())
    }

    /// What is seen of the patch from a position (Moon-centred, m).
    #[must_use]
    pub fn view(&self, r_m: Vec3, moon_radius_m: f64) -> PatchView {
        let distance_m = norm(r_m);
        if moon_radius_m <= 0.0 {
            return PatchView::Whole;
        }
        let from_moon_rad = (-dot(self.centre, r_m) / distance_m).clamp(-1.0, 1.0).acos();
        let disc_rad = (moon_radius_m / distance_m).min(1.0).asin();
        if from_moon_rad >= disc_rad + self.radius_rad {
            PatchView::Whole
        } else if from_moon_rad <= disc_rad - self.radius_rad {
            PatchView::Hidden
        } else {
            PatchView::Limb
        }
    }

    /// What a pair sees of the patch.
    #[must_use]
    pub fn view_of_pair(&self, positions_m: [Vec3; 2], moon_radius_m: f64) -> PatchView {
        match positions_m.map(|r_m| self.view(r_m, moon_radius_m)) {
            [PatchView::Whole, PatchView::Whole] => PatchView::Whole,
            [PatchView::Hidden, _] | [_, PatchView::Hidden] => PatchView::Hidden,
            _ => PatchView::Limb,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::hidden_by_moon;

    #[test]
    fn places_are_those_of_astropy() {
        // astropy 7: SkyCoord(ra=200, dec=-30).directional_offset_by, and SkyOffsetFrame sin(lon) cos(lat), sin(lat) of ra 203.1, dec
        // -27.4: l = cos(dec) sin(dra), m = sin(dec) cos(dec0) - cos(dec) sin(dec0) cos(dra), by hand.
        let patch = Patch::new([200.0, -30.0], 5.0);
        let (dra, dec, dec0) = (3.1_f64.to_radians(), (-27.4_f64).to_radians(), (-30.0_f64).to_radians());
        let l = dec.cos() * dra.sin();
        let m = dec.sin() * dec0.cos() - dec.cos() * dec0.sin() * dra.cos();
        let found = patch.equatorial_deg([l, m]);
        assert!((found[0] - 203.1).abs() < 1e-9 && (found[1] + 27.4).abs() < 1e-9, "{found:?}");
        let ecliptic = rotate(&Frame::Equatorial.to_ecliptic(), direction(203.1, -27.4));
        let [a, b, n] = patch.on_axes(ecliptic);
        assert!(
            (a - l).abs() < 1e-12 && (b - m).abs() < 1e-12 && (a * a + b * b + n * n - 1.0).abs() < 1e-12
        );
    }

    #[test]
    fn a_view_is_whole_or_hidden_only_if_all_directions_are() {
        let moon_m = 1.7371e6;
        let mut seen = [0; 3];
        for k in 0..400 {
            let patch = Patch::new([f64::from(k) * 37.0 % 360.0, f64::from(k % 160) - 80.0], 6.0);
            let r_m = [2.0e6, 1e5 * f64::from(k % 7), -3e5];
            // On the patch's edge and inside.
            let directions = (0..720).map(|j| {
                let (rho, angle) = ([5.9999_f64, 3.0][j % 2].to_radians(), (j as f64).to_radians());
                let (l, m) = (rho.sin() * angle.cos(), rho.sin() * angle.sin());
                let [ra, dec] = patch.equatorial_deg([l, m]);
                rotate(&Frame::Equatorial.to_ecliptic(), direction(ra, dec))
            });
            let hidden = directions.filter(|n| hidden_by_moon(r_m, *n, moon_m)).count();
            match patch.view(r_m, moon_m) {
                PatchView::Whole => assert_eq!((hidden, seen[0] += 1).0, 0),
                PatchView::Hidden => assert_eq!((hidden, seen[1] += 1).0, 720),
                PatchView::Limb => seen[2] += 1,
            }
        }
        assert!(seen.iter().all(|&n| n > 10), "{seen:?}");
    }
}
