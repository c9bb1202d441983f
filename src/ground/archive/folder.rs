//! The folder of an archive: numbered checkpoints; the newest two are kept. Room for three lets both stay until
//! another is whole; room for two is enough.
//!
//! Ranks of a job share a folder. Each writes its part of every checkpoint at the same place of the stream, and nobody waits for the
//! others: a checkpoint counts once all its parts are there, and an older one goes once there are two newer ones.

use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use super::checkpoint;
use super::names::{CheckpointSet, NUMBER_MAX, numbered};
use crate::files::{AtomicFile, FolderLock, IfUnfinished, read_folder};
use crate::ground::GroundError;
use crate::imaging::anywhere::ArchiveSegment;
use crate::ranks::Ranks;

/// Checkpoints that are kept.
const KEPT: usize = 2;

/// A folder that one process, or one job of ranks, uses at a time.
#[derive(Debug)]
pub(super) struct StateFolder {
    path: PathBuf,
    /// Its checkpoints, oldest first.
    held: Vec<CheckpointSet>,
    /// The segments that checkpoints name, of those checkpoints that this process has read or written.
    segments: BTreeMap<u64, Vec<ArchiveSegment>>,
    /// Only the first rank has it.
    lock: Option<FolderLock>,
    ranks: Ranks,
}

impl StateFolder {
    /// Creates the folder if needed, and locks it.
    pub(super) fn open(path: &Path) -> Result<Self, GroundError> {
        Self::open_with_ranks(path, &Ranks::one())
    }

    /// As [`StateFolder::open`], together with the other ranks.
    pub(super) fn open_with_ranks(path: &Path, ranks: &Ranks) -> Result<Self, GroundError> {
        let lock = ranks.is_first().then(|| FolderLock::acquire(path, LOCK, false)).transpose();
        let lock = lock.map_err(|error| match error.kind() {
            ErrorKind::ResourceBusy => GroundError::Locked { path: path.to_owned() },
            _ => GroundError::io(path, "lock the folder")(error),
        })?;
        Self::of_locked(path, ranks, lock)
    }

    /// Opens a folder to read it. One on a read-only file system, which nobody can change, needs no lock.
    pub(super) fn open_to_read(path: &Path) -> Result<Self, GroundError> {
        match Self::open(path) {
            Err(GroundError::Io { source, .. }) if source.kind() == ErrorKind::ReadOnlyFilesystem => {
                Self::of_locked(path, &Ranks::one(), None)
            }
            opened => opened,
        }
    }

    fn of_locked(path: &Path, ranks: &Ranks, lock: Option<FolderLock>) -> Result<Self, GroundError> {
        if ranks.is_first() && lock.is_some() {
            let [_, unfinished] = numbered(path)?;
            // What a job left that was ended meanwhile must not become whole by parts of another.
            for set in unfinished {
                set.remove(path);
            }
        }
        // None of them looks before it is clean, and locked.
        let _ = ranks.all(true);
        if !ranks.is_first() && !path.join(LOCK).is_file() {
            return Err(GroundError::NotShared { path: path.to_owned() });
        }
        let [held, _] = numbered(path)?;
        Ok(Self { path: path.to_owned(), held, segments: BTreeMap::new(), lock, ranks: ranks.clone() })
    }

    /// Where it is.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Number of the newest checkpoint, and of all of them.
    pub(super) fn newest(&self) -> Option<u64> {
        self.held.last().map(|newest| newest.number)
    }

    pub(super) fn numbers(&self) -> Vec<u64> {
        self.held.iter().map(|held| held.number).collect()
    }

    /// The ranks that share it.
    pub(super) fn ranks(&self) -> &Ranks {
        &self.ranks
    }

    /// The newest usable checkpoint, read by `read`, or `None` if there is none; and notes on newer ones that
    /// are damaged, which are renamed if `sets_aside`. `read` gets the first of its files.
    ///
    /// A checkpoint that the system does not let us read may well hold: that is an error, and changes nothing.
    pub(super) fn load<T>(
        &mut self,
        sets_aside: bool,
        read: impl Fn(&Path) -> Result<T, GroundError>,
    ) -> Result<(Option<T>, Vec<String>), GroundError> {
        let mut bad: Vec<(CheckpointSet, GroundError)> = Vec::new();
        let mut found = None;
        for (index, checkpoint) in self.held.iter().enumerate().rev() {
            match read(&checkpoint.path(&self.path, 0)) {
                Ok(read) => {
                    found = Some((index, read));
                    break;
                }
                Err(error @ GroundError::Damaged { .. }) => bad.push((*checkpoint, error)),
                Err(error) => return Err(error),
            }
        }
        let used = found.as_ref().and_then(|(index, _)| self.held.get(*index)).copied();
        // Others may be reading what is to be renamed.
        let chosen = used.map_or([0; 2], |used| [used.number as i64, used.parts as i64]);
        if !self.ranks.agree(&chosen) {
            return Err(GroundError::NotShared { path: self.path.clone() });
        }
        let Some((index, read)) = found else {
            let checkpoints = bad.len();
            return match bad.into_iter().next() {
                None => Ok((None, Vec::new())),
                Some((_, newest)) => {
                    let (path, newest) = (self.path.clone(), Box::new(newest));
                    Err(GroundError::NoneHolds { path, checkpoints, newest })
                }
            };
        };
        if sets_aside && self.ranks.is_first() {
            bad.iter().try_for_each(|(checkpoint, _)| self.set_aside(*checkpoint))?;
        }
        // Nobody writes before that.
        let _ = self.ranks.all(true);
        self.held.truncate(index + 1);
        let path = used.map_or_else(PathBuf::new, |used| used.path(&self.path, 0));
        Ok((Some(read), bad.iter().map(|(_, error)| note(error, &path)).collect()))
    }

