//! Checks of the files that a pipeline names.

use std::path::Path;

use super::config::Problems;
use super::plan::Plan;
use crate::sky::fits::{ReadOptions, read_sky_map, read_whole_map};

impl Plan {
    /// Reads every file that the configuration names; everything that is wrong with them, empty if they are good.
    #[must_use]
    pub fn file_problems(&self) -> Problems {
        let mut found = Problems::new();
        let sky = &self.config.sky;
        let skies = sky.file.iter().flat_map(|files| files.values());
        for (path, &frequency_hz) in skies.zip(&self.config.spacecraft.channels_hz) {
            if let Err(problem) = read_sky_map(path, frequency_hz, sky.frequency) {
                found.push(Box::new(problem));
            }
        }
        for path in &self.config.map.prior_files {
            if let Err(problem) = read_whole_map(path, &ReadOptions::default()) {
                found.push(Box::new(problem));
            }
        }
        if let Err(problem) = self.config.calibration.build(Path::new("")) {
            found.push(Box::new(problem));
        }
        found
    }
}
