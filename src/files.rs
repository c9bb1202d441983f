//! Atomic files: complete under their name or absent, and written by one process at a time. All code that writes files
//! uses this module.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::{self, File, Metadata, TryLockError};
use std::hash::{BuildHasher, RandomState};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// Number of bytes that are buffered before a write.
const WRITE_BYTES: usize = 1 << 20;

/// Suffix of unfinished files.
const PARTIAL: &str = ".partial";

/// Maximum number of names that are tried for an unfinished file before the folder counts as unusable.
const NAMES_MAX: usize = 100;

/// Interval between retries while another writer, which began at the same time, has the name.
const RIVAL_POLL: Duration = Duration::from_millis(20);
/// Maximum number of retries.
const RIVAL_POLLS_MAX: usize = 50;

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

    /// The path of the file if it remains unfinished.
    fn kept_path(&self) -> PathBuf {
        let mut kept = self.path.clone().into_os_string();
        kept.push(PARTIAL);
        kept.into()
    }
}

/// Protects the files that a command reads: this process does not replace them while this value exists.
#[derive(Debug, Default)]
pub struct ProtectedInputs(Vec<FileKey>);

/// Identity of a file, which is the same for all names that lead to it.
#[cfg(unix)]
type FileKey = (u64, u64);
#[cfg(not(unix))]
type FileKey = PathBuf;

/// The protected inputs, with the number of values that protect each.
static PROTECTED: Mutex<BTreeMap<FileKey, usize>> = Mutex::new(BTreeMap::new());

