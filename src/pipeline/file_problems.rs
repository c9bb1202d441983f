//! Checks of the files that a pipeline names.

use std::path::Path;

use super::plan::Plan;
use super::problems::Problems;
use crate::sky::fits::{ReadOptions, read_sky, read_whole_map};

impl Plan {
    /// Reads every file that the configuration names; everything that is wrong with them, empty if they are good.
    #[must_use]
    pub fn file_problems(&self) -> Problems {
        let mut found = Problems::default();
        let may_be_dark = self.config.spacecraft.receiver_noise_k_sr > 0.0;
        let skies = self.config.sky.file.iter().flat_map(|files| files.values());
        let skies = skies.map(|path| read_sky(path, may_be_dark));
        let priors = self.config.map.prior_files.iter();
        let priors = priors.map(|path| read_whole_map(path, &ReadOptions::default()));
        for problem in skies.chain(priors).filter_map(Result::err) {
            found.push(|| problem);
        }
        if let Err(problem) = self.config.calibration.build(Path::new("")) {
            found.push(|| problem);
        }
        found
    }
}
