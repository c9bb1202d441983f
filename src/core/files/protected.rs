//! Protection of files that must not be replaced.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

/// Protects files that a command reads or writes as they grow: this process does not replace them while this value exists.
#[derive(Debug, Default)]
pub struct ProtectedInputs(Vec<FileKey>);

/// Identity of a file, which is the same for all names that lead to it.
#[cfg(unix)]
type FileKey = (u64, u64);
#[cfg(not(unix))]
type FileKey = std::path::PathBuf;

/// The protected files, with the number of values that protect each.
static PROTECTED: Mutex<BTreeMap<FileKey, usize>> = Mutex::new(BTreeMap::new());

impl ProtectedInputs {
    /// Protects regular files; ignores all other paths, which fail when they are opened.
    pub fn of<P: AsRef<Path>>(paths: impl IntoIterator<Item = P>) -> Self {
        let keys: Vec<FileKey> = paths.into_iter().filter_map(|path| key_of(path.as_ref())).collect();
        let mut protected = PROTECTED.lock().unwrap_or_else(PoisonError::into_inner);
        for key in &keys {
            // Elsewhere than on Unix it is no number.
            *protected.entry(ToOwned::to_owned(key)).or_default() += 1;
        }
        Self(keys)
    }
}

impl Drop for ProtectedInputs {
    fn drop(&mut self) {
        let mut protected = PROTECTED.lock().unwrap_or_else(PoisonError::into_inner);
        for key in &self.0 {
            if let Some(count) = protected.get_mut(key) {
                *count -= 1;
            }
        }
        protected.retain(|_, count| *count > 0);
    }
}

#[cfg(unix)]
fn key_of(path: &Path) -> Option<FileKey> {
    use std::os::unix::fs::MetadataExt;
    fs::metadata(path).ok().filter(fs::Metadata::is_file).map(|found| (found.dev(), found.ino()))
}

#[cfg(not(unix))]
fn key_of(path: &Path) -> Option<FileKey> {
    fs::canonicalize(path).ok().filter(|path| path.is_file())
}

/// Requires that a file may be written at `path` and replace a file there. All code that writes files calls this.
///
/// # Errors
/// [`io::ErrorKind::InvalidInput`] for a file that a command in this process has protected, under any of its names, for a symbolic
/// link, and for anything that is not a regular file.
pub fn require_replaceable(path: &Path) -> io::Result<()> {
    let refuse = |reason: String| Err(io::Error::new(io::ErrorKind::InvalidInput, reason));
    let protected = PROTECTED.lock().unwrap_or_else(PoisonError::into_inner);
    if key_of(path).is_some_and(|key| protected.contains_key(&key)) {
        return refuse(
            "it is read as an input, or holds another output of this command, which would be overwritten; expected another name"
                .to_owned(),
        );
    }
    match fs::symlink_metadata(path) {
        Ok(found) if found.is_symlink() => {
            let target = fs::read_link(path).unwrap_or_default();
            refuse(format!(
                "it is a link to {}; expected the name of that file, a new name, or a regular file",
                target.display()
            ))
        }
        Ok(found) if !found.is_file() => {
            refuse("it exists and is not a regular file; expected a regular file or a new name".to_owned())
        }
        _ => Ok(()),
    }
}
