//! A writer of downlink files of either format.

use std::io::Write;
use std::path::{Path, PathBuf};

use crate::downlink::config::DownlinkConfig;
use crate::downlink::error::{DownlinkError, io_error};
use crate::downlink::wire::Transmission;
use crate::files::{AtomicFile, IfUnfinished};
use crate::frames::GroundFrame;

/// Writes ground frames to a file of packets or of CADUs, depending on the configuration.
///
/// [`DownlinkWriter::finish`] gives the file its name, and replaces an older file, once all of it is on disk. A writer that
/// is dropped before leaves `NAME.partial`, which is readable as far as it goes.
#[derive(Debug)]
pub struct DownlinkWriter {
    path: PathBuf,
    file: AtomicFile,
    transmission: Transmission,
    pending: Vec<u8>,
}

impl DownlinkWriter {
    /// Creates the file.
    ///
    /// # Errors
    /// The configuration is invalid; the file cannot be created.
    pub fn create(path: &Path, config: &DownlinkConfig) -> Result<Self, DownlinkError> {
        let transmission = Transmission::new(config)?;
        let file = AtomicFile::create(path, IfUnfinished::Keep).map_err(io_error(path, "create the file"))?;
        Ok(Self { path: path.to_owned(), file, transmission, pending: Vec::new() })
    }

    /// Appends the bytes that a frame adds to the downlink.
    ///
    /// # Errors
    /// The errors of [`Transmission::send`]; the file cannot be written.
    pub fn write(&mut self, frame: &GroundFrame) -> Result<(), DownlinkError> {
        self.pending.clear();
        self.transmission.send(frame, &mut self.pending)?;
        self.file.write_all(&self.pending).map_err(io_error(&self.path, "write"))
    }

    /// Number of bytes written.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.file.bytes()
    }

    /// Flushes the file to disk and gives it its name; returns its length in bytes.
    ///
    /// # Errors
    /// The file cannot be written or renamed.
    pub fn finish(mut self) -> Result<u64, DownlinkError> {
        self.pending.clear();
        self.transmission.finish(&mut self.pending);
        self.file.write_all(&self.pending).map_err(io_error(&self.path, "write"))?;
        self.file.finish().map_err(io_error(&self.path, "finish the file"))
    }
}
