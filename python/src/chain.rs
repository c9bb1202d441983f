//! The chain and its ground segment, run from Python.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use lunarray::downlink::FileSource;
use lunarray::ground::{Ground, WAIT_BYTES};
use lunarray::imaging::{RegulariserChoice, Samples, SolveWatch};
use lunarray::pipeline::{
    self, Config, ConfigSource, INTEGRATE, MemoryLimit, Plan, RunView, Segment, SettingsOrigin, use_threads,
};
use lunarray::runtime::{Cancel, Metrics};
use pyo3::exceptions::PyUserWarning;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::error::{Failure, exception, refused};
use crate::maps::{Collected, MapCallback, MapData, dicts};
use crate::wait::{require_process, require_threads, wait, wait_for};

/// How often an iterator looks for Ctrl-C while it waits for a map.
const POLL: Duration = Duration::from_millis(50);

/// Visibilities between two checkpoints of a state, as in `lunarray replay`.
pub(crate) const CHECKPOINT_EVERY: u64 = 1_000_000;

/// Settings of a ground: those of a file; or those of a state if there is one, and of the run that made the first of these
/// downlinks if it is known; or the defaults.
pub(crate) fn ground_config(
    file: Option<PathBuf>,
    overrides: Vec<String>,
    state: Option<&Path>,
    files: &[PathBuf],
    notes: &mut Vec<String>,
) -> Result<Config, Failure> {
    let source = ConfigSource { file, overrides, seed: None };
    let source = match state {
        Some(folder) => source.with_state_settings(folder)?,
        None => source,
    };
    let (source, origin) = source.with_downlink_settings(files);
    if let (SettingsOrigin::NotUsed(why), None) = (origin, state) {
        notes.push(why);
    }
    Ok(source.load_ground()?)
}

/// The stages of a graph at work, once it has begun, and the windows that it integrates (0 if it integrates none).
#[derive(Clone, Default)]
struct Watch(Arc<OnceLock<(Arc<Metrics>, u64)>>);

impl Watch {
    fn begin(&self, watched: &RunView, windows: u64) {
        let _ = self.0.set((Arc::clone(&watched.metrics), windows));
    }

    /// Tells what every stage has done so far: its name, and a number with its unit; and how many windows of how many are done.
    fn tell(&self, py: Python<'_>, progress: Option<&Py<PyAny>>) -> PyResult<()> {
        let Some(((metrics, windows), progress)) = self.0.get().zip(progress) else { return Ok(()) };
        let stages = PyDict::new(py);
        let mut done = 0;
        for stage in metrics.snapshot() {
            if stage.name == INTEGRATE {
                done = stage.items_in.saturating_sub(1);
            }
            stages.set_item(stage.name, (stage.units.count, stage.units.name))?;
        }
        progress.call1(py, (stages, (done, windows))).map(|_| ())
    }
}

/// Says what is valid but unusual, or follows from settings without having been said.
fn warn(py: Python<'_>, notes: Vec<String>) -> PyResult<()> {
    for note in notes {
        let text = std::ffi::CString::new(note.replace('\0', " ")).unwrap_or_default();
        PyErr::warn(py, &py.get_type::<PyUserWarning>(), &text, 2)?;
    }
    Ok(())
}

/// Runs the whole chain; returns the summary as JSON, the final maps, and the folder of the products.
#[pyfunction]
#[pyo3(signature = (pipeline=None, overrides=Vec::new(), seed=None, out=None, progress=None))]
pub(crate) fn run<'py>(
    py: Python<'py>,
    pipeline: Option<PathBuf>,
    overrides: Vec<String>,
    seed: Option<u64>,
    out: Option<PathBuf>,
    progress: Option<Py<PyAny>>,
) -> PyResult<(String, Vec<Bound<'py, PyDict>>, PathBuf)> {
    let mut notes = Vec::new();
    let source = ConfigSource { file: pipeline, overrides, seed };
    let config = source.load_noting(&mut notes).map_err(exception)?;
    notes.extend(config.notes().iter().map(ToString::to_string));
    warn(py, notes)?;
    let (cancel, watch, maps) = (Cancel::new(), Watch::default(), Collected::default());
    let (ended, begun, found) = (cancel.clone(), watch.clone(), maps.clone());
    let folder = out.unwrap_or_else(|| Path::new("out").join(&config.name));
    let products = folder.clone();
    let work = move || {
        let plan = Plan::new(config)?;
        use_threads(&plan.config.runtime)?;
        plan.cost().require_memory(Segment::Whole, MemoryLimit::of_machine())?;
        let windows = plan.progress_windows();
        let summary = pipeline::run(&plan, &products, &ended, &mut |watched| {
            begun.begin(&watched, windows);
            let found = found.clone();
            let take = move |map: MapData| {
                if map.is_final {
                    found.push(map)
                }
            };
            watched.maps.add_viewer(Box::new(MapCallback(take)));
        })?;
        Ok(serde_json::to_string(&summary)?)
    };
    let summary = wait_for(py, &cancel, &mut |py| watch.tell(py, progress.as_ref()), work)?;
    Ok((summary, dicts(py, maps.take())?, folder))
}

