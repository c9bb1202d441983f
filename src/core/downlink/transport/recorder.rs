//! A stage or sink that writes a byte stream to a file or to standard output.

use std::io::Write;
use std::path::{Path, PathBuf};

use crate::downlink::error::{DownlinkError, io_error};
use crate::files::{AtomicFile, IfUnfinished};
use crate::runtime::{Outlet, Sink, Stage, Units};

/// Records a byte stream in a file. As a stage it forwards the bytes, as a sink it consumes them.
#[derive(Debug)]
pub struct Recorder {
    path: PathBuf,
    /// `None` before the first bytes, so that no empty file is written, and after the end.
    file: Option<AtomicFile>,
    to_standard_output: bool,
    bytes: u64,
}

impl Recorder {
    /// A recorder to a file, which it creates with the first bytes.
    ///
    /// # Errors
    /// The file cannot be created, or another process is writing it.
    pub fn create(path: &Path) -> Result<Self, DownlinkError> {
        // Errors appear before anything is computed.
        drop(create(path)?);
        Ok(Self { path: path.to_owned(), file: None, to_standard_output: false, bytes: 0 })
    }

    /// A recorder to standard output.
    #[must_use]
    #[doc(hidden)]
    pub fn to_standard_output() -> Self {
        Self { path: "standard output".into(), file: None, to_standard_output: true, bytes: 0 }
    }

    fn record(&mut self, bytes: &[u8]) -> Result<(), DownlinkError> {
        if bytes.is_empty() {
            return Ok(());
        }
        if self.bytes == 0 && !self.to_standard_output {
            self.file = Some(create(&self.path)?);
        }
        self.bytes += bytes.len() as u64;
        match &mut self.file {
            Some(file) => file.write_all(bytes).map_err(io_error(&self.path, "write")),
            None if self.to_standard_output => {
                std::io::stdout().lock().write_all(bytes).map_err(io_error(&self.path, "write"))
            }
            None => Ok(()),
        }
    }

    fn close(&mut self) -> Result<(), DownlinkError> {
        match self.file.take() {
            Some(file) => file.finish().map(|_| ()).map_err(io_error(&self.path, "finish the file")),
            None if self.to_standard_output => {
                std::io::stdout().flush().map_err(io_error(&self.path, "write"))
            }
            None => Ok(()),
        }
    }
}

fn create(path: &Path) -> Result<AtomicFile, DownlinkError> {
    AtomicFile::create(path, IfUnfinished::Keep).map_err(io_error(path, "create the file"))
}

impl Stage for Recorder {
    type In = Vec<u8>;
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn step(&mut self, bytes: Vec<u8>, out: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        self.record(&bytes)?;
        out.push(bytes);
        Ok(())
    }

    fn finish(&mut self, _: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        self.close()
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}

impl Sink for Recorder {
    type In = Vec<u8>;
    type Error = DownlinkError;

    fn take(&mut self, bytes: Vec<u8>) -> Result<(), DownlinkError> {
        self.record(&bytes)
    }

    fn finish(&mut self) -> Result<(), DownlinkError> {
        self.close()
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}
