//! Smooth model of the Galaxy: synchrotron emission and free-free absorption along lines of sight.
//!
//! The model has disks of emission and of warm ionised gas, with the Sun slightly above their plane inside a cavity. The profiles
//! are usual in Galactic models (exponential in radius, sech^2 in height, a ring of dense gas at 4 kpc). The
//! parameters reproduce the published statistics of ULSA (see [`super`]), but no particular map.

use std::f64::consts::PI;

use multiversion::multiversion;
use rayon::prelude::*;

use crate::units::arithmetic::exponentials;
use crate::units::vector::Vec3;

/// Frequency at which emission and opacity are stated, Hz.
pub(super) const REFERENCE_HZ: f64 = 10e6;
/// Temperature index of the synchrotron emission.
pub(super) const SYNCHROTRON_INDEX: f64 = 2.51;
/// Frequency index of the free-free opacity.
pub(super) const OPACITY_INDEX: f64 = 2.1;
pub(super) const ELECTRON_K: f64 = 8_000.0;

/// Galactocentric distance of the Sun, kpc (GRAVITY Collaboration 2019).
const SUN_RADIUS_KPC: f64 = 8.2;
/// Height of the Sun above the plane, kpc (Bennett & Bovy 2019).
const SUN_HEIGHT_KPC: f64 = 0.0208;

/// Synchrotron emissivity of the disk at the Sun, K/kpc.
const DISK_K_KPC: f64 = 12.3e3;

/// Synchrotron emissivity of the halo at the Sun, K/kpc.
const HALO_K_KPC: f64 = 28.3e3;
/// Scale lengths and heights of the emission, kpc.
const DISK_LENGTH_KPC: f64 = 2.45;
const DISK_HEIGHT_KPC: f64 = 0.434;
const HALO_LENGTH_KPC: f64 = 8.0;
const HALO_HEIGHT_KPC: f64 = 7.9;

/// Opacity of the thick disk of warm ionised gas at the Sun, 1/kpc.
const GAS_PER_KPC: f64 = 0.0060;
const GAS_LENGTH_KPC: f64 = 2.62;
const GAS_HEIGHT_KPC: f64 = 1.58;
/// Opacity in the ring of dense gas, 1/kpc. The following constants are the ring's radius, width and height, kpc.
const RING_PER_KPC: f64 = 1.02;
const RING_RADIUS_KPC: f64 = 4.0;
const RING_WIDTH_KPC: f64 = 1.8;
const RING_HEIGHT_KPC: f64 = 0.14;
/// Radius of the cavity around the Sun, kpc.
const CAVITY_KPC: f64 = 0.227;

/// Relative extension of the cavity towards the north pole.
const CAVITY_NORTH: f64 = 0.63;

/// Opacity inside the cavity, 1/kpc.
const CAVITY_PER_KPC: f64 = 0.0071;

/// Number of steps along a line of sight, s = FIRST_KPC (exp(u) - 1) with uniform u, up to LENGTH_KPC.
const STEPS: usize = 96;
const FIRST_KPC: f64 = 0.03;
const LENGTH_KPC: f64 = 40.0;

/// Number of nodes in |longitude|, which are uniform.
const LONGITUDES: usize = 121;

/// Number of nodes in latitude b, which are uniform in asinh(b / LATITUDE_SOFT_RAD).
const LATITUDES: usize = 161;
const LATITUDE_SOFT_RAD: f64 = 1.5 * PI / 180.0;
/// Number of nodes in the cloudiness of the absorber, one standard deviation apart.
const CLOUDS: usize = 11;
const CLOUD_MIDDLE: f64 = 5.0;
/// Cloudinesses of a ray: whole vectors of the processor, of which [`CLOUDS`] count.
const LANES: usize = 16;

