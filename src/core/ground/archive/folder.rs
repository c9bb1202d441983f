//! The folder of an archive, with numbered checkpoints of which the newest two are kept. With disk space for three, both stay
//! until the next is complete; space for two is enough.
//!
//! Ranks of a job share a folder. Each writes its part of every checkpoint at the same place of the stream without waiting for the
//! others. A checkpoint is complete once all its parts exist, and removed once there are two newer ones.

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

const KEPT: usize = 2;

/// A folder that one process, or one job of ranks, uses at a time.
#[derive(Debug)]
pub(in crate::ground) struct StateFolder {
    path: PathBuf,
    /// The checkpoints in the folder, oldest first.
    checkpoints: Vec<CheckpointSet>,
    /// The segment files of each checkpoint that this process has read or written.
    segments: BTreeMap<u64, Vec<ArchiveSegment>>,
    /// Held by the first rank only.
    lock: Option<FolderLock>,
    ranks: Ranks,
}

impl StateFolder {
    /// Creates the folder if needed, and locks it.
    pub(in crate::ground) fn open(path: &Path) -> Result<Self, GroundError> {
        Self::open_with_ranks(path, &Ranks::single())
    }

    /// Like [`StateFolder::open`], together with the other ranks.
    pub(in crate::ground) fn open_with_ranks(path: &Path, ranks: &Ranks) -> Result<Self, GroundError> {
        let lock = ranks.is_first().then(|| FolderLock::acquire(path, LOCK, false)).transpose();
        let lock = lock.map_err(|error| match error.kind() {
            ErrorKind::ResourceBusy => GroundError::Locked { path: path.to_owned() },
            _ => GroundError::io(path, "lock the folder")(error),
        })?;
        Self::new(path, ranks, lock)
    }

    /// Opens a folder to read it. A folder on a read-only file system cannot change and needs no lock.
    pub(in crate::ground) fn open_to_read(path: &Path) -> Result<Self, GroundError> {
        match Self::open(path) {
            Err(GroundError::Io { source, .. }) if source.kind() == ErrorKind::ReadOnlyFilesystem => {
                Self::new(path, &Ranks::single(), None)
            }
            opened => opened,
        }
    }

    fn new(path: &Path, ranks: &Ranks, lock: Option<FolderLock>) -> Result<Self, GroundError> {
        if ranks.is_first() && lock.is_some() {
            let [_, unfinished] = numbered(path)?;
            // Parts left by an interrupted job must not be completed by parts of another.
            for set in unfinished {
                set.remove(path);
            }
        }
        // Ranks read the folder only after it is cleaned and locked.
        let _ = ranks.all(true);
        if !ranks.is_first() && !path.join(LOCK).is_file() {
            return Err(GroundError::NotShared { path: path.to_owned() });
        }
        let [checkpoints, _] = numbered(path)?;
        Ok(Self { path: path.to_owned(), checkpoints, segments: BTreeMap::new(), lock, ranks: ranks.clone() })
    }

    pub(in crate::ground) fn path(&self) -> &Path {
        &self.path
    }

    pub(in crate::ground) fn newest(&self) -> Option<u64> {
        self.checkpoints.last().map(|newest| newest.number)
    }

    pub(in crate::ground) fn numbers(&self) -> Vec<u64> {
        self.checkpoints.iter().map(|checkpoint| checkpoint.number).collect()
    }

    pub(in crate::ground) fn ranks(&self) -> &Ranks {
        &self.ranks
    }

