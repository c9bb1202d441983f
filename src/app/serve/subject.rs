//! Description of the run that the server shows.

use std::path::{Path, PathBuf};

use crate::array::EarthModel;
use crate::pipeline::Config;

/// Description of the run that a server shows.
#[derive(Clone, Debug)]
pub struct Subject {
    /// Name of the pipeline.
    pub name: String,
    /// Part of the chain that runs: `whole`, `ground` or `space`.
    pub segment: &'static str,
    /// The configuration in JSON.
    pub config: Vec<u8>,
    /// Folder of the state, if there is one.
    pub state: Option<PathBuf>,
    /// Motion of the Earth.
    pub earth: EarthModel,
    /// Folders whose free disk space is reported, by content.
    pub folders: Vec<(&'static str, PathBuf)>,
}

impl Subject {
    /// Describes a run of a configuration.
    #[must_use]
    pub fn new(config: &Config, segment: &'static str, state: Option<&Path>) -> Self {
        // A configuration always has a JSON form.
        let text = serde_json::to_vec(config).unwrap_or_default();
        let earth = EarthModel::of(&config.array);
        let (name, state) = (config.name.clone(), state.map(Path::to_owned));
        Self {
            name,
            segment,
            config: text,
            folders: state.iter().map(|path| ("state", path.clone())).collect(),
            state,
            earth,
        }
    }

    /// Adds the folder of the maps, whose free disk space is reported.
    #[must_use]
    pub fn with_maps_in(mut self, out: &Path) -> Self {
        self.folders.push(("maps", out.to_owned()));
        self
    }
}
