//! Looking into a state, or a downlink file, without going on with it.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use super::error::StateError;
use super::file::{self, Head};
use super::folder::checkpoints;
use super::gaps::{Gaps, find_gaps};
use super::journal::JournalEntry;
use crate::accumulation::{Accumulator, MapConfig};
use crate::downlink::{Collector, Delivery, Kind, Taken};
use crate::frames::GroundFrame;
use crate::products::pictures::{Axis, Curve, Picture, PictureError, Plot, draw_plots};
use crate::runtime::Ledger;
use crate::units::constants::DAY_S;

/// Bytes that packets of a file wait for those before them.
const WAIT_BYTES: u64 = 1 << 24;
/// Steps of time in a picture.
const BINS: usize = 240;
/// Most channels in a picture.
const PLOTS_MAX: usize = 64;

/// What has been received.
#[derive(Clone, Debug, Default)]
pub struct Survey {
    /// A line on every packet of visibilities.
    pub journal: Vec<JournalEntry>,
    taken: Vec<(Kind, Taken)>,
}

impl Survey {
    /// Surveys a state's folder, one of its checkpoints, or a downlink file.
    ///
    /// # Errors
    /// A folder without a checkpoint that holds, a file that cannot be read or is neither.
    pub fn of(path: &Path) -> Result<Self, StateError> {
        if path.is_dir() {
            return Self::of_folder(path);
        }
        if file::is_checkpoint(path)? {
            return Self::of_checkpoint(path);
        }
        let mut journal = Vec::new();
        let mut collector = Collector::new(WAIT_BYTES);
        collector.read_file(path, &mut |found| journal.extend(entry_of(&found)))?;
        let state = collector.into_state();
        Ok(Self { journal, taken: taken(|kind| state.taken(kind).cloned()) })
    }

    fn of_folder(path: &Path) -> Result<Self, StateError> {
        let files: Vec<PathBuf> = checkpoints(path)?;
        let mut newest = None;
        for file in files.iter().rev() {
            match Self::of_checkpoint(file) {
                Ok(found) => return Ok(found),
                Err(error) => drop(newest.get_or_insert(error)),
            }
        }
        match newest {
            Some(newest) => Err(StateError::NoneHolds {
                path: path.to_owned(),
                checkpoints: files.len(),
                newest: Box::new(newest),
            }),
            None => Err(StateError::without_checkpoint(path)),
        }
    }

    fn of_checkpoint(path: &Path) -> Result<Self, StateError> {
        let head: Head = file::read(path, |head, engines| {
            std::io::copy(engines, &mut std::io::sink()).map_err(StateError::io(path, "read"))?;
            Ok(head)
        })?;
        Ok(Self::of_head(head))
    }

    /// Surveys a checkpoint in memory, and reads its engines too, as a session of `map` would that goes on with it.
    ///
    /// # Errors
    /// A checkpoint that does not hold.
    pub fn of_bytes(bytes: &[u8], map: &MapConfig) -> Result<Self, StateError> {
        let head: Head = file::read_from(&mut Cursor::new(bytes), Path::new("memory"), |head, engines| {
            let accumulator = Accumulator::new(map.clone(), Ledger::default());
            accumulator.resume(head.accumulator.clone(), engines)?;
            Ok(head)
        })?;
        Ok(Self::of_head(head))
    }

    fn of_head(head: Head) -> Self {
        let mut journal: Vec<JournalEntry> = head.journal.entries().copied().collect();
        // Packets that wait have come too, and are in no journal yet.
        let taken = taken(|kind| head.collector.taken(kind).cloned());
        let mut collector = Collector::resume(head.collector);
        while let Some(found) = collector.next_waiting() {
            journal.extend(entry_of(&found));
        }
        Self { journal, taken }
    }

    /// What is missing.
    #[must_use]
    pub fn gaps(&self) -> Gaps {
        let taken: Vec<(Kind, &Taken)> = self.taken.iter().map(|(kind, taken)| (*kind, taken)).collect();
        find_gaps(&self.journal, &taken)
    }

    /// A picture of integration time over mission time, channel by channel: received, and with what is missing.
    ///
    /// # Errors
    /// [`PictureError::Size`] if nothing has been received. Of more than 64 channels the first are shown.
    pub fn picture(&self, gaps: &Gaps) -> Result<Picture, PictureError> {
        let first = self.journal.iter().map(|entry| entry.start.seconds()).fold(f64::INFINITY, f64::min);
        let last = self.journal.iter().map(|entry| entry.end.seconds()).fold(f64::NEG_INFINITY, f64::max);
        let bin_s = ((last - first) / BINS as f64).max(1.0);
        let plots: Vec<Plot> = gaps
            .channels
            .iter()
            .take(PLOTS_MAX)
            .map(|coverage| {
                let mut received = vec![0.0; BINS];
                let bin = |time_s: f64| (((time_s - first) / bin_s).max(0.0) as usize).min(BINS - 1);
                for entry in self.journal.iter().filter(|entry| entry.channel.0 == coverage.channel) {
                    let middle_s = 0.5 * (entry.start.seconds() + entry.end.seconds());
                    received[bin(middle_s)] += entry.integration_s;
                }
                let mut all = received.clone();
                for gap in &gaps.gaps {
                    let [from, to] = gap.between_s;
                    let (from, to) = (bin(from.unwrap_or(first)), bin(to.unwrap_or(last)));
                    let (from, to) = (from.min(to), from.max(to));
                    let of_channel = gap.lost.iter().filter(|lost| lost.channel == coverage.channel);
                    let lost_s: f64 = of_channel.map(|lost| lost.integration_s).sum();
                    for sum in &mut all[from..=to] {
                        *sum += lost_s / (to - from + 1) as f64;
                    }
                }
                let steps = |sums: &[f64]| {
                    let corner = |(k, &sum): (usize, &f64)| {
                        let day = |k: usize| (first + bin_s * k as f64) / DAY_S;
                        [(day(k), sum / 3600.0), (day(k + 1), sum / 3600.0)]
                    };
                    sums.iter().enumerate().flat_map(corner).collect()
                };
                Plot {
                    title: format!("channel {}", coverage.channel),
                    x: Axis { label: "mission time, days".into(), ..Axis::default() },
                    y: Axis { label: format!("pair hours in {:.2} d", bin_s / DAY_S), ..Axis::default() },
                    curves: vec![
                        Curve { label: "with what is missing".into(), points: steps(&all), dashed: true },
                        Curve { label: "received".into(), points: steps(&received), dashed: false },
                    ],
                    levels: Vec::new(),
                }
            })
            .collect();
        draw_plots("Integration time received", &plots, 1 + usize::from(plots.len() > 3))
    }
}

fn entry_of(found: &Delivery) -> Option<JournalEntry> {
    match (found.packets.first(), &found.frame) {
        (Some((header, _)), Some(GroundFrame::Visibilities(block))) if !block.is_empty() => {
            Some(JournalEntry::of(*header, Some(block)))
        }
        _ => None,
    }
}

fn taken(of: impl Fn(Kind) -> Option<Taken>) -> Vec<(Kind, Taken)> {
    Kind::ALL.into_iter().filter_map(|kind| of(kind).map(|taken| (kind, taken))).collect()
}
