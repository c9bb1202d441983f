//! The folder of a raw archive, with the settings of its state.

use std::path::{Path, PathBuf};

use crate::downlink::transport::packet_archive::{PacketArchive, PacketName, unsaved_bytes};
use crate::files::write_atomically;
use crate::ground::GroundError;

const PACKETS: &str = "archive";

pub(in crate::ground) const SETTINGS: &str = "settings.json";

/// Default limit of a raw archive, bytes: 64 GiB, enough for four missions of 30 channels.
pub const ARCHIVE_BYTES_MAX: u64 = 1 << 36;

/// Path of the raw archive of a state.
#[must_use]
pub fn packets_folder(state: &Path) -> PathBuf {
    state.join(PACKETS)
}

/// Stores the settings of a state in its raw archive, for a state without a checkpoint.
pub(in crate::ground) fn keep_settings(
    folder: &Path,
    settings: &[(String, String)],
) -> Result<(), GroundError> {
    let (path, text) = (folder.join(SETTINGS), serde_json::to_vec_pretty(settings).unwrap_or_default());
    if std::fs::read(&path).is_ok_and(|found| found == text) {
        return Ok(());
    }
    write_atomically(&path, &text).map_err(GroundError::io(&path, "write"))
}

/// Reads the settings in the raw archive of a state, or in a separate raw archive.
pub(in crate::ground) fn kept_settings(folder: &Path) -> Option<Vec<(String, String)>> {
    let read = |folder: &Path| std::fs::read(folder.join(SETTINGS)).ok();
    let text = read(&packets_folder(folder)).or_else(|| read(folder))?;
    serde_json::from_slice(&text).ok()
}

/// Returns an error if the raw archive of a state has packets that its checkpoint may lack.
pub(in crate::ground) fn require_saved(state: &Path, checkpoint: Option<u64>) -> Result<(), GroundError> {
    match unsaved_bytes(&packets_folder(state), checkpoint)? {
        0 => Ok(()),
        bytes => Err(GroundError::Unsaved { path: state.to_owned(), bytes }),
    }
}

/// The note on a raw archive with packets that the checkpoint of the state may lack.
pub(in crate::ground) fn unsaved_note(state: &Path, checkpoint: Option<u64>) -> Option<String> {
    require_saved(state, checkpoint).err().map(|error| error.to_string())
}

pub(in crate::ground) fn link_to(folder: &Path, elsewhere: &Path) -> Result<(), GroundError> {
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
pub(in crate::ground) fn record_retraction(
    packets: Option<&PacketArchive>,
    names: &[PacketName],
    state: &Path,
) -> Result<(), GroundError> {
    let Some(packets) = packets.filter(|_| !names.is_empty()) else { return Ok(()) };
    packets.retract(names).map_err(GroundError::io(state, "write the list of retracted packets"))
}
