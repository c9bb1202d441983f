//! Checks of the files that a pipeline names.

use std::collections::BTreeSet;
use std::path::Path;

use super::plan::Plan;
use super::problems::Problems;
use crate::imaging::Regulariser;
use crate::sky::AddedSky;
use crate::sky::fits::{FitsError, FitsProblem, ReadOptions, check_frequency, read_sky, read_whole_map};

impl Plan {
    /// Reads every file that the configuration names; everything that is wrong with them, empty if they are good.
    #[must_use]
    pub fn file_problems(&self) -> Problems {
        let mut found = Problems::default();
        let (sky, spacecraft) = (&self.config.sky, &self.config.spacecraft);
        let channels = spacecraft.channels_hz.iter().zip(spacecraft.receiver_k_sr()).enumerate();
        let skies = channels.filter_map(|(k, channel)| Some((sky.file.as_ref()?.get(k)?, channel)));
        let skies = skies.map(|(path, (&frequency_hz, receiver_k_sr))| {
            read_sky(&path, frequency_hz, sky, receiver_k_sr > 0.0)
        });
        let priors = self.config.map.prior_files.iter();
        let options = ReadOptions { frame_if_missing: self.config.map.prior_frame, ..ReadOptions::default() };
        let priors = priors.map(|path| read_whole_map(path, &options));
        // A file that stands for several channels is told once.
        let mut told = BTreeSet::new();
        for problem in skies.chain(priors).filter_map(Result::err) {
            if told.insert(problem.to_string()) {
                found.push(|| problem);
            }
        }
        for files in [&self.config.map.prior_files, &self.config.calibrate.model_files] {
            let of_channels = files.iter().zip(&spacecraft.channels_hz);
            let of_channels = of_channels.filter(|_| files.len() == spacecraft.channels_hz.len());
            // What cannot be read is told above and below.
            let is_other = |error: &FitsError| matches!(*error.problem, FitsProblem::Keyword { .. });
            let checked = of_channels.filter_map(|(path, &hz)| check_frequency(path, hz).err());
            checked.filter(is_other).for_each(|problem| found.push(|| problem));
        }
        for problem in self.config.map.power_files().iter().filter_map(|path| Regulariser::read(path).err()) {
            found.push(|| problem);
        }
        if let Some(Err(problem)) = sky.added.as_ref().map(AddedSky::check) {
            found.push(|| problem);
        }
        if let Err(problem) = self.config.calibration.build(Path::new("")) {
            found.push(|| problem);
        }
        if let Err(problem) = self.config.calibrate.models() {
            found.push(|| problem);
        }
        found
    }
}
