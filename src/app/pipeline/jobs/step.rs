//! Steps of a job: what an earlier call with the same inputs has finished is kept, all else is made.

use std::fs;
use std::path::{Path, PathBuf};

use crate::mother::SpoolReader;
use crate::pipeline::config::{Config, PipelineError};
use crate::products::write_product;

/// How a step or job has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub(in crate::pipeline) enum Outcome {
    /// Everything is there, made by this call or an earlier one.
    Done,
    /// It was interrupted: the next call makes it.
    Cancelled,
}

impl Outcome {
    pub(super) fn of(is_cancelled: bool) -> Self {
        if is_cancelled { Self::Cancelled } else { Self::Done }
    }

    pub(super) fn is_cancelled(self) -> bool {
        self == Self::Cancelled
    }
}

/// A step of a job, which is done if its marker is there.
pub(super) enum Step<'a> {
    /// A file of this name is written once the step is complete. Its text is everything that decides the result.
    Marked(PathBuf, Vec<u8>),
    /// As `Marked`, for a simulated downlink; its length is in the text, so that a file that was cut is simulated again.
    Downlink(PathBuf, &'a Config, &'a Path),
    /// A spool file gets its name once it is complete, and has the key of its inputs in its header.
    Spool(&'a Path, u64),
}

impl Step<'_> {
    pub(super) fn is_done(&self) -> Result<bool, PipelineError> {
        match self {
            Self::Spool(path, key) => Ok(SpoolReader::open(path, *key)?.is_some()),
            Self::Marked(marker, _) | Self::Downlink(marker, ..) => {
                Ok(fs::read(marker).is_ok_and(|found| found == self.text()))
            }
        }
    }

    /// Makes the step unless it is done, and marks it unless it was cancelled.
    pub(super) fn run(
        &self,
        make: impl FnOnce() -> Result<Outcome, PipelineError>,
    ) -> Result<Outcome, PipelineError> {
        if self.is_done()? {
            return Ok(Outcome::Done);
        }
        let outcome = make()?;
        match self {
            Self::Marked(marker, _) | Self::Downlink(marker, ..) if outcome == Outcome::Done => {
                write_product(marker, self.text())?;
            }
            _ => {}
        }
        Ok(outcome)
    }

    /// Text of the marker.
    fn text(&self) -> Vec<u8> {
        match self {
            Self::Marked(_, text) => text.clone(),
            Self::Downlink(_, config, file) => {
                let bytes = fs::metadata(file).map_or(0, |found| found.len());
                let (version, space_hash) = (env!("CARGO_PKG_VERSION"), config.space_hash());
                format!("{version} {space_hash:016x} {:?} {bytes}", config.downlink).into_bytes()
            }
            Self::Spool(_, key) => key.to_le_bytes().into(),
        }
    }
}

/// Hash of what decides the result of a step.
pub(super) fn key_of(text: impl AsRef<[u8]>) -> u64 {
    crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, text.as_ref())
}
