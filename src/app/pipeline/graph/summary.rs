//! The summary of a run: `summary.json`, and what is printed at the end.

use std::collections::BTreeSet;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use bincode::config::{Configuration, Fixint, Limit, LittleEndian};
use serde::{Deserialize, Serialize};

use super::found_solutions::CalibrateSummary;
use super::ground_segment::SOLVE;
use super::sample_summary::SampleSummary;
use crate::calibration::{BurstChoice, BurstSummary, Completeness, FoundBurst, SearchedPasses};
use crate::downlink::ReceptionCounters;
use crate::downlink::transport::socket::ListenReport;
use crate::frames::VisibilityReason;
use crate::ground::SavingReport;
use crate::pipeline::config::{Config, advice_off_circle};
use crate::products::{ChannelSummary, JOINT, JointReport, ProductsError, write_product};
use crate::runtime::{LedgerReport, Report, StageReport};

/// Which part of the chain ran.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum RunScope {
    /// Space and ground in one process.
    Whole,
    /// The ground alone, from files.
    Ground,
}

/// The results of a run: the content of `summary.json`.
#[derive(Clone, Debug, Serialize)]
pub struct RunSummary {
    /// Version of the program.
    pub version: &'static str,
    /// Name of the pipeline.
    pub name: String,
    /// Which part of the chain ran.
    pub segment: RunScope,
    /// Whether the run was cancelled.
    pub cancelled: bool,
    /// Seed of the space segment, from the instrument description.
    pub seed: Option<u64>,
    /// Hash of the space segment's configuration, from the instrument description.
    pub space_hash: Option<String>,
    /// Hash of the ground's configuration.
    pub ground_hash: String,
    /// The maps, channel by channel.
    pub channels: Vec<ChannelSummary>,
    /// Files of channels whose final map was not made, as the run was ended early.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub intermediate_files: Vec<String>,
    /// The ledger of visibilities.
    pub ledger: LedgerReport<VisibilityReason>,
    /// Whether the ledger is known to be complete.
    pub completeness: Completeness,
    /// Statistics of samples; absent if no samples were simulated.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples: Option<SampleSummary>,
    /// Counters of what was received and of its faults.
    pub reception: ReceptionCounters,
    /// The senders, if the ground listened.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub listening: Option<ListenReport>,
    /// Checkpoints of the ground's state, if it keeps one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub saving: Option<SavingReport>,
    /// Summary of the solved gains, with `calibration.hook = "solve"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration: Option<CalibrateSummary>,
    /// Bursts of point sources; absent if they were not looked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bursts: Option<BurstSummary>,
    /// The joint maps; absent without any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub joint: Option<JointReport>,
    /// Throughput, times and queues of the stages; for the last reading, if the channels were mapped in groups.
    pub report: Report,
    /// Reports of the earlier readings.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub earlier_reports: Vec<Report>,
}

impl RunSummary {
    /// A summary without samples and senders.
    #[must_use]
    pub(in crate::pipeline) fn new(
        segment: RunScope,
        config: &Config,
        report: Report,
        ledger: LedgerReport<VisibilityReason>,
        reception: ReceptionCounters,
        channels: Vec<ChannelSummary>,
    ) -> Self {
        Self {
            version: env!("CARGO_PKG_VERSION"),
            name: config.name.clone(),
            segment,
            cancelled: report.cancelled,
            seed: channels.first().map(|channel| channel.seed),
            space_hash: channels.first().map(|channel| channel.space_hash.clone()),
            ground_hash: format!("{:016x}", config.ground_hash()),
            channels,
            intermediate_files: Vec::new(),
            ledger,
            completeness: Completeness::default(),
            samples: None,
            reception,
            listening: None,
            saving: None,
            calibration: None,
            bursts: None,
            joint: None,
            report,
            earlier_reports: Vec::new(),
        }
    }

    /// Merges this summary with that of an earlier reading of the same downlink, which mapped other channels.
    pub(in crate::pipeline) fn merged_with_earlier(self, earlier: GroupRecord, action: BurstChoice) -> Self {
        let elsewhere = VisibilityReason::ChannelNotMapped;
        let ledger =
            earlier.ledger.merge_readings(&self.ledger, VisibilityReason::is_of_accumulation, elsewhere);
        Self {
            seed: earlier.seed.or(self.seed),
            space_hash: earlier.space_hash.or(self.space_hash),
            channels: [earlier.channels, self.channels].concat(),
            ledger,
            bursts: {
                let ours = self.bursts.map(|ours| (ours.bursts, ours.searched)).unwrap_or_default();
                let (bursts, searched) =
                    ([earlier.bursts, ours.0].concat(), [earlier.searched, ours.1].concat());
                BurstSummary::new(action, bursts, searched)
            },
            ..self
        }
    }

