//! Orbits by numerical integration of the forces on each satellite.
//!
//! The forces are the Moon's field (GRGM900C, to degree and order 16), and the Earth as a point mass on a circle in
//! the plane of the ecliptic. The Moon rotates about the pole of the ecliptic and keeps one side to the Earth. So its
//! pole is off by 1.54 deg, the Earth's distance is a mean, and the Sun (1 % of the Earth's attraction) and radiation
//! pressure are neglected.
//!
//! A follower starts where the leader, satellite 1, was when it had the follower's arc still to go, with the velocity
//! that it had there, in a plane tilted according to `cross_track_ratio`. So the satellites follow each other along
//! one track, and drift apart as little as free satellites can. Station keeping restores these positions
//! instantaneously, for the arcs of that time, when the Earth is high above satellite 1: no observing window has a
//! jump.

mod dop853;
mod field;
mod grgm900c;

use std::f64::consts::TAU;
use std::sync::{Mutex, OnceLock};

use rayon::prelude::*;

use super::config::{ArrayConfig, ArrayError, PropagateConfig, StationKeeping};
use super::formation::Formation;
use super::kepler::{KeplerElements, KeplerOrbit};
use super::oem::{TableOrbit, TableSpan};
use super::state::SatelliteState;
use crate::units::constants::{DAY_S, SIDEREAL_MONTH_S};
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, unit};
use dop853::{LANES, Lanes, States, step};
use field::Forces;
use grgm900c::GM_M3_S2;

/// Step of the integration, s: 68 per orbit 300 km above the Moon. Each step leaves a state; the method would allow
/// twice as long ones, but interpolation between them would err by a centimetre.
const STEP_S: f64 = 120.0;

/// Minimum number of states of a stretch: as many as interpolation needs.
const NODES_MIN: usize = 4;

/// Maximum distance from the Moon's centre, m: its sphere of influence.
const RADIUS_M_MAX: f64 = 6.6e7;

/// Interval of progress reports, in states.
const TELL_EVERY: usize = 4_000;

/// Callback for progress, with the number of days done and their total.
pub type PropagationProgress = fn(f64, f64);

static PROGRESS: OnceLock<PropagationProgress> = OnceLock::new();

/// Sets the callback for the progress of long propagations; only the first call in a process counts.
pub fn report_propagation_to(progress: PropagationProgress) {
    let _ = PROGRESS.set(progress);
}

/// Cache of the last propagated orbits: a pipeline requests them several times.
static LATEST: Mutex<Option<(ArrayConfig, Vec<TableOrbit>)>> = Mutex::new(None);

/// Orbits of all satellites of a configuration without other problems.
pub(super) fn orbits(config: &ArrayConfig) -> Result<Vec<TableOrbit>, ArrayError> {
    // The lock is not held while orbits are propagated, which may wait for other work of this thread.
    let latest = || LATEST.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    if let Some((known, orbits)) = &*latest()
        && known == config
    {
        return Ok(orbits.clone());
    }
    let orbits = propagated(config)?;
    *latest() = Some((config.clone(), orbits.clone()));
    Ok(orbits)
}

fn propagated(config: &ArrayConfig) -> Result<Vec<TableOrbit>, ArrayError> {
    let propagation = Propagation::new(config)?;
    // The leader is propagated with each group of followers.
    let groups: Vec<Vec<usize>> = match propagation.formation {
        Some(_) => {
            let followers: Vec<usize> = (1..config.satellites).collect();
            followers.chunks(LANES - 1).map(|some| [&[0], some].concat()).collect()
        }
        None => {
            let all: Vec<usize> = (0..config.satellites).collect();
            all.chunks(LANES).map(<[usize]>::to_vec).collect()
        }
    };
    let found: Result<Vec<Vec<Vec<TableSpan>>>, ArrayError> = groups
        .par_iter()
        .enumerate()
        .map(|(index, group)| propagation.propagate_group(group, index == 0))
        .collect();
    let mut orbits: Vec<TableOrbit> = Vec::with_capacity(config.satellites);
    for (stretches, group) in found?.into_iter().zip(&groups) {
        for (stretches, satellite) in stretches.into_iter().zip(group) {
            if *satellite == orbits.len() {
                orbits.push(TableOrbit::of_stretches(stretches));
            }
        }
    }
    Ok(orbits)
}

/// A propagation: forces, initial states and length.
struct Propagation<'a> {
    config: &'a ArrayConfig,
    forces: Forces,
    /// The formation; `None` if each satellite has its own elements.
    formation: Option<Formation>,
    /// Number of states to be kept after the first.
    nodes: usize,
}

