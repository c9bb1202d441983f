//! Orbital motion of the daughters, direction of the Earth, and occultation by the Moon.

use std::f64::consts::{FRAC_PI_2, TAU};
use std::sync::Arc;

use super::bodies::{DatedEarth, Earth};
use super::config::{ArrayConfig, ArrayError, NodeMotion};
use super::formation::Formation;
use super::kepler::{KeplerOrbit, eccentric_anomaly};
use super::oem::{self, TableOrbit, TableSpan};
use super::propagate;
use super::state::SatelliteState;
use super::surface::{self, StationMotion};
use crate::units::constants::{DAY_S, MOON_RELIEF_M, SIDEREAL_MONTH_S};
use crate::units::time_scales::Tai;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, sub};

/// Minimum distance of two satellites at the epoch, m.
const DISTANCE_M_MIN: f64 = 1.0;

/// Orbit of one satellite, or the motion of a station.
#[derive(Clone, Debug, PartialEq)]
enum OwnOrbit {
    Kepler(KeplerOrbit),
    Table(TableOrbit),
    Station(StationMotion),
}

impl OwnOrbit {
    fn state(&self, t_s: f64) -> SatelliteState {
        match self {
            Self::Kepler(orbit) => orbit.state(t_s),
            Self::Table(orbit) => orbit.state(t_s),
            Self::Station(station) => station.state(t_s),
        }
    }

    fn normal_hat(&self, t_s: f64) -> Vec3 {
        match self {
            Self::Kepler(orbit) => orbit.normal_hat(t_s),
            Self::Table(orbit) => orbit.normal_hat(t_s),
            Self::Station(station) => station.north_hat(t_s),
        }
    }

    fn semi_major_axis_m(&self) -> f64 {
        match self {
            Self::Kepler(orbit) => orbit.semi_major_axis_m(),
            Self::Table(orbit) => orbit.semi_major_axis_m(),
            Self::Station(station) => station.radius_m(),
        }
    }

    fn inclination_rad(&self) -> f64 {
        match self {
            Self::Kepler(orbit) => orbit.inclination_rad(),
            Self::Table(orbit) => orbit.inclination_rad(),
            Self::Station(station) => station.north_hat(0.0)[2].clamp(-1.0, 1.0).acos(),
        }
    }

    fn period_s(&self) -> f64 {
        match self {
            Self::Kepler(orbit) => orbit.period_s(),
            Self::Table(orbit) => orbit.period_s(),
            Self::Station(_) => SIDEREAL_MONTH_S,
        }
    }

    fn farthest_m(&self) -> f64 {
        match self {
            Self::Kepler(orbit) => orbit.apoapsis_m(),
            Self::Table(orbit) => orbit.farthest_m(),
            Self::Station(station) => station.radius_m(),
        }
    }
}

/// Deviation of a formation from a common circle: an ellipse, and inclined planes.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Shape {
    eccentricity: f64,
    /// Argument of the periapsis at the epoch.
    periapsis_rad: f64,
    periapsis_rate_rad_s: f64,
    /// Ratio of the maximum distance across the track to that along it.
    cross_track_ratio: f64,
}

impl Shape {
    fn new(config: &ArrayConfig) -> Option<Self> {
        let shape = Self {
            eccentricity: config.eccentricity,
            periapsis_rad: config.periapsis_deg.to_radians(),
            periapsis_rate_rad_s: config.periapsis_rate_deg_per_day.to_radians() / DAY_S,
            cross_track_ratio: config.cross_track_ratio,
        };
        (!config.is_circle()).then_some(shape)
    }
}