/// Returns the emissivity, K/kpc, and the opacity, 1/kpc, at distance `s_kpc`, both at [`REFERENCE_HZ`].
#[inline(always)]
fn medium<const FMA: bool>(direction: Vec3, s_kpc: f64) -> (f64, f64) {
    let exp = |x: f64| exponentials::<FMA>(x).1;
    let sech2 = |x: f64| {
        let e = exp(-2.0 * x.abs());
        4.0 * e / ((1.0 + e) * (1.0 + e))
    };
    let x = SUN_RADIUS_KPC - s_kpc * direction[0];
    let y = s_kpc * direction[1];
    let z = SUN_HEIGHT_KPC + s_kpc * direction[2];
    let radius = (x * x + y * y).sqrt();
    let outward = radius - SUN_RADIUS_KPC;
    let outward_spherical = (radius * radius + z * z).sqrt() - SUN_RADIUS_KPC;
    let emission = DISK_K_KPC * exp(-outward / DISK_LENGTH_KPC) * sech2(z / DISK_HEIGHT_KPC)
        + HALO_K_KPC * exp(-outward_spherical / HALO_LENGTH_KPC) * sech2(z / HALO_HEIGHT_KPC);
    let from_ring = (radius - RING_RADIUS_KPC) / RING_WIDTH_KPC;
    let gas = GAS_PER_KPC * exp(-outward / GAS_LENGTH_KPC) * sech2(z / GAS_HEIGHT_KPC)
        + RING_PER_KPC * exp(-from_ring * from_ring) * sech2(z / RING_HEIGHT_KPC);
    let northward = direction[2].max(0.0);
    let edge = s_kpc / (CAVITY_KPC * (1.0 + CAVITY_NORTH * northward * northward));
    let inside = 1.0 / (1.0 + (edge * edge) * (edge * edge));
    (emission, gas * (1.0 - inside) + CAVITY_PER_KPC * inside)
}

fn step_edges() -> [f64; STEPS + 1] {
    let top = (LENGTH_KPC / FIRST_KPC).ln_1p();
    std::array::from_fn(|k| FIRST_KPC * (top * k as f64 / STEPS as f64).exp_m1())
}

/// Result of the transfer along a line of sight, before the emission is scaled to the frequency.
struct Ray {
    /// Synchrotron temperature at [`REFERENCE_HZ`] without absorption, K.
    unabsorbed_k: f64,
    /// Optical depth at [`REFERENCE_HZ`].
    depth: f64,
    /// Absorbed synchrotron temperature for each cloudiness, K with the emissivity at [`REFERENCE_HZ`].
    absorbed_k: [f64; LANES],
}

/// Solves the radiative transfer from the last of `edges`, at most `STEPS + 1`, to the Sun; each step is homogeneous.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn transfer(direction: Vec3, edges: &[f64], opacity_scales: &[f64; LANES]) -> Ray {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let (mut middles, mut steps) = ([0.0; STEPS], [0.0; STEPS]);
    for ((middle, step), edge) in middles.iter_mut().zip(&mut steps).zip(edges.windows(2)) {
        (*middle, *step) = (0.5 * (edge[0] + edge[1]), edge[1] - edge[0]);
    }
    let (mut emitted, mut depths) = ([0.0; STEPS], [0.0; STEPS]);
    for k in 0..STEPS {
        let (emission, opacity) = medium::<FMA>(direction, middles[k]);
        (emitted[k], depths[k]) = (emission * steps[k], opacity * steps[k]);
    }
    let (mut absorbed_k, mut transmitted) = ([0.0; LANES], [1.0; LANES]);
    for (emitted, depth) in emitted.iter().zip(&depths) {
        for k in 0..LANES {
            let depth = depth * opacity_scales[k];
            let stopped = -exponentials::<FMA>(-depth).0;
            // (1 - exp(-x)) / x, by its series where that is accurate to 1e-12.
            let escaping = if depth > 1e-6 { stopped / depth } else { 1.0 - 0.5 * depth };
            absorbed_k[k] += emitted * escaping * transmitted[k];
            transmitted[k] *= 1.0 - stopped;
        }
    }
    Ray { unabsorbed_k: emitted.iter().sum(), depth: depths.iter().sum(), absorbed_k }
}

