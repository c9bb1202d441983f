//! The configuration of a whole pipeline, with its checks and hashes.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::problems::Problems;
use crate::array::{Array, ArrayConfig, Stations};
use crate::calibration::solver::SolverConfig;
use crate::calibration::{CalibrationConfig, CalibrationHook, VanVleck};
use crate::daughters::{DaughtersConfig, InstrumentConfig, NavigationConfig, Tones};
use crate::downlink::DownlinkConfig;
use crate::imaging::joint::JointConfig;
use crate::imaging::{EngineKind, MapConfig, Method, RegulariserChoice, SolveError, StoppingRule};
use crate::mother::{Antenna, Fidelity, MoonMirror, SpacecraftConfig};
use crate::products::ProductsConfig;
use crate::response::model::ModelChoice;
use crate::runtime::RuntimeConfig;
use crate::sky::SkyConfig;
use crate::units::time_scales::utc_text;
use crate::units::{ChannelId, Checks, InvalidValue, keys};

keys! {
    /// A whole pipeline: the sky, the spacecraft and the ground.
    ///
    /// Sections are in the order of the data path. A ground segment reads only `calibration`, `calibrate`, `map`, `products` and
    /// `runtime`, and `downlink.listen` when it listens.
    pub struct Config {
        /// Name of the run: products go to `out/NAME`. Empty for the file's name.
        everyday name: String = String::new();
        /// Seed of all random numbers of the space segment.
        everyday seed: u64 = 0;
        /// The simulated sky.
        section sky: SkyConfig = SkyConfig::default();
        /// Orbit and formation; the defaults are the paper's.
        section array: ArrayConfig = ArrayConfig::default();
        /// Samples of the daughters, quantisers, and links to the mother.
        #[only_with(r#"spacecraft.fidelity = "samples""#)]
        section daughters: DaughtersConfig = DaughtersConfig::default();
        /// Errors of the instrument. The truth is written beside the downlink, as FILE.instrument.csv.
        section instrument: InstrumentConfig = InstrumentConfig::default();
        /// Errors of the positions and times in packets: reported minus true.
        section navigation: NavigationConfig = NavigationConfig::default();
        /// Channels, integration and model of the visibilities.
        section spacecraft: SpacecraftConfig = SpacecraftConfig::default();
        /// Packets or frames, and the link to the ground.
        section downlink: DownlinkConfig = DownlinkConfig::default();
        /// Corrections of visibilities before they are mapped.
        section calibration: CalibrationConfig = CalibrationConfig::default();
        /// The solver of gains, for `lunarray calibrate` and `calibration.hook = "solve"`. Keys with `_sigma` are standard
        /// deviations expected before the data are seen; parameters with 0 are not solved for.
        section calibrate: SolverConfig = SolverConfig::default();
        /// How maps are made.
        section map: MapConfig = MapConfig::default();
        /// Joint maps of the channels at the end of `lunarray run`.
        #[only_with(
            "map.engine = \"harmonic\" and no map.refine.passes_max and no map.moon_reflection and no map.prior_k and no map.prior_files"
        )]
        section joint: JointConfig = JointConfig::default();
        /// Products besides the maps.
        section products: ProductsConfig = ProductsConfig::default();
        /// Queues and threads. They do not change a byte of the results.
        section runtime: RuntimeConfig = RuntimeConfig::default();
    }
}