    /// Reads the newest usable checkpoint with `read`, which gets the first of its files; `None` if there is no checkpoint.
    ///
    /// Also returns notes on newer checkpoints that are damaged; these are renamed if `renames_damaged`. A checkpoint
    /// that the system cannot read may be intact, so that this is an error and changes nothing.
    pub(in crate::ground) fn load<T>(
        &mut self,
        renames_damaged: bool,
        read: impl Fn(&Path) -> Result<T, GroundError>,
    ) -> Result<(Option<T>, Vec<String>), GroundError> {
        let mut bad: Vec<(CheckpointSet, GroundError)> = Vec::new();
        let mut found = None;
        for (index, checkpoint) in self.checkpoints.iter().enumerate().rev() {
            match read(&checkpoint.path(&self.path, 0)) {
                Ok(read) => {
                    found = Some((index, read));
                    break;
                }
                Err(error @ GroundError::Damaged { .. }) => bad.push((*checkpoint, error)),
                Err(error) => return Err(error),
            }
        }
        let used = found.as_ref().and_then(|(index, _)| self.checkpoints.get(*index)).copied();
        // Other ranks may still be reading files that are about to be renamed.
        let chosen = used.map_or([0; 2], |used| [used.number as i64, used.parts as i64]);
        if !self.ranks.have_equal(&chosen) {
            return Err(GroundError::NotShared { path: self.path.clone() });
        }
        let Some((index, read)) = found else {
            let checkpoints = bad.len();
            return match bad.into_iter().next() {
                None => Ok((None, Vec::new())),
                Some((_, newest)) => {
                    let (path, newest) = (self.path.clone(), Box::new(newest));
                    Err(GroundError::NoUsableCheckpoint { path, checkpoints, newest })
                }
            };
        };
        if renames_damaged && self.ranks.is_first() {
            bad.iter().try_for_each(|(checkpoint, _)| self.rename_damaged(*checkpoint))?;
        }
        // Ranks write only after the renaming.
        let _ = self.ranks.all(true);
        self.checkpoints.truncate(index + 1);
        let path = used.map_or_else(PathBuf::new, |used| used.path(&self.path, 0));
        Ok((Some(read), bad.iter().map(|(_, error)| note(error, &path)).collect()))
    }

    fn rename_damaged(&self, checkpoint: CheckpointSet) -> Result<(), GroundError> {
        for path in checkpoint.paths(&self.path) {
            let mut renamed = path.clone().into_os_string();
            renamed.push(".damaged");
            fs::rename(&path, renamed).map_err(GroundError::io(&path, "rename"))?;
        }
        Ok(())
    }

    pub(in crate::ground) fn next(&self) -> (PathBuf, u64) {
        (self.path.clone(), self.checkpoints.last().map_or(1, |newest| newest.number + 1))
    }