    /// Whether maps are missing or not converged because the grace period after cancellation was too short.
    #[must_use]
    #[doc(hidden)]
    pub fn lacks_maps(&self) -> bool {
        let is_skipped = |solve: &StageReport| solve.items_out < solve.items_in;
        let is_interrupted = |channel: &ChannelSummary| channel.interrupted.is_some();
        self.cancelled
            && (!self.report.cut.is_empty()
                || self.report.stage(SOLVE).is_some_and(is_skipped)
                || self.channels.iter().any(is_interrupted))
    }

    /// Writes `summary.json` into `folder`. Removes maps and pictures that the summary of an earlier run there names and
    /// that this run did not write, so that all files belong to this run.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub(in crate::pipeline) fn write(&self, folder: &Path) -> Result<PathBuf, ProductsError> {
        let path = folder.join("summary.json");
        let text = serde_json::to_vec_pretty(self)
            .map_err(|error| ProductsError::Encode { path: path.clone(), reason: error.to_string() })?;
        let previous = std::fs::read(&path).unwrap_or_default();
        write_product(&path, &text)?;
        let ours: BTreeSet<String> = product_files(&text).into_iter().collect();
        // If this run lacks maps, those of the previous run are kept.
        let is_complete = !self.lacks_maps();
        for file in product_files(&previous).iter().filter(|file| is_complete && !ours.contains(*file)) {
            let file = folder.join(file);
            // The file may no longer exist, and the folder may hold other files.
            let _ = std::fs::remove_file(&file);
            let _ = file.parent().map(std::fs::remove_dir);
        }
        Ok(path)
    }
}

/// Part of a summary that is kept on disk for a mapped group of channels, until all groups are mapped.
#[derive(bincode::Encode, bincode::Decode)]
pub(in crate::pipeline) struct GroupRecord {
    /// Checksums of the product files, in the order of `channels`.
    checksums: Vec<u64>,
    pub(in crate::pipeline) ledger: LedgerReport<VisibilityReason>,
    pub(in crate::pipeline) channels: Vec<ChannelSummary>,
    pub(in crate::pipeline) seed: Option<u64>,
    pub(in crate::pipeline) space_hash: Option<String>,
    pub(in crate::pipeline) bursts: Vec<FoundBurst>,
    pub(in crate::pipeline) searched: Vec<SearchedPasses>,
}

/// Maximum size of a record, bytes: a channel's curves take some 100 kB.
const RECORD_BYTES_MAX: usize = 1 << 28;

const CODEC: Configuration<LittleEndian, Fixint, Limit<RECORD_BYTES_MAX>> = bincode::config::standard()
    .with_little_endian()
    .with_fixed_int_encoding()
    .with_limit::<RECORD_BYTES_MAX>();

impl GroupRecord {
    /// The record of a group whose products are in `out`.
    ///
    /// # Errors
    /// A product that cannot be read.
    pub(in crate::pipeline) fn new(summary: &RunSummary, out: &Path) -> Result<Self, ProductsError> {
        let checksum = |file: &String| {
            let path = out.join(file);
            file_checksum(&path).map_err(|source| ProductsError::Read { path, source })
        };
        let files = summary.channels.iter().flat_map(|channel| &channel.files);
        Ok(Self {
            checksums: files.map(checksum).collect::<Result<_, _>>()?,
            ledger: summary.ledger.clone(),
            channels: summary.channels.clone(),
            seed: summary.seed,
            space_hash: summary.space_hash.clone(),
            bursts: summary.bursts.as_ref().map(|bursts| bursts.bursts.clone()).unwrap_or_default(),
            searched: summary.bursts.as_ref().map(|bursts| bursts.searched.clone()).unwrap_or_default(),
        })
    }

    /// Reads the record of a mapped group; `None` if there is none, if it has another key, or if its products are missing or
    /// changed.
    pub(in crate::pipeline) fn read(path: &Path, key: u64, out: &Path) -> Option<Self> {
        let bytes = fs::read(path).ok().filter(|bytes| bytes.len() <= RECORD_BYTES_MAX)?;
        let (body, crc) = bytes.split_last_chunk::<8>()?;
        let (found, body) = body.split_first_chunk::<8>()?;
        let expected_crc = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, body);
        if u64::from_le_bytes(*found) != key || u64::from_le_bytes(*crc) != expected_crc {
            return None;
        }
        let (record, _) = bincode::decode_from_slice::<Self, _>(body, CODEC).ok()?;
        let mut files = record.channels.iter().flat_map(|channel| &channel.files);
        let are_unchanged = files
            .by_ref()
            .zip(&record.checksums)
            .all(|(file, checksum)| file_checksum(&out.join(file)).is_ok_and(|found| found == *checksum));
        (are_unchanged && files.next().is_none()).then_some(record)
    }

    pub(in crate::pipeline) fn write(&self, path: &Path, key: u64) -> Result<(), ProductsError> {
        let body = bincode::encode_to_vec(self, CODEC)
            .map_err(|error| ProductsError::Encode { path: path.to_owned(), reason: error.to_string() })?;
        let crc = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &body);
        let bytes = [key.to_le_bytes().as_slice(), &body, &crc.to_le_bytes()].concat();
        write_product(path, bytes)
    }
}

