//! Access to files and folders: bounded and interrupted reads, offsets, disk space, identity.

use std::fs::{self, File, Metadata};
use std::io::{self, Read};
use std::path::{Component, Path, PathBuf};

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

/// Reads a text of at most `bytes_max` bytes, with bounded memory even for an endless input such as a device.
///
/// # Errors
/// The system's error; [`io::ErrorKind::FileTooLarge`] for a longer text; [`io::ErrorKind::InvalidData`] if it is not UTF-8.
pub fn read_text(path: &Path, bytes_max: u64) -> io::Result<String> {
    let bytes = read_bounded(File::open(path)?, bytes_max)?;
    String::from_utf8(bytes).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
}

/// Reads a file of at most `bytes_max` bytes that is read several times in a run, and so is no pipe or device.
///
/// # Errors
/// As [`open_file`]; [`io::ErrorKind::FileTooLarge`] for a longer file.
pub fn read_file(path: &Path, bytes_max: u64) -> io::Result<Vec<u8>> {
    read_bounded(open_file(path)?, bytes_max)
}

/// Opens a file for reading. A pipe would be waited for, and a device may be endless.
///
/// # Errors
/// The system's error; [`io::ErrorKind::InvalidInput`] for a folder, a pipe or a device.
pub fn open_file(path: &Path) -> io::Result<File> {
    if fs::metadata(path)?.is_file() {
        return File::open(path);
    }
    Err(io::Error::new(
        io::ErrorKind::InvalidInput,
        "not a regular file, but a folder, a pipe or a device; expected a file",
    ))
}

fn read_bounded(source: impl Read, bytes_max: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    source.take(bytes_max.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > bytes_max {
        let reason = format!("it is too long; expected at most {bytes_max} bytes");
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, reason));
    }
    Ok(bytes)
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

#[cfg(unix)]
pub(super) fn is_same(a: &Metadata, b: &Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    (a.dev(), a.ino()) == (b.dev(), b.ino())
}

/// Whether both describe the same file or folder; unknown on this system.
#[cfg(not(unix))]
pub(super) fn is_same(_: &Metadata, _: &Metadata) -> bool {
    true
}

/// Whether two paths are names of one place: the same name in the same folder, by whatever way.
pub fn is_same_name(one: &Path, other: &Path) -> bool {
    let place = |path: &Path| {
        let folder = folder_of(path).unwrap_or(Path::new("."));
        let folder = fs::canonicalize(folder).or_else(|_| normalized(folder)).ok()?;
        Some(folder.join(path.file_name()?))
    };
    place(one).is_some_and(|found| place(other) == Some(found))
}

/// The absolute path of a folder, of which a part may not exist, without `..`.
fn normalized(folder: &Path) -> io::Result<PathBuf> {
    let mut whole = PathBuf::new();
    for part in std::path::absolute(folder)?.components() {
        match part {
            Component::ParentDir => _ = whole.pop(),
            part => whole.push(part),
        }
    }
    Ok(fs::canonicalize(&whole).unwrap_or(whole))
}

/// The folder in `path`; `None` for a bare file name.
pub(super) fn folder_of(path: &Path) -> Option<&Path> {
    path.parent().filter(|folder| !folder.as_os_str().is_empty())
}
