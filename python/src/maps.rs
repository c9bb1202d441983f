//! Maps: what the solver makes of sums, and what is done with pixels.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use lunarray::imaging::{Solution, Uncertainty};
use lunarray::products::{MapViewer, PublishedMap};
use lunarray::runtime::Cancel;
use lunarray::sky::fits::{ReadOptions, check_frequency, read_whole_map};
use lunarray::sky::harmonics::{self, AnalysisOptions};
use lunarray::sky::{Frame, SkyMap};
use num_complex::Complex64;
use numpy::{PyArray1, PyArray2, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::error::{exception, refused};
use crate::wait::wait;

/// A map that has crossed a thread.
#[derive(Clone, Debug)]
pub(crate) struct MapData {
    channel: u16,
    frequency_hz: f64,
    number: u32,
    pub(crate) is_final: bool,
    span_s: [f64; 2],
    visibilities: u64,
    nside: usize,
    map_k: Vec<f64>,
    noise_k: Vec<f64>,
    diagnostics: String,
    /// rho_l, where the true sky is known.
    rho: Option<Vec<f64>>,
    /// With R from the data.
    errors: Option<MapErrors>,
}

/// Errors of a map, and maps drawn from its posterior.
#[derive(Clone, Debug)]
struct MapErrors {
    sigma_k: Vec<f64>,
    resolution_deg: Vec<f64>,
    mean_sigma_k: f64,
    samples_k: Vec<Vec<f64>>,
}

impl MapErrors {
    fn new(found: &Uncertainty) -> Self {
        Self {
            sigma_k: found.sigma_k.clone(),
            resolution_deg: found.resolution_deg.clone(),
            mean_sigma_k: found.mean_sigma_k,
            samples_k: found.samples.iter().map(|sample| sample.map_k.clone()).collect(),
        }
    }
}

impl MapData {
    pub(crate) fn new(solution: &Solution) -> Self {
        let channel = solution.channel.0;
        let described = solution.instrument.channels.get(usize::from(channel));
        Self {
            channel,
            frequency_hz: described.map_or(f64::NAN, |channel| channel.frequency_hz),
            number: solution.number,
            is_final: solution.is_final,
            span_s: solution.span_s,
            visibilities: solution.visibilities,
            nside: solution.nside,
            map_k: solution.map_k.clone(),
            noise_k: solution.noise_k.clone(),
            diagnostics: serde_json::to_string(&solution.diagnostics).unwrap_or_default(),
            rho: None,
            errors: solution.uncertainty.as_ref().map(MapErrors::new),
        }
    }

    /// The keyword arguments of `lunarray.Map`.
    pub(crate) fn into_dict(self, py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
        let dict = PyDict::new(py);
        dict.set_item("channel", self.channel)?;
        dict.set_item("frequency_hz", self.frequency_hz)?;
        dict.set_item("number", self.number)?;
        dict.set_item("is_final", self.is_final)?;
        dict.set_item("span_s", (self.span_s[0], self.span_s[1]))?;
        dict.set_item("visibilities", self.visibilities)?;
        dict.set_item("nside", self.nside)?;
        dict.set_item("pixels", PyArray1::from_vec(py, self.map_k))?;
        dict.set_item("noise", PyArray1::from_vec(py, self.noise_k))?;
        dict.set_item("diagnostics", self.diagnostics)?;
        dict.set_item("rho_l", self.rho.map(|rho| PyArray1::from_vec(py, rho)))?;
        let errors = match self.errors {
            Some(MapErrors { sigma_k, resolution_deg, mean_sigma_k, samples_k }) => {
                let errors = PyDict::new(py);
                errors.set_item("sigma", PyArray1::from_vec(py, sigma_k))?;
                errors.set_item("resolution_deg", PyArray1::from_vec(py, resolution_deg))?;
                errors.set_item("mean_sigma", mean_sigma_k)?;
                errors.set_item("samples", PyArray2::from_vec2(py, &samples_k)?)?;
                Some(errors)
            }
            None => None,
        };
        dict.set_item("errors", errors)?;
        Ok(dict)
    }
}

/// Maps as dictionaries.
pub(crate) fn dicts(py: Python<'_>, maps: Vec<MapData>) -> PyResult<Vec<Bound<'_, PyDict>>> {
    maps.into_iter().map(|map| map.into_dict(py)).collect()
}

/// Gives every map that is published to a function.
pub(crate) struct MapCallback<F>(pub(crate) F);

impl<F: Fn(MapData) + Send + Sync> MapViewer for MapCallback<F> {
    fn view(&self, map: PublishedMap<'_>) {
        let rho = map.comparison.map(|comparison| comparison.rho.clone());
        self.0(MapData { rho, ..MapData::new(map.solution) });
    }
}

/// Maps that come from another thread.
#[derive(Clone, Default)]
pub(crate) struct Collected(Arc<Mutex<Vec<MapData>>>);

impl Collected {
    pub(crate) fn push(&self, map: MapData) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(map);
    }

    pub(crate) fn take(&self) -> Vec<MapData> {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// The frame of a letter of COORDSYS: E, G or C.
pub(crate) fn frame(letter: &str) -> PyResult<Frame> {
    let expected = "expected E (ecliptic), G (Galactic) or C (equatorial)";
    Frame::from_coordsys(letter).ok_or_else(|| refused(format!("frame {letter:?}: {expected}")))
}

/// A map from an array.
pub(crate) fn sky_map(pixels: &PyReadonlyArray1<'_, f64>, letter: &str) -> PyResult<SkyMap> {
    SkyMap::new(frame(letter)?, pixels.as_array().to_vec()).map_err(exception)
}

/// A map file: its pixels in RING order, K, and the letter of its frame. With a frequency it has to be the map's, if its file says one.
#[pyfunction]
#[pyo3(signature = (path, frame_if_missing=None, frequency_hz=None))]
pub(crate) fn read_map<'py>(
    py: Python<'py>,
    path: PathBuf,
    frame_if_missing: Option<&str>,
    frequency_hz: Option<f64>,
) -> PyResult<(Bound<'py, PyArray1<f64>>, char)> {
    let frame_if_missing = frame_if_missing.map(frame).transpose()?;
    let options = ReadOptions { frame_if_missing, frequency_hz, ..ReadOptions::default() };
    let map = wait(py, &Cancel::new(), move || {
        if let Some(frequency_hz) = frequency_hz {
            check_frequency(&path, frequency_hz, &options)?;
        }
        Ok(read_whole_map(&path, &options)?)
    })?;
    let letter = map.frame().letter();
    Ok((PyArray1::from_vec(py, map.into_values()), letter))
}

/// Spectra of an ecliptic map and a truth, as `lunarray compare --json` prints them.
#[pyfunction]
#[pyo3(signature = (pixels, truth, truth_frame, noise=None, l_max=None))]
pub(crate) fn compare(
    py: Python<'_>,
    pixels: PyReadonlyArray1<'_, f64>,
    truth: PyReadonlyArray1<'_, f64>,
    truth_frame: &str,
    noise: Option<PyReadonlyArray1<'_, f64>>,
    l_max: Option<usize>,
) -> PyResult<String> {
    let (map, truth) = (sky_map(&pixels, "E")?, sky_map(&truth, truth_frame)?);
    let noise = noise.map(|noise| sky_map(&noise, "E")).transpose()?;
    wait(py, &Cancel::new(), move || {
        let found = lunarray::sky::compare(&map, &truth, noise.as_ref(), l_max)?;
        Ok(serde_json::to_string(&found)?)
    })
}

/// Harmonic coefficients of a map in RING order, in healpy's order.
#[pyfunction]
pub(crate) fn analysis<'py>(
    py: Python<'py>,
    pixels: PyReadonlyArray1<'py, f64>,
    l_max: usize,
) -> PyResult<Bound<'py, PyArray1<Complex64>>> {
    let pixels = pixels.as_array().to_vec();
    let values = wait(py, &Cancel::new(), move || {
        Ok(harmonics::analysis(&pixels, l_max, &AnalysisOptions::default())?.alm.values().to_vec())
    })?;
    Ok(PyArray1::from_vec(py, values))
}