/// Smooth Galaxy at one frequency, tabulated over the sky and the cloudiness of its gas.
pub(super) struct Galaxy {
    /// Factor from the emissivity at [`REFERENCE_HZ`] to this frequency.
    emission_scale: f64,
    /// Factor from the opacity at [`REFERENCE_HZ`] to this frequency.
    opacity_scale: f64,
    /// Standard deviation of the logarithm of the gas's opacity.
    cloud_rms: f64,
    /// Logarithm of the optical depth at the reference frequency, `[latitude][longitude]`.
    depth: Vec<f64>,
    /// Logarithm of the unabsorbed temperature, `[latitude][longitude]`.
    unabsorbed: Vec<f64>,
    /// Logarithm of the absorbed temperature, `[latitude][longitude][cloudiness]`.
    absorbed: Vec<f64>,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct GalaxySight {
    /// Absorbed synchrotron temperature, K.
    pub synchrotron_k: f64,
    /// Synchrotron temperature at the reference frequency without absorption, K.
    pub unabsorbed_reference_k: f64,
    /// Optical depth of the whole line of sight.
    pub depth: f64,
}

impl Galaxy {
    /// Solves the transfer at `frequency_hz` for gas with opacity exp(cloud_rms g - cloud_rms^2 / 2)
    /// times the mean.
    pub fn new(frequency_hz: f64, cloud_rms: f64) -> Self {
        let ratio = frequency_hz / REFERENCE_HZ;
        let opacity_scale = ratio.powf(-OPACITY_INDEX);
        let scales = std::array::from_fn(|k| {
            opacity_scale * cloudiness(cloud_rms, k.min(CLOUDS - 1) as f64 - CLOUD_MIDDLE)
        });
        let edges = step_edges();
        let rays: Vec<Ray> = (0..LATITUDES * LONGITUDES)
            .into_par_iter()
            .map(|node| {
                let latitude = node_latitude(node / LONGITUDES);
                let longitude = PI * (node % LONGITUDES) as f64 / (LONGITUDES - 1) as f64;
                transfer(direction_of(longitude, latitude), &edges, &scales)
            })
            .collect();
        Self {
            emission_scale: ratio.powf(-SYNCHROTRON_INDEX),
            opacity_scale,
            cloud_rms,
            depth: rays.iter().map(|ray| ray.depth.ln()).collect(),
            unabsorbed: rays.iter().map(|ray| ray.unabsorbed_k.ln()).collect(),
            absorbed: rays.iter().flat_map(|ray| ray.absorbed_k[..CLOUDS].iter().map(|k| k.ln())).collect(),
        }
    }

    /// Interpolates the line of sight in a Galactic direction, through gas of cloudiness `cloud` (a standard normal number).
    pub fn sight(&self, direction: Vec3, cloud: f64) -> GalaxySight {
        let latitude = direction[2].atan2(direction[0].hypot(direction[1]));
        let longitude = direction[1].atan2(direction[0]).abs();
        let (row0, row_weights) = cubic(latitude_node(latitude), LATITUDES);
        let (column0, column_weights) = cubic(longitude / PI * (LONGITUDES - 1) as f64, LONGITUDES);
        let (cloud0, cloud_weights) = cubic(cloud + CLOUD_MIDDLE, CLOUDS);
        let (mut depth, mut unabsorbed, mut absorbed) = (0.0, 0.0, 0.0);
        for (row, row_weight) in row_weights.into_iter().enumerate() {
            for (column, column_weight) in column_weights.into_iter().enumerate() {
                let weight = row_weight * column_weight;
                let node = clamped(row0, row, LATITUDES) * LONGITUDES + mirrored(column0, column, LONGITUDES);
                depth += weight * self.depth[node];
                unabsorbed += weight * self.unabsorbed[node];
                let clouds = &self.absorbed[node * CLOUDS..][..CLOUDS];
                let along: f64 = cloud_weights
                    .into_iter()
                    .enumerate()
                    .map(|(k, cloud_weight)| cloud_weight * clouds[clamped(cloud0, k, CLOUDS)])
                    .sum();
                absorbed += weight * along;
            }
        }
        GalaxySight {
            synchrotron_k: self.emission_scale * absorbed.exp(),
            unabsorbed_reference_k: unabsorbed.exp(),
            depth: self.opacity_scale * self.opacity_factor(cloud) * depth.exp(),
        }
    }

    /// Opacity of gas of cloudiness `cloud` relative to the mean.
    pub fn opacity_factor(&self, cloud: f64) -> f64 {
        cloudiness(self.cloud_rms, cloud.clamp(-CLOUD_MIDDLE, CLOUD_MIDDLE))
    }