/// Checksum of a file, read in small pieces.
fn file_checksum(path: &Path) -> std::io::Result<u64> {
    let mut crc = crc_fast::Digest::new(crc_fast::CrcAlgorithm::Crc64Nvme);
    let mut file = std::io::BufReader::with_capacity(1 << 16, fs::File::open(path)?);
    loop {
        let piece = std::io::BufRead::fill_buf(&mut file)?;
        if piece.is_empty() {
            return Ok(crc.finalize());
        }
        crc.update(piece);
        let length = piece.len();
        std::io::BufRead::consume(&mut file, length);
    }
}

/// Files that a `summary.json` lists, restricted to the folders of channels and of joint maps, so that no other file can be removed.
fn product_files(summary: &[u8]) -> Vec<String> {
    #[derive(Default, Deserialize)]
    #[serde(default)]
    struct Summary {
        channels: Vec<Channel>,
        intermediate_files: Vec<String>,
        joint: Option<Joint>,
    }
    #[derive(Default, Deserialize)]
    #[serde(default)]
    struct Joint {
        maps: Vec<JointMap>,
    }
    #[derive(Default, Deserialize)]
    #[serde(default)]
    struct JointMap {
        folder: PathBuf,
    }
    #[derive(Default, Deserialize)]
    #[serde(default)]
    struct Channel {
        files: Vec<String>,
    }
    let summary: Summary = serde_json::from_slice(summary).unwrap_or_default();
    let is_product = |file: &String| {
        let parts: Vec<&str> = file.split('/').collect();
        let [folder, name] = parts[..] else { return false };
        folder.ends_with("MHz") && !name.is_empty() && !folder.contains('\\') && !name.contains('\\')
    };
    let of_joint = |map: JointMap| {
        let folder =
            map.folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        ["map.fits", "map.png"].map(|name| format!("{folder}/{name}"))
    };
    let has_joint = summary.joint.is_some();
    let maps = summary.joint.into_iter().flat_map(|joint| joint.maps).flat_map(of_joint);
    let maps = maps.filter(is_product).map(|file| format!("{JOINT}/{file}"));
    let others = ["spectra.fits", "joint.json"].into_iter().filter(|_| has_joint);
    let final_files = summary.channels.into_iter().flat_map(|channel| channel.files);
    let of_channels = final_files.chain(summary.intermediate_files).filter(is_product);
    of_channels.chain(maps).chain(others.map(|name| format!("{JOINT}/{name}"))).collect()
}

impl fmt::Display for RunSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "Stages\n{}\n", self.report)?;
        let advice = advice_off_circle(&self.ledger);
        writeln!(f, "Ledger of visibilities\n{}{advice}\n{}\n", self.ledger, self.completeness)?;
        if let Some(samples) = &self.samples {
            writeln!(f, "Samples\n{samples}\n")?;
        }
        writeln!(f, "Reception\n{}\n", self.reception)?;
        if let Some(listening) = &self.listening {
            writeln!(f, "Senders\n{listening}\n")?;
        }
        if let Some(saving) = self.saving.as_ref().filter(|saving| saving.failed > 0) {
            writeln!(f, "State\n{saving}\n")?;
        }
        if let Some(bursts) = &self.bursts {
            writeln!(f, "Bursts\n{bursts}\n")?;
        }
        if let Some(gains) = &self.calibration {
            writeln!(f, "Gains\n{gains}\n")?;
        }
        writeln!(f, "Maps")?;
        for channel in &self.channels {
            writeln!(f, "{channel}")?;
        }
        if let Some(joint) = &self.joint {
            writeln!(f, "\nJoint maps\n{joint}")?;
        }
        if self.lacks_maps() {
            write!(
                f,
                "Ended early: runtime.grace_s left no time for all maps. Maps of channels that are not listed are missing or without all products; earlier ones are kept."
            )?;
            if !self.intermediate_files.is_empty() {
                write!(f, " Of these there is: {}", self.intermediate_files.join(", "))?;
            }
        } else if self.cancelled && !self.report.cancelled {
            write!(f, "Ended early, without joint maps: all other products are complete.")?;
        } else if self.cancelled {
            write!(f, "Ended early: all products hold the data so far.")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_products_of_channels_are_named() {
        let summary =
            br#"{"channels": [{"files": ["3.000MHz/map.fits", "../MHz/x", "/MHz", "3.000MHz/../../x",
            "3.000MHz", "notes/x.txt"]}, {}], "more": 1}"#;
        assert_eq!(product_files(summary), ["3.000MHz/map.fits"]);
        // The folders of joint maps are as the user wrote that of the run.
        let summary =
            br#"{"joint": {"maps": [{"folder": "a/b/joint/8.500MHz"}, {"folder": "../.."}, {"folder": "/etc"}]}}"#;
        let expected =
            ["joint/8.500MHz/map.fits", "joint/8.500MHz/map.png", "joint/spectra.fits", "joint/joint.json"];
        assert_eq!(product_files(summary), expected);
        assert!(product_files(b"").is_empty() && product_files(b"[1]").is_empty());
    }
}
