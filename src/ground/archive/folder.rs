//! The folder of an archive: numbered checkpoints, of which the newest two are kept. Room for three lets both stay until
//! another is whole; room for two is enough.

use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use super::checkpoint;
use crate::accumulation::harmonic::HeldSegment;
use crate::files::{AtomicFile, FolderLock, IfUnfinished, read_folder};
use crate::ground::GroundError;

const PREFIX: &str = "checkpoint-";
const SUFFIX: &str = ".lunarray";
/// Greatest number of a checkpoint, which no state that counts from 1 reaches.
const NUMBER_MAX: u64 = u64::MAX / 2;

/// A folder that one process uses at a time.
#[derive(Debug)]
pub(super) struct StateFolder {
    path: PathBuf,
    /// Numbers of its checkpoints, oldest first.
    numbers: Vec<u64>,
    /// The segments that checkpoints name, of those checkpoints that this process has read or written.
    segments: BTreeMap<u64, Vec<HeldSegment>>,
    lock: FolderLock,
}

impl StateFolder {
    /// Creates the folder if needed, and locks it.
    pub(super) fn open(path: &Path) -> Result<Self, GroundError> {
        let lock = FolderLock::acquire(path, "lock", false).map_err(|error| match error.kind() {
            ErrorKind::ResourceBusy => GroundError::Locked { path: path.to_owned() },
            _ => GroundError::io(path, "lock the folder")(error),
        })?;
        Ok(Self { path: path.to_owned(), numbers: numbers(path)?, segments: BTreeMap::new(), lock })
    }