    fn set_aside(&self, checkpoint: CheckpointSet) -> Result<(), GroundError> {
        for path in checkpoint.paths(&self.path) {
            let mut aside = path.clone().into_os_string();
            aside.push(".damaged");
            fs::rename(&path, aside).map_err(GroundError::io(&path, "rename"))?;
        }
        Ok(())
    }

    /// Where the next checkpoint will be, and its number.
    pub(super) fn next(&self) -> (PathBuf, u64) {
        (self.path.clone(), self.held.last().map_or(1, |newest| newest.number + 1))
    }

    /// Says which segments the newest checkpoint names.
    pub(super) fn names<'a>(&mut self, segments: impl Iterator<Item = &'a ArchiveSegment>) {
        if let Some(newest) = self.held.last() {
            self.segments.insert(newest.number, segments.copied().collect());
        }
    }

    /// Removes segments that no checkpoint names, of older ones or of one that was never finished, once it is known what all of them
    /// name. One that stays takes room and does no harm. Ranks have none.
    pub(super) fn remove_unnamed(&mut self) {
        self.segments.retain(|number, _| self.held.iter().any(|held| held.number == *number));
        if self.segments.len() < self.held.len() || self.check_place().is_err() || self.ranks.are_many() {
            return;
        }
        let named = || self.segments.values().flatten().flat_map(ArchiveSegment::file_names);
        for entry in read_folder(&self.path).into_iter().flatten().flatten() {
            let name = entry.file_name();
            let name = name.to_string_lossy();
            if ArchiveSegment::is_name(&name) && !named().any(|other| other == name) {
                let _ = fs::remove_file(entry.path());
            }
        }
    }

    /// Writes a checkpoint, or this rank's part of one, whole or not at all, and removes all but the newest two. If there is no room
    /// for a third, the older of the two gives way, once the newer one has been found to hold; not to a part.
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
        let next = CheckpointSet { number, parts: self.ranks.share().count };
        let path = next.path(&self.path, self.ranks.share().rank);
        if number > NUMBER_MAX {
            let greatest = CheckpointSet { number: NUMBER_MAX, ..next };
            return Err(GroundError::CheckpointName { path: greatest.path(&self.path, 0) });
        }
        match self.write(&path, &mut write) {
            Err(error) if is_out_of_room(&error) && self.held.len() > 1 && !self.ranks.are_many() => {
                self.drop_older()?;
                self.write(&path, &mut write)?;
            }
            written => written?,
        }
        self.held.push(next);
        match self.ranks.are_many() {
            true => self.remove_superseded(),
            false => self.remove_all_but(KEPT),
        }
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

    /// Removes all checkpoints but the newest. If that is damaged, it is an error, and nothing is removed.
    pub(super) fn drop_older(&mut self) -> Result<(), GroundError> {
        if let Some(newest) = self.held.last().copied() {
            newest.paths(&self.path).iter().try_for_each(|path| checkpoint::verify(path))?;
            for segment in self.segments.get(&newest.number).into_iter().flatten() {
                segment.verify(&self.path)?;
            }
            self.remove_all_but(1);
            self.remove_unnamed();
        }
        Ok(())
    }

    /// Checks that the path still leads to the folder that was locked: another process may use the folder that is there now.
    fn check_place(&self) -> Result<(), GroundError> {
        match self.lock.as_ref().and_then(FolderLock::loss) {
            None => Ok(()),
            Some(what) => Err(GroundError::FolderLost { path: self.path.clone(), what }),
        }
    }

    /// Removes all checkpoints but the newest ones. One that stays takes room and does no harm: the next time again.
    fn remove_all_but(&mut self, most: usize) {
        let oldest = self.held.len().saturating_sub(most);
        let (path, mut index) = (&self.path, 0);
        self.held.retain(|checkpoint| {
            index += 1;
            index > oldest || !checkpoint.remove(path)
        });
    }

    /// Removes what all ranks have written two newer ones of: this rank its own part, the first one also those of other jobs. What
    /// stays takes room and does no harm.
    fn remove_superseded(&mut self) {
        let Ok([whole, _]) = numbered(&self.path) else { return };
        let Some(oldest) = whole.iter().rev().nth(KEPT - 1).map(|kept| kept.number) else { return };
        let share = self.ranks.share();
        let path = &self.path;
        self.held.retain(|held| {
            if held.number >= oldest {
                return true;
            }
            if held.parts == share.count {
                let _ = fs::remove_file(held.path(path, share.rank));
            } else if share.rank == 0 {
                held.remove(path);
            }
            false
        });
    }
}

/// Name of the lock of a folder.
const LOCK: &str = "lock";

/// A note on a checkpoint that cannot be used when an older one is.
pub(super) fn note(error: &GroundError, used: &Path) -> String {
    format!("{error}; resuming from the previous checkpoint, {}", used.display())
}

/// The checkpoints in a folder, oldest first: the first file of each.
pub(super) fn checkpoints(folder: &Path) -> Result<Vec<PathBuf>, GroundError> {
    let [whole, _] = numbered(folder)?;
    Ok(whole.into_iter().map(|checkpoint| checkpoint.path(folder, 0)).collect())
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

    fn file_name(number: u64) -> String {
        CheckpointSet { number, parts: 1 }.file_name(0)
    }

    fn name(folder: &StateFolder, number: u64) -> PathBuf {
        folder.path.join(file_name(number))
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
            assert_eq!(fs::read(name(&folder, number)).unwrap(), sealed(&number.to_string()));
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
        fs::write(name(&folder, 2), b"damaged, and more than twenty-four bytes").unwrap();
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
        assert!(StateFolder::open(place.path()).unwrap().held.is_empty());
    }
}
