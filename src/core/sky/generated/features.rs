//! Nearby features of the sky: radio loops in front of most of the gas, and nebulae that absorb the emission behind them.

use crate::units::vector::{Vec3, dot, unit};

use super::galaxy::{ELECTRON_K, Galaxy, OPACITY_INDEX, REFERENCE_HZ, direction_of};

/// A spherical shell of synchrotron emission with the Sun outside or just inside it.
struct Loop {
    longitude_deg: f64,
    latitude_deg: f64,
    radius_deg: f64,
    brightness: f64,
}

/// Loops I to IV, with centres and radii of Berkhuijsen, Haslam & Salter (1971) and rounded brightnesses.
const LOOPS: [Loop; 4] = [
    Loop { longitude_deg: 329.0, latitude_deg: 17.5, radius_deg: 58.0, brightness: 1.0 },
    Loop { longitude_deg: 100.0, latitude_deg: -32.5, radius_deg: 45.5, brightness: 1.0 },
    Loop { longitude_deg: 124.0, latitude_deg: 15.5, radius_deg: 32.5, brightness: 0.8 },
    Loop { longitude_deg: 315.0, latitude_deg: 48.5, radius_deg: 19.75, brightness: 0.3 },
];
/// Ratio of the inner to the outer radius of a shell.
const SHELL_INNER: f64 = 0.9;
/// Temperature for a path through a shell as long as the distance to its centre, K at the reference frequency.
const LOOP_K: f64 = 8.65e5;

/// Temperature index of the loops: steeper than the diffuse emission, like the North Polar Spur (Roger et al. 1999).
const LOOP_INDEX: f64 = 2.9;
/// Optical depth of the local clouds in front of the loops at the reference frequency.
const LOOP_DEPTH: f64 = 0.0037;
/// Distance of the loops, kpc.
const LOOP_KPC: f64 = 0.13;
/// Longitude and latitude of the North Polar Spur, where the loops are brightest, degrees.
const SPUR_DEG: [f64; 2] = [25.0, 50.0];

/// Rate at which the loops fade away from the spur.
const SPUR_SHARPNESS: f64 = 4.4;

/// Spherical nebula of ionised gas.
struct Nebula {
    longitude_deg: f64,
    latitude_deg: f64,
    radius_deg: f64,
    distance_kpc: f64,
    /// Emission measure through the centre, pc cm^-6.
    emission_measure: f64,
}

const fn nebula(place_deg: [f64; 2], radius_deg: f64, distance_kpc: f64, emission_measure: f64) -> Nebula {
    Nebula {
        longitude_deg: place_deg[0],
        latitude_deg: place_deg[1],
        radius_deg,
        distance_kpc,
        emission_measure,
    }
}

/// Well-known nebulae with rounded positions, sizes and distances, and emission measures from their H-alpha brightness.
const NEBULAE: [Nebula; 11] = [
    nebula([258.0, -2.0], 14.0, 0.45, 150.0), // Gum
    nebula([6.3, 23.6], 5.0, 0.12, 80.0),     // zeta Ophiuchi, Sh 2-27
    nebula([316.1, 50.8], 5.0, 0.077, 4.0),   // Spica
    nebula([195.1, -12.0], 3.3, 0.40, 70.0),  // lambda Orionis, Sh 2-264
    nebula([206.5, -17.5], 6.0, 0.41, 40.0),  // Orion and Barnard's loop
    nebula([160.5, -12.3], 1.3, 0.46, 200.0), // California, Sh 2-220
    nebula([206.3, -2.1], 0.7, 1.6, 3_000.0), // Rosette
    nebula([79.5, 0.8], 3.5, 1.4, 2_000.0),   // Cygnus X
    nebula([85.0, -1.0], 1.3, 0.75, 2_000.0), // North America
    nebula([135.5, 0.9], 1.6, 2.0, 1_000.0),  // W 3, 4, 5
    nebula([287.6, -0.8], 1.0, 2.3, 5_000.0), // eta Carinae
];

/// Free-free optical depth of gas at [`ELECTRON_K`] for an emission measure of 1 pc cm^-6 (Mezger & Henderson 1967):
/// 3.28e-7 (T / 1e4 K)^-1.35 at 1 GHz.
fn depth_per_measure(frequency_hz: f64) -> f64 {
    3.28e-7 * (ELECTRON_K / 1e4).powf(-1.35) * (frequency_hz / 1e9).powf(-OPACITY_INDEX)
}

struct Screen {
    direction: Vec3,
    sin2_radius: f64,
    depth: f64,
    foreground_k: f64,
    before_loops: bool,
}

