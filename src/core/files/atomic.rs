//! Files with a temporary name until they are complete.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs::{self, File, TryLockError};
use std::hash::{BuildHasher, RandomState};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use super::access::{folder_of, is_at, read_folder};
use super::protected::require_replaceable;

/// Number of bytes that are buffered before a write.
pub(super) const WRITE_BYTES: usize = 1 << 20;

const PARTIAL: &str = ".partial";

/// Maximum number of names that are tried for an unfinished file before the folder counts as unusable.
const NAMES_MAX: usize = 100;

/// Interval between retries while another writer, which began at the same time, has the name.
const RIVAL_POLL: Duration = Duration::from_millis(20);

const RIVAL_POLLS_MAX: usize = 50;

/// Files that this process is writing.
static UNFINISHED: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// Removes the files that this process is writing, before a signal ends it.
pub fn remove_unfinished() {
    for path in &*UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner) {
        let _ = fs::remove_file(path);
    }
}

/// What happens to a file that is dropped before it is finished.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IfUnfinished {
    /// The file is removed.
    Remove,
    /// The file remains as `NAME.partial`, unless it is empty.
    Keep,
}

/// A file with a temporary name until [`AtomicFile::finish`] has put all of it on disk, gives it its final name and thereby
/// replaces an older file.
///
/// The temporary name `.NAME.PROCESS-NUMBER.partial` is new and unpredictable, and the file is locked. A second writer of the
/// same name is refused, and unfinished files without a writer are removed.
#[derive(Debug)]
pub struct AtomicFile {
    path: PathBuf,
    partial_path: PathBuf,
    /// The open file; `None` once it is finished.
    file: Option<File>,
    unfinished: IfUnfinished,
    pending: Vec<u8>,
    written: u64,
}

impl AtomicFile {
    /// Creates the file, and its folder if necessary.
    ///
    /// # Errors
    /// The errors of [`require_replaceable`] and of the system; [`io::ErrorKind::ResourceBusy`] if another process, or this one,
    /// is writing the file.
    pub fn create(path: &Path, unfinished: IfUnfinished) -> io::Result<Self> {
        require_replaceable(path)?;
        if let Some(folder) = folder_of(path) {
            fs::create_dir_all(folder)?;
        }
        let (partial_path, file) = create_partial(path)?;
        UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner).insert(partial_path.clone());
        let partial = Self {
            path: path.to_owned(),
            partial_path,
            file: Some(file),
            unfinished,
            pending: Vec::new(),
            written: 0,
        };
        // On an error from here on, `drop` removes the empty file.
        for _ in 0..RIVAL_POLLS_MAX {
            let Some(rival) = partial.rival() else { return Ok(partial) };
            // Of two writers that began at the same time, the one whose temporary name sorts first continues.
            if rival < partial.partial_path {
                return Err(busy(&rival));
            }
            std::thread::sleep(RIVAL_POLL);
        }
        match partial.rival() {
            None => Ok(partial),
            Some(rival) => Err(busy(&rival)),
        }
    }

    /// Number of bytes written.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.written + self.pending.len() as u64
    }

    /// Flushes the file to disk and gives it its name; returns its length, bytes.
    ///
    /// # Errors
    /// The system's error; the file is then unfinished.
    pub fn finish(mut self) -> io::Result<u64> {
        self.flush()?;
        if let Some(file) = &self.file {
            file.sync_all()?;
        }
        fs::rename(&self.partial_path, &self.path)?;
        self.file = None;
        // The rename is durable once the folder is synchronised.
        File::open(folder_of(&self.path).unwrap_or(Path::new(".")))?.sync_all()?;
        Ok(self.written)
    }

    /// The first unfinished file of the same name that another writer has locked. Removes unfinished files without a writer.
    fn rival(&self) -> Option<PathBuf> {
        let name = self.path.file_name().map(|name| name.as_encoded_bytes());
        let is_other = |path: &PathBuf| *path != self.partial_path && finished_name(path) == name;
        let unfinished = unfinished_files(&self.path.with_file_name("")).into_iter().filter(is_other);
        // A writer that failed leaves `NAME.partial`.
        unfinished.chain([self.kept_path()]).filter_map(|path| remove_stale(&path)).min()
    }

    fn kept_path(&self) -> PathBuf {
        let mut kept = self.path.clone().into_os_string();
        kept.push(PARTIAL);
        kept.into()
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
        UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.partial_path);
        if self.file.is_none() {
            return;
        }
        // Errors are ignored here, as the error that stopped the writing is reported.
        if self.unfinished == IfUnfinished::Remove || self.bytes() == 0 {
            let _ = fs::remove_file(&self.partial_path);
            return;
        }
        let _ = self.flush();
        let _ = fs::rename(&self.partial_path, self.kept_path());
    }
}

