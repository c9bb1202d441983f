//! Where satellites are, and the visibilities that a sky gives there.

use std::path::PathBuf;

use lunarray::array::{Array, Ephemeris, integration_time_s};
use lunarray::frames::{AntennaResponse, EphemerisSegment};
use lunarray::mother::BAND_HZ;
use lunarray::pipeline::{Config, ConfigSource};
use lunarray::response::pixel::{PairGeometry, exact};
use lunarray::runtime::Cancel;
use lunarray::sky::healpix::pixel_area_sr;
use lunarray::units::vector::{Vec3, norm, sub};
use lunarray::units::{MAX_SATELLITES, MissionTime};
use num_complex::Complex64;
use numpy::{PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use rayon::prelude::*;

use crate::error::{exception, refused};
use crate::maps::sky_map;
use crate::wait::{require_threads, wait};

/// Times beyond which nothing is known, s.
const TIME_S_MAX: f64 = 1e9;

/// Farthest that a satellite may be, and nearest that two may be to each other, m: as in files of orbits.
const FAR_M: f64 = 1e9;
const APART_M: f64 = 1.0;

/// Positions at times, m: a row a time, three columns a satellite; NaN where unknown.
pub(crate) fn places<'py>(
    py: Python<'py>,
    times_s: &PyReadonlyArray1<'py, f64>,
    satellites: usize,
    position: impl Fn(f64, usize) -> Option<Vec3>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let mut values = Vec::new();
    for &t_s in times_s.as_array() {
        require_time(t_s)?;
        for n in 0..satellites {
            values.extend(position(t_s, n).unwrap_or([f64::NAN; 3]));
        }
    }
    PyArray1::from_vec(py, values).reshape([times_s.as_array().len(), 3 * satellites])
}

fn require_time(t_s: f64) -> PyResult<()> {
    if t_s.abs() <= TIME_S_MAX {
        return Ok(());
    }
    Err(refused(format!("t = {t_s}: expected seconds since the mission epoch, -1e9 to 1e9")))
}

/// The array of a pipeline.
#[pyclass(frozen)]
pub(crate) struct NativeArray {
    array: Array,
    config: Config,
}

#[pymethods]
impl NativeArray {
    #[new]
    #[pyo3(signature = (pipeline=None, overrides=Vec::new()))]
    fn new(pipeline: Option<PathBuf>, overrides: Vec<String>) -> PyResult<Self> {
        let source = ConfigSource { file: pipeline, overrides, seed: None };
        let config = source.load().map_err(exception)?;
        if config.array.propagate.days > 0.0 {
            require_threads()?;
        }
        let array = Array::new(&config.array).map_err(exception)?;
        Ok(Self { array, config })
    }

    #[getter]
    fn satellites(&self) -> usize {
        self.array.satellites()
    }

    /// The mission's epoch: TAI seconds since 1958-01-01.
    #[getter]
    fn epoch_tai_s(&self) -> f64 {
        self.config.epoch_tai_s(&self.array)
    }

    #[getter]
    fn moon_radius_m(&self) -> f64 {
        self.array.moon_radius_m()
    }

    /// Whether antennas are dipoles along the orbit's normal.
    #[getter]
    fn dipoles(&self) -> bool {
        AntennaResponse::from(self.config.spacecraft.antenna) == AntennaResponse::DipoleNormal
    }

    fn positions<'py>(
        &self,
        py: Python<'py>,
        times_s: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        times_s.as_array().iter().try_for_each(|&t_s| self.require_known(t_s))?;
        places(py, &times_s, self.array.satellites(), |t_s, n| Some(self.array.position_m(n, t_s)))
    }

    /// Whether the Moon hides the Earth, and the directions of the Earth and, where orbits have dates, of the Sun.
    fn earth(&self, t_s: f64) -> PyResult<(bool, Vec3, Option<Vec3>)> {
        self.require_known(t_s)?;
        Ok((self.array.observing(t_s), self.array.earth_hat(t_s), self.array.sun_hat(t_s)))
    }

    /// Integration time of a pair (satellites from 0) at a frequency, s.
    fn integration_s(&self, t_s: f64, i: usize, j: usize, frequency_hz: f64) -> PyResult<f64> {
        self.require_known(t_s)?;
        require_frequency(frequency_hz)?;
        require_pairs(&[(i, j)], self.array.satellites())?;
        let [i, j] = [i, j].map(|n| self.array.state(n, t_s));
        Ok(integration_time_s(self.config.spacecraft.rule(), frequency_hz, i.velocity_m_s, j.velocity_m_s))
    }
}

