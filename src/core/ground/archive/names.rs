//! File names of checkpoints, which consist of one file, or of one file per rank of a job.
//!
//! `checkpoint-00000007.lunarray` is a complete checkpoint; `checkpoint-00000007.2-of-4.lunarray` is the part of the second of four
//! ranks. A set is complete once all its parts exist. Every part has the whole head and the sums of its rank.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use crate::files::read_folder;
use crate::ground::GroundError;
use crate::ranks::RankShare;

const PREFIX: &str = "checkpoint-";
const SUFFIX: &str = ".lunarray";
pub(in crate::ground) const NUMBER_MAX: u64 = u64::MAX / 2;
const PARTS_MAX: usize = 1 << 20;

/// A checkpoint, which consists of one or more files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(in crate::ground) struct CheckpointSet {
    pub(in crate::ground) number: u64,
    pub(in crate::ground) parts: usize,
}

impl CheckpointSet {
    pub(in crate::ground) fn file_name(self, part: usize) -> String {
        let Self { number, parts } = self;
        match parts {
            1 => format!("{PREFIX}{number:08}{SUFFIX}"),
            _ => format!("{PREFIX}{number:08}.{}-of-{parts}{SUFFIX}", part + 1),
        }
    }

    pub(in crate::ground) fn path(self, folder: &Path, part: usize) -> PathBuf {
        folder.join(self.file_name(part))
    }

    pub(in crate::ground) fn paths(self, folder: &Path) -> Vec<PathBuf> {
        (0..self.parts).map(|part| self.path(folder, part)).collect()
    }

    /// Removes all files, and returns whether none is left.
    pub(in crate::ground) fn remove(self, folder: &Path) -> bool {
        let stays =
            |path: &PathBuf| fs::remove_file(path).is_err_and(|error| error.kind() != ErrorKind::NotFound);
        // `count` visits all files, even after a failure.
        self.paths(folder).iter().filter(|path| stays(path)).count() == 0
    }

    /// Parses a file name into the checkpoint and the part; `None` for other or invalid names.
    fn parse(text: &str) -> Option<(Self, usize)> {
        let name = inner(text)?;
        let (number, part) = name.split_once('.').unwrap_or((name, ""));
        let (part, parts) = match part.split_once("-of-") {
            Some((part, parts)) => (part.parse::<usize>().ok()?.checked_sub(1)?, parts.parse().ok()?),
            None => (0, 1),
        };
        let found = Self { number: number.parse().ok()?, parts };
        let is_valid = found.number <= NUMBER_MAX && part < parts && parts <= PARTS_MAX;
        (is_valid && found.file_name(part) == text).then_some((found, part))
    }
}

pub(in crate::ground) fn number_of(path: &Path) -> Option<u64> {
    let name = path.file_name()?.to_string_lossy().into_owned();
    CheckpointSet::parse(&name).map(|(found, _)| found.number)
}

/// The part of a checkpoint's file name with its number and part.
fn inner(text: &str) -> Option<&str> {
    text.strip_prefix(PREFIX)?.strip_suffix(SUFFIX)
}

/// All files of the checkpoint to which a file belongs, each with its share. A file with another name is a checkpoint by itself.
pub(in crate::ground) fn parts_with(path: &Path) -> Vec<(PathBuf, RankShare)> {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    match (CheckpointSet::parse(&name), path.parent()) {
        (Some((found, _)), Some(folder)) if found.parts > 1 => {
            let share = |rank| RankShare { rank, count: found.parts };
            found.paths(folder).into_iter().enumerate().map(|(rank, path)| (path, share(rank))).collect()
        }
        _ => vec![(path.to_owned(), RankShare::WHOLE)],
    }
}

/// The complete and the incomplete checkpoints in a folder, oldest first. An invalid checkpoint name is an error, as the file may be
/// a checkpoint.
pub(in crate::ground) fn numbered(folder: &Path) -> Result<[Vec<CheckpointSet>; 2], GroundError> {
    let mut found: BTreeMap<CheckpointSet, BTreeSet<usize>> = BTreeMap::new();
    for entry in read_folder(folder).map_err(GroundError::io(folder, "read the folder"))? {
        let name = entry.map_err(GroundError::io(folder, "read the folder"))?.file_name();
        let text = name.to_string_lossy();
        if inner(&text).is_none() {
            continue;
        }
        let Some((checkpoint, part)) = CheckpointSet::parse(&text) else {
            return Err(GroundError::CheckpointName { path: folder.join(&name) });
        };
        found.entry(checkpoint).or_default().insert(part);
    }
    let is_complete = |checkpoint: &CheckpointSet| found[checkpoint].len() == checkpoint.parts;
    let (complete, incomplete) = found.keys().partition(|checkpoint| is_complete(checkpoint));
    Ok([complete, incomplete])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_set_counts_once_all_of_its_parts_are_there() {
        let place = tempfile::tempdir().unwrap();
        let put = |name: &str| fs::write(place.path().join(name), b"x").unwrap();
        put("checkpoint-00000001.lunarray");
        put("checkpoint-00000002.2-of-3.lunarray");
        put("checkpoint-00000002.3-of-3.lunarray");
        let [one, set] = [(1, 1), (2, 3)].map(|(number, parts)| CheckpointSet { number, parts });
        assert_eq!(numbered(place.path()).unwrap(), [vec![one], vec![set]]);
        put("checkpoint-00000002.1-of-3.lunarray");
        assert_eq!(numbered(place.path()).unwrap(), [vec![one, set], vec![]]);
        let parts = parts_with(&set.path(place.path(), 0));
        assert_eq!(parts.len(), 3);
        assert_eq!(parts[2].1, RankShare { rank: 2, count: 3 });
        assert_eq!(parts_with(&one.path(place.path(), 0))[0].1, RankShare::WHOLE);
        assert!(set.remove(place.path()));
        assert_eq!(numbered(place.path()).unwrap(), [vec![one], vec![]]);
    }

    #[test]
    fn names_that_no_part_has_are_refused() {
        for name in ["0-of-2", "3-of-2", "1-of-1", "01-of-2", "1-of-", "x", "1-of-2.1-of-2"] {
            let place = tempfile::tempdir().unwrap();
            fs::write(place.path().join(format!("checkpoint-00000001.{name}.lunarray")), b"x").unwrap();
            let found = numbered(place.path());
            assert!(matches!(found, Err(GroundError::CheckpointName { .. })), "{name}");
        }
    }
}