pub(super) struct Features {
    loops: Vec<(Vec3, f64, f64)>,
    loop_depth: f64,
    spur: Vec3,
    /// Nebulae from the farthest to the nearest.
    screens: Vec<Screen>,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct FeatureSight {
    /// Temperature with loops and nebulae, K.
    pub temperature_k: f64,
    /// Optical depth that nebulae add to the whole line of sight.
    pub depth: f64,
}

impl Features {
    /// Computes the features at `frequency_hz` in front of and within `galaxy`.
    pub fn new(frequency_hz: f64, galaxy: &Galaxy, loops: bool, nebulae: bool) -> Self {
        let ratio = frequency_hz / REFERENCE_HZ;
        let loop_k = LOOP_K * ratio.powf(-LOOP_INDEX);
        let per_measure = depth_per_measure(frequency_hz);
        let shown = if loops { LOOPS.as_slice() } else { &[] };
        let screens = if nebulae { NEBULAE.as_slice() } else { &[] };
        let mut screens: Vec<&Nebula> = screens.iter().collect();
        screens.sort_by(|a, b| b.distance_kpc.total_cmp(&a.distance_kpc));
        Self {
            loops: shown
                .iter()
                .map(|shell| {
                    let centre = direction_deg(shell.longitude_deg, shell.latitude_deg);
                    (centre, shell.radius_deg.to_radians().sin(), loop_k * shell.brightness)
                })
                .collect(),
            loop_depth: LOOP_DEPTH * ratio.powf(-OPACITY_INDEX),
            spur: direction_deg(SPUR_DEG[0], SPUR_DEG[1]),
            screens: screens
                .into_iter()
                .map(|nebula| {
                    let direction = direction_deg(nebula.longitude_deg, nebula.latitude_deg);
                    Screen {
                        direction,
                        sin2_radius: nebula.radius_deg.to_radians().sin().powi(2),
                        depth: per_measure * nebula.emission_measure,
                        foreground_k: galaxy.foreground_k(direction, nebula.distance_kpc),
                        before_loops: nebula.distance_kpc < LOOP_KPC,
                    }
                })
                .collect(),
        }
    }

    /// Adds loops and nebulae to a smooth sky of `diffuse_k` in a Galactic direction; the gas in
    /// front of the loops has `opacity_factor` times its mean opacity.
    pub fn add_to(&self, direction: Vec3, diffuse_k: f64, opacity_factor: f64) -> FeatureSight {
        let mut temperature = diffuse_k;
        let mut added = 0.0;
        let mut loops_pending = true;
        for screen in &self.screens {
            if screen.before_loops && loops_pending {
                temperature += self.loops_k(direction, opacity_factor);
                loops_pending = false;
            }
            let cos = dot(direction, screen.direction);
            let sin2 = 1.0 - cos * cos;
            if cos <= 0.0 || sin2 >= screen.sin2_radius {
                continue;
            }
            let depth = screen.depth * (1.0 - sin2 / screen.sin2_radius).sqrt();
            let before = screen.foreground_k.min(temperature);
            temperature = before + (temperature - before) * (-depth).exp() - ELECTRON_K * (-depth).exp_m1();
            added += depth;
        }
        if loops_pending {
            temperature += self.loops_k(direction, opacity_factor);
        }
        FeatureSight { temperature_k: temperature, depth: added }
    }

    fn loops_k(&self, direction: Vec3, opacity_factor: f64) -> f64 {
        let path: f64 =
            self.loops.iter().map(|(c, radius, k)| k * shell_path(dot(direction, *c), *radius)).sum();
        if path <= 0.0 {
            return 0.0;
        }
        let fading = (SPUR_SHARPNESS * (dot(direction, self.spur) - 1.0)).exp();
        path * fading * (-self.loop_depth * opacity_factor).exp()
    }
}

/// Path through a shell of outer radius `radius` around a centre at distance 1, at an angle with cosine `cos` from the centre's
/// direction.
fn shell_path(cos: f64, radius: f64) -> f64 {
    let sin2 = 1.0 - cos * cos;
    let chord = |radius: f64| {
        let inside = radius * radius - sin2;
        if inside > 0.0 { (cos + inside.sqrt()).max(0.0) - (cos - inside.sqrt()).max(0.0) } else { 0.0 }
    };
    chord(radius) - chord(radius * SHELL_INNER)
}

fn direction_deg(longitude_deg: f64, latitude_deg: f64) -> Vec3 {
    unit(direction_of(longitude_deg.to_radians(), latitude_deg.to_radians()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shell_is_brightest_at_its_inner_edge_and_dark_outside() {
        let radius = 0.5;
        let at = |angle: f64| shell_path(angle.cos(), radius);
        let middle = at(0.0);
        // Twice the thickness through the middle.
        assert!((middle - 2.0 * radius * (1.0 - SHELL_INNER)).abs() < 1e-12);
        let rim = at((radius * SHELL_INNER).asin());
        // Half the chord that touches the inner sphere is the leg of a right triangle.
        assert!((rim - 2.0 * radius * (1.0 - SHELL_INNER * SHELL_INNER).sqrt()).abs() < 1e-7);
        assert_eq!(at(radius.asin() + 1e-3), 0.0);
        assert_eq!(at(std::f64::consts::PI), 0.0);
    }

    #[test]
    fn an_opaque_nebula_shows_its_foreground_and_its_own_warmth() {
        let galaxy = Galaxy::new(1e6, 0.0);
        let features = Features::new(1e6, &galaxy, false, true);
        let gum = direction_deg(258.0, -2.0);
        let through = features.add_to(gum, 3e7, 1.0);
        let before = galaxy.foreground_k(gum, 0.45);
        assert!(before > 0.0 && before < 3e7);
        // 150 pc cm^-6 at 1 MHz is some 130 optical depths.
        assert!(through.depth > 100.0);
        assert!((through.temperature_k - before - ELECTRON_K).abs() < 1e-6 * before);
        let beside = features.add_to(direction_deg(230.0, 30.0), 3e7, 1.0);
        assert_eq!((beside.temperature_k, beside.depth), (3e7, 0.0));
    }
}
