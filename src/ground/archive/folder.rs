//! The folder of an archive: numbered checkpoints, of which the newest two are kept.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use crate::files::{AtomicFile, FolderLock, IfUnfinished};
use crate::ground::GroundError;

const PREFIX: &str = "checkpoint-";
const SUFFIX: &str = ".lunarray";

/// A folder that one process uses at a time.
#[derive(Debug)]
pub(super) struct StateFolder {
    path: PathBuf,
    /// Number of the newest checkpoint.
    newest: u64,
    lock: FolderLock,
}

impl StateFolder {
    /// Creates the folder if needed, and locks it.
    pub(super) fn open(path: &Path) -> Result<Self, GroundError> {
        let lock = FolderLock::acquire(path, "lock", false).map_err(|error| match error.kind() {
            ErrorKind::ResourceBusy => GroundError::Locked { path: path.to_owned() },
            _ => GroundError::io(path, "lock the folder")(error),
        })?;
        let mut folder = Self { path: path.to_owned(), newest: 0, lock };
        folder.newest = numbers(&folder.path)?.last().copied().unwrap_or(0);
        Ok(folder)
    }

    /// The newest checkpoint that `read` can read, or `None` if there is no checkpoint; and notes on newer ones that it
    /// cannot, which are renamed if `sets_aside`.
    pub(super) fn load<T>(
        &mut self,
        sets_aside: bool,
        read: impl Fn(&Path) -> Result<T, GroundError>,
    ) -> Result<(Option<T>, Vec<String>), GroundError> {
        let numbers = numbers(&self.path)?;
        let mut bad: Vec<(PathBuf, GroundError)> = Vec::new();
        for &number in numbers.iter().rev() {
            let path = self.name(number);
            match read(&path) {
                Ok(found) => {
                    self.newest = number;
                    for (path, _) in bad.iter().filter(|_| sets_aside) {
                        let mut aside = path.clone().into_os_string();
                        aside.push(".damaged");
                        fs::rename(path, aside).map_err(GroundError::io(path, "rename"))?;
                    }
                    let used = self.name(number);
                    return Ok((Some(found), bad.iter().map(|(_, error)| note(error, &used)).collect()));
                }
                Err(error @ (GroundError::Damaged { .. } | GroundError::Io { .. })) => {
                    bad.push((path, error))
                }
                Err(error) => return Err(error),
            }
        }
        let checkpoints = bad.len();
        match bad.into_iter().next() {
            None => Ok((None, Vec::new())),
            Some((_, newest)) => {
                let (path, newest) = (self.path.clone(), Box::new(newest));
                Err(GroundError::NoneHolds { path, checkpoints, newest })
            }
        }
    }

    /// Writes a checkpoint, whole or not at all, and removes all but the newest two.
    pub(super) fn save(
        &mut self,
        write: impl FnOnce(&mut AtomicFile, &Path) -> Result<(), GroundError>,
    ) -> Result<(), GroundError> {
        self.check_place()?;
        let saved = self.save_here(write);
        // What fails because the folder has gone is to be told as that.
        saved.or_else(|error| self.check_place().and(Err(error)))
    }

    fn save_here(
        &mut self,
        write: impl FnOnce(&mut AtomicFile, &Path) -> Result<(), GroundError>,
    ) -> Result<(), GroundError> {
        let path = self.name(self.newest + 1);
        let file = AtomicFile::create(&path, IfUnfinished::Remove);
        let mut file = file.map_err(GroundError::io(&path, "create the file"))?;
        write(&mut file, &path)?;
        self.check_place()?;
        file.finish().map_err(GroundError::io(&path, "finish the file"))?;
        self.newest += 1;
        for number in numbers(&self.path)?.into_iter().filter(|number| number + 1 < self.newest) {
            let old = self.name(number);
            fs::remove_file(&old).map_err(GroundError::io(&old, "remove the file"))?;
        }
        Ok(())
    }

    /// Checks that the path still leads to the folder that was locked: another process may use what is there now.
    fn check_place(&self) -> Result<(), GroundError> {
        match self.lock.lost() {
            None => Ok(()),
            Some(what) => Err(GroundError::FolderLost { path: self.path.clone(), what }),
        }
    }

    fn name(&self, number: u64) -> PathBuf {
        name(&self.path, number)
    }
}

/// A note on a checkpoint that cannot be used when an older one is.
pub(super) fn note(error: &GroundError, used: &Path) -> String {
    format!("{error}; resuming from the previous checkpoint, {}", used.display())
}

/// The checkpoints in a folder, oldest first.
pub(super) fn checkpoints(folder: &Path) -> Result<Vec<PathBuf>, GroundError> {
    Ok(numbers(folder)?.into_iter().map(|number| name(folder, number)).collect())
}

fn name(folder: &Path, number: u64) -> PathBuf {
    folder.join(format!("{PREFIX}{number:08}{SUFFIX}"))
}

/// Numbers of the checkpoints, in order.
fn numbers(folder: &Path) -> Result<Vec<u64>, GroundError> {
    let mut numbers = Vec::new();
    for entry in fs::read_dir(folder).map_err(GroundError::io(folder, "read the folder"))? {
        let name = entry.map_err(GroundError::io(folder, "read the folder"))?.file_name();
        let name = name.to_string_lossy();
        let number = name.strip_prefix(PREFIX).and_then(|name| name.strip_suffix(SUFFIX));
        numbers.extend(number.and_then(|number| number.parse::<u64>().ok()));
    }
    numbers.sort_unstable();
    Ok(numbers)
}
