//! Files that bear their name only once they are complete.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use super::error::DownlinkError;
use super::file::io_error;

/// Bytes that are gathered before they are written.
const WRITE_BYTES: usize = 1 << 20;

/// A file called `NAME.partial` until [`PartialFile::finish`] has put all of it on the disk; then it
/// takes its name, replacing an older one.
#[derive(Debug)]
pub(super) struct PartialFile {
    path: PathBuf,
    partial_path: PathBuf,
    file: File,
    pending: Vec<u8>,
    bytes: u64,
}

impl PartialFile {
    /// Begins a file, in a folder that is made if it is not there.
    pub(super) fn create(path: &Path) -> Result<Self, DownlinkError> {
        if let Some(folder) = folder_of(path) {
            fs::create_dir_all(folder).map_err(io_error(folder, "create the folder"))?;
        }
        let mut name = path.as_os_str().to_owned();
        name.push(".partial");
        let partial_path = PathBuf::from(name);
        let file = File::create(&partial_path).map_err(io_error(&partial_path, "create the file"))?;
        Ok(Self { path: path.to_owned(), partial_path, file, pending: Vec::new(), bytes: 0 })
    }

    /// What is to be written next; call [`PartialFile::settle`] after adding to it.
    pub(super) fn pending(&mut self) -> &mut Vec<u8> {
        &mut self.pending
    }

    /// Writes what is pending if it is enough to be worth it.
    pub(super) fn settle(&mut self) -> Result<(), DownlinkError> {
        if self.pending.len() >= WRITE_BYTES { self.flush() } else { Ok(()) }
    }

    /// Bytes so far.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes + self.pending.len() as u64
    }

    /// Puts everything on the disk and gives the file its name; returns its length.
    pub(super) fn finish(&mut self) -> Result<u64, DownlinkError> {
        self.flush()?;
        self.file.sync_all().map_err(io_error(&self.partial_path, "put the file on the disk"))?;
        fs::rename(&self.partial_path, &self.path).map_err(io_error(&self.path, "rename the file"))?;
        let folder = folder_of(&self.path).unwrap_or(Path::new("."));
        File::open(folder)
            .and_then(|folder| folder.sync_all())
            .map_err(io_error(folder, "put the folder on the disk"))?;
        Ok(self.bytes)
    }

    fn flush(&mut self) -> Result<(), DownlinkError> {
        self.file.write_all(&self.pending).map_err(io_error(&self.partial_path, "write"))?;
        self.bytes += self.pending.len() as u64;
        self.pending.clear();
        Ok(())
    }
}

fn folder_of(path: &Path) -> Option<&Path> {
    path.parent().filter(|folder| !folder.as_os_str().is_empty())
}
