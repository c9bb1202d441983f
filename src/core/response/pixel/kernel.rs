//! Common parts of the fast kernels: the geometry of a pair, and its envelope over a chunk of directions.
//!
//! Kernels are plain loops over short buffers. `multiversion` compiles each of them for AVX-512, AVX2 and the baseline
//! and selects one at run time.

use super::{DirectionForm, PairGeometry, SatelliteAntenna, SingleGeometry};
use crate::frames::AntennaResponse;
use crate::units::arithmetic::{fused, fused64};
use crate::units::vector::{Vec3, dot, scale};

/// Number of directions that a kernel handles at a time; its buffers fit the first-level cache.
pub(super) const CHUNK: usize = 256;

pub(super) type ChunkDirections<'a> = [&'a [f64; CHUNK]; 3];

/// A chunk of the sky shorter than [`CHUNK`], padded with pixels of 0 K.
pub(super) struct PaddedChunk {
    n: [[f64; CHUNK]; 3],
    pub sky_k: [f32; CHUNK],
}

impl PaddedChunk {
    /// Copies directions and temperatures, at most [`CHUNK`] of them.
    #[inline(always)]
    pub fn new(n: [&[f64]; 3], sky_k: &[f32]) -> Self {
        let mut chunk = Self { n: [[0.0; CHUNK]; 3], sky_k: [0.0; CHUNK] };
        chunk.sky_k[..sky_k.len()].copy_from_slice(sky_k);
        for (padded, n) in chunk.n.iter_mut().zip(n) {
            padded[..n.len()].copy_from_slice(n);
        }
        chunk
    }

    #[inline(always)]
    pub fn directions(&self) -> ChunkDirections<'_> {
        [&self.n[0], &self.n[1], &self.n[2]]
    }
}

/// Geometry of a pair, or of a single satellite, in the form that the kernels need.
#[derive(Clone, Copy, Debug)]
pub(super) struct KernelGeometry {
    /// Baseline in wavelengths.
    pub u: Vec3,
    /// Direction of satellite i, which sees direction n where n . i_hat + limb_i >= 0.
    pub i_hat: Vec3,
    /// Cosine of the angle between the limb and the Moon's centre, seen from satellite i.
    pub limb_i: f64,
    /// Direction of satellite j.
    pub j_hat: Vec3,
    /// Cosine of the angle between the limb and the Moon's centre, seen from satellite j.
    pub limb_j: f64,
    /// Direction of the dipoles, if there are any.
    pub dipole: Option<Vec3>,
    /// Individual antennas, in place of isotropic ones or dipoles.
    pub antennas: Option<[SatelliteAntenna; 2]>,
}

/// Direction of a position, and the cosine of the angle between the limb and the Moon's centre.
fn limb(r_m: Vec3, moon_radius_m: f64) -> (Vec3, f64) {
    let length_m = dot(r_m, r_m).sqrt();
    let ratio = moon_radius_m / length_m;
    (scale(1.0 / length_m, r_m), (1.0 - ratio * ratio).max(0.0).sqrt())
}

impl KernelGeometry {
    pub fn pair(pair: &PairGeometry) -> Self {
        let (i_hat, limb_i) = limb(pair.r_i_m, pair.moon_radius_m);
        let (j_hat, limb_j) = limb(pair.r_j_m, pair.moon_radius_m);
        let dipole = match pair.response {
            AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => None,
            // Without an orbital plane the dipoles have no direction, and the result is NaN.
            AntennaResponse::DipoleNormal => Some(pair.orbit_normal().unwrap_or([f64::NAN; 3])),
        };
        Self { u: pair.baseline_wavelengths(), i_hat, limb_i, j_hat, limb_j, dipole, antennas: None }
    }

    /// A pair with individual antennas.
    pub fn antenna_pair((pair, antennas): &(PairGeometry, [SatelliteAntenna; 2])) -> Self {
        let ideal = PairGeometry { response: AntennaResponse::Isotropic, ..*pair };
        Self { antennas: Some(*antennas), ..Self::pair(&ideal) }
    }

    /// A satellite with an individual antenna.
    pub fn antenna_single((single, antenna): &(SingleGeometry, SatelliteAntenna)) -> Self {
        let ideal = SingleGeometry { response: AntennaResponse::Isotropic, ..*single };
        Self { antennas: Some([*antenna; 2]), ..Self::single(&ideal) }
    }

    pub fn single(single: &SingleGeometry) -> Self {
        let (i_hat, limb_i) = limb(single.r_m, single.moon_radius_m);
        let dipole = match single.response {
            AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => None,
            AntennaResponse::DipoleNormal => Some(single.normal_hat),
        };
        Self { u: [0.0; 3], i_hat, limb_i, j_hat: i_hat, limb_j: limb_i, dipole, antennas: None }
    }