    /// The newest checkpoint that holds, read by `read`, or `None` if there is no checkpoint; and notes on newer ones that
    /// are damaged, which are renamed if `sets_aside`.
    ///
    /// A checkpoint that the system does not let us read may well hold: that is an error, and changes nothing.
    pub(super) fn load<T>(
        &mut self,
        sets_aside: bool,
        read: impl Fn(&Path) -> Result<T, GroundError>,
    ) -> Result<(Option<T>, Vec<String>), GroundError> {
        let mut bad: Vec<(PathBuf, GroundError)> = Vec::new();
        for (index, &number) in self.numbers.iter().enumerate().rev() {
            let path = self.name(number);
            match read(&path) {
                Ok(found) => {
                    for (path, _) in bad.iter().filter(|_| sets_aside) {
                        let mut aside = path.clone().into_os_string();
                        aside.push(".damaged");
                        fs::rename(path, aside).map_err(GroundError::io(path, "rename"))?;
                    }
                    self.numbers.truncate(index + 1);
                    return Ok((Some(found), bad.iter().map(|(_, error)| note(error, &path)).collect()));
                }
                Err(error @ GroundError::Damaged { .. }) => bad.push((path, error)),
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

    /// Where the next checkpoint will be, and its number.
    pub(super) fn next(&self) -> (PathBuf, u64) {
        (self.path.clone(), self.numbers.last().map_or(1, |newest| newest + 1))
    }

    /// Says which segments the newest checkpoint names. Those that none names are removed, once it is known of all.
    pub(super) fn names<'a>(&mut self, segments: impl Iterator<Item = &'a HeldSegment>) {
        if let Some(&newest) = self.numbers.last() {
            self.segments.insert(newest, segments.copied().collect());
        }
        self.remove_unnamed();
    }

    /// Removes segments that no checkpoint names: of older ones, or of one that was never finished. One that stays takes room and does
    /// no harm.
    fn remove_unnamed(&mut self) {
        self.segments.retain(|number, _| self.numbers.contains(number));
        if self.segments.len() < self.numbers.len() {
            return;
        }
        let named = || self.segments.values().flatten().map(HeldSegment::file_name);
        for entry in read_folder(&self.path).into_iter().flatten().flatten() {
            let name = entry.file_name();
            let name = name.to_string_lossy();
            if HeldSegment::is_name(&name) && !named().any(|other| other == name) && self.lock.lost().is_none() {
                let _ = fs::remove_file(entry.path());
            }
        }
    }

    /// Writes a checkpoint, whole or not at all, and removes all but the newest two. If there is no room for a third, the
    /// older of the two gives way, once the newer one has been found to hold.
    pub(super) fn save(
        &mut self,
        mut write: impl FnMut(&mut AtomicFile, &Path) -> Result<(), GroundError>,
    ) -> Result<(), GroundError> {
        self.check_place()?;
        let saved = self.save_here(&mut write);
        // What fails because the folder has gone is to be told as that.
        saved.or_else(|error| self.check_place().and(Err(error)))
    }

    fn save_here(
        &mut self,
        mut write: impl FnMut(&mut AtomicFile, &Path) -> Result<(), GroundError>,
    ) -> Result<(), GroundError> {
        let (_, number) = self.next();
        let path = self.name(number);
        if number > NUMBER_MAX {
            return Err(GroundError::CheckpointName { path: self.name(NUMBER_MAX) });
        }
        match self.write(&path, &mut write) {
            Err(error) if is_out_of_room(&error) && self.numbers.len() > 1 => {
                self.drop_older()?;
                self.write(&path, &mut write)?;
            }
            written => written?,
        }
        self.numbers.push(number);
        self.remove_all_but(2);
        Ok(())
    }

    fn write(
        &self,
        path: &Path,
        write: &mut impl FnMut(&mut AtomicFile, &Path) -> Result<(), GroundError>,
    ) -> Result<(), GroundError> {
        let file = AtomicFile::create(path, IfUnfinished::Remove);
        let mut file = file.map_err(GroundError::io(path, "create the file"))?;
        write(&mut file, path)?;
        self.check_place()?;
        file.finish().map_err(GroundError::io(path, "finish the file")).map(|_| ())
    }

    /// Removes all checkpoints but the newest. That has to hold: otherwise an error, and nothing is removed.
    pub(super) fn drop_older(&mut self) -> Result<(), GroundError> {
        if let Some(&newest) = self.numbers.last() {
            checkpoint::verify(&self.name(newest))?;
            for segment in self.segments.get(&newest).into_iter().flatten() {
                segment.verify(&self.path)?;
            }
            self.remove_all_but(1);
            self.remove_unnamed();
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

    /// Removes all checkpoints but the newest ones. One that stays takes room and does no harm: the next time again.
    fn remove_all_but(&mut self, most: usize) {
        let oldest = self.numbers.len().saturating_sub(most);
        let (path, mut index) = (&self.path, 0);
        self.numbers.retain(|&number| {
            index += 1;
            let removed = || fs::remove_file(name(path, number));
            index > oldest || removed().is_err_and(|error| error.kind() != ErrorKind::NotFound)
        });
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
    folder.join(file_name(number))
}

fn file_name(number: u64) -> String {
    format!("{PREFIX}{number:08}{SUFFIX}")
}

/// Numbers of the checkpoints, in order. A name that is like theirs and that none can have may hide one: it is refused.
fn numbers(folder: &Path) -> Result<Vec<u64>, GroundError> {
    let mut numbers = Vec::new();
    for entry in read_folder(folder).map_err(GroundError::io(folder, "read the folder"))? {
        let name = entry.map_err(GroundError::io(folder, "read the folder"))?.file_name();
        let text = name.to_string_lossy();
        let Some(digits) = text.strip_prefix(PREFIX).and_then(|text| text.strip_suffix(SUFFIX)) else {
            continue;
        };
        match digits.parse::<u64>() {
            Ok(number) if number <= NUMBER_MAX && file_name(number) == text => numbers.push(number),
            _ => return Err(GroundError::CheckpointName { path: folder.join(&name) }),
        }
    }
    numbers.sort_unstable();
    Ok(numbers)
}

/// Whether the disk or a quota is full.
fn is_out_of_room(error: &GroundError) -> bool {
    use ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    matches!(error, GroundError::Io { source, .. }
        if matches!(source.kind(), StorageFull | QuotaExceeded | FileTooLarge))
}

#[cfg(test)]
mod tests {
    use std::io::{self, Write};

    use super::*;

    fn full(path: &Path) -> GroundError {
        GroundError::io(path, "write")(io::Error::from(ErrorKind::StorageFull))
    }

    /// A checkpoint of no ground, whose checksum holds.
    fn sealed(text: &str) -> Vec<u8> {
        let mut bytes = format!("{text:>32}").into_bytes();
        let crc = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &bytes);
        bytes.extend(crc.to_le_bytes());
        bytes
    }

    fn save(folder: &mut StateFolder, text: &str) -> Result<(), GroundError> {
        folder.save(|file, path| file.write_all(&sealed(text)).map_err(GroundError::io(path, "write")))
    }

    /// As [`save`], on a disk with room for this number of checkpoints.
    fn save_in(folder: &mut StateFolder, room: usize, text: &str) -> Result<(), GroundError> {
        let place = folder.path.clone();
        folder.save(|file, path| match checkpoints(&place)?.len() < room {
            true => file.write_all(&sealed(text)).map_err(GroundError::io(path, "write")),
            false => Err(full(path)),
        })
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        let mut names: Vec<String> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.retain(|name| name != "lock");
        names.sort();
        names
    }

    #[test]
    fn room_for_two_checkpoints_is_enough() {
        let place = tempfile::tempdir().unwrap();
        let mut folder = StateFolder::open(place.path()).unwrap();
        for (number, room) in [(1, 3), (2, 3), (3, 3), (4, 2), (5, 2)] {
            save_in(&mut folder, room, &number.to_string()).unwrap();
            assert_eq!(fs::read(folder.name(number)).unwrap(), sealed(&number.to_string()));
            // Both stay where there is room for a third.
            let kept = if room == 3 { number.min(2) } else { 2 };
            assert_eq!(checkpoints(place.path()).unwrap().len() as u64, kept);
        }
        // Without room for a second, nothing is lost.
        assert!(is_out_of_room(&save_in(&mut folder, 1, "6").unwrap_err()));
        assert_eq!(names(place.path()), ["checkpoint-00000005.lunarray"]);
        save(&mut folder, "7").unwrap();
        assert_eq!(names(place.path()), [5, 6].map(file_name));
    }

    #[test]
    fn the_older_checkpoint_gives_way_only_to_one_that_holds() {
        let place = tempfile::tempdir().unwrap();
        let mut folder = StateFolder::open(place.path()).unwrap();
        ["1", "2"].iter().for_each(|text| save(&mut folder, text).unwrap());
        fs::write(folder.name(2), b"damaged, and more than twenty-four bytes").unwrap();
        assert!(matches!(save_in(&mut folder, 2, "3"), Err(GroundError::Damaged { .. })));
        assert_eq!(names(place.path()), [1, 2].map(file_name));
    }

    #[test]
    fn what_cannot_be_read_is_not_damaged() {
        let place = tempfile::tempdir().unwrap();
        let mut folder = StateFolder::open(place.path()).unwrap();
        for number in 1..3 {
            save(&mut folder, &number.to_string()).unwrap();
        }
        let before = names(place.path());
        for kind in [ErrorKind::PermissionDenied, ErrorKind::NotFound, ErrorKind::Other] {
            let refused = |path: &Path| Err(GroundError::io(path, "read")(io::Error::from(kind)));
            let loaded = folder.load::<()>(true, refused);
            assert!(matches!(loaded, Err(GroundError::Io { path, .. }) if path.ends_with(&before[1])));
            assert_eq!(names(place.path()), before);
        }
    }

    #[test]
    fn names_that_no_checkpoint_has_are_refused() {
        for name in [
            "checkpoint-18446744073709551615.lunarray",
            "checkpoint-18446744073709551616.lunarray",
            "checkpoint-7.lunarray",
            "checkpoint-+0000007.lunarray",
            "checkpoint-00000007 (copy).lunarray",
        ] {
            let place = tempfile::tempdir().unwrap();
            fs::write(place.path().join(name), sealed("")).unwrap();
            let error = StateFolder::open(place.path()).unwrap_err();
            assert!(
                matches!(&error, GroundError::CheckpointName { path } if path.ends_with(name)),
                "{error}"
            );
        }
        // Nothing follows the greatest number.
        let place = tempfile::tempdir().unwrap();
        fs::write(place.path().join(file_name(NUMBER_MAX)), sealed("")).unwrap();
        let mut folder = StateFolder::open(place.path()).unwrap();
        assert!(matches!(save(&mut folder, ""), Err(GroundError::CheckpointName { .. })));
        // Other files are nobody's business.
        let place = tempfile::tempdir().unwrap();
        for name in
            ["notes.txt", "checkpoint-00000001.lunarray.damaged", "checkpoint-00000002.lunarray.partial"]
        {
            fs::write(place.path().join(name), b"x").unwrap();
        }
        assert!(StateFolder::open(place.path()).unwrap().numbers.is_empty());
    }
}