impl ProtectedInputs {
    /// Protects regular files; ignores all other paths, which fail when they are opened.
    pub fn of<P: AsRef<Path>>(paths: impl IntoIterator<Item = P>) -> Self {
        let keys: Vec<FileKey> = paths.into_iter().filter_map(|path| key_of(path.as_ref())).collect();
        let mut protected = PROTECTED.lock().unwrap_or_else(PoisonError::into_inner);
        keys.iter().for_each(|key| *protected.entry(*key).or_default() += 1);
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
    fs::metadata(path).ok().filter(Metadata::is_file).map(|found| (found.dev(), found.ino()))
}

#[cfg(not(unix))]
fn key_of(path: &Path) -> Option<FileKey> {
    fs::canonicalize(path).ok().filter(|path| path.is_file())
}

/// Requires that a file may be written at `path` and replace a file there. All code that writes files calls this.
///
/// # Errors
/// [`io::ErrorKind::InvalidInput`] for an input of a command in this process, under any of its names, for a symbolic link, and
/// for anything that is not a regular file.
pub fn require_replaceable(path: &Path) -> io::Result<()> {
    let refuse = |reason: String| Err(io::Error::new(io::ErrorKind::InvalidInput, reason));
    let protected = PROTECTED.lock().unwrap_or_else(PoisonError::into_inner);
    if key_of(path).is_some_and(|key| protected.contains_key(&key)) {
        return refuse(
            "it is read as an input, which would be overwritten; expected another name".to_owned(),
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
fn remove_stale(path: &Path) -> Option<PathBuf> {
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

/// The entries of a folder. Repeats interrupted calls, which the standard library does not do here.
///
/// # Errors
/// The folder cannot be read.
pub fn read_folder(folder: &Path) -> io::Result<fs::ReadDir> {
    loop {
        match fs::read_dir(folder) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            read => return read,
        }
    }
}

/// Paths of the files in a folder that are named as unfinished files; none if the folder cannot be read. An empty path means
/// the working directory.
fn unfinished_files(folder: &Path) -> Vec<PathBuf> {
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

/// Reads a text of at most `bytes_max` bytes, with bounded memory even for an endless input such as a device.
///
/// # Errors
/// The system's error; [`io::ErrorKind::FileTooLarge`] for a longer text; [`io::ErrorKind::InvalidData`] if it is not UTF-8.
pub fn read_text(path: &Path, bytes_max: u64) -> io::Result<String> {
    let mut bytes = Vec::new();
    File::open(path)?.take(bytes_max.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > bytes_max {
        let reason = format!("it is too long; expected at most {bytes_max} bytes");
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, reason));
    }
    String::from_utf8(bytes).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
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

/// Reads bytes at an offset of a file, which several threads may do at a time.
///
/// # Errors
/// The system's error; an error on systems without such a call.
pub fn read_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    #[cfg(unix)]
    return std::os::unix::fs::FileExt::read_exact_at(file, bytes, offset);
    #[cfg(not(unix))]
    return Err(io::Error::new(io::ErrorKind::Unsupported, format!("{file:?}: {} at {offset}", bytes.len())));
}

/// Writes bytes at an offset of a file, which several threads may do at a time.
///
/// # Errors
/// The system's error; an error on systems without such a call.
pub fn write_at(file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
    #[cfg(unix)]
    return std::os::unix::fs::FileExt::write_all_at(file, bytes, offset);
    #[cfg(not(unix))]
    return Err(io::Error::new(io::ErrorKind::Unsupported, format!("{file:?}: {} at {offset}", bytes.len())));
}

/// The lock of a folder that one process uses at a time: it locks a file in the folder.
///
/// The system releases the lock however the process ends.
#[derive(Debug)]
pub struct FolderLock {
    folder: PathBuf,
    lock_path: PathBuf,
    lock: File,
    /// Identity of the folder that was locked.
    locked: Metadata,
    removes_lock: bool,
    /// Whether the folder was created for the lock.
    is_new: bool,
}

impl FolderLock {
    /// Creates the folder if necessary and locks it with the file `name` in it. Removes unfinished files without a writer.
    ///
    /// With `removes_lock`, dropping the lock removes this file, and the folder if it is new and empty, so that a run that fails
    /// before its first product leaves nothing behind.
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
        if self.removes_lock && self.loss().is_none() {
            let _ = fs::remove_file(&self.lock_path);
            if self.is_new {
                // Fails if the folder is not empty.
                let _ = fs::remove_dir(&self.folder);
            }
        }
    }
}

/// Free space and size of the disk of a folder, bytes; `None` if the system does not report them.
#[must_use]
pub fn disk_space(folder: &Path) -> Option<[u64; 2]> {
    #[cfg(unix)]
    return rustix::fs::statvfs(folder).ok().map(|found| {
        let bytes = |blocks: u64| blocks.saturating_mul(found.f_frsize);
        [bytes(found.f_bavail), bytes(found.f_blocks)]
    });
    #[cfg(not(unix))]
    return folder.file_name().and(None);
}

/// Whether `path` leads to this open file.
pub fn is_at(file: &File, path: &Path) -> bool {
    let both = file.metadata().and_then(|open| Ok((open, fs::metadata(path)?)));
    both.is_ok_and(|(open, at_path)| is_same(&open, &at_path))
}

/// Whether both describe the same file or folder.
#[cfg(unix)]
fn is_same(a: &Metadata, b: &Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    (a.dev(), a.ino()) == (b.dev(), b.ino())
}

/// Whether both describe the same file or folder; unknown on this system.
#[cfg(not(unix))]
fn is_same(_: &Metadata, _: &Metadata) -> bool {
    true
}

/// The folder in `path`; `None` for a bare file name.
fn folder_of(path: &Path) -> Option<&Path> {
    path.parent().filter(|folder| !folder.as_os_str().is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        let mut names: Vec<String> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_has_its_name_once_it_is_finished() {
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
    fn an_unfinished_file_is_removed_or_kept() {
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
        // An empty file is not kept.
        drop(AtomicFile::create(&folder.path().join("empty"), IfUnfinished::Keep).unwrap());
        assert_eq!(names(folder.path()), ["Keep.partial"]);
    }

    #[test]
    fn a_second_writer_is_refused_and_leaves_the_first_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        let mut first = AtomicFile::create(&path, IfUnfinished::Keep).unwrap();
        first.write_all(b"first").unwrap();
        for _ in 0..3 {
            let refused = AtomicFile::create(&path, IfUnfinished::Keep).unwrap_err();
            assert_eq!(refused.kind(), io::ErrorKind::ResourceBusy);
            assert!(refused.to_string().contains("another process is writing it"), "{refused}");
        }
        assert_eq!(names(folder.path()).len(), 1);
        // Another name in the same folder is free.
        write_atomically(&folder.path().join("file2"), b"second").unwrap();
        first.finish().unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"first");
        write_atomically(&path, b"then").unwrap();
        assert_eq!(names(folder.path()), ["file", "file2"]);
    }

    #[test]
    fn of_several_simultaneous_writers_one_writes() {
        let folder = tempfile::tempdir().unwrap();
        for round in 0..10 {
            let path = folder.path().join(format!("file-{round}"));
            let barrier = std::sync::Barrier::new(6);
            let written: Vec<bool> = std::thread::scope(|scope| {
                let writers: Vec<_> = (0..6)
                    .map(|writer: u8| {
                        let (path, barrier) = (&path, &barrier);
                        scope.spawn(move || {
                            barrier.wait();
                            let file = AtomicFile::create(path, IfUnfinished::Remove);
                            // Each writer keeps its file until all have tried.
                            barrier.wait();
                            let written = file.and_then(|mut file| {
                                file.write_all(&[writer; 9])?;
                                file.finish()
                            });
                            written.is_ok()
                        })
                    })
                    .collect();
                writers.into_iter().map(|writer| writer.join().unwrap()).collect()
            });
            assert_eq!(written.iter().filter(|written| **written).count(), 1, "{written:?}");
        }
        assert_eq!(names(folder.path()).len(), 10);
    }

    #[test]
    fn unfinished_files_without_a_writer_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        let leftovers = [".file.77-0123456789abcdef.partial", "file.partial"];
        let others =
            [".other.77-0123456789abcdef.partial", ".file.partial", "other.partial", ".file.x-1.partial"];
        for name in leftovers.iter().chain(&others) {
            fs::write(folder.path().join(name), "left").unwrap();
        }
        write_atomically(&path, b"new").unwrap();
        let mut expected: Vec<&str> = others.iter().copied().chain(["file"]).collect();
        expected.sort_unstable();
        assert_eq!(names(folder.path()), expected);
        // A lock of the folder removes all its unfinished files.
        drop(FolderLock::acquire(folder.path(), ".lock", true).unwrap());
        expected.retain(|name| *name != others[0]);
        assert_eq!(names(folder.path()), expected);
    }

    #[cfg(unix)]
    #[test]
    fn planted_links_are_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let (path, victim) = (folder.path().join("file"), folder.path().join("victim"));
        fs::write(&victim, "precious").unwrap();
        for name in ["file.partial", ".file.1-0123456789abcdef.partial"] {
            std::os::unix::fs::symlink(&victim, folder.path().join(name)).unwrap();
        }
        let mut file = AtomicFile::create(&path, IfUnfinished::Keep).unwrap();
        file.write_all(b"mine").unwrap();
        drop(file);
        // The file has replaced the link.
        assert_eq!(fs::read(folder.path().join("file.partial")).unwrap(), b"mine");
        write_atomically(&path, b"whole").unwrap();
        assert_eq!(fs::read(&victim).unwrap(), b"precious");
        assert_eq!(fs::read(&path).unwrap(), b"whole");
    }

    #[cfg(unix)]
    #[test]
    fn inputs_and_links_are_not_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let place = |name: &str| folder.path().join(name);
        for name in ["input", "other"] {
            fs::write(place(name), name).unwrap();
        }
        fs::hard_link(place("input"), place("second-name")).unwrap();
        std::os::unix::fs::symlink(place("other"), place("link")).unwrap();
        std::os::unix::fs::symlink(place("nowhere"), place("dangling")).unwrap();
        let said = |name: &str| write_atomically(&place(name), b"new").unwrap_err().to_string();
        {
            let _inputs = ProtectedInputs::of([place("input"), place("missing")]);
            let _twice = ProtectedInputs::of([place("input")]);
            drop(ProtectedInputs::of([place("input")]));
            for name in ["input", "second-name"] {
                assert!(said(name).contains("read as an input"), "{}", said(name));
                assert!(growing_file(&place(name)).is_err());
            }
            write_atomically(&place("missing"), b"new").unwrap();
        }
        assert!(said("link").contains("is a link to") && said("dangling").contains("is a link to"));
        assert!(growing_file(&place("link")).is_err());
        assert_eq!(fs::read(place("input")).unwrap(), b"input");
        assert_eq!(fs::read(place("other")).unwrap(), b"other");
        // Once nobody reads it, it is a file as others.
        write_atomically(&place("second-name"), b"new").unwrap();
        assert_eq!(fs::read(place("input")).unwrap(), b"input");
    }