    /// Depth of direction (x, y, z) above the limb for satellite i and for satellite j; negative where hidden.
    #[inline(always)]
    pub fn depths<const FMA: bool>(&self, x: f64, y: f64, z: f64) -> (f64, f64) {
        let depth_i = dot64::<FMA>(self.i_hat, x, y, z) + self.limb_i;
        let depth_j = dot64::<FMA>(self.j_hat, x, y, z) + self.limb_j;
        (depth_i, depth_j)
    }

    /// Whether both satellites see direction (x, y, z).
    #[inline(always)]
    pub fn sees<const FMA: bool>(&self, x: f64, y: f64, z: f64) -> bool {
        let (depth_i, depth_j) = self.depths::<FMA>(x, y, z);
        (depth_i >= 0.0) & (depth_j >= 0.0)
    }

    /// Multiplies a chunk of values by the antennas' power response.
    ///
    /// It is 1 - (n . d)^2 for dipoles along d. For an unpolarised wave, dipoles along d and e have d . e - (n . d) (n . e), the scalar
    /// product of their components across its direction; three dipoles on each satellite have half the sum over corresponding dipoles.
    #[inline(always)]
    pub fn apply_antenna<const FMA: bool, const N: usize>(
        &self,
        [x, y, z]: [&[f64; N]; 3],
        values: &mut [f32; N],
    ) {
        if let Some(dipole) = self.dipole {
            for k in 0..N {
                let along = dot64::<FMA>(dipole, x[k], y[k], z[k]) as f32;
                values[k] *= fused::<FMA>(-along, along, 1.0);
            }
        }
        if let Some([a, b]) = &self.antennas {
            let pair = PairAntennas::new(a, b);
            for k in 0..N {
                values[k] *= pair.response::<FMA>(x[k], y[k], z[k]) as f32;
            }
        }
    }
}

/// Antennas of two satellites that differ.
struct PairAntennas<'a> {
    axes: [&'a [Vec3; 3]; 2],
    /// Scalar products of like axes.
    common: [f64; 3],
    forms: [Option<&'a [DirectionForm; 3]>; 2],
    dipoles: usize,
}

impl<'a> PairAntennas<'a> {
    fn new(a: &'a SatelliteAntenna, b: &'a SatelliteAntenna) -> Self {
        let dipoles = match (a.elements, b.elements) {
            (AntennaResponse::DipoleNormal, AntennaResponse::DipoleNormal) => 1,
            (AntennaResponse::ThreeDipoles, AntennaResponse::ThreeDipoles) => 3,
            _ => 0,
        };
        let common = std::array::from_fn(|k| dot(a.axes[k], b.axes[k]));
        Self { axes: [&a.axes, &b.axes], common, forms: [a.forms.as_ref(), b.forms.as_ref()], dipoles }
    }

    /// The sum over like dipoles, each with its factors.
    #[inline(always)]
    fn response<const FMA: bool>(&self, x: f64, y: f64, z: f64) -> f64 {
        let factors = |k: usize| -> f64 {
            let of =
                |forms: Option<&[DirectionForm; 3]>| forms.map_or(1.0, |forms| forms[k].value([x, y, z]));
            of(self.forms[0]) * of(self.forms[1])
        };
        let [p, q] = self.axes.map(|axes| axes.map(|axis| dot64::<FMA>(axis, x, y, z)));
        let across = |k: usize| self.common[k] - p[k] * q[k];
        match (self.dipoles, self.forms) {
            (0, _) => factors(0),
            (1, _) => across(0) * factors(0),
            (_, [None, None]) => {
                let along = p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
                0.5 * (self.common.iter().sum::<f64>() - along)
            }
            _ => 0.5 * (0..3).map(|k| across(k) * factors(k)).sum::<f64>(),
        }
    }
}

#[inline(always)]
pub(super) fn dot64<const FMA: bool>(a: Vec3, x: f64, y: f64, z: f64) -> f64 {
    fused64::<FMA>(a[0], x, fused64::<FMA>(a[1], y, a[2] * z))
}

#[inline(always)]
pub(super) fn dot32<const FMA: bool>(a: [f32; 3], x: f32, y: f32, z: f32) -> f32 {
    fused::<FMA>(a[0], x, fused::<FMA>(a[1], y, a[2] * z))
}

/// Sum of a multiple of four values in `f64`: four partial sums, then their sum.
#[inline(always)]
pub(super) fn total<const LANES: usize>(lanes: &[f32; LANES]) -> f64 {
    let mut four = [0.0_f64; 4];
    for values in lanes.as_chunks::<4>().0 {
        for (sum, value) in four.iter_mut().zip(values) {
            *sum += f64::from(*value);
        }
    }
    (four[0] + four[1]) + (four[2] + four[3])
}