impl Config {
    /// All problems of a whole pipeline.
    #[must_use]
    pub fn problems(&self) -> Problems {
        if self.map.engine == EngineKind::Auto {
            return self.with_chosen_engine(true).problems();
        }
        let channels = self.spacecraft.channels_hz.len();
        let mut found = Problems::default();
        found.extend(self.sky.problems(channels));
        let mut checks = Checks::new("");
        let is_folder = is_folder_name(&self.name);
        let expected = "at most 60 bytes, without slashes and control characters";
        checks.require("name", format!("{:?}", self.name), is_folder, expected);
        let (space, ground) = (self.spacecraft.sub_bands, self.calibration.sub_bands);
        let expected = format!("spacecraft.sub_bands, which is {space}");
        checks.require("calibration.sub_bands", ground, space == ground, expected);
        self.check_quantiser(&mut checks);
        self.check_orbits(&mut checks);
        self.check_antennas(&mut checks);
        self.check_moving(&mut checks);
        found.extend(checks.finish());
        let array = self.array.problems();
        let spacecraft = self.spacecraft.problems();
        if array.is_empty() {
            match Array::new(&self.array) {
                Ok(array) if spacecraft.is_empty() => {
                    if let Some(problem) = self.spacecraft.dump_problem(&array) {
                        found.push(|| problem);
                    }
                    found.extend(self.position_problems(&array));
                    found.extend(self.epoch_problems(&array));
                }
                Ok(_) => {}
                Err(problem) => found.push(|| problem),
            }
        }
        found.extend(array);
        let width_hz = self.spacecraft.channel_width_hz;
        found.extend(self.daughters.problems(width_hz));
        let is_sampled = self.spacecraft.fidelity == Fidelity::Samples;
        found.extend(self.instrument.problems(self.array.satellites, channels, is_sampled));
        found.extend(self.navigation.problems(self.array.satellites));
        found.extend(spacecraft);
        found.extend(self.downlink.problems());
        found.extend(self.map.mismatches(channels));
        let joint = self.joint.problems(channels);
        match self.joint_problem() {
            Some(problem) if joint.is_empty() => found.push(|| format!("[joint]: {problem}")),
            _ => found.extend(joint),
        }
        found.append(self.ground_value_problems());
        found.append(self.without_effect(&[]));
        found
    }

    /// Whether the instrument has errors, or the positions and times in packets have.
    #[must_use]
    pub(in crate::pipeline) fn has_errors(&self) -> bool {
        self.instrument.is_on() || self.navigation.is_on()
    }

    /// A copy without errors of the instrument and of navigation; it keeps the schedule of the artificial signal.
    #[must_use]
    pub(in crate::pipeline) fn without_errors(&self) -> Self {
        let instrument = self.instrument.without_errors();
        Self { instrument, navigation: NavigationConfig::default(), ..self.clone() }
    }

    /// Epoch of the mission, TAI seconds since 1958-01-01. Orbits from dated files set the epoch.
    #[must_use]
    #[doc(hidden)]
    pub fn epoch_tai_s(&self, array: &Array) -> f64 {
        array.epoch_tai_s().unwrap_or(self.spacecraft.epoch_tai_s)
    }

    /// Requires that the given epoch agrees with that of dated orbits, and that the packets' time code can represent it.
    fn epoch_problems(&self, array: &Array) -> Vec<InvalidValue> {
        let mut checks = Checks::new("spacecraft");
        if let Some(dated_s) = array.epoch_tai_s() {
            let given_s = self.spacecraft.epoch_tai_s;
            let default_s = SpacecraftConfig::default().epoch_tai_s;
            let expected =
                format!("nothing with array.oem or array.stations: by their dates it is {dated_s}");
            checks.number("epoch_tai_s", given_s, given_s == default_s || given_s == dated_s, expected);
            let date = utc_text(dated_s);
            let is_representable = (0.0..=3.0e9).contains(&dated_s);
            let expected = "an epoch from 1958 to 2053, which is what the packets' time code holds";
            checks.require(
                "epoch_tai_s",
                format_args!("(by array.oem or array.stations_epoch) {date} UTC"),
                is_representable,
                expected,
            );
        }
        checks.finish()
    }