    /// Notes the segment files of the newest checkpoint.
    pub(in crate::ground) fn set_segments<'a>(&mut self, segments: impl Iterator<Item = &'a ArchiveSegment>) {
        if let Some(newest) = self.checkpoints.last() {
            self.segments.insert(newest.number, segments.copied().collect());
        }
    }

    /// Removes segment files that no checkpoint names, once the segments of all checkpoints are known. A file that cannot be removed
    /// only takes space. Ranks have no segments.
    pub(in crate::ground) fn remove_unnamed(&mut self) {
        self.segments
            .retain(|number, _| self.checkpoints.iter().any(|checkpoint| checkpoint.number == *number));
        if self.segments.len() < self.checkpoints.len()
            || self.require_same_folder().is_err()
            || self.ranks.is_distributed()
        {
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

    /// Writes a checkpoint, or this rank's part of one, atomically, and removes all but the newest two.
    ///
    /// A single process that has no disk space for a third deletes the older one first, after verifying the newer one.
    pub(in crate::ground) fn save(
        &mut self,
        mut write: impl FnMut(&mut AtomicFile, &Path) -> Result<(), GroundError>,
    ) -> Result<(), GroundError> {
        self.require_same_folder()?;
        let saved = self.save_in_folder(&mut write);
        // If the folder has been moved or deleted, report that as the cause.
        saved.or_else(|error| self.require_same_folder().and(Err(error)))
    }

    fn save_in_folder(
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
            Err(error)
                if is_out_of_room(&error) && self.checkpoints.len() > 1 && !self.ranks.is_distributed() =>
            {
                self.drop_older()?;
                self.write(&path, &mut write)?;
            }
            written => written?,
        }
        self.checkpoints.push(next);
        match self.ranks.is_distributed() {
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
        self.require_same_folder()?;
        file.finish().map_err(GroundError::io(path, "finish the file")).map(|_| ())
    }

    /// Removes all checkpoints except the newest. If the newest is damaged, this is an error and nothing is removed.
    pub(in crate::ground) fn drop_older(&mut self) -> Result<(), GroundError> {
        if let Some(newest) = self.checkpoints.last().copied() {
            newest.paths(&self.path).iter().try_for_each(|path| checkpoint::verify(path))?;
            for segment in self.segments.get(&newest.number).into_iter().flatten() {
                segment.verify(&self.path)?;
            }
            self.remove_all_but(1);
            self.remove_unnamed();
        }
        Ok(())
    }

    /// Checks that the path still leads to the locked folder, as another process may use a folder that replaced it.
    fn require_same_folder(&self) -> Result<(), GroundError> {
        match self.lock.as_ref().and_then(FolderLock::loss) {
            None => Ok(()),
            Some(what) => Err(GroundError::FolderLost { path: self.path.clone(), what }),
        }
    }

    /// Removes all checkpoints except the newest ones. A file that cannot be removed only takes space, and is tried again next time.
    fn remove_all_but(&mut self, kept: usize) {
        let oldest = self.checkpoints.len().saturating_sub(kept);
        let (path, mut index) = (&self.path, 0);
        self.checkpoints.retain(|checkpoint| {
            index += 1;
            index > oldest || !checkpoint.remove(path)
        });
    }

    /// Removes checkpoints that are older than two complete ones. Each rank removes its own part; the first also removes
    /// parts of other jobs. A file that cannot be removed only takes space.
    fn remove_superseded(&mut self) {
        let Ok([whole, _]) = numbered(&self.path) else { return };
        let Some(oldest) = whole.iter().rev().nth(KEPT - 1).map(|kept| kept.number) else { return };
        let share = self.ranks.share();
        let path = &self.path;
        self.checkpoints.retain(|checkpoint| {
            if checkpoint.number >= oldest {
                return true;
            }
            if checkpoint.parts == share.count {
                let _ = fs::remove_file(checkpoint.path(path, share.rank));
            } else if share.rank == 0 {
                checkpoint.remove(path);
            }
            false
        });
    }
}

const LOCK: &str = "lock";

/// The note on a damaged checkpoint in place of which an older one is used.
pub(in crate::ground) fn note(error: &GroundError, used: &Path) -> String {
    format!("{error}; resuming from the previous checkpoint, {}", used.display())
}

/// The first file of each checkpoint in a folder, oldest first.
pub(in crate::ground) fn checkpoints(folder: &Path) -> Result<Vec<PathBuf>, GroundError> {
    let [whole, _] = numbered(folder)?;
    Ok(whole.into_iter().map(|checkpoint| checkpoint.path(folder, 0)).collect())
}

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

    /// A file with the checksum of a checkpoint.
    fn sealed(content: &str) -> Vec<u8> {
        let mut bytes = format!("{content:>32}").into_bytes();
        let crc = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &bytes);
        bytes.extend(crc.to_le_bytes());
        bytes
    }

    fn save(folder: &mut StateFolder, content: &str) -> Result<(), GroundError> {
        folder.save(|file, path| file.write_all(&sealed(content)).map_err(GroundError::io(path, "write")))
    }

    /// Like [`save`], on a disk with space for this number of checkpoints.
    fn save_in(folder: &mut StateFolder, room: usize, content: &str) -> Result<(), GroundError> {
        let place = folder.path.clone();
        folder.save(|file, path| match checkpoints(&place)?.len() < room {
            true => file.write_all(&sealed(content)).map_err(GroundError::io(path, "write")),
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
            // Both stay if there is space for a third.
            let kept = if room == 3 { number.min(2) } else { 2 };
            assert_eq!(checkpoints(place.path()).unwrap().len() as u64, kept);
        }
        // Without space for a second, nothing is lost.
        assert!(is_out_of_room(&save_in(&mut folder, 1, "6").unwrap_err()));
        assert_eq!(names(place.path()), ["checkpoint-00000005.lunarray"]);
        save(&mut folder, "7").unwrap();
        assert_eq!(names(place.path()), [5, 6].map(file_name));
    }

    #[test]
    fn the_older_checkpoint_gives_way_only_to_one_that_holds() {
        let place = tempfile::tempdir().unwrap();
        let mut folder = StateFolder::open(place.path()).unwrap();
        ["1", "2"].iter().for_each(|content| save(&mut folder, content).unwrap());
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
        let place = tempfile::tempdir().unwrap();
        for name in
            ["notes.txt", "checkpoint-00000001.lunarray.damaged", "checkpoint-00000002.lunarray.partial"]
        {
            fs::write(place.path().join(name), b"x").unwrap();
        }
        assert!(StateFolder::open(place.path()).unwrap().checkpoints.is_empty());
    }
}