/// The array in motion: positions at any time.
///
/// ```
/// use lunarray::array::{Array, ArrayConfig, IntegrationRule, integration_time_s};
/// use lunarray::units::vector::{norm, sub};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let array = Array::new(&ArrayConfig::default())?;
/// let [first, last] = [0, 7].map(|n| array.state(n, 3600.0));
/// let baseline_m = sub(first.position_m, last.position_m);
/// assert!(norm(baseline_m) > 1e3);
/// let dt_s = integration_time_s(IntegrationRule::default(), 10e6, first.velocity_m_s, last.velocity_m_s);
/// assert!(dt_s <= 25.0);
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// Formation on one orbit, if there is one.
    formation: Option<Formation>,
    /// Deviation from a common circle.
    shape: Option<Shape>,
    /// Separate orbits of the satellites; empty for a formation.
    own: Vec<OwnOrbit>,
    orbit_radius_m: f64,
    moon_radius_m: f64,
    inclination_rad: f64,
    orbital_period_s: f64,
    phase_rad: f64,
    node_rad: f64,
    node_rate_rad_s: f64,
    earth: Earth,
    /// Epoch of orbits with dates.
    epoch: Option<Tai>,
    /// Notes on content of orbit files that is not used.
    notes: Vec<String>,
}

impl Array {
    /// Creates the array of a configuration.
    ///
    /// # Errors
    /// The first of [`ArrayConfig::problems`], or a formation that cannot be built.
    pub fn new(config: &ArrayConfig) -> Result<Self, ArrayError> {
        if let Some(problem) = config.problems().into_iter().next() {
            return Err(problem.into());
        }
        let rate = TAU / config.precession_period_s;
        let kepler: Vec<KeplerOrbit> = config.kepler.iter().map(KeplerOrbit::new).collect();
        require_distinct(&kepler.iter().map(|orbit| orbit.state(0.0).position_m).collect::<Vec<_>>())?;
        let (mut epoch, mut notes) = (None, Vec::new());
        let mut moon_radius_m = config.moon_radius_m;
        let own: Vec<OwnOrbit> =
            if let Some(given) = config.stations_epoch().filter(|_| config.is_on_surface()) {
                epoch = Some(given);
                let stations = surface::motions(&config.stations, config.satellites, given, moon_radius_m)?;
                require_distinct(
                    &stations.iter().map(|station| station.state(0.0).position_m).collect::<Vec<_>>(),
                )?;
                // The Moon's surface is below every station, so that each sees the half of the sky above its own horizon.
                moon_radius_m = stations.iter().map(StationMotion::radius_m).fold(0.0, f64::max);
                stations.into_iter().map(OwnOrbit::Station).collect()
            } else if config.propagate.is_on() {
                propagate::orbits(config)?.into_iter().map(OwnOrbit::Table).collect()
            } else if config.oem.is_empty() {
                kepler.into_iter().map(OwnOrbit::Kepler).collect()
            } else {
                let found = oem::read(config)?;
                (epoch, notes) = (Some(found.epoch), found.notes);
                found.orbits.into_iter().map(OwnOrbit::Table).collect()
            };
        let earth = match epoch {
            // Orbits that are always known have no span, and the Earth then no table.
            Some(epoch) => Earth::Dated(Arc::new(DatedEarth::new(epoch, known_s(&own).unwrap_or_default()))),
            None => Earth::Circle(config.earth_longitude_deg.to_radians()),
        };
        Ok(Self {
            formation: if own.is_empty() { Some(Formation::new(config)?) } else { None },
            shape: Shape::new(config),
            own,
            orbit_radius_m: config.moon_radius_m + config.altitude_m,
            moon_radius_m,
            inclination_rad: config.inclination_deg.to_radians(),
            orbital_period_s: config.orbital_period_s,
            phase_rad: config.orbital_phase_deg.to_radians(),
            node_rad: config.node_longitude_deg.to_radians(),
            node_rate_rad_s: match config.node_motion {
                NodeMotion::Regress => -rate,
                NodeMotion::Advance => rate,
            },
            earth,
            epoch,
            notes,
        })
    }

    /// First and last mission time, s, between which positions are known without a gap; `None` if they are always
    /// known. Positions at other times are NaN.
    #[must_use]
    pub fn known_s(&self) -> Option<[f64; 2]> {
        known_s(&self.own)
    }

    /// Checks that positions are known at a time, s.
    ///
    /// # Errors
    /// [`ArrayError::NotKnown`] beyond [`Self::known_s`].
    #[doc(hidden)]
    pub fn require_known(&self, t_s: f64) -> Result<(), ArrayError> {
        match self.known_s() {
            // Dates in files are given to a microsecond.
            Some([from_s, until_s]) if !(from_s - 1e-6..=until_s + 1e-6).contains(&t_s) => {
                Err(ArrayError::NotKnown { t_s, known_s: [from_s, until_s], epoch_tai_s: self.epoch_tai_s() })
            }
            _ => Ok(()),
        }
    }

