//! Sessions of a ground with an archive: opened, merged, resumed; packets retracted, recalibrated, or read again from the raw archive.

mod open_archive;
mod recalibrate;
mod recovery;
mod retract;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use self::open_archive::OpenArchive;
pub use self::recalibrate::Recalibrated;
pub use self::retract::{RefusedPacket, Retracted};
use crate::frames::{AutoPower, Instrument};
use crate::ground::archive::checkpoint::{self, ArchiveHead};
use crate::ground::archive::folder::{StateFolder, checkpoints};
use crate::ground::archive::raw_archive::{SETTINGS, kept_settings, packets_folder, require_saved};
use crate::ground::archive::store::Archive;
use crate::ground::{Ground, GroundConfig, GroundError};
use crate::imaging::Snapshot;
use crate::ranks::Ranks;
use crate::runtime::{Outlet, Stage};
use crate::units::vector::Vec3;

/// The sums of all channels, and total powers with the positions of their daughters.
type SumsAndPowers = (Vec<Snapshot>, Vec<(AutoPower, Vec3)>);

impl Ground {
    /// A ground stage that resumes from the newest checkpoint in `folder`, or starts a new archive there.
    ///
    /// It writes a checkpoint after every `checkpoint_every` visibilities received, and at the end.
    ///
    /// # Errors
    /// A folder that cannot be used or is in use; an archive that was made with other settings, or without a usable
    /// checkpoint; calibration that cannot be read.
    pub fn open(folder: &Path, config: &GroundConfig, checkpoint_every: u64) -> Result<Self, GroundError> {
        Self::open_with_ranks(folder, config, checkpoint_every, &Ranks::single())
    }

    /// Like [`Ground::open`], as one of several ranks that open the folder together. Each writes its part of every checkpoint.
    /// The existing checkpoint may be from another number of ranks, or from a single process.
    ///
    /// # Errors
    /// As [`Ground::open`]; a folder that ranks do not share.
    #[doc(hidden)]
    pub fn open_with_ranks(
        folder: &Path,
        config: &GroundConfig,
        checkpoint_every: u64,
        ranks: &Ranks,
    ) -> Result<Self, GroundError> {
        let mut ground =
            OpenArchive::with_ranks(folder, config, true, ranks)?.resume(config, checkpoint_every)?;
        // Ranks apply the raw archive but do not write to it; only a stage that listens does.
        ground.recover(folder, !ranks.is_distributed())?;
        let latest_s = ground.archive.as_ref().and_then(|archive| archive.journal.latest_s());
        ground.show_state(latest_s);
        Ok(ground)
    }

    /// Opens a new archive in `folder` without applying its raw archive.
    fn open_anew(folder: &Path, config: &GroundConfig) -> Result<Self, GroundError> {
        OpenArchive::new(folder, config, true)?.resume(config, u64::MAX)
    }

    /// Merges the archives in `parts`, which stay unchanged, into a new one in the folder `into`.
    ///
    /// # Errors
    /// A folder that holds another archive, or is one of the parts; an archive given twice; archives of different instruments or
    /// settings, or with common visibilities.
    pub fn merge(into: &Path, parts: &[PathBuf], config: &GroundConfig) -> Result<Self, GroundError> {
        let mut whole: Option<OpenArchive> = None;
        let mut seen = BTreeSet::new();
        let is_into = into.canonicalize().ok();
        for path in parts {
            let real = path.canonicalize().map_err(GroundError::io(path, "find"))?;
            if is_into.as_ref() == Some(&real) {
                return Err(GroundError::MergeIntoPart { path: into.to_owned() });
            }
            if !seen.insert(real) {
                return Err(GroundError::GivenTwice { path: path.clone() });
            }
            if checkpoints(path)?.is_empty() {
                return Err(GroundError::without_checkpoint(path));
            }
            let part = OpenArchive::new(path, config, false)?;
            require_saved(path, part.folder.newest())?;
            match &mut whole {
                None => whole = Some(part),
                Some(whole) => whole.merge(part)?,
            }
        }
        let mut whole = whole.ok_or_else(|| GroundError::without_checkpoint(into))?;
        whole.move_to(StateFolder::open(into)?);
        let is_new = checkpoints(into)?.is_empty();
        let mut ground = whole.resume(config, u64::MAX)?;
        ground.advance(&mut Outlet::collect())?;
        match is_new {
            true => ground.checkpoint()?,
            // An earlier merge was interrupted after it had written its checkpoint.
            false if ground.is_written()? => {}
            false => return Err(GroundError::Occupied { path: into.to_owned() }),
        }
        Ok(ground)
    }