    /// Requires that positions are known for the whole mission.
    fn position_problems(&self, array: &Array) -> Vec<InvalidValue> {
        let Some([from_s, until_s]) = array.known_s() else { return Vec::new() };
        let mut checks = Checks::new("spacecraft");
        let duration_s = self.spacecraft.duration_s;
        // Dates in files are rounded to a microsecond.
        let is_covered = from_s <= 1e-6 && until_s + 1e-6 >= duration_s;
        let source = match self.array.propagate.is_on() {
            true => "what array.propagate.days gives",
            false => "what the files of array.oem hold",
        };
        let expected = format!(
            "at most {source} without a gap: from {from_s:.3} s to {until_s:.3} s after the mission's epoch"
        );
        checks.number("duration_s", duration_s, is_covered, expected);
        checks.finish()
    }

    /// Why the mapped channels have no joint maps, if so.
    fn joint_problem(&self) -> Option<SolveError> {
        let Self { joint, spacecraft, map, .. } = self;
        let mapped = (0..).map(ChannelId).zip(&spacecraft.channels_hz);
        let mapped: Vec<f64> =
            mapped.filter(|(channel, _)| map.is_mapped(*channel)).map(|(_, hz)| *hz).collect();
        let frequency_hz = mapped.first().copied().filter(|_| joint.on)?;
        let rule = StoppingRule { residual_max: map.residual_max, iterations_max: map.iterations_max };
        let request = joint.request(rule, spacecraft.autos_s() > 0.0, vec![0.0]);
        let has_pattern = spacecraft.antenna == Antenna::DipoleNormal;
        match request.check(&mapped, true) {
            Err(problem) => Some(problem),
            Ok(()) if request.powers.is_some() && has_pattern => {
                Some(SolveError::PowersOfDipoles { frequency_hz })
            }
            Ok(()) => None,
        }
    }

    /// Requires that `good` holds of a key, whose value a message then has.
    fn require(&self, checks: &mut Checks, key: &str, good: bool, expected: impl Into<Cow<'static, str>>) {
        if !good {
            checks.require(key, self.shown(key), false, expected);
        }
    }

    /// Requires settings that are possible for satellites that do not share a circular orbit.
    fn check_orbits(&self, checks: &mut Checks) {
        if self.array.is_circle() {
            return;
        }
        let Self { spacecraft, map, .. } = self;
        let visibilities = spacecraft.fidelity == Fidelity::Visibilities;
        let is_general = spacecraft.model != ModelChoice::Harmonic;
        let isotropic = spacecraft.antenna == Antenna::Isotropic;
        for (key, good, expected) in [
            ("map.engine", map.method() != Method::Harmonic, "\"pixel\", or map.refine,"),
            ("spacecraft.fidelity", visibilities, "\"visibilities\""),
            ("spacecraft.model", is_general, "\"auto\", \"general\" or \"direct\""),
            ("spacecraft.antenna", isotropic || map.refine.is_on(), "\"isotropic\", or map.refine,"),
            ("spacecraft.moon_temperature_k", isotropic || spacecraft.moon_temperature_k == 0.0, "0"),
            ("spacecraft.moon_reflection", isotropic || spacecraft.moon_reflection == 0.0, "0"),
            ("spacecraft.ninth.on", !spacecraft.ninth.on, "false"),
        ] {
            let expected = format!(
                "{expected} with array.kepler, array.oem, array.stations, array.propagate, array.eccentricity or array.cross_track_ratio: the \
                     other needs a common circle"
            );
            self.require(checks, key, good, expected);
        }
        let reflection = spacecraft.moon_reflection;
        let is_possible = reflection == 0.0 || !self.array.is_on_surface();
        let expected = "0 with array.stations: images in the ground under an antenna are part of its pattern";
        checks.require("spacecraft.moon_reflection", reflection, is_possible, expected);
        let is_possible = isotropic || !self.array.is_on_surface();
        let expected = "\"isotropic\" with array.stations: dipoles are normal to an orbit";
        self.require(checks, "spacecraft.antenna", is_possible, expected);
        let is_possible = !self.map.refine.is_on() || !self.array.is_on_surface();
        let expected = "0 with array.stations: refined maps from the ground have not been validated";
        self.require(checks, "map.refine.passes_max", is_possible, expected);
        let rate = self.downlink.rate_bits_per_s_max;
        let is_possible = rate == 0.0 || !self.array.is_on_surface();
        let expected = "0 with array.stations: they observe while the Earth is hidden, and a relay that is not simulated takes the data";
        checks.require("downlink.rate_bits_per_s_max", rate, is_possible, expected);
    }

