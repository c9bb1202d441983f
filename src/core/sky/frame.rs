//! Celestial frames of maps, and the rotations between them.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::units::vector::{Vec3, dot};

/// Rotation matrix: row `k` is axis `k` of the target frame in coordinates of the source frame.
pub type Rotation = [Vec3; 3];

/// Celestial frame of a map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Frame {
    /// Mean ecliptic and equinox of J2000, in which all computation is done.
    #[default]
    Ecliptic,
    /// Galactic (IAU 1958).
    Galactic,
    /// Mean equator and equinox of J2000 (FK5).
    Equatorial,
}

/// Rotation from Galactic to ecliptic axes.
///
/// It is astropy 8.0's transformation of `galactic` into `barycentricmeanecliptic` (IAU 2006 obliquity and frame bias,
/// Capitaine & Wallace 2006; Galactic pole of Reid & Brunthaler 2004), which healpy's `Rotator` uses.
const GALACTIC_TO_ECLIPTIC: Rotation = [
    [-5.487_563_486_628_312e-2, 4.941_095_288_578_971_6e-1, -8.676_660_868_040_493e-1],
    [-9.938_213_523_891_737e-1, -1.109_909_720_383_277_8e-1, -3.516_551_470_140_832e-4],
    [-9.647_685_853_808_478e-2, 8.622_857_865_103_742e-1, 4.971_473_002_529_609_5e-1],
];

/// Rotation from equatorial to ecliptic axes: astropy's `fk5` (J2000) to `barycentricmeanecliptic`, as in healpy's `Rotator`.
const EQUATORIAL_TO_ECLIPTIC: Rotation = [
    [9.999_999_999_999_924e-1, 4.023_865_539_325_272e-8, 1.246_801_808_749_580_6e-7],
    [-8.651_314_600_163_742e-8, 9.174_821_682_916_512e-1, 3.977_769_109_272_729e-1],
    [-9.838_583_464_995_669e-8, -3.977_769_109_272_802e-1, 9.174_821_682_916_463e-1],
];

const IDENTITY: Rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

impl Frame {
    /// Rotation from this frame to the ecliptic one.
    #[must_use]
    pub fn to_ecliptic(self) -> Rotation {
        match self {
            Self::Ecliptic => IDENTITY,
            Self::Galactic => GALACTIC_TO_ECLIPTIC,
            Self::Equatorial => EQUATORIAL_TO_ECLIPTIC,
        }
    }

    /// Rotation from this frame to another.
    #[must_use]
    pub fn to_frame(self, other: Self) -> Rotation {
        product(&transpose(&other.to_ecliptic()), &self.to_ecliptic())
    }

    /// The letter of COORDSYS: E, G or C.
    #[must_use]
    #[doc(hidden)]
    pub fn letter(self) -> char {
        match self {
            Self::Ecliptic => 'E',
            Self::Galactic => 'G',
            Self::Equatorial => 'C',
        }
    }

    /// Parses a COORDSYS value: a letter (C or Q for equatorial) or the name, in upper or lower case.
    #[must_use]
    #[doc(hidden)]
    pub fn from_coordsys(text: &str) -> Option<Self> {
        match text.trim().to_ascii_uppercase().as_str() {
            "E" | "ECLIPTIC" => Some(Self::Ecliptic),
            "G" | "GALACTIC" => Some(Self::Galactic),
            "C" | "Q" | "CELESTIAL" | "EQUATORIAL" => Some(Self::Equatorial),
            _ => None,
        }
    }
}

impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Ecliptic => "ecliptic",
            Self::Galactic => "Galactic",
            Self::Equatorial => "equatorial",
        })
    }
}

/// Applies `rotation` to a direction.
#[inline]
#[must_use]
pub fn rotate(rotation: &Rotation, direction: Vec3) -> Vec3 {
    rotation.map(|row| dot(row, direction))
}

/// The inverse of a rotation.
#[must_use]
pub fn transpose(rotation: &Rotation) -> Rotation {
    std::array::from_fn(|i| std::array::from_fn(|j| rotation[j][i]))
}

/// The rotation `first` followed by `second`.
#[must_use]
pub fn product(second: &Rotation, first: &Rotation) -> Rotation {
    let columns = transpose(first);
    second.map(|row| columns.map(|column| dot(row, column)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::vector::{cross, norm, sub};

    const FRAMES: [Frame; 3] = [Frame::Ecliptic, Frame::Galactic, Frame::Equatorial];

    fn direction(longitude_deg: f64, latitude_deg: f64) -> Vec3 {
        let (sin_lon, cos_lon) = longitude_deg.to_radians().sin_cos();
        let (sin_lat, cos_lat) = latitude_deg.to_radians().sin_cos();
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    }

    #[test]
    fn rotations_are_proper() {
        for from in FRAMES {
            for to in FRAMES {
                let rotation = from.to_frame(to);
                let [x, y, z] = rotation;
                assert!(norm(sub(cross(x, y), z)) < 1e-14, "{from} to {to}");
                let back = product(&to.to_frame(from), &rotation);
                for (row, axis) in back.iter().zip(IDENTITY) {
                    assert!(norm(sub(*row, axis)) < 1e-14, "{from} to {to}");
                }
            }
        }
    }

    #[test]
    fn known_directions_agree() {
        // Textbook definitions of the frames neglect the bias between dynamical mean, FK5 and ICRS axes,
        // 0.023 arcsec = 1.1e-7 rad, and give the pole to 1e-8: 3e-7 in total.
        let textbook = 3e-7;
        let (sin, cos) = (84_381.406_f64 / 3600.0).to_radians().sin_cos();
        let ecliptic_pole = rotate(&Frame::Ecliptic.to_frame(Frame::Equatorial), [0.0, 0.0, 1.0]);
        assert!(norm(sub(ecliptic_pole, [0.0, -sin, cos])) < textbook);
        let galactic_pole = rotate(&Frame::Galactic.to_frame(Frame::Equatorial), [0.0, 0.0, 1.0]);
        assert!(norm(sub(galactic_pole, direction(192.859_48, 27.128_25))) < textbook);
        // Longitude of the equatorial pole in Galactic coordinates.
        let celestial_pole = rotate(&Frame::Equatorial.to_frame(Frame::Galactic), [0.0, 0.0, 1.0]);
        assert!(norm(sub(celestial_pole, direction(122.931_92, 27.128_25))) < textbook);
    }

    #[test]
    fn coordsys_is_read_as_it_is_written() {
        for frame in FRAMES {
            assert_eq!(Frame::from_coordsys(&frame.letter().to_string()), Some(frame));
            assert_eq!(Frame::from_coordsys(&format!(" {frame} ")), Some(frame));
        }
        assert_eq!(Frame::from_coordsys("X"), None);
    }
}
