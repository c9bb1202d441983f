//! Errors of the ground and its archive.

use std::path::PathBuf;

use thiserror::Error;

use crate::units::ChannelId;

/// Errors of the ground and its archive.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum GroundError {
    /// Archives whose gains were found from different data.
    #[error(
        "states with calibration.hook = \"solve\" cannot be merged: each has found its gains from its own data; replay the \
         files into one state"
    )]
    SolvedApart,
    /// Other gains for packets that no file has.
    #[error(
        "{missing} packets of visibilities in the state have other gains now and are in none of the files, packet {count} among \
         them; expected all of them, as they were received: the state stays as it is"
    )]
    GainsWithoutData {
        /// How many.
        missing: usize,
        /// Count of one.
        count: u64,
    },
    /// Visibilities whose positions have changed since they were added.
    #[error(
        "packet {count}: the positions that are known now are others than those that it was placed by; the state stays as it is"
    )]
    OtherPositions {
        /// Count of the packet.
        count: u64,
    },
    /// Sums whose first data change.
    #[error(
        "the sums of channel {channel} begin with other data or positions under the new gains; expected all files of the channel, or a \
         new state: this one stays as it is"
    )]
    OtherBeginning {
        /// The channel.
        channel: ChannelId,
    },
    /// An archive that is to be merged with itself.
    #[error("{}: named twice; expected each state once", path.display())]
    NamedTwice {
        /// The folder.
        path: PathBuf,
    },
    /// A state with files that nobody has named.
    #[error("{}: the state was accumulated with {found}; expected the same again, by {expected}", path.display())]
    FilesOfState {
        /// The folder.
        path: PathBuf,
        /// What the files are, with their checksums.
        found: String,
        /// How they are given.
        expected: &'static str,
    },
    /// An archive that would be merged into itself.
    #[error("{}: is one of the states to merge; expected a new folder for the merged state", path.display())]
    MergedIntoPart {
        /// The folder.
        path: PathBuf,
    },
    /// The operating system refused.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// What was attempted.
        action: &'static str,
        /// What the system said.
        source: std::io::Error,
    },
    /// Another process uses the folder.
    #[error("{}: in use by another process; expected one at a time", path.display())]
    Locked {
        /// The folder.
        path: PathBuf,
    },
    /// The folder of a running archive is no longer the one that was locked.
    #[error(
        "{}: the folder of the state {what} while it was in use; expected it to stay: nothing was saved there. Its last \
         checkpoint is where the folder went; replay what came after it",
        path.display()
    )]
    FolderLost {
        /// The folder.
        path: PathBuf,
        /// What has become of it.
        what: &'static str,
    },
    /// Ranks of a job that see different folders.
    #[error(
        "{}: not the same folder on all ranks of the job; expected one on a file system that all of them share",
        path.display()
    )]
    NotShared {
        /// The folder.
        path: PathBuf,
    },
    /// A damaged checkpoint.
    #[error("{}: found {found}; expected {expected}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What was found.
        found: String,
        /// What was expected.
        expected: &'static str,
    },
    /// A file with a name that is like a checkpoint's and that none has.
    #[error(
        "{}: found a number that no checkpoint has; expected a name such as checkpoint-00000001.lunarray: rename the \
         file, or move it away",
        path.display()
    )]
    CheckpointName {
        /// The file.
        path: PathBuf,
    },
    /// There are checkpoints, and none can be used.
    #[error(
        "{}: none of its {checkpoints} checkpoints holds, the newest because of: {newest}; move the folder away, and \
         make a new state of its raw archive by `lunarray rebuild`, or of the files",
        path.display()
    )]
    NoneHolds {
        /// The folder.
        path: PathBuf,
        /// How many there are.
        checkpoints: usize,
        /// Why the newest cannot be used.
        newest: Box<GroundError>,
    },
    /// The archive was made with other settings.
    #[error(
        "{}: the state was summed with {key} = {found}; expected {expected}, as this session is to sum: give the \
         settings that the state was made with, or another folder",
        path.display()
    )]
    Settings {
        /// The file.
        path: PathBuf,
        /// Key.
        key: String,
        /// Its value in the archive.
        found: String,
        /// Its value now.
        expected: String,
    },
    /// Sums that disagree with the journal.
    #[error(
        "the packet of visibilities with count {count}: {found} of its visibilities could be removed from the sums; \
         expected {expected}, as the journal says: nothing has been changed"
    )]
    NotInSums {
        /// Packet count.
        count: u64,
        /// Visibilities that could be removed.
        found: u64,
        /// Visibilities that the journal has.
        expected: u32,
    },
    /// A state whose raw archive has more than its checkpoints.
    #[error(
        "{}: the last checkpoint lacks {bytes} bytes of packets that were taken after it and are in the raw archive; they are added \
         by the next `lunarray replay --state` of this folder",
        path.display()
    )]
    Unsaved {
        /// The folder.
        path: PathBuf,
        /// Bytes of packets.
        bytes: u64,
    },
    /// A new archive where there is one.
    #[error("{}: holds a state already; expected a new folder", path.display())]
    Occupied {
        /// The folder.
        path: PathBuf,
    },
    /// Received bytes.
    #[error(transparent)]
    Downlink(#[from] crate::downlink::DownlinkError),
    /// Calibration.
    #[error(transparent)]
    Calibration(#[from] crate::calibration::CalibrationError),
    /// Sums.
    #[error(transparent)]
    Accumulation(#[from] crate::imaging::AccumulationError),
}

impl GroundError {
    /// A folder without an archive.
    pub(in crate::ground) fn without_checkpoint(path: &std::path::Path) -> Self {
        Self::Damaged {
            path: path.to_owned(),
            found: "no checkpoint".into(),
            expected: "a folder that `lunarray replay --state` has made",
        }
    }

    /// Adds path and attempt to an error of the operating system.
    pub(in crate::ground) fn io(
        path: &std::path::Path,
        action: &'static str,
    ) -> impl FnOnce(std::io::Error) -> Self + use<> {
        let path = path.to_owned();
        move |source| Self::Io { path, action, source }
    }
}