/// Maps of the sums in a state; with samples R is from the data.
#[pyfunction]
#[pyo3(signature = (folder, map=None, overrides=Vec::new(), epsilons=Vec::new(), samples=0))]
pub(crate) fn solve_state(
    py: Python<'_>,
    folder: PathBuf,
    map: Option<PathBuf>,
    overrides: Vec<String>,
    epsilons: Vec<f64>,
    samples: usize,
) -> PyResult<Vec<Bound<'_, PyDict>>> {
    let cancel = Cancel::new();
    let watch = SolveWatch::new(cancel.clone());
    let found = wait(py, &cancel, move || {
        let config = ground_config(map, overrides, Some(&folder), &[], &mut Vec::new())?;
        use_threads(&config.runtime)?;
        if samples > 0 && config.map.regulariser() != RegulariserChoice::Data {
            let expected = "expected set={\"map.regulariser\": \"data\"}, and no map.epsilon";
            return Err(format!(
                "samples need R from the data, and these settings choose another R: {expected}"
            )
            .into());
        }
        let mut found = Vec::new();
        let mut take = |solution| found.push(MapData::new(&solution));
        match samples {
            0 => pipeline::solve_state(&folder, &config, &epsilons, &watch, &mut take)?,
            count => {
                let samples = Samples { count, gibbs: false };
                pipeline::sample_state(&folder, &config, samples, &watch, &mut take)?;
            }
        }
        Ok(found)
    })?;
    dicts(py, found)
}

/// What a replay leaves at its end.
type Ended = Result<String, Failure>;

/// A replay on its thread, whose maps are taken one by one; it waits while nobody takes them.
#[pyclass(frozen)]
pub(crate) struct NativeReplay {
    cancel: Cancel,
    maps: Mutex<Option<Receiver<MapData>>>,
    thread: Mutex<Option<JoinHandle<Ended>>>,
    summary: OnceLock<String>,
    /// The process that has its thread.
    process: u32,
    watch: Watch,
    progress: Option<Py<PyAny>>,
}

#[pymethods]
impl NativeReplay {
    #[new]
    #[pyo3(signature = (files, out, map=None, overrides=Vec::new(), state=None, progress=None))]
    fn new(
        py: Python<'_>,
        files: Vec<PathBuf>,
        out: PathBuf,
        map: Option<PathBuf>,
        overrides: Vec<String>,
        state: Option<PathBuf>,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<Self> {
        require_threads()?;
        // A state that is to be made takes the settings given; one that is there may be used without naming them again.
        let known = state.as_deref().filter(|folder| Ground::settings_in(folder).is_ok());
        let mut notes = Vec::new();
        let config = ground_config(map, overrides, known, &files, &mut notes).map_err(exception)?;
        warn(py, notes)?;
        let (sender, receiver) = sync_channel(1);
        let cancel = Cancel::new();
        let ended = cancel.clone();
        let watch = Watch::default();
        let begun = watch.clone();
        let work = move || -> Ended {
            use_threads(&config.runtime)?;
            let settings = config.ground(WAIT_BYTES);
            let ground = match &state {
                Some(folder) => Ground::open(folder, &settings, CHECKPOINT_EVERY)?,
                None => Ground::new(&settings)?,
            };
            let source = FileSource::open(&files)?;
            let summary = pipeline::replay(source, &config, ground, &out, &ended, &mut |watched| {
                begun.begin(&watched, 0);
                let (sender, ended) = (sender.clone(), ended.clone());
                watched.maps.add_viewer(Box::new(MapCallback(move |map| {
                    if sender.send(map).is_err() {
                        ended.cancel();
                    }
                })));
            })?;
            Ok(serde_json::to_string(&summary)?)
        };
        let thread = std::thread::Builder::new().name("lunarray".to_owned()).spawn(work);
        let thread = thread.map_err(exception)?;
        let summary = OnceLock::new();
        Ok(Self {
            cancel,
            maps: Mutex::new(Some(receiver)),
            thread: Mutex::new(Some(thread)),
            summary,
            process: std::process::id(),
            watch,
            progress,
        })
    }

    /// The next map; `None` once there is none left.
    fn next_map<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        require_process(self.process)?;
        loop {
            let found = py.detach(|| {
                let maps = self.maps.lock().unwrap_or_else(PoisonError::into_inner);
                maps.as_ref().map_or(Err(RecvTimeoutError::Disconnected), |maps| maps.recv_timeout(POLL))
            });
            match found {
                Ok(map) => return map.into_dict(py).map(Some),
                Err(RecvTimeoutError::Disconnected) => return self.finish(py).map(|()| None),
                Err(RecvTimeoutError::Timeout) => {
                    let told = py.check_signals().and_then(|()| self.watch.tell(py, self.progress.as_ref()));
                    told.inspect_err(|_| self.end(py))?;
                }
            }
        }
    }

    /// Ends it early, in order: what was received is saved if there is a state.
    fn close(&self, py: Python<'_>) {
        self.end(py);
    }

    /// The summary as JSON; `None` before the end.
    fn summary(&self) -> Option<&str> {
        self.summary.get().map(String::as_str)
    }
}

impl NativeReplay {
    fn end(&self, py: Python<'_>) {
        if require_process(self.process).is_err() {
            // The thread is the parent's.
            return;
        }
        self.cancel.cancel();
        // A sender that waits for room gives up.
        self.maps.lock().unwrap_or_else(PoisonError::into_inner).take();
        // What went wrong after that is not asked for any more.
        let _ = self.finish(py);
    }

    fn finish(&self, py: Python<'_>) -> PyResult<()> {
        let thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some(thread) = thread else { return Ok(()) };
        let ended = py.detach(|| thread.join());
        let ended = ended.map_err(|_| refused("a bug of lunarray: the replay has panicked".to_owned()))?;
        let _ = self.summary.set(ended.map_err(exception)?);
        Ok(())
    }
}

impl Drop for NativeReplay {
    fn drop(&mut self) {
        self.cancel.cancel();
    }
}
