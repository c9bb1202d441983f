//! A ground that is fed with bytes.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use lunarray::ground::{Ground, WAIT_BYTES};
use lunarray::imaging::{SolveWatch, Solver};
use lunarray::pipeline::use_threads;
use lunarray::runtime::{Cancel, Outlet, Stage};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::chain::{CHECKPOINT_EVERY, ground_config};
use crate::error::{Failure, exception, refused};
use crate::maps::{MapData, dicts};
use crate::wait::{require_threads, wait};

/// Ground and solver.
struct Segment {
    ground: Ground,
    solver: Solver,
}

impl Segment {
    /// Takes bytes, or the end; returns maps that became due.
    fn advance(&mut self, bytes: Option<Vec<u8>>) -> Result<Vec<MapData>, Failure> {
        let (mut sums, mut maps) = (Outlet::collect(), Outlet::collect());
        match bytes {
            Some(bytes) => self.ground.step(bytes, &mut sums)?,
            None => self.ground.finish(&mut sums)?,
        }
        for snapshot in sums.take() {
            self.solver.step(snapshot, &mut maps)?;
        }
        Ok(maps.take().iter().map(MapData::new).collect())
    }

    /// Requires that bytes which left no map were those of a downlink.
    fn require_downlink(&self, maps: &[MapData]) -> Result<(), Failure> {
        let outcome = self.ground.outcome();
        let received = outcome.reception.lock().unwrap_or_else(PoisonError::into_inner);
        let foreign = received.bytes_garbage + received.bytes_truncated;
        if maps.is_empty() && received.bytes > 0 && foreign >= received.bytes {
            let bytes = received.bytes;
            return Err(format!(
                "finish: {bytes} bytes were fed and no packet was among them: expected those of a downlink"
            )
            .into());
        }
        Ok(())
    }
}

/// Bytes of a downlink to maps, without threads and files of products.
#[pyclass(frozen)]
pub(crate) struct NativeGround(Arc<Mutex<Option<Segment>>>);

#[pymethods]
impl NativeGround {
    #[new]
    #[pyo3(signature = (map=None, overrides=Vec::new(), state=None))]
    fn new(map: Option<PathBuf>, overrides: Vec<String>, state: Option<PathBuf>) -> PyResult<Self> {
        let open = || -> Result<Segment, Failure> {
            let known = state.as_deref().filter(|folder| Ground::settings_in(folder).is_ok());
            let config = ground_config(map, overrides, known, &[], &mut Vec::new())?;
            use_threads(&config.runtime)?;
            let settings = config.ground(WAIT_BYTES);
            let ground = match &state {
                Some(folder) => Ground::open(folder, &settings, CHECKPOINT_EVERY)?,
                None => Ground::new(&settings)?,
            };
            Ok(Segment { ground, solver: Solver::new(config.solver(SolveWatch::default())?) })
        };
        require_threads()?;
        let segment = open().map_err(exception)?;
        Ok(Self(Arc::new(Mutex::new(Some(segment)))))
    }

    /// Takes bytes of the downlink, in pieces of any size; returns snapshot maps that became due.
    fn feed<'py>(&self, py: Python<'py>, bytes: &[u8]) -> PyResult<Vec<Bound<'py, PyDict>>> {
        let (shared, bytes) = (Arc::clone(&self.0), bytes.to_vec());
        let maps = wait(py, &Cancel::new(), move || {
            let mut held = shared.lock().unwrap_or_else(PoisonError::into_inner);
            let segment = held.as_mut().ok_or("feed: this ground has finished; open another")?;
            segment.advance(Some(bytes))
        })?;
        dicts(py, maps)
    }

    /// Ends the downlink; returns the final maps. With a state this writes it.
    fn finish<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyDict>>> {
        require_threads()?;
        let taken = self.0.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some(mut segment) = taken else {
            return Err(refused("finish: this ground has finished already".to_owned()));
        };
        let maps = wait(py, &Cancel::new(), move || {
            let maps = segment.advance(None)?;
            segment.require_downlink(&maps)?;
            Ok(maps)
        })?;
        dicts(py, maps)
    }

    /// What became of every visibility, by reason: `(accumulated, flagged, lost, sampled)` as JSON.
    fn ledger(&self) -> PyResult<String> {
        require_threads()?;
        let held = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let segment = held.as_ref().ok_or_else(|| refused("ledger: this ground has finished".to_owned()))?;
        let report = segment.ground.outcome().ledger.report();
        serde_json::to_string(&report).map_err(exception)
    }
}