    /// Epoch of a mission whose orbits have dates: TAI seconds since 1958-01-01; `None` if the configuration
    /// determines it.
    #[doc(hidden)]
    #[must_use]
    pub fn epoch_tai_s(&self) -> Option<f64> {
        self.epoch.map(Tai::seconds_since_1958)
    }

    /// Notes on content of orbit files that is not used.
    #[doc(hidden)]
    #[must_use]
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Memory for the states of tabulated orbits (from files or propagation), bytes. Clones share it.
    #[must_use]
    #[doc(hidden)]
    pub fn table_bytes(&self) -> u64 {
        let bytes = |orbit: &OwnOrbit| match orbit {
            OwnOrbit::Table(orbit) => orbit.table_bytes(),
            OwnOrbit::Kepler(_) | OwnOrbit::Station(_) => 0,
        };
        self.own.iter().map(bytes).sum()
    }

    /// Tabulated states of the orbit of satellite `n` (from 0), if there are any.
    pub(super) fn table_spans(&self, n: usize) -> Option<Vec<TableSpan>> {
        match self.own.get(n) {
            Some(OwnOrbit::Table(orbit)) => Some(orbit.table_spans()),
            _ => None,
        }
    }

    /// Number of daughters.
    #[must_use]
    pub fn satellites(&self) -> usize {
        self.formation.as_ref().map_or(self.own.len(), Formation::satellites)
    }

    /// Whether the array consists of stations on the Moon.
    #[must_use]
    #[doc(hidden)]
    pub fn is_on_surface(&self) -> bool {
        matches!(self.own.first(), Some(OwnOrbit::Station(_)))
    }

    /// Radius of the Moon, m; under stations, that of the highest one's ground.
    #[must_use]
    pub fn moon_radius_m(&self) -> f64 {
        self.moon_radius_m
    }

    /// Radius of the orbit, or the semi-major axis of satellite 1, m.
    #[must_use]
    #[doc(hidden)]
    pub fn orbit_radius_m(&self) -> f64 {
        self.own.first().map_or(self.orbit_radius_m, OwnOrbit::semi_major_axis_m)
    }

    /// Inclination of the orbit, or of that of satellite 1, to the ecliptic, rad.
    #[must_use]
    #[doc(hidden)]
    pub fn inclination_rad(&self) -> f64 {
        self.own.first().map_or(self.inclination_rad, OwnOrbit::inclination_rad)
    }

    /// Maximum distance of a satellite from the Moon's centre, m.
    #[must_use]
    #[doc(hidden)]
    pub fn farthest_m(&self) -> f64 {
        let farthest_m = self.own.iter().map(OwnOrbit::farthest_m).fold(0.0, f64::max);
        let eccentricity = self.shape.map_or(0.0, |shape| shape.eccentricity);
        if self.own.is_empty() { self.orbit_radius_m * (1.0 + eccentricity) } else { farthest_m }
    }

    /// Orbital period, or that of satellite 1, s.
    #[must_use]
    pub fn orbital_period_s(&self) -> f64 {
        self.own.first().map_or(self.orbital_period_s, OwnOrbit::period_s)
    }

    /// The daughters' arcs, if they follow each other on a circle.
    #[must_use]
    #[doc(hidden)]
    pub fn formation(&self) -> Option<&Formation> {
        self.formation.as_ref().filter(|_| self.shape.is_none())
    }

    /// The daughters' arcs on a common orbit, a circle or not.
    #[must_use]
    pub(crate) fn formation_of_any_shape(&self) -> Option<&Formation> {
        self.formation.as_ref()
    }