impl<'a> Propagation<'a> {
    fn new(config: &'a ArrayConfig) -> Result<Self, ArrayError> {
        let PropagateConfig { days, degree, earth, .. } = config.propagate;
        Ok(Self {
            config,
            forces: Forces::new(degree, earth, config.earth_longitude_deg.to_radians()),
            formation: if config.kepler.is_empty() { Some(Formation::new(config)?) } else { None },
            nodes: ((days * DAY_S / STEP_S).ceil() as usize).max(NODES_MIN),
        })
    }

    /// Propagates satellites that are computed together, and returns their stretches; satellite 1 is the first of
    /// them if there is a formation.
    fn propagate_group(
        &self,
        group: &[usize],
        reports_progress: bool,
    ) -> Result<Vec<Vec<TableSpan>>, ArrayError> {
        let mut states = self.at_epoch(group);
        let mut out: Vec<Vec<TableSpan>> = vec![vec![TableSpan::default()]; group.len()];
        let every_s = self.config.propagate.keep_every_days * DAY_S;
        let mut due_s = if every_s > 0.0 { every_s } else { f64::INFINITY };
        // Height of the Earth above satellite 1 at the last two states.
        let mut heights = [f64::NEG_INFINITY; 2];
        for node in 0..=self.nodes {
            let time_s = node as f64 * STEP_S;
            self.check(group, time_s, &states)?;
            append(&mut out, time_s, &states);
            let height = self.earth_height(time_s, &states);
            let culminates = heights[0] < heights[1] && height <= heights[1];
            heights = [heights[1], height];
            if time_s >= due_s && culminates && node + NODES_MIN <= self.nodes {
                states = self.after_station_keeping(time_s, &states, group);
                out.iter_mut().for_each(|stretches| stretches.push(TableSpan::default()));
                append(&mut out, time_s, &states);
                due_s = every_s * ((time_s / every_s).floor() + 1.0);
            }
            let slopes = |time_s: &Lanes, states: &States| self.forces.slopes(time_s, states);
            states = step(&[time_s; LANES], &[STEP_S; LANES], &states, &slopes);
            if reports_progress
                && node % TELL_EVERY == 0
                && let Some(tell) = PROGRESS.get()
            {
                tell(time_s / DAY_S, self.nodes as f64 * STEP_S / DAY_S);
            }
        }
        Ok(out)
    }

    /// States at the epoch.
    fn at_epoch(&self, group: &[usize]) -> States {
        let elements = &self.config.kepler;
        if elements.is_empty() {
            let ArrayConfig { orbital_phase_deg, periapsis_deg, node_longitude_deg, .. } = *self.config;
            let leader = KeplerOrbit::about(
                &self.leader(node_longitude_deg, orbital_phase_deg - periapsis_deg),
                GM_M3_S2,
            );
            return self.with_followers(0.0, leader.state(0.0), group);
        }
        // The field rotates planes and apsides: configured rates are not used.
        let state = |satellite: usize| {
            let still = KeplerElements {
                node_rate_deg_per_day: 0.0,
                periapsis_rate_deg_per_day: 0.0,
                ..elements[satellite]
            };
            KeplerOrbit::about(&still, GM_M3_S2).state(0.0)
        };
        let mut states = all_lanes(state(group[0]));
        group.iter().enumerate().for_each(|(lane, satellite)| put(&mut states, lane, state(*satellite)));
        states
    }

    /// Elements of satellite 1 at the epoch, with this node and mean anomaly, degrees.
    fn leader(&self, node_longitude_deg: f64, mean_anomaly_deg: f64) -> KeplerElements {
        KeplerElements {
            semi_major_axis_m: self.config.moon_radius_m + self.config.altitude_m,
            eccentricity: self.config.eccentricity,
            inclination_deg: self.config.inclination_deg,
            node_longitude_deg,
            periapsis_deg: self.config.periapsis_deg,
            mean_anomaly_deg,
            node_rate_deg_per_day: 0.0,
            periapsis_rate_deg_per_day: 0.0,
        }
    }

    /// States after station keeping.
    fn after_station_keeping(&self, time_s: f64, states: &States, group: &[usize]) -> States {
        let leader = of_lane(states, 0);
        let leader = match self.config.propagate.keep {
            StationKeeping::Formation => leader,
            StationKeeping::Orbit => self.on_initial_orbit(leader),
        };
        self.with_followers(time_s, leader, group)
    }

    /// State of satellite 1 on its initial ellipse, at its current node and argument of latitude.
    fn on_initial_orbit(&self, leader: SatelliteState) -> SatelliteState {
        let normal = unit(cross(leader.position_m, leader.velocity_m_s));
        let node = node_hat(normal);
        let latitude = dot(leader.position_m, cross(normal, node)).atan2(dot(leader.position_m, node));
        let (e, periapsis) = (self.config.eccentricity, self.config.periapsis_deg.to_radians());
        let half = 0.5 * (latitude - periapsis);
        // Tangents of half the true and half the eccentric anomaly.
        let anomaly = 2.0 * ((1.0 - e).sqrt() * half.sin()).atan2((1.0 + e).sqrt() * half.cos());
        let mean = anomaly - e * anomaly.sin();
        let elements = self.leader(node[1].atan2(node[0]).to_degrees(), mean.to_degrees());
        KeplerOrbit::about(&elements, GM_M3_S2).state(0.0)
    }