    #[cfg(unix)]
    #[test]
    fn what_never_ends_is_not_read() {
        assert_eq!(read_text(Path::new("/dev/zero"), 1000).unwrap_err().kind(), io::ErrorKind::FileTooLarge);
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), "text").unwrap();
        assert_eq!(read_text(file.path(), 4).unwrap(), "text");
        assert!(read_text(file.path(), 3).is_err());
    }

    #[test]
    fn a_growing_file_takes_the_place_of_the_older_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("events");
        fs::write(&path, "older").unwrap();
        let older = File::open(&path).unwrap();
        let mut file = growing_file(&path).unwrap();
        file.write_all(b"first\n").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"first\n");
        // Whoever has the older one open keeps it.
        assert_eq!(io::read_to_string(older).unwrap(), "older");
        assert_eq!(names(folder.path()), ["events"]);
    }

    #[test]
    fn a_folder_has_one_user_who_notices_its_loss() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("folder");
        let lock = FolderLock::acquire(&folder, ".lock", true).unwrap();
        let refused = FolderLock::acquire(&folder, ".lock", true).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::ResourceBusy);
        assert_eq!(lock.loss(), None);
        fs::remove_file(folder.join(".lock")).unwrap();
        assert!(lock.loss().unwrap().contains("lost its lock"));
        // The next one is not disturbed when the first lets go.
        let next = FolderLock::acquire(&folder, ".lock", true).unwrap();
        drop(lock);
        assert_eq!(next.loss(), None);
        fs::rename(&folder, place.path().join("elsewhere")).unwrap();
        assert!(next.loss().unwrap().contains("moved or removed"));
        fs::create_dir(&folder).unwrap();
        assert!(next.loss().unwrap().contains("replaced"));
        drop(next);
        let last = FolderLock::acquire(&folder, ".lock", true).unwrap();
        drop(last);
        assert!(names(&folder).is_empty());
    }
}