    /// Requires settings that are possible with three dipoles, and with antenna errors.
    fn check_antennas(&self, checks: &mut Checks) {
        let is_sampled = self.spacecraft.fidelity == Fidelity::Samples;
        let has_one_receiver = self.spacecraft.antenna != Antenna::ThreeDipoles;
        let expected = "one receiver a daughter with spacecraft.fidelity = \"samples\": \"isotropic\" or \"dipole-normal\"";
        checks.require("spacecraft.antenna", "\"three-dipoles\"", has_one_receiver || !is_sampled, expected);
        if !self.instrument.has_own_antennas() {
            return;
        }
        let spacecraft = &self.spacecraft;
        let is_direct = is_sampled || matches!(spacecraft.model, ModelChoice::Direct | ModelChoice::General);
        let is_flat = spacecraft.moon_reflection == 0.0 || spacecraft.moon_mirror == MoonMirror::Flat;
        for (key, good, expected) in [
            ("spacecraft.model", is_direct, "\"direct\" or \"general\""),
            ("spacecraft.moon_temperature_k", spacecraft.moon_temperature_k == 0.0, "0"),
            ("spacecraft.moon_mirror", is_flat, "\"flat\""),
        ] {
            let expected = format!(
                "{expected} with instrument.tilt_along_deg, tilt_radial_deg, pattern, pattern_by_frequency or antenna_files"
            );
            self.require(checks, key, good, expected);
        }
        // A flat mirror's image is seen from below, where an antenna that leans away from the Moon has another response.
        let leans = !self.instrument.tilt_radial_deg.is_none() || self.instrument.antenna_files.is_some();
        let is_upright = spacecraft.moon_reflection == 0.0 || !leans;
        let expected = "0 with instrument.tilt_radial_deg or antenna_files";
        checks.require("spacecraft.moon_reflection", spacecraft.moon_reflection, is_upright, expected);
    }

    /// Requires settings for which moving sources are simulated.
    fn check_moving(&self, checks: &mut Checks) {
        if self.sky.moving.is_empty() && self.sky.points.is_none() {
            return;
        }
        let key_of_sources = if self.sky.moving.is_empty() { "sky.points" } else { "sky.moving" };
        let spacecraft = &self.spacecraft;
        let is_plain = spacecraft.antenna != Antenna::DipoleNormal || self.array.is_circle();
        for (key, good, expected) in [
            ("spacecraft.fidelity", spacecraft.fidelity == Fidelity::Visibilities, "\"visibilities\""),
            ("spacecraft.ninth.on", !spacecraft.ninth.on, "false"),
            ("spacecraft.moon_reflection", spacecraft.moon_reflection == 0.0, "0"),
            ("spacecraft.antenna", is_plain, "another antenna, or daughters on one circle,"),
        ] {
            let expected = format!("{expected} with {key_of_sources}, which is not simulated otherwise");
            self.require(checks, key, good, expected);
        }
        let expected = format!("ideal antennas with {key_of_sources}, which is not simulated otherwise");
        checks.require("instrument", "(errors of antennas)", !self.instrument.has_own_antennas(), expected);
    }

