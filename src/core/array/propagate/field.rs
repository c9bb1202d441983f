//! Forces on a satellite of the Moon: the Moon's field and the Earth.

use std::f64::consts::TAU;

use multiversion::multiversion;

use super::dop853::{LANES, Lanes, States};
use super::grgm900c::{COEFFICIENTS, GM_M3_S2, RADIUS_M};
use crate::units::constants::SIDEREAL_MONTH_S;

/// GM of the Earth, m^3/s^2 (DE440).
const EARTH_GM_M3_S2: f64 = 3.986_004_355e14;

/// Distance of the Earth, m: its mean semi-major axis.
const EARTH_DISTANCE_M: f64 = 384.4e6;

/// Acceleration by one spherical harmonic, for its cosine and sine coefficients.
#[derive(Clone, Copy, Debug, Default)]
struct Term {
    /// Recursion factors for the terms of one and two degrees below.
    from_below: [f64; 2],
    x: [f64; 2],
    y: [f64; 2],
    z: [f64; 2],
}

/// Forces on a satellite.
#[derive(Clone, Debug)]
pub(super) struct Forces {
    /// Terms by order, then by degree from the order on; for degrees 0 to one more than the field's.
    terms: Vec<Vec<Term>>,
    earth: bool,
    /// Longitude of the Earth at the epoch, rad. As the Moon keeps one side to the Earth, it is also the longitude of
    /// the Moon's prime meridian.
    earth_rad: f64,
}

impl Forces {
    /// Creates the Moon's field up to `degree`, with the attraction of the Earth if `earth`.
    pub(super) fn new(degree: usize, earth: bool, earth_rad: f64) -> Self {
        let top = degree + 1;
        let mut terms: Vec<Vec<Term>> =
            (0..=top).map(|order| vec![Term::default(); top + 1 - order]).collect();
        for (order, terms) in terms.iter_mut().enumerate() {
            for (k, term) in terms.iter_mut().enumerate().skip(1) {
                let (n, m) = ((order + k) as f64, order as f64);
                term.from_below = [(2.0 * n - 1.0) / (n - m), -(n + m - 1.0) / (n - m)];
            }
        }
        // Derivatives of degree n are harmonic functions of degree n + 1 (Montenbruck and Gill, Satellite Orbits, Eq. 3.33).
        for n in 2..=degree {
            for m in 0..=n {
                let [c, s] = unnormalised(n, m);
                let mut add = |order: usize, x: [f64; 2], y: [f64; 2], z: [f64; 2]| {
                    let term = &mut terms[order][n + 1 - order];
                    for part in 0..2 {
                        term.x[part] += x[part];
                        term.y[part] += y[part];
                        term.z[part] += z[part];
                    }
                };
                let half = if m == 0 { 1.0 } else { 0.5 };
                add(m + 1, [-half * c, -half * s], [half * s, -half * c], [0.0; 2]);
                if m > 0 {
                    let rest = (n - m) as f64;
                    let f = 0.5 * (rest + 1.0) * (rest + 2.0);
                    add(m - 1, [f * c, f * s], [f * s, -f * c], [0.0; 2]);
                }
                let f = -((n - m + 1) as f64);
                add(m, [0.0; 2], [0.0; 2], [f * c, f * s]);
            }
        }
        Self { terms, earth, earth_rad }
    }

    /// Rates of states: velocities and accelerations.
    pub(super) fn slopes(&self, time_s: &Lanes, states: &States) -> States {
        let mut turn = [[0.0; LANES]; 2];
        for lane in 0..LANES {
            let (sin, cos) = (self.earth_rad + TAU * time_s[lane] / SIDEREAL_MONTH_S).sin_cos();
            (turn[0][lane], turn[1][lane]) = (cos, sin);
        }
        let mut out = [[0.0; LANES]; 6];
        out[..3].copy_from_slice(&states[3..]);
        let pulls = moon_acceleration(&self.terms, &turn, states);
        out[3..].copy_from_slice(&pulls);
        if self.earth {
            add_earth_acceleration(&turn, states, &mut out);
        }
        out
    }
}

