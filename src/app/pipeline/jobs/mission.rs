//! Builder for the common uses: change some keys of a pipeline, then simulate, replay or run it.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use crate::downlink::FileSource;
use crate::ground::{Ground, WAIT_BYTES};
use crate::pipeline::config::{ConfigSource, MemoryLimit, PipelineError, Plan};
use crate::pipeline::cost::Segment;
use crate::pipeline::graph::{RunSummary, replay, run, simulate, use_threads};
use crate::runtime::{Cancel, Report};

/// A mission to simulate, to map, or both: a pipeline with some keys changed.
///
/// The keys are listed in `pipelines/reference.toml`. All errors are reported together when the mission is planned.
///
/// ```
/// use lunarray::prelude::*;
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// # let folder = tempfile::tempdir()?;
/// # let out = folder.path();
/// let summary = Mission::dsl()
///     .channels(&[3e6])
///     .nside(4)
///     .set("spacecraft.every_nth_integration", 15)
///     .set("spacecraft.baseline_wavelengths_max", 16)
///     .out(out)
///     .run()?;
/// let rho = summary.channels[0].rho.as_ref().ok_or("the generated sky is known")?;
/// assert!(rho[4] > 0.9, "rho_4 = {}", rho[4]);
/// assert!(out.join("3.000MHz/map.fits").exists());
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
#[must_use]
pub struct Mission {
    source: ConfigSource,
    out: Option<PathBuf>,
    cancel: Cancel,
}

impl Mission {
    /// The mission of `lunarray run` without a file: the paper's array of eight satellites, with channels of 1, 3 and 10 MHz over
    /// one precession of the orbit, thinned to run in seconds or minutes.
    pub fn dsl() -> Self {
        Self { source: ConfigSource::default(), out: None, cancel: Cancel::new() }
    }

    /// The mission of a pipeline file.
    pub fn of_file(pipeline: impl Into<PathBuf>) -> Self {
        let source = ConfigSource { file: Some(pipeline.into()), ..ConfigSource::default() };
        Self { source, ..Self::dsl() }
    }

    /// Sets the centre frequencies of the channels, Hz. Settings by channel are copied from the nearest channel of the pipeline.
    pub fn channels(self, channels_hz: &[f64]) -> Self {
        let listed: Vec<String> = channels_hz.iter().map(|hz| format!("{hz:e}")).collect();
        self.set("spacecraft.channels_hz", format!("[{}]", listed.join(", ")))
    }

    /// Sets the resolution of the maps: 12 nside^2 pixels.
    pub fn nside(self, nside: usize) -> Self {
        self.set("map.nside", nside)
    }

    /// Sets the seed of all random numbers; the same seed gives the same bytes.
    pub fn seed(self, seed: u64) -> Self {
        Self { source: ConfigSource { seed: Some(seed), ..self.source }, ..self }
    }

    /// Changes a key of the pipeline file, such as `("map.epsilon", 1e-4)` or `("map.snapshot_every_s", "30d")`.
    pub fn set(mut self, key: &str, value: impl Display) -> Self {
        self.source.overrides.push(format!("{key}={value}"));
        self
    }

    /// Sets the folder of the products; the default is `out/NAME`.
    pub fn out(self, folder: impl Into<PathBuf>) -> Self {
        Self { out: Some(folder.into()), ..self }
    }

    /// Sets a handle that ends the run when it is cancelled, with products of the data so far.
    pub fn cancelled_by(self, cancel: &Cancel) -> Self {
        Self { cancel: cancel.clone(), ..self }
    }

    /// Checks the settings and makes the plan of the mission.
    ///
    /// # Errors
    /// Everything that is wrong with the settings.
    pub fn plan(&self) -> Result<Plan, PipelineError> {
        let plan = Plan::new(self.source.load()?)?;
        use_threads(&plan.config.runtime)?;
        Ok(plan)
    }

    /// Simulates the mission and maps the sky. Downlink, maps, pictures and `summary.json` are in the folder of products.
    ///
    /// # Errors
    /// Wrong settings; more memory than the machine has; the first failure of any stage.
    pub fn run(&self) -> Result<RunSummary, PipelineError> {
        let plan = self.plan()?;
        plan.cost().require_memory(Segment::Whole, MemoryLimit::of_machine())?;
        run(&plan, &self.folder(&plan), &self.cancel, &mut |_| {})
    }

    /// Simulates the space segment alone, into a downlink file.
    ///
    /// # Errors
    /// Wrong settings; the first failure of any stage.
    ///
    /// ```
    /// use lunarray::prelude::*;
    ///
    /// # fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// # let folder = tempfile::tempdir()?;
    /// let file = folder.path().join("mission.ccsds");
    /// let mission = Mission::dsl().channels(&[3e6]).nside(4).set("spacecraft.every_nth_integration", 30).out(folder.path());
    /// mission.simulate(&file)?;
    /// // The ground segment makes the maps from the downlink alone.
    /// let summary = mission.replay(&[file])?;
    /// assert_eq!(summary.ledger.accumulated, summary.channels[0].visibilities);
    /// # Ok(())
    /// # }
    /// ```
    pub fn simulate(&self, file: impl AsRef<Path>) -> Result<Report, PipelineError> {
        simulate(&self.plan()?, &file, &self.cancel, &mut |_| {})
    }

    /// Maps downlink files of this or another mission with the settings of this one.
    ///
    /// # Errors
    /// Wrong settings; a file that cannot be read; the first failure of any stage; no visibility for any map.
    pub fn replay(&self, files: &[PathBuf]) -> Result<RunSummary, PipelineError> {
        let plan = self.plan()?;
        let ground = Ground::new(&plan.config.ground(WAIT_BYTES))?;
        replay(FileSource::open(files)?, &plan.config, ground, &self.folder(&plan), &self.cancel, &mut |_| {})
    }

    fn folder(&self, plan: &Plan) -> PathBuf {
        self.out.clone().unwrap_or_else(|| Path::new("out").join(&plan.config.name))
    }
}