    /// Least distance of two daughters whose arcs differ by `arc_m`, anywhere on their orbits, m; 0 if there is no such bound, as beyond a
    /// quarter of an ellipse.
    #[must_use]
    pub(crate) fn distance_m_min(&self, arc_m: f64) -> f64 {
        let axis_m = self.orbit_radius_m;
        let Some(Shape { eccentricity: e, cross_track_ratio, .. }) = self.shape else {
            return 2.0 * axis_m * (0.5 * arc_m / axis_m).sin().abs();
        };
        // The true anomaly is slowest at the apoapsis, r = a (1 + e), by dnu / dM = a^2 sqrt(1 - e^2) / r^2.
        let angle = arc_m.abs() / axis_m;
        let along = angle * (1.0 - e * e).sqrt() / (1.0 + e).powi(2);
        if angle > FRAC_PI_2 {
            return 0.0;
        }
        // Directions at angles of t and u from the common node, in planes tilted by d, are an angle s apart with
        // 1 - cos s = 1 - cos(t - u) + sin t sin u (1 - cos d), and sin t sin u >= -sin^2((t - u) / 2): so sin(s / 2) is at least
        // sin((t - u) / 2) cos(d / 2).
        2.0 * axis_m * (1.0 - e) * (0.5 * along).sin() * (0.5 * cross_track_ratio * angle).cos()
    }

    /// State of daughter `n` (from 0) at `t_s`.
    ///
    /// On the circle, `r = R [cos O cos f - sin O sin f cos i, sin O cos f + cos O sin f cos i, sin f sin i]`
    /// with `f = phi - s_n / R` (the paper, Sect. 3.1).
    #[must_use]
    pub fn state(&self, n: usize, t_s: f64) -> SatelliteState {
        let Some(formation) = &self.formation else { return self.own[n].state(t_s) };
        if let Some(shape) = &self.shape {
            return self.shaped_state(shape, formation.arc_m(n, t_s), t_s);
        }
        let radius = self.orbit_radius_m;
        let (arc_m, arc_rate_m_s) = formation.arc_m(n, t_s);
        // As in the paper; after 1.3 years the last bit of the phase is worth 7 um along the track, equal for all daughters.
        let phase = self.phase_rad + TAU * t_s / self.orbital_period_s - arc_m / radius;
        let phase_rate = TAU / self.orbital_period_s - arc_rate_m_s / radius;
        let (sin_f, cos_f) = phase.sin_cos();
        let (sin_o, cos_o) = (self.node_rad + self.node_rate_rad_s * t_s).sin_cos();
        let (sin_i, cos_i) = self.inclination_rad.sin_cos();
        // The point in the orbital plane, then its rotation with fused operations: fewer roundings than with the radius
        // outside. Half a nanometre at each end of a baseline is 1e-10 of a turn at 30 MHz, the accuracy required of rows.
        let (along_node, beyond_node) = (radius * cos_f, radius * sin_f);
        let position_m = [
            (-sin_o * cos_i).mul_add(beyond_node, cos_o * along_node),
            (cos_o * cos_i).mul_add(beyond_node, sin_o * along_node),
            sin_i * beyond_node,
        ];
        let along =
            [-cos_o * sin_f - sin_o * cos_f * cos_i, -sin_o * sin_f + cos_o * cos_f * cos_i, cos_f * sin_i];
        let around = [-position_m[1], position_m[0], 0.0];
        SatelliteState {
            position_m,
            velocity_m_s: std::array::from_fn(|k| {
                radius * phase_rate * along[k] + self.node_rate_rad_s * around[k]
            }),
        }
    }