/// C and S of a degree and order, for unnormalised Legendre functions.
fn unnormalised(n: usize, m: usize) -> [f64; 2] {
    let product: f64 = (n - m + 1..=n + m).map(|k| k as f64).product();
    let twice = if m == 0 { 1.0 } else { 2.0 };
    let norm = (twice * (2 * n + 1) as f64 / product).sqrt();
    // The table lists degrees from 2 on, each with its orders from 0.
    COEFFICIENTS[n * (n + 1) / 2 + m - 3].map(|value| norm * value)
}

/// Accelerations in the Moon's field, m/s^2, by axis; `turn` is the cosine and sine of the longitude of its prime
/// meridian.
///
/// Harmonic functions follow from Cunningham's recursions (Montenbruck and Gill, Eq. 3.29 to 3.31) on axes that
/// rotate with the Moon. No multiplication is fused with an addition, so that every target gives the same bits.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn moon_acceleration(terms: &[Vec<Term>], turn: &[Lanes; 2], states: &States) -> [Lanes; 3] {
    let mut x = [0.0; LANES];
    let mut y = [0.0; LANES];
    let mut z = [0.0; LANES];
    let mut square = [0.0; LANES];
    let mut below = [[0.0; LANES]; 2];
    let mut sums = [[0.0; LANES]; 3];
    let mut middle = [0.0; LANES];
    for k in 0..LANES {
        let [rx, ry, rz] = [states[0][k], states[1][k], states[2][k]];
        let r2 = rx * rx + ry * ry + rz * rz;
        let part = RADIUS_M / r2;
        x[k] = (turn[0][k] * rx + turn[1][k] * ry) * part;
        y[k] = (turn[0][k] * ry - turn[1][k] * rx) * part;
        z[k] = rz * part;
        square[k] = RADIUS_M * part;
        below[0][k] = RADIUS_M / r2.sqrt();
        middle[k] = -GM_M3_S2 / (r2 * r2.sqrt());
    }
    for (order, terms) in terms.iter().enumerate() {
        if order > 0 {
            let factor = (2 * order - 1) as f64;
            for k in 0..LANES {
                let [v, w] = [below[0][k], below[1][k]];
                below[0][k] = factor * (x[k] * v - y[k] * w);
                below[1][k] = factor * (x[k] * w + y[k] * v);
            }
        }
        let (mut now, mut before) = (below, [[0.0; LANES]; 2]);
        for (step, term) in terms.iter().enumerate() {
            if step > 0 {
                let [one, two] = term.from_below;
                for part in 0..2 {
                    for k in 0..LANES {
                        let next = one * z[k] * now[part][k] + two * square[k] * before[part][k];
                        before[part][k] = now[part][k];
                        now[part][k] = next;
                    }
                }
            }
            for k in 0..LANES {
                let [v, w] = [now[0][k], now[1][k]];
                sums[0][k] += term.x[0] * v + term.x[1] * w;
                sums[1][k] += term.y[0] * v + term.y[1] * w;
                sums[2][k] += term.z[0] * v + term.z[1] * w;
            }
        }
    }
    let scale = GM_M3_S2 / (RADIUS_M * RADIUS_M);
    let mut out = [[0.0; LANES]; 3];
    for k in 0..LANES {
        let [ax, ay, az] = [sums[0][k], sums[1][k], sums[2][k]];
        out[0][k] = middle[k] * states[0][k] + scale * (turn[0][k] * ax - turn[1][k] * ay);
        out[1][k] = middle[k] * states[1][k] + scale * (turn[1][k] * ax + turn[0][k] * ay);
        out[2][k] = middle[k] * states[2][k] + scale * az;
    }
    out
}

/// Adds the Earth's attraction of the satellite minus that of the Moon; `turn` is its direction.
fn add_earth_acceleration(turn: &[Lanes; 2], states: &States, out: &mut States) {
    for k in 0..LANES {
        let earth_m = [EARTH_DISTANCE_M * turn[0][k], EARTH_DISTANCE_M * turn[1][k], 0.0];
        let away_m: [f64; 3] = std::array::from_fn(|axis| earth_m[axis] - states[axis][k]);
        let square: f64 = away_m[0] * away_m[0] + away_m[1] * away_m[1] + away_m[2] * away_m[2];
        let (near, far) = (square * square.sqrt(), EARTH_DISTANCE_M.powi(3));
        for axis in 0..3 {
            out[3 + axis][k] += EARTH_GM_M3_S2 * (away_m[axis] / near - earth_m[axis] / far);
        }
    }
}