impl NativeArray {
    fn require_known(&self, t_s: f64) -> PyResult<()> {
        require_time(t_s)?;
        self.array.require_known(t_s).map_err(exception)
    }
}

/// Positions that are given at equal steps of time, and interpolated as the ground does.
#[pyclass(frozen)]
pub(crate) struct NativeEphemeris {
    ephemeris: Ephemeris,
    satellites: usize,
    /// First and last time.
    known_s: [f64; 2],
}

#[pymethods]
impl NativeEphemeris {
    /// Of times, s, and as many rows of positions, m, three columns a satellite.
    #[new]
    fn new(
        times_s: PyReadonlyArray1<'_, f64>,
        positions_m: PyReadonlyArray2<'_, f64>,
        moon_radius_m: f64,
    ) -> PyResult<Self> {
        let (times_s, positions) = (times_s.as_array(), positions_m.as_array());
        let (nodes, columns) = positions.dim();
        let satellites = columns / 3;
        if times_s.len() != nodes
            || nodes < 8
            || columns % 3 != 0
            || !(1..=MAX_SATELLITES).contains(&satellites)
        {
            return Err(refused(format!(
                "found {} times and {nodes} rows of {columns} numbers; expected at least 8 times, and a row of x, y, z of 1 to \
                 {MAX_SATELLITES} satellites for each",
                times_s.len()
            )));
        }
        if let Some(bad) = positions.iter().find(|value| !value.is_finite()) {
            return Err(refused(format!("a position is {bad}; expected metres")));
        }
        times_s.iter().try_for_each(|&t_s| require_time(t_s))?;
        let ticks: Vec<i64> = times_s.iter().map(|&t_s| MissionTime::from_seconds(t_s).0).collect();
        let step = ticks[1] - ticks[0];
        let uneven = ticks.windows(2).position(|two| two[1] - two[0] != step);
        let step_ticks = u32::try_from(step).ok().filter(|&step| step > 0);
        let (None, Some(step_ticks)) = (uneven, step_ticks) else {
            let at = uneven.unwrap_or(0);
            return Err(refused(format!(
                "times: the step after time {at} is {} s, the first {} s; expected equal steps of whole microseconds, from \
                 1 us to 4294 s",
                (ticks[at + 1] - ticks[at]) as f64 * 1e-6,
                step as f64 * 1e-6
            )));
        };
        let row = |k: usize| (0..satellites).map(move |n| [0, 1, 2].map(|axis| positions[[k, 3 * n + axis]]));
        let segment = EphemerisSegment {
            start: MissionTime(ticks[0]),
            step_ticks,
            satellites: satellites as u8,
            positions_m: (0..nodes).flat_map(row).collect(),
        };
        require_flown(&segment.positions_m, satellites, &times_s.to_vec(), moon_radius_m)?;
        let mut ephemeris = Ephemeris::default();
        ephemeris.insert(segment);
        Ok(Self { ephemeris, satellites, known_s: [times_s[0], times_s[nodes - 1]] })
    }

    #[getter]
    fn satellites(&self) -> usize {
        self.satellites
    }

    fn positions<'py>(
        &self,
        py: Python<'py>,
        times_s: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let [from_s, until_s] = self.known_s;
        if let Some(t_s) = times_s.as_array().iter().find(|t_s| !(from_s..=until_s).contains(*t_s)) {
            return Err(refused(format!(
                "t = {t_s} s: expected a time at which positions are known, {from_s} s to {until_s} s"
            )));
        }
        places(py, &times_s, self.satellites, |t_s, n| self.ephemeris.position_at(t_s, n))
    }
}