    /// State of a daughter on an ellipse: it trails daughter 1 by `arc / a` of mean anomaly, in a plane whose
    /// inclination differs by `cross_track_ratio` times that angle.
    fn shaped_state(&self, shape: &Shape, (arc_m, arc_rate_m_s): (f64, f64), t_s: f64) -> SatelliteState {
        let (axis_m, e) = (self.orbit_radius_m, shape.eccentricity);
        let periapsis_rate = shape.periapsis_rate_rad_s;
        let periapsis = shape.periapsis_rad + periapsis_rate * t_s;
        let mean = self.phase_rad + TAU * t_s / self.orbital_period_s - arc_m / axis_m - periapsis;
        let mean_rate = TAU / self.orbital_period_s - arc_rate_m_s / axis_m - periapsis_rate;
        let anomaly = eccentric_anomaly(mean, e);
        let (sin, cos) = anomaly.sin_cos();
        let anomaly_rate = mean_rate / (1.0 - e * cos);
        let beside_m = axis_m * (1.0 - e * e).sqrt();
        let plane_m = [axis_m * (cos - e), beside_m * sin];
        let plane_m_s = [-axis_m * anomaly_rate * sin, beside_m * anomaly_rate * cos];
        let (sin_w, cos_w) = periapsis.sin_cos();
        let (sin_o, cos_o) = (self.node_rad + self.node_rate_rad_s * t_s).sin_cos();
        let (sin_i, cos_i) = (self.inclination_rad + shape.cross_track_ratio * arc_m / axis_m).sin_cos();
        let inclination_rate = shape.cross_track_ratio * arc_rate_m_s / axis_m;
        let node_hat = [cos_o, sin_o, 0.0];
        let quadrature_hat = [-sin_o * cos_i, cos_o * cos_i, sin_i];
        let normal_hat = [sin_i * sin_o, -sin_i * cos_o, cos_i];
        let in_space = |[x, y]: [f64; 2]| {
            add(scale(x * cos_w - y * sin_w, node_hat), scale(x * sin_w + y * cos_w, quadrature_hat))
        };
        let position_m = in_space(plane_m);
        // The line of apsides rotates about the orbit's normal, the plane about its node, the node about the pole.
        let turning = add(
            add(scale(periapsis_rate, normal_hat), scale(inclination_rate, node_hat)),
            [0.0, 0.0, self.node_rate_rad_s],
        );
        SatelliteState { position_m, velocity_m_s: add(in_space(plane_m_s), cross(turning, position_m)) }
    }

    /// Position of a satellite that trails daughter 1 by an arc `arc_m` on its osculating circle, m.
    #[must_use]
    #[doc(hidden)]
    pub fn trailing_position_m(&self, arc_m: f64, t_s: f64) -> Vec3 {
        let ahead_m = self.position_m(0, t_s);
        let first_arc_m = self.formation.as_ref().map_or(0.0, |formation| formation.arc_m(0, t_s).0);
        let (sin, cos) = ((first_arc_m - arc_m) / self.orbit_radius_m()).sin_cos();
        let along_m = cross(self.orbit_normal_hat(t_s), ahead_m);
        add(scale(cos, ahead_m), scale(sin, along_m))
    }

    /// Normal of the orbital plane, or of that of satellite 1.
    #[must_use]
    #[doc(hidden)]
    pub fn orbit_normal_hat(&self, t_s: f64) -> Vec3 {
        self.normal_hat(0, t_s)
    }

    /// Normal of the plane in which satellite `n` (from 0) moves.
    #[must_use]
    #[doc(hidden)]
    pub fn normal_hat(&self, n: usize, t_s: f64) -> Vec3 {
        if let Some(orbit) = self.own.get(n) {
            return orbit.normal_hat(t_s);
        }
        let (sin_o, cos_o) = (self.node_rad + self.node_rate_rad_s * t_s).sin_cos();
        let arc_rad = |formation: &Formation| formation.arc_m(n, t_s).0 / self.orbit_radius_m;
        let across = self.shape.zip(self.formation.as_ref());
        let offset = across.map_or(0.0, |(shape, formation)| shape.cross_track_ratio * arc_rad(formation));
        let (sin_i, cos_i) = (self.inclination_rad + offset).sin_cos();
        [sin_i * sin_o, -sin_i * cos_o, cos_i]
    }

    /// Position of daughter `n` (from 0), m.
    ///
    /// ```
    /// use lunarray::array::{Array, ArrayConfig, ObservingWindows};
    /// use lunarray::units::vector::{norm, sub};
    ///
    /// let array = Array::new(&ArrayConfig::default())?;
    /// let window = ObservingWindows::new(&array, 0.0, 1e5).next().expect("an orbit takes 8249 s");
    /// let middle_s = 0.5 * (window.start.seconds() + window.end.seconds());
    /// let baseline_m = norm(sub(array.position_m(0, middle_s), array.position_m(1, middle_s)));
    /// assert!(baseline_m > 100.0 && baseline_m < 600.0);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[must_use]
    pub fn position_m(&self, n: usize, t_s: f64) -> Vec3 {
        self.state(n, t_s).position_m
    }

