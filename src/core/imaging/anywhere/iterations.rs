//! Saves the solution after each iteration of a refinement, because one iteration over all visibilities can take an hour.

use std::path::{Path, PathBuf};

use crc_fast::{CrcAlgorithm, checksum};

use crate::files::write_atomically;
use crate::units::ChannelId;

const MAGIC: &[u8; 8] = b"LNRPASS1";
/// Maximum size of a file: two maps of harmonics up to l = 1024.
const BYTES_MAX: u64 = 64 << 20;

/// The file in which the iterations of one map save their solution.
///
/// It only saves time, so errors in reading or writing it are ignored.
pub(in crate::imaging) struct IterationFile {
    path: PathBuf,
    /// Hash of the data and settings that the solution belongs to.
    key: u64,
}

impl IterationFile {
    /// The file of a channel in `folder`; `fingerprint` identifies the data and settings.
    pub(in crate::imaging) fn new(folder: &Path, channel: ChannelId, fingerprint: &[i64]) -> Self {
        let bytes: Vec<u8> = fingerprint.iter().flat_map(|number| number.to_le_bytes()).collect();
        let path = folder.join(format!(".refining-{channel}"));
        Self { path, key: checksum(CrcAlgorithm::Crc64Nvme, &bytes) }
    }

    /// The unknowns of the map and the noise-only map after the last iteration; `None` without a valid file.
    pub(in crate::imaging) fn read(&self) -> Option<[Vec<f64>; 2]> {
        let length = std::fs::metadata(&self.path).ok()?.len();
        let bytes = std::fs::read(&self.path).ok().filter(|_| length <= BYTES_MAX)?;
        let (body, crc) = bytes.split_last_chunk::<8>()?;
        if checksum(CrcAlgorithm::Crc64Nvme, body) != u64::from_le_bytes(*crc) {
            return None;
        }
        let numbers = body.strip_prefix(MAGIC)?.strip_prefix(&self.key.to_le_bytes())?;
        let (numbers, rest) = numbers.as_chunks::<8>();
        let values: Vec<f64> = numbers.iter().map(|number| f64::from_le_bytes(*number)).collect();
        let half = values.len() / 2;
        let is_valid = rest.is_empty() && values.len() == 2 * half && values.iter().all(|x| x.is_finite());
        is_valid.then(|| [values[..half].to_vec(), values[half..].to_vec()])
    }

    /// Saves the solutions of an iteration.
    pub(in crate::imaging) fn write(&self, x: [&[f64]; 2]) {
        let numbers = x.into_iter().flatten().flat_map(|x| x.to_le_bytes());
        let mut bytes: Vec<u8> = MAGIC.iter().copied().chain(self.key.to_le_bytes()).chain(numbers).collect();
        bytes.extend(checksum(CrcAlgorithm::Crc64Nvme, &bytes).to_le_bytes());
        let _ = write_atomically(&self.path, &bytes);
    }

    pub(in crate::imaging) fn remove(&self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_solution_is_read_again_for_the_same_data_only() {
        let folder = tempfile::tempdir().unwrap();
        let file = IterationFile::new(folder.path(), ChannelId(3), &[1, 2]);
        assert_eq!(file.read(), None);
        file.write([&[1.0, -2.5], &[1e-300, 4.0]]);
        assert_eq!(file.read(), Some([vec![1.0, -2.5], vec![1e-300, 4.0]]));
        assert_eq!(IterationFile::new(folder.path(), ChannelId(3), &[1, 3]).read(), None);
        assert_eq!(IterationFile::new(folder.path(), ChannelId(4), &[1, 2]).read(), None);
        let whole = std::fs::read(&file.path).unwrap();
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 1;
            std::fs::write(&file.path, &bytes).unwrap();
            assert_eq!(file.read(), None, "byte {at}");
            std::fs::write(&file.path, &whole[..at]).unwrap();
            assert_eq!(file.read(), None, "{at} bytes");
        }
        std::fs::write(&file.path, &whole).unwrap();
        assert!(file.read().is_some());
        file.remove();
        assert_eq!(file.read(), None);
        // A folder that does not exist is no failure.
        IterationFile::new(&folder.path().join("gone"), ChannelId(0), &[]).write([&[], &[]]);
    }
}
