//! Checks of the files that a pipeline names.

use std::path::Path;

use super::plan::Plan;
use super::problems::Problems;
use crate::sky::fits::{ReadOptions, read_whole_map};

impl Plan {
    /// Reads every file that the configuration names; everything that is wrong with them, empty if they are good.
    #[must_use]
    pub fn file_problems(&self) -> Problems {
        let mut found = Problems::default();
        let skies = self.config.sky.file.iter().flat_map(|files| files.values());
        for path in skies.chain(&self.config.map.prior_files) {
            if let Err(problem) = read_whole_map(path, &ReadOptions::default()) {
                found.push(|| problem);
            }
        }
        if let Err(problem) = self.config.calibration.build(Path::new("")) {
            found.push(|| problem);
        }
        found
    }
}
