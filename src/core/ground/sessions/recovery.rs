//! Applies packets of the raw archive that are newer than the checkpoint, and makes a state from a raw archive alone.

use std::path::Path;

use crate::downlink::transport::packet_archive::{ArchiveScan, PacketArchive, read_archive, read_unsaved};
use crate::ground::archive::folder::checkpoints;
use crate::ground::archive::raw_archive::{keep_settings, link_to, packets_folder};
use crate::ground::{Ground, GroundConfig, GroundError};
use crate::runtime::{Outlet, Stage};

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