    /// Direction of the Earth from the Moon's centre: by its ephemeris if orbits have dates (to 0.004 degrees from
    /// 2020 to 2040), else an idealised Earth on a circle in the ecliptic.
    #[must_use]
    pub fn earth_hat(&self, t_s: f64) -> Vec3 {
        self.earth.hat(t_s)
    }

    /// Direction of the Sun from the Moon's centre (to 0.002 degrees from 2020 to 2040); `None` without dates.
    #[doc(hidden)]
    #[must_use]
    pub fn sun_hat(&self, t_s: f64) -> Option<Vec3> {
        match &self.earth {
            Earth::Circle(_) => None,
            Earth::Dated(earth) => Some(earth.sun_hat(t_s)),
        }
    }

    /// Whether the Earth is hidden from daughter 1, so that the array observes.
    #[must_use]
    pub fn observing(&self, t_s: f64) -> bool {
        self.earth_depth_m(t_s) > 0.0
    }

    /// Depth of the Earth behind the limb for daughter 1, m: positive when hidden.
    pub(super) fn earth_depth_m(&self, t_s: f64) -> f64 {
        self.earth_depth_for_m(0, t_s)
    }

    /// Depth of the Earth behind the limb for daughter `n` (from 0), m: positive when hidden.
    #[must_use]
    #[doc(hidden)]
    pub fn earth_depth_for_m(&self, n: usize, t_s: f64) -> f64 {
        let position = self.position_m(n, t_s);
        hiding_depth_m(position, self.earth_hat(t_s), self.moon_radius_m)
    }
}

impl Array {
    /// Angle of the Earth below the Moon's limb for daughter `n` (from 0), rad: positive when hidden.
    #[must_use]
    #[doc(hidden)]
    pub fn earth_below_limb_rad(&self, n: usize, t_s: f64) -> f64 {
        let position_m = self.position_m(n, t_s);
        let distance_m = norm(position_m);
        let from_zenith = (dot(self.earth_hat(t_s), position_m) / distance_m).clamp(-1.0, 1.0).acos();
        let limb_from_nadir = (self.moon_radius_m / distance_m).min(1.0).asin();
        from_zenith - (std::f64::consts::PI - limb_from_nadir)
    }
}

/// Interval in which all of some orbits are known, s; `None` if they are always known.
fn known_s(orbits: &[OwnOrbit]) -> Option<[f64; 2]> {
    let spans = orbits.iter().filter_map(|orbit| match orbit {
        OwnOrbit::Table(orbit) => Some(orbit.span_s()),
        OwnOrbit::Kepler(_) | OwnOrbit::Station(_) => None,
    });
    spans.reduce(|[from, to], [start, end]| [from.max(start), to.min(end)])
}

/// Checks that no two satellites have the same position at the epoch.
fn require_distinct(positions: &[Vec3]) -> Result<(), ArrayError> {
    for (second, position) in positions.iter().enumerate() {
        let coincides = |other: &Vec3| norm(sub(*position, *other)) < DISTANCE_M_MIN;
        if let Some(first) = positions[..second].iter().position(coincides) {
            return Err(ArrayError::OnePlace { first: first + 1, second: second + 1 });
        }
    }
    Ok(())
}

/// Whether a position is below the Moon's surface by more than its relief. With stations that is the highest one's, and the others lie below.
#[must_use]
pub fn is_underground(r_m: Vec3, moon_radius_m: f64) -> bool {
    norm(r_m) <= moon_radius_m - MOON_RELIEF_M
}

/// Whether the Moon hides direction `n_hat` from a satellite at `r_m` (the paper, Sect. 3.2). From a station that is what lies below
/// its horizon.
#[must_use]
pub fn hidden_by_moon(r_m: Vec3, n_hat: Vec3, moon_radius_m: f64) -> bool {
    hiding_depth_m(r_m, n_hat, moon_radius_m) > 0.0
}

/// How far the tangent point of the line of sight lies beyond the limb, along that line, m: positive when hidden.
fn hiding_depth_m(r_m: Vec3, n_hat: Vec3, moon_radius_m: f64) -> f64 {
    let to_limb_m = (dot(r_m, r_m) - moon_radius_m * moon_radius_m).max(0.0).sqrt();
    -dot(n_hat, r_m) - to_limb_m
}
