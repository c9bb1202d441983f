//! Checks of the files that a pipeline names.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::error::PipelineError;
use super::plan::Plan;
use super::problems::Problems;
use super::sections::Config;
use crate::imaging::{Regulariser, read_power};
use crate::sky::SkyConfig;
use crate::sky::fits::{
    FitsError, FitsProblem, MapOutline, ReadOptions, check_frequency, read_prior, read_sky, sky_options,
};
use crate::sky::generated::AddedSky;
use crate::sky::generated::describe_catalogue;
use crate::units::InvalidValue;

impl Plan {
    /// Reads every file that the configuration names, and returns all problems with them.
    #[must_use]
    #[doc(hidden)]
    pub fn file_problems(&self) -> Problems {
        let mut found = Problems::default();
        let (sky, spacecraft) = (&self.config.sky, &self.config.spacecraft);
        let channels = 0..spacecraft.channels_hz.len();
        let skies = channels.filter_map(|channel| Some((sky.file.as_ref()?.get(channel)?, channel)));
        let skies = skies.map(|(path, channel)| read_sky(&path, &self.sky_channel(channel), sky));
        let priors = self.config.map.prior_files.iter();
        let prior_options = |channel| self.config.map.prior_options(&spacecraft.channels_hz, channel);
        let priors = priors
            .enumerate()
            .map(|(channel, path)| read_prior(path, &prior_options(channel)).map(|file| file.map));
        // A file may serve several channels.
        let mut reported = BTreeSet::new();
        for problem in skies.chain(priors).filter_map(Result::err) {
            if reported.insert(problem.to_string()) {
                found.push(|| problem);
            }
        }
        let (map, calibrate) = (&self.config.map, &self.config.calibrate);
        for (files, is_prior) in [(&map.prior_files, true), (&calibrate.model_files, false)] {
            if files.len() != spacecraft.channels_hz.len() {
                continue;
            }
            // Unreadable files are reported elsewhere.
            let is_keyword = |error: &FitsError| matches!(*error.problem, FitsProblem::Keyword { .. });
            let errors = files.iter().zip(&spacecraft.channels_hz).enumerate();
            let errors = errors.filter_map(|(channel, (path, &hz))| {
                let options = if is_prior { prior_options(channel) } else { ReadOptions::default() };
                check_frequency(path, hz, &options).err()
            });
            errors.filter(is_keyword).for_each(|problem| found.push(|| problem));
        }
        for problem in self.config.map.power_files().iter().filter_map(|path| Regulariser::read(path).err()) {
            found.push(|| problem);
        }
        for problem in self.config.map.beyond_files.iter().filter_map(|path| read_power(path).err()) {
            found.push(|| problem);
        }
        if let Some(problem) = self.sky_l_max_problem() {
            found.push(|| problem);
        }
        if let Some(Err(problem)) = sky.added.as_ref().map(AddedSky::check) {
            found.push(|| problem);
        }
        if let Err(problem) = self.moving_sky() {
            found.push(|| problem);
        }
        if let Err(problem) = self.antenna_errors() {
            found.push(|| problem);
        }
        if let Err(error) = self.config.map.assumed() {
            found.push(|| PipelineError::Antennas("map.antennas.files", error));
        }
        if let Err(problem) = self.config.calibration.build(Path::new("")) {
            found.push(|| problem);
        }
        if let Err(problem) = self.config.calibrate.models() {
            found.push(|| problem);
        }
        found
    }

    /// A `sky.l_max` above what the map of some channel determines.
    fn sky_l_max_problem(&self) -> Option<InvalidValue> {
        let nside_min = self.sky_nsides().into_iter().min()?;
        SkyConfig::check_l_max(self.config.sky.l_max, nside_min).err()
    }

    /// One line of description for every map and catalogue that the configuration names. Files that cannot be read are left out;
    /// [`Plan::file_problems`] reports them.
    #[must_use]
    #[doc(hidden)]
    pub fn file_descriptions(&self) -> Vec<String> {
        let Config { sky, spacecraft, map, calibrate, .. } = &self.config;
        let mut lines: Vec<String> = Vec::new();
        let mut add_line = |key: &str, line: Option<String>| {
            let line = line.map(|line| format!("{key}: {line}"));
            lines.extend(line.filter(|line| !lines.contains(line)));
        };
        for (channel, &hz) in spacecraft.channels_hz.iter().enumerate() {
            let path = sky.file.as_ref().and_then(|files| files.get(channel));
            let outline = path.and_then(|path| MapOutline::read(&path, &sky_options(sky, hz)).ok());
            add_line("sky.file", outline.map(|outline| outline.to_string()));
        }
        let priors = map.prior_files.iter().enumerate().map(|(channel, path)| {
            ("map.prior_files", path, map.prior_options(&spacecraft.channels_hz, channel))
        });
        let models = calibrate.model_files.iter();
        let models = models.map(|path| ("calibrate.model_files", path, ReadOptions::default()));
        for (key, path, options) in priors.chain(models) {
            add_line(key, MapOutline::read(path, &options).ok().map(|outline| outline.to_string()));
        }
        let added = sky.added.as_ref().and_then(|added| added.catalogue.as_ref());
        for (key, path) in [("sky.added.catalogue", added), ("sky.points", sky.points.as_ref())] {
            let described = path.and_then(|path| describe_catalogue(path).ok());
            add_line(key, described.map(|(catalogue, _)| catalogue));
        }
        lines
    }
}

impl Config {
    /// Every file that the configuration names. A run reads these files and must not overwrite them.
    #[must_use]
    pub fn input_files(&self) -> Vec<PathBuf> {
        let skies = self.sky.file.iter().flat_map(|files| files.values().iter().cloned());
        let catalogue =
            self.sky.added.iter().filter_map(|added| added.catalogue.clone()).chain(self.sky.points.clone());
        let maps = self.map.prior_files.iter().chain(self.map.power_files()).chain(&self.map.beyond_files);
        let antennas = self.map.antennas.files.paths().chain(self.instrument.antenna_files.paths());
        let others = maps.chain(&self.calibrate.model_files).chain(&self.calibration.gains_file);
        let others = others.chain(antennas).cloned();
        let orbits = self.array.oem.iter().map(PathBuf::as_path).chain(self.array.stations.file());
        skies.chain(catalogue).chain(others).chain(orbits.map(PathBuf::from)).collect()
    }
}
