//! Files that are there whole or not at all.

use std::fs::{self, File};
use std::io::Write;
use std::path::Path;

use super::error::ProductsError;

/// Writes a file under another name in its folder, puts it on the disk, and gives it its name.
///
/// # Errors
/// A file that cannot be written.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), ProductsError> {
    let fail = |source| ProductsError::Write { path: path.to_owned(), source };
    let mut name = path.as_os_str().to_owned();
    name.push(".partial");
    let partial = Path::new(&name);
    let mut file = File::create(partial).map_err(fail)?;
    file.write_all(bytes).and_then(|()| file.sync_all()).map_err(fail)?;
    fs::rename(partial, path).map_err(fail)
}
