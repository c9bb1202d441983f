//! Locks of folders.

use std::fs::{self, File, Metadata, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use super::access::{is_at, is_same};
use super::atomic::{remove_stale, unfinished_files};

/// The lock of a folder that one process uses at a time: it locks a file in the folder.
///
/// The system releases the lock however the process ends.
#[derive(Debug)]
pub struct FolderLock {
    folder: PathBuf,
    lock_path: PathBuf,
    lock: File,
    locked: Metadata,
    removes_lock: bool,
    /// Whether the folder was created for the lock.
    is_new: bool,
}

impl FolderLock {
    /// Creates the folder if necessary and locks it with the file `name` in it. Removes unfinished files without a writer.
    ///
    /// With `removes_lock`, or if the folder is new and still empty, dropping the lock removes this file, and the folder if it is new
    /// and empty, so that a run that fails before its first product leaves nothing behind.
    ///
    /// # Errors
    /// The system's error; [`io::ErrorKind::ResourceBusy`] if another process, or this one, has locked the folder.
    pub fn acquire(folder: &Path, name: &str, removes_lock: bool) -> io::Result<Self> {
        let is_new = !folder.exists();
        fs::create_dir_all(folder)?;
        let lock_path = folder.join(name);
        let lock = loop {
            let lock = File::options().create(true).append(true).open(&lock_path)?;
            match lock.try_lock() {
                // The previous owner may have removed the file in the meantime.
                Ok(()) if is_at(&lock, &lock_path) => break lock,
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => {
                    let reason = "in use by another process; expected one process at a time";
                    return Err(io::Error::new(io::ErrorKind::ResourceBusy, reason));
                }
                Err(TryLockError::Error(error)) => return Err(error),
            }
        };
        let locked = fs::metadata(folder)?;
        for path in unfinished_files(folder) {
            remove_stale(&path);
        }
        Ok(Self { folder: folder.to_owned(), lock_path, lock, locked, removes_lock, is_new })
    }

    /// Why the lock is lost, as the folder or the lock's file was moved, removed or replaced; `None` if it is not.
    #[must_use]
    pub fn loss(&self) -> Option<&'static str> {
        match fs::metadata(&self.folder) {
            Err(_) => Some("is missing: it was moved or removed"),
            Ok(found) if !is_same(&found, &self.locked) => {
                Some("is a different one: it was moved and replaced")
            }
            Ok(_) if !is_at(&self.lock, &self.lock_path) => Some("has lost its lock: the file was removed"),
            Ok(_) => None,
        }
    }
}

impl Drop for FolderLock {
    fn drop(&mut self) {
        let has_only_lock = || fs::read_dir(&self.folder).is_ok_and(|entries| entries.count() == 1);
        if (self.removes_lock || (self.is_new && has_only_lock())) && self.loss().is_none() {
            let _ = fs::remove_file(&self.lock_path);
            if self.is_new {
                // Fails if the folder is not empty.
                let _ = fs::remove_dir(&self.folder);
            }
        }
    }
}