    /// Requires that the van Vleck correction is for the daughters' quantiser.
    fn check_quantiser(&self, checks: &mut Checks) {
        let (ground, bits) = (self.calibration.quantiser_bits, self.daughters.bits);
        let (fidelity, accepted) = match self.spacecraft.fidelity {
            Fidelity::Visibilities => ("visibilities", "0".to_owned()),
            Fidelity::Samples if VanVleck::new(bits).is_ok() => {
                ("samples", format!("{bits}, or 0 for no correction"))
            }
            Fidelity::Samples => ("samples", "0".to_owned()),
        };
        let good = ground == 0 || (self.spacecraft.fidelity == Fidelity::Samples && ground == bits);
        let expected =
            format!("{accepted}, as daughters.bits is {bits} and spacecraft.fidelity is \"{fidelity}\"");
        checks.require("calibration.quantiser_bits", ground, good, expected);
    }

    /// All problems of the ground segment's sections.
    #[must_use]
    #[doc(hidden)]
    pub fn ground_problems(&self) -> Problems {
        if self.map.engine == EngineKind::Auto {
            return self.with_chosen_engine(false).ground_problems();
        }
        let mut found = self.ground_value_problems();
        found.append(self.without_effect(&["calibration", "calibrate", "map", "products", "runtime"]));
        found
    }

    fn ground_value_problems(&self) -> Problems {
        let mut found = Problems::default();
        found.extend(self.downlink.listen.problems());
        found.extend(self.calibration.problems());
        found.extend(self.calibrate.problems());
        if self.calibration.hook == CalibrationHook::Solve {
            found.extend(self.calibrate.problems_of_hook());
        }
        found.extend(self.map.problems());
        found.extend(self.products.problems());
        found.extend(self.runtime.problems());
        found.extend(self.error_draws_problems());
        found
    }

    /// Draws of errors of gains for maps that do not use them.
    fn error_draws_problems(&self) -> Vec<InvalidValue> {
        let (draws, map) = (self.calibration.error_draws, &self.map);
        // An engine that is not chosen yet is checked when it is.
        let is_circle = map.engine == EngineKind::Auto || map.method() == Method::Harmonic;
        let is_used = is_circle && map.regulariser() == RegulariserChoice::Data && map.movers.is_empty();
        let mut checks = Checks::new("calibration");
        let expected = "0, as only maps with map.engine = \"harmonic\", R from the data, no map.refine and no map.movers state errors by gains";
        checks.require("error_draws", draws, draws == 0 || is_used, expected);
        checks.finish()
    }

    /// Hash of the settings that decide the measured data, including the contents of named files, for provenance. `[downlink]` is not
    /// part of it: the same data may arrive through two stations, or in two formats.
    #[must_use]
    #[doc(hidden)]
    pub fn space_hash(&self) -> u64 {
        let Self { name, seed, sky, array, daughters, instrument, navigation, spacecraft, .. } = self;
        let (mut sky, mut array) = (sky.clone(), array.clone());
        if let Some(path) = array.stations.file() {
            array.stations = Stations::File(content_checksum(path));
        }
        array.oem = array.oem.iter().map(|path| content_checksum(path)).collect();
        sky.file = sky.file.map(|files| files.map(|path| content_checksum(path)));
        if let Some(added) = &mut sky.added {
            added.catalogue = added.catalogue.as_deref().map(content_checksum);
        }
        sky.points = sky.points.as_deref().map(content_checksum);
        let mut instrument = instrument.clone();
        instrument.antenna_files = instrument.antenna_files.map_paths(|path| content_checksum(path));
        let daughters = HashedDaughters::new(daughters);
        // Without errors, the hash must equal that of versions before these sections existed.
        match (instrument.is_on(), navigation.is_on()) {
            (false, false) => hash(&(name, seed, sky, &array, &daughters, spacecraft)),
            (true, false) => hash(&(name, seed, sky, &array, &daughters, spacecraft, &instrument)),
            (_, true) => hash(&(name, seed, sky, &array, &daughters, spacecraft, &instrument, navigation)),
        }
    }

