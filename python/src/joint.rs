//! Joint maps of several channels.

use std::path::PathBuf;

use lunarray::imaging::SolveWatch;
use lunarray::imaging::joint::{JointRequest, PowerPriors};
use lunarray::pipeline::{self, MemoryLimit, SumsStorage, use_threads};
use lunarray::runtime::Cancel;
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::json;

use crate::chain::ground_config;
use crate::wait::wait;

/// Standard deviations of gain, offset and slope of a total power, and what is constant in it, K sr.
type Priors = ([f64; 3], Vec<f64>);
/// Pixels of a map and their standard deviations, K.
type MapArrays<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>);
/// Reference frequency, Hz, and index and curvature with their standard deviations by pixel.
type Spectra<'py> = (f64, Bound<'py, PyDict>);

/// Joint maps of the channels of states: their description as JSON, their pixels and standard deviations, and spectra, with their frequency.
#[pyfunction]
pub(crate) fn joint<'py>(
    py: Python<'py>,
    folders: Vec<PathBuf>,
    scratch: PathBuf,
    settings: (Option<PathBuf>, Vec<String>),
    at_hz: Vec<f64>,
    samples: usize,
    priors: Option<Priors>,
) -> PyResult<(String, Vec<MapArrays<'py>>, Option<Spectra<'py>>)> {
    let cancel = Cancel::new();
    let watch = SolveWatch::new(cancel.clone());
    let found = wait(py, &cancel, move || {
        let (map, overrides) = settings;
        let mut states = Vec::new();
        for folder in &folders {
            let config = ground_config(map.clone(), overrides.clone(), Some(folder), &[], &mut Vec::new())?;
            states.push((folder.as_path(), config));
        }
        if let Some((_, config)) = states.first() {
            use_threads(&config.runtime)?;
        }
        let powers = priors.map(|([gain, offset, slope], constant_k_sr)| PowerPriors {
            gain,
            offset,
            slope,
            constant_k_sr,
        });
        let request = |rule| JointRequest { rule, samples, at_hz: at_hz.clone(), powers: powers.clone() };
        let place = SumsStorage { limit: MemoryLimit::of_machine(), folder: &scratch };
        Ok(pipeline::solve_states_jointly(&states, &request, place, &watch)?)
    })?;
    let maps: Vec<_> = found
        .maps
        .iter()
        .map(|map| {
            json!({
                "frequency_hz": map.frequency_hz,
                "mean_sigma": map.mean_sigma_k,
                "agreement": map.agreement,
                "powers": map.powers,
            })
        })
        .collect();
    let described = json!({
        "likeness": found.likeness,
        "iterations": found.convergence.iterations,
        "residual": found.convergence.residual,
        "converged": found.convergence.converged,
        "maps": maps,
    });
    let arrays = |map: lunarray::imaging::joint::JointMap| {
        (PyArray1::from_vec(py, map.map_k), PyArray1::from_vec(py, map.sigma_k))
    };
    let maps = found.maps.into_iter().map(arrays).collect();
    let spectra = match found.spectra {
        Some(spectra) => {
            let dict = PyDict::new(py);
            dict.set_item("index", PyArray1::from_vec(py, spectra.index))?;
            dict.set_item("index_sigma", PyArray1::from_vec(py, spectra.index_sigma))?;
            dict.set_item("curvature", PyArray1::from_vec(py, spectra.curvature))?;
            dict.set_item("curvature_sigma", PyArray1::from_vec(py, spectra.curvature_sigma))?;
            Some((spectra.reference_hz, dict))
        }
        None => None,
    };
    Ok((described.to_string(), maps, spectra))
}