    /// States of a leader and its followers on its track: each where the leader was when it had the follower's arc of
    /// that time to go, in the follower's own plane.
    fn with_followers(&self, time_s: f64, leader: SatelliteState, group: &[usize]) -> States {
        let Some(formation) = &self.formation else { return all_lanes(leader) };
        let axis_m = self.config.moon_radius_m + self.config.altitude_m;
        let mut arcs_m = [0.0; LANES];
        for (arc_m, satellite) in arcs_m.iter_mut().zip(group) {
            *arc_m = formation.arc_m(*satellite, time_s).0;
        }
        let delays_s = arcs_m.map(|arc_m| arc_m / (GM_M3_S2 / axis_m).sqrt());
        let steps = (delays_s.iter().fold(0.0, |a: f64, b| a.max(*b)) / STEP_S).ceil().max(1.0);
        let step_s = delays_s.map(|delay_s| -delay_s / steps);
        let mut states = all_lanes(leader);
        let mut now_s = [time_s; LANES];
        for _ in 0..steps as usize {
            let slopes = |time_s: &Lanes, states: &States| self.forces.slopes(time_s, states);
            states = step(&now_s, &step_s, &states, &slopes);
            for (now_s, step_s) in now_s.iter_mut().zip(&step_s) {
                *now_s += step_s;
            }
        }
        let axis = node_hat(cross(leader.position_m, leader.velocity_m_s));
        for (lane, arc_m) in arcs_m.iter().enumerate().take(group.len()) {
            let tilt = self.config.cross_track_ratio * arc_m / axis_m;
            let state = of_lane(&states, lane);
            let tilted = SatelliteState {
                position_m: rotated(state.position_m, axis, tilt),
                velocity_m_s: rotated(state.velocity_m_s, axis, tilt),
            };
            put(&mut states, lane, tilted);
        }
        states
    }

    /// Sine of the Earth's height above satellite 1.
    fn earth_height(&self, time_s: f64, states: &States) -> f64 {
        let angle = self.config.earth_longitude_deg.to_radians() + TAU * time_s / SIDEREAL_MONTH_S;
        let (sin, cos) = angle.sin_cos();
        dot(unit(of_lane(states, 0).position_m), [cos, sin, 0.0])
    }

    /// Checks that all satellites are above the surface and within the Moon's sphere of influence.
    fn check(&self, group: &[usize], time_s: f64, states: &States) -> Result<(), ArrayError> {
        for (lane, satellite) in group.iter().enumerate() {
            let radius_m = norm(of_lane(states, lane).position_m);
            if !(radius_m > self.config.moon_radius_m && radius_m < RADIUS_M_MAX) {
                return Err(ArrayError::Strays { satellite: satellite + 1, day: time_s / DAY_S, radius_m });
            }
        }
        Ok(())
    }
}

fn append(out: &mut [Vec<TableSpan>], time_s: f64, states: &States) {
    for (lane, stretches) in out.iter_mut().enumerate() {
        if let Some(stretch) = stretches.last_mut() {
            stretch.push(time_s, of_lane(states, lane));
        }
    }
}

/// Direction of the ascending node of a plane with this normal; longitude 0 for the ecliptic itself.
fn node_hat(normal: Vec3) -> Vec3 {
    let node = [-normal[1], normal[0], 0.0];
    if norm(node) > 1e-12 * norm(normal) { unit(node) } else { [1.0, 0.0, 0.0] }
}

/// Rotates a vector about a unit axis.
fn rotated(v: Vec3, axis: Vec3, angle: f64) -> Vec3 {
    let (sin, cos) = angle.sin_cos();
    add(add(scale(cos, v), scale(sin, cross(axis, v))), scale((1.0 - cos) * dot(axis, v), axis))
}

/// Copies one state to all lanes.
fn all_lanes(state: SatelliteState) -> States {
    let mut states = [[0.0; LANES]; 6];
    (0..LANES).for_each(|lane| put(&mut states, lane, state));
    states
}

fn put(states: &mut States, lane: usize, state: SatelliteState) {
    for axis in 0..3 {
        states[axis][lane] = state.position_m[axis];
        states[3 + axis][lane] = state.velocity_m_s[axis];
    }
}

fn of_lane(states: &States, lane: usize) -> SatelliteState {
    SatelliteState {
        position_m: std::array::from_fn(|axis| states[axis][lane]),
        velocity_m_s: std::array::from_fn(|axis| states[3 + axis][lane]),
    }
}

#[cfg(test)]
mod tests;