    /// Whether a folder holds an archive: a checkpoint, or the raw archive of a session that was killed before its first.
    ///
    /// # Errors
    /// A folder that cannot be read.
    #[doc(hidden)]
    pub fn is_state(folder: &Path) -> Result<bool, GroundError> {
        Ok(folder.is_dir()
            && (!checkpoints(folder)?.is_empty() || packets_folder(folder).join(SETTINGS).is_file()))
    }

    /// Keys and values of the settings on which the sums of an archive depend, from its newest usable checkpoint or its raw
    /// archive.
    ///
    /// # Errors
    /// A folder without a usable checkpoint, or in use.
    #[doc(hidden)]
    pub fn settings_in(folder: &Path) -> Result<Vec<(String, String)>, GroundError> {
        let of_checkpoint = match checkpoints(folder)?.is_empty() {
            true => Err(GroundError::without_checkpoint(folder)),
            false => StateFolder::open_to_read(folder)?.load(false, settings_at),
        };
        match of_checkpoint {
            Ok((Some(found), _)) => Ok(found),
            Ok((None, _)) => Err(GroundError::without_checkpoint(folder)),
            // The stage was killed before its first checkpoint, or the checkpoint is of another version.
            Err(error @ GroundError::Locked { .. }) => Err(error),
            Err(error) => kept_settings(folder).ok_or(error),
        }
    }

    /// The instrument of an archive, whether each channel has sums, and whether there are total powers, from its newest usable checkpoint;
    /// `None` if that has received no description of it.
    ///
    /// # Errors
    /// A folder without a usable checkpoint, or in use.
    #[doc(hidden)]
    pub fn channels_in(folder: &Path) -> Result<Option<(Instrument, Vec<bool>, bool)>, GroundError> {
        let of_head = |path: &Path| {
            head_at(path, |head| {
                let instrument = head.collector.instrument()?.clone();
                let has_powers = !head.autos.list(&instrument).is_empty();
                Some((instrument, head.accumulator.has_sums().to_vec(), has_powers))
            })
        };
        let (found, _) = StateFolder::open_to_read(folder)?.load(false, of_head)?;
        found.ok_or_else(|| GroundError::without_checkpoint(folder))
    }

    /// Like [`Ground::settings_in`], without a lock, for ranks before they open the folder together.
    ///
    /// # Errors
    /// A folder without a usable checkpoint.
    #[doc(hidden)]
    pub fn settings_for_ranks(folder: &Path) -> Result<Vec<(String, String)>, GroundError> {
        for path in checkpoints(folder)?.iter().rev() {
            match settings_at(path) {
                Err(GroundError::Damaged { .. }) => {}
                found => return found,
            }
        }
        Err(GroundError::without_checkpoint(folder))
    }

    /// The sums of an archive including its held packets, as at the end of a session. The archive stays unchanged.
    ///
    /// # Errors
    /// As [`Ground::open`]; a folder without a checkpoint.
    #[doc(hidden)]
    pub fn sums_in(folder: &Path, config: &GroundConfig) -> Result<Vec<Snapshot>, GroundError> {
        Ok(Self::sums_and_powers_in(folder, config)?.0)
    }

    /// The sums as of [`Ground::sums_in`], and the daughters' total powers with their positions where the ephemeris has them.
    ///
    /// # Errors
    /// As [`Ground::sums_in`].
    #[doc(hidden)]
    pub fn sums_and_powers_in(folder: &Path, config: &GroundConfig) -> Result<SumsAndPowers, GroundError> {
        if checkpoints(folder)?.is_empty() {
            return Err(GroundError::without_checkpoint(folder));
        }
        let mut ground = OpenArchive::new(folder, config, false)?.resume(config, u64::MAX)?;
        ground.recover(folder, false)?;
        let mut out = Outlet::collect();
        ground.advance(&mut out)?;
        ground.flush(&mut out)?;
        ground.accumulator.finish(&mut out)?;
        Ok((out.into_vec(), ground.placed_autos()))
    }

    /// Number of packets of visibilities in the archive.
    #[must_use]
    #[doc(hidden)]
    pub fn packets(&self) -> usize {
        self.archive.as_ref().map_or(0, |archive| archive.journal.packets())
    }

    /// Notes on checkpoints that could not be used.
    #[doc(hidden)]
    pub fn notes(&self) -> impl Iterator<Item = &str> {
        self.archive.iter().flat_map(Archive::notes)
    }
}

fn settings_at(path: &Path) -> Result<Vec<(String, String)>, GroundError> {
    head_at(path, |head| head.settings)
}

fn head_at<T>(path: &Path, choose: impl FnOnce(ArchiveHead) -> T) -> Result<T, GroundError> {
    checkpoint::read(path, |head, sums| {
        std::io::copy(sums, &mut std::io::sink()).map_err(GroundError::io(path, "read"))?;
        Ok(choose(head))
    })
}
