//! What the raw archive has beyond a checkpoint, and a state made from the raw archive alone.

use std::path::{Path, PathBuf};

use super::folder::checkpoints;
use crate::downlink::transport::packet_archive::{
    ArchiveScan, PacketArchive, PacketName, read_archive, read_unsaved, unsaved_bytes,
};
use crate::files::write_atomically;
use crate::ground::{Ground, GroundConfig, GroundError};
use crate::runtime::{Outlet, Stage};

/// Name of the raw archive in the folder of a state.
const PACKETS: &str = "archive";

/// Name of the settings in a raw archive.
const SETTINGS: &str = "settings.json";

/// Greatest size of a raw archive, bytes, unless another is given: 64 GiB, four missions of 30 channels.
pub const ARCHIVE_BYTES_MAX: u64 = 1 << 36;

/// Where the raw archive of a state is.
#[must_use]
pub fn packets_folder(state: &Path) -> PathBuf {
    state.join(PACKETS)
}

impl Ground {
    /// Applies what the raw archive of `state` has and the checkpoint lacks, as if it arrived now; then goes on with that archive
    /// if `keeps`. Without an archive there is nothing to do.
    pub(super) fn recover(&mut self, state: &Path, keeps: bool) -> Result<(), GroundError> {
        let folder = packets_folder(state);
        if !folder.is_dir() {
            return Ok(());
        }
        let checkpoint = self.archive.as_ref().and_then(|archive| archive.folder.newest());
        // Nobody else writes there from now on.
        let packets = keeps.then(|| PacketArchive::open(&folder, u64::MAX)).transpose()?;
        let reading = read_unsaved(&folder, checkpoint, |piece| self.take_piece(piece))?;
        self.note_recovered(&folder, reading);
        if let Some(archive) = &mut self.archive {
            archive.packets = packets;
        }
        self.promises.begin(self.collector.bytes());
        Ok(())
    }

    /// Keeps received packets in the raw archive of its state from now on, which is `elsewhere` if that is given, and has at most
    /// `bytes_max` as far as checkpoints allow. `None` without a state.
    ///
    /// # Errors
    /// A folder that cannot be used; a state whose archive is at another place.
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

    /// Makes a new state in `folder` from the raw archive in `archive`; returns it and what was read.
    ///
    /// # Errors
    /// A folder that has a state; an archive without a packet, or that cannot be read.
    pub fn rebuild(
        folder: &Path,
        archive: &Path,
        config: &GroundConfig,
    ) -> Result<(Self, ArchiveScan), GroundError> {
        if folder.is_dir() && !checkpoints(folder)?.is_empty() {
            return Err(GroundError::Occupied { path: folder.to_owned() });
        }
        let mut ground = Self::open_anew(folder, config)?;
        let reading = read_archive(archive, |piece| ground.take_piece(piece))?;
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

    /// Takes a piece of the archive. Snapshots that are due on the way are not made.
    fn take_piece(&mut self, piece: Vec<u8>) -> Result<(), GroundError> {
        self.step(piece, &mut Outlet::collect())
    }

    fn note_recovered(&mut self, folder: &Path, reading: ArchiveScan) {
        let ArchiveScan { packets, bytes, damaged, .. } = reading;
        let Some(archive) = &mut self.archive else { return };
        if packets > 0 {
            let folder = folder.display();
            archive.notes.push(format!("{folder}: {packets} packets ({bytes} bytes) came after the last checkpoint, and are taken from here"));
        }
        if damaged > 0 {
            let folder = folder.display();
            archive.notes.push(format!(
                "{folder}: {damaged} stretches are damaged and were left out; `lunarray gaps` names what is missing now"
            ));
        }
    }
}

/// Keeps the settings of a state beside its packets, for a state that has no checkpoint.
fn keep_settings(folder: &Path, settings: &[(String, String)]) -> Result<(), GroundError> {
    let (path, text) = (folder.join(SETTINGS), serde_json::to_vec_pretty(settings).unwrap_or_default());
    if std::fs::read(&path).is_ok_and(|found| found == text) {
        return Ok(());
    }
    write_atomically(&path, &text).map_err(GroundError::io(&path, "write"))
}

/// The settings beside the packets of a state, or of a raw archive by itself.
pub(super) fn kept_settings(folder: &Path) -> Option<Vec<(String, String)>> {
    let read = |folder: &Path| std::fs::read(folder.join(SETTINGS)).ok();
    let text = read(&packets_folder(folder)).or_else(|| read(folder))?;
    serde_json::from_slice(&text).ok()
}

/// Refuses a state whose raw archive has packets that its checkpoint may lack.
pub(super) fn require_saved(state: &Path, checkpoint: Option<u64>) -> Result<(), GroundError> {
    match unsaved_bytes(&packets_folder(state), checkpoint)? {
        0 => Ok(()),
        bytes => Err(GroundError::Unsaved { path: state.to_owned(), bytes }),
    }
}

/// Says so if the raw archive of a state has packets that its checkpoint may lack.
pub(super) fn unsaved_note(state: &Path, checkpoint: Option<u64>) -> Option<String> {
    require_saved(state, checkpoint).err().map(|error| error.to_string())
}

/// Makes `folder` lead to another one.
fn link_to(folder: &Path, elsewhere: &Path) -> Result<(), GroundError> {
    std::fs::create_dir_all(elsewhere).map_err(GroundError::io(elsewhere, "create the folder"))?;
    let place = elsewhere.canonicalize().map_err(GroundError::io(elsewhere, "find"))?;
    match folder.canonicalize() {
        Ok(found) if found == place => Ok(()),
        Ok(found) => Err(GroundError::Damaged {
            path: folder.to_owned(),
            found: format!("the raw archive at {}", found.display()),
            expected: "the one that --archive names: leave --archive out, or move the folder there yourself",
        }),
        #[cfg(unix)]
        Err(_) => {
            std::os::unix::fs::symlink(&place, folder).map_err(GroundError::io(folder, "make the link"))
        }
        #[cfg(not(unix))]
        Err(error) => Err(GroundError::io(folder, "find")(error)),
    }
}

/// Tells the raw archive of a state which packets were removed from it.
pub(super) fn forget(
    packets: Option<&PacketArchive>,
    names: &[PacketName],
    state: &Path,
) -> Result<(), GroundError> {
    let Some(packets) = packets.filter(|_| !names.is_empty()) else { return Ok(()) };
    packets.retract(names).map_err(GroundError::io(state, "write the list of retracted packets"))
}
