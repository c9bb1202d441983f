//! The whole chain on one thread, a step at a time, for places without threads and files, such as a browser tab.

use super::space_segment::{integrator, skies, store};
use crate::downlink::Transmitter;
use crate::frames::ObservingWindow;
use crate::ground::{Ground, WAIT_BYTES};
use crate::imaging::{Solution, SolveWatch, Solver};
use crate::mother::{Fidelity, Integrator, Store};
use crate::pipeline::config::{PipelineError, Plan};
use crate::runtime::{BoxError, Outlet, Stage};
use crate::sky::SkyMap;

/// A run whose stages are those of [`run`](super::run()), without the ones that write files. Its final maps have the bits that `run` writes.
pub struct StepwiseRun {
    windows: std::vec::IntoIter<ObservingWindow>,
    count: usize,
    integrator: Integrator,
    store: Store,
    transmitter: Transmitter,
    ground: Ground,
    solver: Solver,
    downlink_bytes: u64,
    is_done: bool,
    skies: Vec<SkyMap>,
}

impl StepwiseRun {
    /// Makes the stages and the skies.
    ///
    /// # Errors
    /// Samples, the ninth daughter, faults of the link, a refinement or joint maps, for which `run` has more stages or files; those of `run`.
    pub fn new(plan: &Plan) -> Result<Self, BoxError> {
        let config = &plan.config;
        if config.spacecraft.fidelity == Fidelity::Samples
            || config.spacecraft.ninth.on
            || config.downlink.link.is_on()
            || config.map.refine.is_on()
            || config.joint.on
        {
            let reason = "a run in steps has no samples, ninth daughter, link faults, refinement or joint maps; expected none of these keys";
            return Err(reason.into());
        }
        let skies = skies(plan)?;
        let seen: Vec<Option<&SkyMap>> = skies.iter().map(Some).collect();
        Ok(Self {
            windows: plan.windows.clone().into_iter(),
            count: plan.windows.len(),
            integrator: integrator(plan, &seen)?,
            store: store(plan),
            transmitter: Transmitter::new(&config.downlink).map_err(PipelineError::from)?,
            ground: Ground::new(&config.ground(WAIT_BYTES))?,
            solver: Solver::new(config.solver(SolveWatch::default())?),
            downlink_bytes: 0,
            is_done: false,
            skies,
        })
    }

    /// The skies that are observed, one per channel.
    #[must_use]
    pub fn skies(&self) -> &[SkyMap] {
        &self.skies
    }

    /// Observing windows that are done, and all.
    #[must_use]
    pub fn windows(&self) -> [usize; 2] {
        [self.count - self.windows.len(), self.count]
    }

    /// Bytes sent down so far.
    #[must_use]
    pub fn downlink_bytes(&self) -> u64 {
        self.downlink_bytes
    }

    /// Whether all windows are done and the final maps are returned.
    #[must_use]
    pub fn is_done(&self) -> bool {
        self.is_done
    }

    /// Observes one window, sends it down, receives it, and returns the maps that are solved then; after the last window the final maps.
    ///
    /// # Errors
    /// The error of a stage, which ends the run.
    pub fn step(&mut self) -> Result<Vec<Solution>, BoxError> {
        if self.is_done {
            return Ok(Vec::new());
        }
        let window = self.windows.next();
        self.is_done = window.is_none();
        let is_last = self.is_done;
        let frames = pass(&mut self.integrator, window, is_last)?;
        let sent = pass(&mut self.store, frames, is_last)?;
        let bytes = pass(&mut self.transmitter, sent, is_last)?;
        self.downlink_bytes += bytes.iter().map(|piece| piece.len() as u64).sum::<u64>();
        let sums = pass(&mut self.ground, bytes, is_last)?;
        Ok(pass(&mut self.solver, sums, is_last)?)
    }
}

/// Passes inputs through a stage, and ends it after the last ones.
fn pass<S: Stage>(
    stage: &mut S,
    inputs: impl IntoIterator<Item = S::In>,
    is_last: bool,
) -> Result<Vec<S::Out>, S::Error> {
    let mut out = Outlet::collect();
    for input in inputs {
        stage.step(input, &mut out)?;
    }
    if is_last {
        stage.finish(&mut out)?;
    }
    Ok(out.into_vec())
}