    /// Absorbed synchrotron temperature, K, of the first `distance_kpc` in a Galactic direction, for
    /// mean gas.
    pub fn foreground_k(&self, direction: Vec3, distance_kpc: f64) -> f64 {
        let mut edges: Vec<f64> = step_edges().into_iter().take_while(|&s| s < distance_kpc).collect();
        edges.push(distance_kpc);
        let scales = [self.opacity_scale; LANES];
        self.emission_scale * transfer(direction, &edges, &scales).absorbed_k[0]
    }
}

pub(super) fn direction_of(longitude_rad: f64, latitude_rad: f64) -> Vec3 {
    let (sin_longitude, cos_longitude) = longitude_rad.sin_cos();
    let (sin_latitude, cos_latitude) = latitude_rad.sin_cos();
    [cos_latitude * cos_longitude, cos_latitude * sin_longitude, sin_latitude]
}

fn cloudiness(cloud_rms: f64, cloud: f64) -> f64 {
    (cloud_rms * cloud - 0.5 * cloud_rms * cloud_rms).exp()
}

fn latitude_top() -> f64 {
    (0.5 * PI / LATITUDE_SOFT_RAD).asinh()
}

fn node_latitude(row: usize) -> f64 {
    let u = 2.0 * row as f64 / (LATITUDES - 1) as f64 - 1.0;
    LATITUDE_SOFT_RAD * (u * latitude_top()).sinh()
}

fn latitude_node(latitude: f64) -> f64 {
    let u = (latitude / LATITUDE_SOFT_RAD).asinh() / latitude_top();
    (u + 1.0) * 0.5 * (LATITUDES - 1) as f64
}

/// Returns the node before position `x` and the Catmull-Rom weights of the four nodes around it.
fn cubic(x: f64, nodes: usize) -> (usize, [f64; 4]) {
    let x = x.clamp(0.0, (nodes - 1) as f64);
    let before = (x.floor() as usize).min(nodes - 2);
    let t = x - before as f64;
    let (t2, t3) = (t * t, t * t * t);
    let weights = [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ];
    (before, weights)
}

fn clamped(before: usize, k: usize, nodes: usize) -> usize {
    (before + k).saturating_sub(1).min(nodes - 1)
}

/// Index of node k of four, as in [`clamped`], with the table mirrored at its ends.
fn mirrored(before: usize, k: usize, nodes: usize) -> usize {
    let node = (before + k).abs_diff(1);
    if node < nodes { node } else { 2 * (nodes - 1) - node }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_agree_with_the_transfer_itself() {
        let galaxy = Galaxy::new(3e6, 0.3);
        let edges = step_edges();
        for k in 0..400_u32 {
            let longitude = f64::from(k) * 2.399_963;
            let latitude = (2.0 * (f64::from(k) + 0.5) / 400.0 - 1.0).asin();
            let direction = direction_of(longitude, latitude);
            let cloud = 1.7 * f64::from(k).sin();
            let scales = [galaxy.opacity_scale * galaxy.opacity_factor(cloud); LANES];
            let ray = transfer(direction, &edges, &scales);
            let seen = galaxy.sight(direction, cloud);
            // The error of interpolation between nodes about a degree apart is far below the added fluctuations.
            let want = galaxy.emission_scale * ray.absorbed_k[0];
            assert!((seen.synchrotron_k / want - 1.0).abs() < 3e-3, "{k}: {} {want}", seen.synchrotron_k);
            assert!((seen.depth / (ray.depth * scales[0]) - 1.0).abs() < 3e-3, "{k}");
            assert!((seen.unabsorbed_reference_k / ray.unabsorbed_k - 1.0).abs() < 3e-3, "{k}");
        }
    }

    #[test]
    fn thin_gas_lets_everything_through_and_thick_gas_little() {
        let direction = direction_of(0.3, 0.0);
        let clear = Galaxy::new(1e12, 0.0).sight(direction, 0.0);
        let scale = (1e12_f64 / REFERENCE_HZ).powf(-SYNCHROTRON_INDEX);
        assert!((clear.synchrotron_k / (scale * clear.unabsorbed_reference_k) - 1.0).abs() < 3e-3);
        let galaxy = Galaxy::new(1e6, 0.0);
        let thick = galaxy.sight(direction, 0.0);
        assert!(thick.depth > 10.0);
        assert!(thick.synchrotron_k < 0.1 * galaxy.emission_scale * thick.unabsorbed_reference_k);
        // Nearly all emission seen through thick gas is nearby.
        assert!(galaxy.foreground_k(direction, 4.0) > 0.9 * thick.synchrotron_k);
    }
}
