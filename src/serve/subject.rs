//! What the server tells about.

use std::path::{Path, PathBuf};

use crate::array::EarthModel;
use crate::pipeline::Config;

/// The run that the server shows.
#[derive(Clone, Debug)]
pub struct Subject {
    /// Name of the pipeline.
    pub name: String,
    /// Which part of the chain runs: `whole`, `ground` or `space`.
    pub segment: &'static str,
    /// The configuration in JSON.
    pub config: Vec<u8>,
    /// Folder of the state, if there is one.
    pub state: Option<PathBuf>,
    /// Says where the Earth is.
    pub earth: EarthModel,
    /// Folders on whose disks there has to be room, by what they hold.
    pub folders: Vec<(&'static str, PathBuf)>,
}

impl Subject {
    /// A run of this configuration, which is shown as it is.
    #[must_use]
    pub fn new(config: &Config, segment: &'static str, state: Option<&Path>) -> Self {
        // A configuration that was read can be written.
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

    /// As [`Subject::new`], and tells of the disk on which maps are written.
    #[must_use]
    pub fn with_maps_in(mut self, out: &Path) -> Self {
        self.folders.push(("maps", out.to_owned()));
        self
    }
}