    /// Hash of the settings that decide the maps of a downlink, including the contents of named files, for provenance.
    #[must_use]
    #[doc(hidden)]
    pub fn ground_hash(&self) -> u64 {
        let (mut calibration, mut map) = (self.calibration.clone(), self.map.clone());
        calibration.gains_file = calibration.gains_file.as_deref().map(content_checksum);
        map.prior_files = map.prior_files.iter().map(|path| content_checksum(path)).collect();
        map.beyond_files = map.beyond_files.iter().map(|path| content_checksum(path)).collect();
        map.antennas.files = map.antennas.files.map_paths(|path| content_checksum(path));
        if let Some(RegulariserChoice::File(files)) = &mut map.regulariser {
            files.iter_mut().for_each(|path| *path = content_checksum(path));
        }
        if calibration.hook != CalibrationHook::Solve {
            return hash(&(calibration, map));
        }
        let mut calibrate = self.calibrate.clone();
        calibrate.model_files = calibrate.model_files.iter().map(|path| content_checksum(path)).collect();
        hash(&(calibration, map, calibrate))
    }
}

/// `[daughters]` in the form that is hashed: with the former section `disturbances` in place of `tones`, so that hashes of existing data
/// remain valid.
#[derive(Serialize)]
struct HashedDaughters<'a> {
    #[serde(flatten)]
    others: DaughtersConfig,
    disturbances: HashedTones<'a>,
}

#[derive(Serialize)]
struct HashedTones<'a> {
    gain_error: [f64; 0],
    gain_drift_per_s: [f64; 0],
    phase_rad: [f64; 0],
    phase_drift_rad_per_s: [f64; 0],
    clock_offset_s: [f64; 0],
    clock_drift: [f64; 0],
    #[serde(flatten)]
    tones: &'a Tones,
}

impl<'a> HashedDaughters<'a> {
    fn new(daughters: &'a DaughtersConfig) -> Self {
        // Default tones are left out of the serialised form.
        let others = DaughtersConfig { tones: Tones::default(), ..daughters.clone() };
        let disturbances = HashedTones {
            gain_error: [],
            gain_drift_per_s: [],
            phase_rad: [],
            phase_drift_rad_per_s: [],
            clock_offset_s: [],
            clock_drift: [],
            tones: &daughters.tones,
        };
        Self { others, disturbances }
    }
}

/// Whether a name is short and stays within the folder that it is joined to. An empty name is allowed.
pub(in crate::pipeline) fn is_folder_name(name: &str) -> bool {
    let is_forbidden = |c: char| c.is_control() || c == '/' || c == '\\';
    !(name.len() > 60 || name.contains(is_forbidden) || [".", ".."].contains(&name))
}

/// Replacement for the path of a file in a hash: the checksum of its content, or the path itself if the file cannot be read.
fn content_checksum(path: &Path) -> PathBuf {
    // Devices and pipes may be endless.
    if !path.is_file() {
        return path.to_owned();
    }
    let sum = crc_fast::checksum_file(crc_fast::CrcAlgorithm::Crc64Nvme, &path.to_string_lossy(), None);
    sum.map_or_else(|_| path.to_owned(), |sum| PathBuf::from(format!("{sum:016x}")))
}

