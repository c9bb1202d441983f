//! Applies packets of the raw archive that are newer than the checkpoint, and makes a state from a raw archive alone.

use std::path::{Path, PathBuf};

use super::folder::checkpoints;
use crate::downlink::transport::packet_archive::{
    ArchiveScan, PacketArchive, PacketName, read_archive, read_unsaved, unsaved_bytes,
};
use crate::files::write_atomically;
use crate::ground::{Ground, GroundConfig, GroundError};
use crate::runtime::{Outlet, Stage};

const PACKETS: &str = "archive";

pub(super) const SETTINGS: &str = "settings.json";

/// Default limit of a raw archive, bytes: 64 GiB, enough for four missions of 30 channels.
pub const ARCHIVE_BYTES_MAX: u64 = 1 << 36;

/// Path of the raw archive of a state.
#[must_use]
pub fn packets_folder(state: &Path) -> PathBuf {
    state.join(PACKETS)
}

impl Ground {
    /// Applies packets of the raw archive of `state`, if there is one, that the checkpoint lacks. If `continues_archive`, later
    /// packets are added to it.
    pub(super) fn recover(&mut self, state: &Path, continues_archive: bool) -> Result<(), GroundError> {
        let folder = packets_folder(state);
        if !folder.is_dir() {
            return Ok(());
        }
        let checkpoint = self.archive.as_ref().and_then(|archive| archive.folder.newest());
        // Opened first, so that no other process writes to it.
        let packets = continues_archive.then(|| PacketArchive::open(&folder, u64::MAX)).transpose()?;
        let reading = read_unsaved(&folder, checkpoint, |chunk| self.take_chunk(chunk))?;
        self.note_recovered(&folder, reading);
        if let Some(archive) = &mut self.archive {
            archive.packets = packets;
        }
        self.promises.begin(self.collector.bytes());
        Ok(())
    }

    /// Stores received packets in the raw archive from now on; returns `None` if there is no state.
    ///
    /// The raw archive is in the folder `elsewhere` if that is given. It has at most `bytes_max` bytes, except packets that are
    /// not in all checkpoints.
    ///
    /// # Errors
    /// A folder that cannot be used; a state whose raw archive is in another folder.
    #[doc(hidden)]
    pub fn keep_packets(
        &mut self,
        elsewhere: Option<&Path>,
        bytes_max: u64,
    ) -> Result<Option<PacketArchive>, GroundError> {
        let Some(archive) = &mut self.archive else { return Ok(None) };
        let folder = packets_folder(archive.folder.path());
        if let Some(elsewhere) = elsewhere {
            link_to(&folder, elsewhere)?;
        }
        let packets = match archive.packets.take() {
            Some(packets) => packets,
            None => PacketArchive::open(&folder, bytes_max)?,
        };
        keep_settings(&folder, &archive.settings)?;
        packets.set_bytes_max(bytes_max);
        packets.set_received(self.collector.received());
        archive.packets = Some(packets.clone());
        Ok(Some(packets))
    }

    /// Makes a new state in `folder` from the raw archive in `archive`. Also returns a report on the archive.
    ///
    /// # Errors
    /// A folder that has a state; an archive without packets, or that cannot be read.
    pub fn rebuild(
        folder: &Path,
        archive: &Path,
        config: &GroundConfig,
    ) -> Result<(Self, ArchiveScan), GroundError> {
        if folder.is_dir() && !checkpoints(folder)?.is_empty() {
            return Err(GroundError::Occupied { path: folder.to_owned() });
        }
        let mut ground = Self::open_anew(folder, config)?;
        let reading = read_archive(archive, |chunk| ground.take_chunk(chunk))?;
        if reading.packets == 0 {
            return Err(GroundError::Damaged {
                path: archive.to_owned(),
                found: "no packet".into(),
                expected: "the raw archive of a state, with files such as packets-00000001.ccsds",
            });
        }
        ground.collector.finish();
        ground.advance(&mut Outlet::collect())?;
        ground.checkpoint()?;
        Ok((ground, reading))
    }

    /// Takes a chunk of the archive, without emitting snapshots.
    fn take_chunk(&mut self, chunk: Vec<u8>) -> Result<(), GroundError> {
        self.step(chunk, &mut Outlet::collect())
    }

    fn note_recovered(&mut self, folder: &Path, reading: ArchiveScan) {
        let ArchiveScan { packets, bytes, damaged, .. } = reading;
        let Some(archive) = &mut self.archive else { return };
        if packets > 0 {
            let folder = folder.display();
            archive.notes.push(format!("{folder}: {packets} packets ({bytes} bytes) are newer than the last checkpoint, and were added from this raw archive"));
        }
        if damaged > 0 {
            let folder = folder.display();
            archive.notes.push(format!(
                "{folder}: {damaged} stretches are damaged and were left out; `lunarray gaps` lists the missing packets"
            ));
        }
    }
}

/// Stores the settings of a state in its raw archive, for a state without a checkpoint.
fn keep_settings(folder: &Path, settings: &[(String, String)]) -> Result<(), GroundError> {
    let (path, text) = (folder.join(SETTINGS), serde_json::to_vec_pretty(settings).unwrap_or_default());
    if std::fs::read(&path).is_ok_and(|found| found == text) {
        return Ok(());
    }
    write_atomically(&path, &text).map_err(GroundError::io(&path, "write"))
}

/// Reads the settings in the raw archive of a state, or in a separate raw archive.
pub(super) fn kept_settings(folder: &Path) -> Option<Vec<(String, String)>> {
    let read = |folder: &Path| std::fs::read(folder.join(SETTINGS)).ok();
    let text = read(&packets_folder(folder)).or_else(|| read(folder))?;
    serde_json::from_slice(&text).ok()
}

/// Returns an error if the raw archive of a state has packets that its checkpoint may lack.
pub(super) fn require_saved(state: &Path, checkpoint: Option<u64>) -> Result<(), GroundError> {
    match unsaved_bytes(&packets_folder(state), checkpoint)? {
        0 => Ok(()),
        bytes => Err(GroundError::Unsaved { path: state.to_owned(), bytes }),
    }
}

/// The note on a raw archive with packets that the checkpoint of the state may lack.
pub(super) fn unsaved_note(state: &Path, checkpoint: Option<u64>) -> Option<String> {
    require_saved(state, checkpoint).err().map(|error| error.to_string())
}

fn link_to(folder: &Path, elsewhere: &Path) -> Result<(), GroundError> {
    std::fs::create_dir_all(elsewhere).map_err(GroundError::io(elsewhere, "create the folder"))?;
    let place = elsewhere.canonicalize().map_err(GroundError::io(elsewhere, "find"))?;
    match folder.canonicalize() {
        Ok(found) if found == place => Ok(()),
        Ok(found) => Err(GroundError::Damaged {
            path: folder.to_owned(),
            found: format!("the raw archive at {}", found.display()),
            expected: "the folder given by --archive: omit --archive, or move the raw archive there first",
        }),
        #[cfg(unix)]
        Err(_) => {
            std::os::unix::fs::symlink(&place, folder).map_err(GroundError::io(folder, "make the link"))
        }
        #[cfg(not(unix))]
        Err(error) => Err(GroundError::io(folder, "find")(error)),
    }
}

/// Adds packets to the raw archive's list of retracted packets.
pub(super) fn record_retraction(
    packets: Option<&PacketArchive>,
    names: &[PacketName],
    state: &Path,
) -> Result<(), GroundError> {
    let Some(packets) = packets.filter(|_| !names.is_empty()) else { return Ok(()) };
    packets.retract(names).map_err(GroundError::io(state, "write the list of retracted packets"))
}
