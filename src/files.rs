//! Files that are there whole or not at all; for everything that writes.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Bytes that are gathered before they are written.
const WRITE_BYTES: usize = 1 << 20;

/// What becomes of a file that was begun and not finished.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IfUnfinished {
    /// It is removed.
    Remove,
    /// It stays under the name `NAME.partial`.
    Keep,
}

/// A file called `NAME.partial` until [`AtomicFile::finish`] has put all of it on the disk; then it takes
/// its name, replacing an older file.
#[derive(Debug)]
pub struct AtomicFile {
    path: PathBuf,
    partial_path: PathBuf,
    /// `None` once finished.
    file: Option<File>,
    unfinished: IfUnfinished,
    pending: Vec<u8>,
    written: u64,
}

impl AtomicFile {
    /// Begins a file, in a folder that is made if it is not there.
    ///
    /// # Errors
    /// What the system says.
    pub fn create(path: &Path, unfinished: IfUnfinished) -> io::Result<Self> {
        if let Some(folder) = folder_of(path) {
            fs::create_dir_all(folder)?;
        }
        if fs::metadata(path).is_ok_and(|found| !found.is_file()) {
            let reason = "something is there that is not a regular file; expected a file or a new name";
            return Err(io::Error::new(io::ErrorKind::InvalidInput, reason));
        }
        let mut name = path.as_os_str().to_owned();
        name.push(".partial");
        let partial_path = PathBuf::from(name);
        let file = Some(File::create(&partial_path)?);
        Ok(Self { path: path.to_owned(), partial_path, file, unfinished, pending: Vec::new(), written: 0 })
    }

    /// Bytes so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.written + self.pending.len() as u64
    }

    /// Puts everything on the disk and gives the file its name; returns its length.
    ///
    /// # Errors
    /// What the system says; the file is then unfinished.
    pub fn finish(mut self) -> io::Result<u64> {
        self.flush()?;
        if let Some(file) = &self.file {
            file.sync_all()?;
        }
        fs::rename(&self.partial_path, &self.path)?;
        self.file = None;
        // The new name is on the disk once its folder is.
        File::open(folder_of(&self.path).unwrap_or(Path::new(".")))?.sync_all()?;
        Ok(self.written)
    }
}

impl Write for AtomicFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.pending.extend_from_slice(bytes);
        if self.pending.len() >= WRITE_BYTES {
            self.flush()?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        if let Some(file) = &mut self.file {
            file.write_all(&self.pending)?;
        }
        self.written += self.pending.len() as u64;
        self.pending.clear();
        Ok(())
    }
}

impl Drop for AtomicFile {
    fn drop(&mut self) {
        if self.file.is_none() {
            return;
        }
        // What went wrong before is what counts; remains are a nuisance, not an error.
        match self.unfinished {
            IfUnfinished::Remove => drop(fs::remove_file(&self.partial_path)),
            // All that was handed over, and not only what filled a buffer.
            IfUnfinished::Keep => drop(self.flush()),
        }
    }
}

/// Writes a whole file at once.
///
/// # Errors
/// What the system says.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = AtomicFile::create(path, IfUnfinished::Remove)?;
    file.write_all(bytes)?;
    file.finish().map(|_| ())
}

fn folder_of(path: &Path) -> Option<&Path> {
    path.parent().filter(|folder| !folder.as_os_str().is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_there_once_it_is_finished() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/folder/file");
        let mut file = AtomicFile::create(&path, IfUnfinished::Remove).unwrap();
        file.write_all(b"some").unwrap();
        assert!(!path.exists());
        assert_eq!(file.finish().unwrap(), 4);
        assert_eq!(fs::read(&path).unwrap(), b"some");
        write_atomically(&path, b"other").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"other");
        assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    }

    #[test]
    fn what_is_not_finished_goes_or_stays_as_asked() {
        let folder = tempfile::tempdir().unwrap();
        for (unfinished, remains) in [(IfUnfinished::Remove, false), (IfUnfinished::Keep, true)] {
            let path = folder.path().join(format!("{unfinished:?}"));
            let mut file = AtomicFile::create(&path, unfinished).unwrap();
            file.write_all(&vec![7; WRITE_BYTES + 5]).unwrap();
            file.write_all(&[8; 3]).unwrap();
            drop(file);
            assert!(!path.exists());
            let left = fs::read(path.with_extension("partial")).ok();
            assert_eq!(left.map(|bytes| bytes.len()), remains.then_some(WRITE_BYTES + 8));
        }
    }
}