/// Writes a complete file atomically.
///
/// # Errors
/// The system's error.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = AtomicFile::create(path, IfUnfinished::Remove)?;
    file.write_all(bytes)?;
    file.finish().map(|_| ())
}

/// Opens a file that other processes can follow as it grows. It immediately replaces an older file; a pipe or terminal is
/// written to directly.
///
/// # Errors
/// The errors of [`AtomicFile::create`]; the folder does not exist.
pub fn growing_file(path: &Path) -> io::Result<File> {
    if fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
        return File::options().write(true).open(path);
    }
    require_replaceable(path)?;
    let (partial_path, file) = create_partial(path)?;
    if let Err(error) = fs::rename(&partial_path, path) {
        let _ = fs::remove_file(&partial_path);
        return Err(error);
    }
    Ok(file)
}

/// Creates a file without a name on the disk of a folder. The system deletes it once it is closed, however the process ends.
///
/// # Errors
/// The system's error.
pub fn nameless_file(folder: &Path) -> io::Result<File> {
    fs::create_dir_all(folder)?;
    let (path, _lock) = create_partial(&folder.join("nameless"))?;
    let file = File::options().read(true).write(true).open(&path);
    fs::remove_file(&path)?;
    file
}

/// Creates a locked file with a temporary name for the content of `path`, in its folder.
fn create_partial(path: &Path) -> io::Result<(PathBuf, File)> {
    let name = path.file_name().ok_or(io::ErrorKind::InvalidFilename)?;
    for _ in 0..NAMES_MAX {
        let mut unique = OsString::from(".");
        unique.push(name);
        // The system seeds the hash, so the number is unpredictable.
        let number = RandomState::new().hash_one(());
        unique.push(format!(".{}-{number:016x}{PARTIAL}", std::process::id()));
        let unique = path.with_file_name(unique);
        // O_CREAT | O_EXCL: fails if the name exists, and never follows a symbolic link.
        let file = match File::options().write(true).create_new(true).open(&unique) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => continue,
            other => other?,
        };
        match file.try_lock() {
            // Before the lock, another writer may have removed it as a file without a writer.
            Ok(()) if is_at(&file, &unique) => return Ok((unique, file)),
            Ok(()) | Err(TryLockError::WouldBlock) => {}
            Err(TryLockError::Error(error)) => {
                let _ = fs::remove_file(&unique);
                return Err(error);
            }
        }
    }
    Err(io::ErrorKind::ResourceBusy.into())
}

fn busy(rival: &Path) -> io::Error {
    let reason = format!("another process is writing it, as {}; expected one writer", rival.display());
    io::Error::new(io::ErrorKind::ResourceBusy, reason)
}

/// Removes an unfinished file without a writer; returns its path if it has one. Ignores anything except regular files.
pub(super) fn remove_stale(path: &Path) -> Option<PathBuf> {
    if !fs::symlink_metadata(path).is_ok_and(|found| found.is_file()) {
        return None;
    }
    let file = File::options().read(true).write(true).open(path).ok()?;
    match file.try_lock() {
        Ok(()) if is_at(&file, path) => {
            // A file that cannot be removed does no harm.
            let _ = fs::remove_file(path);
            None
        }
        Err(TryLockError::WouldBlock) => Some(path.to_owned()),
        Ok(()) | Err(TryLockError::Error(_)) => None,
    }
}

/// Paths of the files in a folder that are named as unfinished files; none if the folder cannot be read. An empty path means
/// the working directory.
pub(super) fn unfinished_files(folder: &Path) -> Vec<PathBuf> {
    let here = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let names = read_folder(here).into_iter().flatten().flatten().map(|entry| entry.file_name());
    let unfinished = names.filter(|name| finished_name(Path::new(name)).is_some());
    unfinished.map(|name| folder.join(name)).collect()
}

/// The final name NAME of an unfinished file `.NAME.PROCESS-NUMBER.partial`; `None` for another form.
fn finished_name(path: &Path) -> Option<&[u8]> {
    let name = path.file_name()?.as_encoded_bytes();
    let name = name.strip_prefix(b".")?.strip_suffix(PARTIAL.as_bytes())?;
    let (name, number) = name.split_at_checked(name.len().checked_sub(17)?)?;
    let (name, process) = name.split_at(name.iter().rposition(|byte| *byte == b'.')?);
    let is_unique = number[0] == b'-'
        && number[1..].iter().all(u8::is_ascii_hexdigit)
        && process[1..].iter().all(u8::is_ascii_digit);
    is_unique.then_some(name)
}
