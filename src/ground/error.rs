//! Errors of the ground and its archive.

use std::path::PathBuf;

use thiserror::Error;

/// Errors of the ground and its archive.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum GroundError {
    /// A state that is to be put together with itself.
    #[error("{}: named twice; expected each state once", path.display())]
    NamedTwice {
        /// The folder.
        path: PathBuf,
    },
    /// The operating system refused.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// What the system said.
        source: std::io::Error,
    },
    /// Another process has the folder.
    #[error("{}: another process is keeping its state there; expected one at a time", path.display())]
    Locked {
        /// The folder.
        path: PathBuf,
    },
    /// A checkpoint that does not hold.
    #[error("{}: found {found}; expected {expected}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What was found.
        found: String,
        /// What was expected.
        expected: &'static str,
    },
    /// No checkpoint holds, though there are some.
    #[error(
        "{}: none of its {checkpoints} checkpoints holds, the newest because of: {newest}; move the folder away to \
         begin anew from the files",
        path.display()
    )]
    NoneHolds {
        /// The folder.
        path: PathBuf,
        /// How many there are.
        checkpoints: usize,
        /// What is wrong with the newest.
        newest: Box<GroundError>,
    },
    /// The state was summed with other settings.
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
        /// Its value in the state.
        found: String,
        /// Its value now.
        expected: String,
    },
    /// Sums that do not hold what the journal says.
    #[error(
        "the packet of visibilities with count {count}: {found} of its visibilities could be taken out of the sums; \
         expected {expected}, as the journal says: nothing has been changed"
    )]
    NotInSums {
        /// Packet count.
        count: u64,
        /// Visibilities that the sums would give.
        found: u64,
        /// Visibilities that the journal has.
        expected: u32,
    },
    /// A new state where there is one.
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
    Accumulation(#[from] crate::accumulation::AccumulationError),
}

impl GroundError {
    /// A folder that is no state's.
    pub(in crate::ground) fn without_checkpoint(path: &std::path::Path) -> Self {
        Self::Damaged {
            path: path.to_owned(),
            found: "no checkpoint".into(),
            expected: "a folder that `lunarray replay --state` has made",
        }
    }

    /// Names what was tried when the operating system refused.
    pub(in crate::ground) fn io(
        path: &std::path::Path,
        action: &'static str,
    ) -> impl FnOnce(std::io::Error) -> Self + use<> {
        let path = path.to_owned();
        move |source| Self::Io { path, action, source }
    }
}
