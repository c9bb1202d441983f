//! Errors of the ground and its archive.

use std::path::PathBuf;

use thiserror::Error;

use crate::units::ChannelId;

/// Errors of the ground and its archive.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum GroundError {
    /// Archives whose gains were solved from different data.
    #[error(
        "states with calibration.hook = \"solve\" cannot be merged, as the gains of each were solved from its own data only; \
        replay the files of all of them into one new state"
    )]
    SeparateSolutions,
    /// Gains that are found from the data, where they have to be known.
    #[error(
        "calibration.hook = \"solve\": expected \"identity\" or \"antenna-gains\", as with --calibration and the gains that \
        `lunarray calibrate` found"
    )]
    GainsFromData,
    /// Changed gains for packets that no file has.
    #[error(
        "{missing} packets of visibilities in the state need new gains and are in none of the files, the one with count {count} \
        among them; expected files with all of these packets: nothing was changed"
    )]
    GainsWithoutData {
        /// Number of packets.
        missing: usize,
        /// Count of one of the packets.
        count: u64,
    },
    /// Packets from which bursts were subtracted that were fitted with other gains.
    #[error(
        "{packets} packets of visibilities whose gains change lie in bursts, whose flux was fitted with the old gains \
        (calibration.bursts = \"peel\"); expected none: make a new state with the new gains by \
        `lunarray rebuild` or `replay`; nothing was changed"
    )]
    PeeledWithOldGains {
        /// Number of packets.
        packets: usize,
    },
    /// Visibilities whose positions or bursts have changed since they were added.
    #[error(
        "packet {count}: the ephemeris, or the table of bursts, has changed since the packet was added to the sums; expected the \
        same: nothing was changed"
    )]
    EphemerisChanged {
        /// Count of the packet.
        count: u64,
    },
    /// Sums whose first block of data changes with the gains.
    #[error(
        "with the new gains, the sums of channel {channel} would begin with other data or positions; expected all files of the \
        channel, or a new state: nothing was changed"
    )]
    FirstDataChanged {
        /// The channel.
        channel: ChannelId,
    },
    /// An archive given twice for a merge.
    #[error("{}: named twice; expected each state only once", path.display())]
    GivenTwice {
        /// The folder.
        path: PathBuf,
    },
    /// A state that needs files which were not given.
    #[error("{}: the state was accumulated with {found}; expected the same files, given by {expected}", path.display())]
    FilesOfState {
        /// The folder.
        path: PathBuf,
        /// The files of the state, with their checksums.
        found: String,
        /// Key or option that gives them.
        expected: &'static str,
    },
    /// A merge into one of its parts.
    #[error("{}: is one of the states to merge; expected a new folder for the merged state", path.display())]
    MergeIntoPart {
        /// The folder.
        path: PathBuf,
    },
    /// An error of the operating system.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// What was attempted.
        action: &'static str,
        /// Error of the system.
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
        "{}: the folder of the state {what} while it was in use, so nothing was saved; expected it to stay in place. The last \
        checkpoint is in the original folder; replay the data received after it",
        path.display()
    )]
    FolderLost {
        /// The folder.
        path: PathBuf,
        /// What happened to the folder.
        what: &'static str,
    },
    /// A folder that is not shared by all ranks of a job.
    #[error(
    "{}: not the same folder on all ranks of the job; expected a folder on a file system that all ranks share",
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
    /// A file with an invalid checkpoint name.
    #[error(
        "{}: found an invalid checkpoint number; expected a name such as checkpoint-00000001.lunarray: rename the file, or \
        move it out of the folder",
        path.display()
    )]
    CheckpointName {
        /// The file.
        path: PathBuf,
    },
    /// An archive without a usable checkpoint.
    #[error(
        "{}: none of its {checkpoints} checkpoints can be used; the newest: {newest}. Move the folder away, and make a new \
        state from its raw archive with `lunarray rebuild`, or from the downlink files",
        path.display()
    )]
    NoUsableCheckpoint {
        /// The folder.
        path: PathBuf,
        /// Number of checkpoints.
        checkpoints: usize,
        /// Why the newest cannot be used.
        newest: Box<GroundError>,
    },
    /// An archive that was made with other settings.
    #[error(
    "{}: the state was made with {key} = {found}; expected {expected}, the value of this session: use the settings of \
    the state, or another folder",
        path.display()
    )]
    Settings {
        /// The file.
        path: PathBuf,
        /// Key of the setting.
        key: String,
        /// Value in the archive.
        found: String,
        /// Value of this session.
        expected: String,
    },
    /// Sums that disagree with the journal.
    #[error(
        "packet of visibilities with count {count}: {found} of its visibilities could be removed from the sums; expected \
        {expected}, as in the journal: nothing was changed"
    )]
    NotInSums {
        /// Packet count.
        count: u64,
        /// Number of visibilities that could be removed.
        found: u64,
        /// Number of visibilities in the journal.
        expected: u32,
    },
    /// A state whose raw archive has packets that are in no checkpoint.
    #[error(
    "{}: {bytes} bytes of packets in the raw archive are newer than the last checkpoint; run `lunarray replay --state` \
    on this folder first, which adds them",
        path.display()
    )]
    Unsaved {
        /// The folder.
        path: PathBuf,
        /// Bytes of packets.
        bytes: u64,
    },
    /// A new archive in a folder that has one.
    #[error("{}: holds a state already; expected a new folder", path.display())]
    Occupied {
        /// The folder.
        path: PathBuf,
    },
    /// An error in the received bytes.
    #[error(transparent)]
    Downlink(#[from] crate::downlink::DownlinkError),
    /// An error in the calibration.
    #[error(transparent)]
    Calibration(#[from] crate::calibration::CalibrationError),
    /// An error in the sums.
    #[error(transparent)]
    Accumulation(#[from] crate::imaging::AccumulationError),
}

impl GroundError {
    /// The error for a folder without an archive.
    pub(in crate::ground) fn without_checkpoint(path: &std::path::Path) -> Self {
        Self::Damaged {
            path: path.to_owned(),
            found: "no checkpoint".into(),
            expected: "a folder made by `lunarray replay --state`",
        }
    }

    /// Adds the path and the attempted action to an error of the operating system.
    pub(in crate::ground) fn io(
        path: &std::path::Path,
        action: &'static str,
    ) -> impl FnOnce(std::io::Error) -> Self + use<> {
        let path = path.to_owned();
        move |source| Self::Io { path, action, source }
    }
}