/// CRC-64 of the JSON form, which is the same on every machine.
fn hash(value: &impl Serialize) -> u64 {
    // A structure with string keys and finite numbers always has a JSON form.
    let text = serde_json::to_vec(value).unwrap_or_default();
    crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::ConfigSource;

    fn with(overrides: &[&str]) -> Option<Config> {
        let overrides = overrides.iter().map(|&text| text.to_owned()).collect();
        ConfigSource { overrides, ..ConfigSource::default() }.parse().ok()
    }

    #[test]
    fn a_correction_has_to_fit_the_quantiser() {
        let problems = |bits: u32, ground: u32, fidelity: &str| {
            let fidelity = format!("spacecraft.fidelity={fidelity}");
            let (bits, ground) =
                (format!("daughters.bits={bits}"), format!("calibration.quantiser_bits={ground}"));
            let config = with(&[&bits, &ground, &fidelity]).unwrap();
            let mut checks = Checks::new("");
            config.check_quantiser(&mut checks);
            checks.finish().pop().map(|problem| problem.to_string())
        };
        for good in [(1, 1), (2, 2), (4, 4), (2, 0), (8, 0), (32, 0)] {
            assert_eq!(problems(good.0, good.1, "samples"), None);
        }
        for bad in [(1, 2), (2, 4), (8, 1), (32, 4)] {
            assert!(problems(bad.0, bad.1, "samples").is_some_and(|text| text.contains("daughters.bits is")));
        }
        assert!(problems(1, 1, "visibilities").is_some_and(|text| text.contains("expected 0")));
    }

    #[test]
    fn draws_for_maps_that_do_not_use_them_are_refused() {
        let problems = |overrides: &[&str]| {
            let gains = ["calibration.hook=solve", "calibration.error_draws=8"];
            let config = with(&[&gains, overrides].concat()).unwrap();
            config.ground_value_problems().iter().map(ToString::to_string).collect::<String>()
        };
        assert!(!problems(&[]).contains("error_draws"));
        for unused in [["map.engine=pixel"], ["map.regulariser=identity"], ["map.refine.passes_max=3"]] {
            assert!(problems(&unused).contains("calibration.error_draws = 8"), "{unused:?}");
            assert!(!problems(&[unused[0], "calibration.error_draws=0"]).contains("error_draws"));
        }
    }

    #[test]
    fn existing_data_keep_their_hash() {
        // From packets of version 0.1.0, before [daughters.disturbances] became [daughters.tones].
        let thin = ["spacecraft.every_nth_window=1500", "sky.nside=8", "sky.l_max=8"];
        assert_eq!(with(&thin).unwrap().space_hash(), 0x85d8_7b8e_cfbe_4d84);
        let toned = with(&["daughters.tones.calibration_k_sr=1.0"]).unwrap();
        assert_ne!(toned.space_hash(), with(&[]).unwrap().space_hash());
    }

    #[test]
    fn hashes_follow_the_contents_of_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).display().to_string();
        let hashes = |name: &str| {
            let sky = format!("sky.file={:?}", path(name));
            let [prior, beyond] =
                ["prior_files", "beyond_files"].map(|key| format!("map.{key}=[{:?}]", path(name)));
            let gains = path("gains");
            let sky = with(&[&sky]).unwrap();
            let prior = with(&[&prior]).unwrap();
            let beyond = with(&[&beyond]).unwrap();
            let gains = with(&[&format!("calibration.gains_file={gains:?}")]).unwrap();
            [sky.space_hash(), prior.ground_hash(), beyond.ground_hash(), gains.ground_hash()]
        };
        for (name, text) in [("one", "a"), ("same", "a"), ("other", "b"), ("gains", "c")] {
            std::fs::write(path(name), text).unwrap();
        }
        let first = hashes("one");
        assert_eq!(first, hashes("same"));
        let other = hashes("other");
        assert!((0..3).all(|k| first[k] != other[k]) && first[3] == other[3]);
        std::fs::write(path("gains"), "d").unwrap();
        assert_ne!(first[3], hashes("one")[3]);
        // Missing files: the hash contains the path.
        assert_ne!(hashes("none"), hashes("neither"));
    }

    #[test]
    fn hashes_depend_on_their_segment_only() {
        let base = with(&[]).unwrap();
        let mapped = with(&["map.nside=8"]).unwrap();
        let flown = with(&["spacecraft.thermal_noise=false"]).unwrap();
        let queued = with(&["runtime.queue_capacity=3"]).unwrap();
        assert_eq!(base.space_hash(), mapped.space_hash());
        assert_ne!(base.ground_hash(), mapped.ground_hash());
        assert_ne!(base.space_hash(), flown.space_hash());
        assert_eq!(base.ground_hash(), flown.ground_hash());
        assert_eq!((base.space_hash(), base.ground_hash()), (queued.space_hash(), queued.ground_hash()));
    }
}
