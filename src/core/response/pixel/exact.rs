//! The response in `f64`, direction by direction: the reference for the fast path.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::{PairGeometry, SkySum};
use crate::array::hidden_by_moon;
use crate::frames::AntennaResponse;
use crate::sky::healpix;
use crate::units::vector::{Vec3, dot};

/// Envelope A S_i S_j of a pair: 0 where the Moon hides the direction from either satellite.
#[must_use]
#[doc(hidden)]
pub fn envelope(pair: &PairGeometry, n_hat: Vec3) -> f64 {
    let hidden = |r_m| hidden_by_moon(r_m, n_hat, pair.moon_radius_m);
    if hidden(pair.r_i_m) || hidden(pair.r_j_m) {
        return 0.0;
    }
    match pair.response {
        AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => 1.0,
        AntennaResponse::DipoleNormal => pair.antenna(n_hat),
    }
}

/// Computes exp(-2 pi i u . n) from the phase reduced to a fraction of a turn.
fn fringe(baseline_wavelengths: Vec3, n_hat: Vec3) -> Complex64 {
    let turns = dot(baseline_wavelengths, n_hat);
    Complex64::cis(-TAU * (turns - turns.round()))
}

/// Computes the row of B at the given directions, without the pixel area.
#[must_use]
pub fn centre_row(pair: &PairGeometry, directions: &[Vec3]) -> Vec<Complex64> {
    let u = pair.baseline_wavelengths();
    let at = |&n_hat: &Vec3| match envelope(pair, n_hat) {
        0.0 => Complex64::ZERO,
        envelope_value => envelope_value * fringe(u, n_hat),
    };
    directions.iter().map(at).collect()
}

/// Computes the row of B averaged over the centres of the `children`^2 children of each pixel of `nside`, each with
/// its own envelope; in RING order, without the pixel area. `children` need not be a power of two.
#[must_use]
pub fn average_row(pair: &PairGeometry, nside: usize, children: usize) -> Vec<Complex64> {
    let u = pair.baseline_wavelengths();
    let of_pixel = |pixel| {
        let mut sum = Complex64::ZERO;
        for n_hat in child_directions(nside, children, pixel) {
            let envelope_value = envelope(pair, n_hat);
            if envelope_value != 0.0 {
                sum += envelope_value * fringe(u, n_hat);
            }
        }
        sum / (children * children) as f64
    };
    (0..healpix::pixel_count(nside)).map(of_pixel).collect()
}

/// Centres of the `children`^2 children of a RING pixel, y running fastest.
pub(super) fn child_directions(nside: usize, children: usize, pixel: usize) -> impl Iterator<Item = Vec3> {
    let (face, ix, iy) = healpix::nested_to_face(nside, healpix::ring_to_nested(nside, pixel));
    let place =
        move |whole: usize, k: usize| (whole as f64 + (k as f64 + 0.5) / children as f64) / nside as f64;
    (0..children * children)
        .map(move |k| healpix::face_direction(face, place(ix, k / children), place(iy, k % children)))
}

/// Computes the visibility and the zero-spacing sum of a sky (K) at the given directions, each of `area_sr`.
///
/// The sums run over blocks of 1024 directions, then over blocks, to limit rounding.
#[must_use]
pub fn visibility(pair: &PairGeometry, directions: &[Vec3], sky_k: &[f64], area_sr: f64) -> SkySum {
    const BLOCK: usize = 1024;
    let u = pair.baseline_wavelengths();
    let mut total = SkySum::default();
    for (directions, sky_k) in directions.chunks(BLOCK).zip(sky_k.chunks(BLOCK)) {
        let mut part = SkySum::default();
        for (&n_hat, &value) in directions.iter().zip(sky_k) {
            let envelope_value = envelope(pair, n_hat);
            if envelope_value != 0.0 {
                part.visibility_k_sr += value * envelope_value * fringe(u, n_hat);
                part.zero_spacing_k_sr += value * envelope_value;
            }
        }
        total.visibility_k_sr += part.visibility_k_sr;
        total.zero_spacing_k_sr += part.zero_spacing_k_sr;
    }
    SkySum {
        visibility_k_sr: total.visibility_k_sr * area_sr,
        zero_spacing_k_sr: total.zero_spacing_k_sr * area_sr,
    }
}