/// Requires satellites above the surface, and apart.
fn require_flown(
    positions_m: &[Vec3],
    satellites: usize,
    times_s: &[f64],
    moon_radius_m: f64,
) -> PyResult<()> {
    for (places_m, t_s) in positions_m.chunks_exact(satellites).zip(times_s) {
        for (n, place_m) in places_m.iter().enumerate() {
            let radius_m = norm(*place_m);
            if radius_m <= moon_radius_m || radius_m > FAR_M {
                return Err(refused(format!(
                    "satellite {} at t = {t_s} s is {:.3} km from the Moon's centre: expected above its surface, {:.3} km, within 1e6 km",
                    n + 1,
                    radius_m / 1e3,
                    moon_radius_m / 1e3
                )));
            }
            let other = places_m[..n].iter().position(|other_m| norm(sub(*other_m, *place_m)) < APART_M);
            if let Some(other) = other {
                return Err(refused(format!(
                    "satellites {} and {} at t = {t_s} s are at one place: expected places of their own",
                    other + 1,
                    n + 1
                )));
            }
        }
    }
    Ok(())
}

/// Visibilities, K sr, of a sky (K, RING order, in the frame of a letter) at positions (a row a time, three columns a
/// satellite): a row a time, a column a pair (satellites from 0). Sums over pixel centres in double precision.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "the arguments of the Python function")]
pub(crate) fn predict<'py>(
    py: Python<'py>,
    sky: PyReadonlyArray1<'py, f64>,
    frame: &str,
    frequency_hz: f64,
    positions_m: PyReadonlyArray2<'py, f64>,
    pairs: Vec<(usize, usize)>,
    moon_radius_m: f64,
    dipoles: bool,
) -> PyResult<Bound<'py, PyArray2<Complex64>>> {
    require_frequency(frequency_hz)?;
    let positions = positions_m.as_array();
    require_pairs(&pairs, positions.ncols() / 3)?;
    let map = sky_map(&sky, frame)?;
    map.check_whole().map_err(exception)?;
    let response = if dipoles { AntennaResponse::DipoleNormal } else { AntennaResponse::Isotropic };
    let mut geometry = Vec::with_capacity(positions.nrows() * pairs.len());
    for (time, row) in positions.outer_iter().enumerate() {
        if let Some(bad) = row.iter().find(|value| !value.is_finite()) {
            return Err(refused(format!(
                "a position at time {time} is {bad}: expected times at which positions are known"
            )));
        }
        let place = |n: usize| [row[3 * n], row[3 * n + 1], row[3 * n + 2]];
        geometry.extend(pairs.iter().map(|&(i, j)| PairGeometry {
            r_i_m: place(i),
            r_j_m: place(j),
            frequency_hz,
            moon_radius_m,
            response,
        }));
    }
    let shape = [positions.nrows(), pairs.len()];
    let cancel = Cancel::new();
    let watched = cancel.clone();
    let values = wait(py, &cancel, move || {
        let directions = map.directions_ecliptic();
        let area_sr = pixel_area_sr(map.nside());
        let one = |pair: &PairGeometry| match watched.is_cancelled() {
            true => Complex64::ZERO,
            false => exact::visibility(pair, &directions, map.values(), area_sr).visibility_k_sr,
        };
        Ok(geometry.par_iter().map(one).collect::<Vec<_>>())
    })?;
    PyArray1::from_vec(py, values).reshape(shape)
}

fn require_frequency(frequency_hz: f64) -> PyResult<()> {
    if (BAND_HZ[0]..=BAND_HZ[1]).contains(&frequency_hz) {
        return Ok(());
    }
    Err(refused(format!("frequency {frequency_hz} Hz: expected {} to {} Hz", BAND_HZ[0], BAND_HZ[1])))
}

fn require_pairs(pairs: &[(usize, usize)], satellites: usize) -> PyResult<()> {
    match pairs.iter().find(|&&(i, j)| i >= satellites || j >= satellites || i == j) {
        None => Ok(()),
        Some((i, j)) => Err(refused(format!(
            "pair {}-{}: expected two of the array's {satellites} satellites, from 1",
            i + 1,
            j + 1
        ))),
    }
}
