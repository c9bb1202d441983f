//! Looking into a state, or a downlink file, without going on with it.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use super::checkpoint;
use super::checkpoint::Head;
use super::error::StateError;
use super::folder::{checkpoints, note};
use super::gaps::{Gaps, Positions, Reading, Received, find_gaps};
use super::journal::JournalEntry;
use crate::accumulation::{Accumulator, MapConfig};
use crate::array::Ephemeris;
use crate::downlink::{Kind, PacketHeader};
use crate::frames::GroundFrame;
use crate::ground::{Collector, Delivery};
use crate::products::pictures::{Axis, Curve, Picture, PictureError, Plot, draw_plots};
use crate::runtime::Ledger;
use crate::units::constants::DAY_S;

/// Bytes that packets of a file wait for those before them.
const WAIT_BYTES: u64 = 1 << 24;
/// Segments of positions that are looked at.
const SEGMENTS_MAX: usize = 1 << 14;
/// Steps of time in a picture.
const BINS: usize = 240;
/// Most channels in a picture.
const PLOTS_MAX: usize = 64;

/// What has been received.
#[derive(Clone, Debug, Default)]
pub struct Survey {
    received: Received,
    /// Positions that are known.
    ephemeris: Ephemeris,
    notes: Vec<String>,
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
        if checkpoint::is_checkpoint(path)? {
            return Self::of_checkpoint(path);
        }
        let mut survey = Self { ephemeris: Ephemeris::new(SEGMENTS_MAX), ..Self::default() };
        let mut collector = Collector::new(WAIT_BYTES);
        collector.read_file(path, &mut |found| survey.see(found))?;
        let Self { received, ephemeris, .. } = &mut survey;
        for reading in &mut received.readings {
            reading.waits = !ephemeris.covers([reading.entry.start, reading.entry.end]);
        }
        survey.conclude(collector);
        Ok(survey)
    }

    fn of_folder(path: &Path) -> Result<Self, StateError> {
        let files: Vec<PathBuf> = checkpoints(path)?;
        let mut bad = Vec::new();
        for file in files.iter().rev() {
            match Self::of_checkpoint(file) {
                Ok(found) => {
                    let notes = bad.iter().map(|error| note(error, file)).collect();
                    return Ok(Self { notes, ..found });
                }
                Err(error) => bad.push(error),
            }
        }
        match bad.into_iter().next() {
            Some(newest) => Err(StateError::NoneHolds {
                path: path.to_owned(),
                checkpoints: files.len(),
                newest: Box::new(newest),
            }),
            None => Err(StateError::without_checkpoint(path)),
        }
    }

    fn of_checkpoint(path: &Path) -> Result<Self, StateError> {
        let head: Head = checkpoint::read(path, |head, engines| {
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
        let head: Head =
            checkpoint::read_from(&mut Cursor::new(bytes), Path::new("memory"), |head, engines| {
                let accumulator = Accumulator::new(map.clone(), Ledger::default());
                accumulator.resume(head.accumulator.clone(), engines)?;
                Ok(head)
            })?;
        Ok(Self::of_head(head))
    }

    fn of_head(head: Head) -> Self {
        let Head { journal, calibrator, collector, .. } = head;
        let mut survey = Self { ephemeris: Ephemeris::new(SEGMENTS_MAX), ..Self::default() };
        for segment in calibrator.ephemeris() {
            survey.ephemeris.insert(segment.clone());
        }
        let readings = journal.shares().map(|(entry, share)| Reading { entry: *entry, waits: false, share });
        survey.received.readings = readings.collect();
        for ((_, (made, count)), line) in &journal.others {
            let segment = line.segment.and_then(|start| survey.ephemeris.segment(start));
            let span = segment.map(|segment| [segment.start, segment.end()]);
            survey.received.positions.extend(span.map(|span| Positions { count: *count, made: *made, span }));
        }
        // Packets that wait have come too, and are in no journal yet.
        let mut collector = Collector::resume(collector);
        let read = survey.received.readings.len();
        while let Some(found) = collector.next_waiting() {
            survey.see(found);
        }
        survey.received.readings[read..].iter_mut().for_each(|reading| reading.waits = true);
        survey.conclude(collector);
        survey
    }

    fn see(&mut self, found: Delivery) {
        let Delivery { packets, frame } = found;
        match frame {
            Some(GroundFrame::Visibilities(block)) if !block.is_empty() => {
                let entry = packets.first().map(|(header, _)| JournalEntry::of(*header, Some(&block)));
                let reading = entry.map(|entry| Reading { entry, waits: false, share: None });
                self.received.readings.extend(reading);
            }
            Some(GroundFrame::Ephemeris(segment)) => {
                let span = [segment.start, segment.end()];
                let positions = |(header, _): &(PacketHeader, u32)| Positions {
                    count: header.count,
                    made: header.time,
                    span,
                };
                self.received.positions.extend(packets.iter().map(positions));
                self.ephemeris.insert(segment);
            }
            _ => {}
        }
    }

    fn conclude(&mut self, collector: Collector) {
        let channels = collector.instrument().into_iter().flat_map(|instrument| &instrument.channels);
        self.received.frequencies_hz = channels.map(|channel| channel.frequency_hz).collect();
        let state = collector.into_state();
        let taken = |kind| state.taken(kind).map(|taken| (kind, taken.clone()));
        self.received.taken = Kind::ALL.into_iter().filter_map(taken).collect();
    }

    /// What is to be said of checkpoints that do not hold.
    pub fn notes(&self) -> impl Iterator<Item = &str> {
        self.notes.iter().map(String::as_str)
    }

    /// What has been received.
    #[must_use]
    pub fn received(&self) -> &Received {
        &self.received
    }

    /// What is missing.
    #[must_use]
    pub fn gaps(&self) -> Gaps {
        find_gaps(&self.received)
    }

    /// A picture of integration time over mission time, channel by channel: received, and with what is missing.
    ///
    /// # Errors
    /// [`PictureError::Size`] if nothing has been received. Of more than 64 channels the first are shown.
    pub fn picture(&self, gaps: &Gaps) -> Result<Picture, PictureError> {
        let entries = || self.received.readings.iter().map(|reading| &reading.entry);
        let first = entries().map(|entry| entry.start.seconds()).fold(f64::INFINITY, f64::min);
        let last = entries().map(|entry| entry.end.seconds()).fold(f64::NEG_INFINITY, f64::max);
        let bin_s = ((last - first) / BINS as f64).max(1.0);
        let plots: Vec<Plot> = gaps
            .channels
            .iter()
            .take(if self.received.readings.is_empty() { 0 } else { PLOTS_MAX })
            .map(|coverage| {
                let mut received = vec![0.0; BINS];
                let bin = |time_s: f64| (((time_s - first) / bin_s).max(0.0) as usize).min(BINS - 1);
                let is_shown = |entry: &&JournalEntry| {
                    entry.channel.0 == coverage.channel && entry.pair.i != entry.pair.j
                };
                for entry in entries().filter(is_shown) {
                    let middle_s = 0.5 * (entry.start.seconds() + entry.end.seconds());
                    received[bin(middle_s)] += entry.integration_s;
                }
                let mut all = received.clone();
                for gap in gaps.gaps.iter().filter(|gap| gap.kind == Kind::Visibilities) {
                    let of_channel = gap.lost.iter().filter(|lost| lost.channel == coverage.channel);
                    let lost_s: f64 = of_channel.map(|lost| lost.integration_s).sum();
                    let [from, to] = gap.between_s;
                    let stretches = self.observed([from.unwrap_or(first), to.unwrap_or(last)]);
                    let length_s: f64 = stretches.iter().map(|[from, to]| to - from).sum();
                    for [from, to] in stretches {
                        let bins = bin(from)..=bin(to);
                        for (k, sum) in bins.clone().zip(&mut all[bins]) {
                            let (begin, end) = (first + bin_s * k as f64, first + bin_s * (k + 1) as f64);
                            let within_s = (end.min(to) - begin.max(from)).max(0.0);
                            *sum += lost_s * within_s / length_s;
                        }
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
                    title: match coverage.frequency_hz {
                        Some(hz) => format!("channel {}: {:.4} MHz", coverage.channel, hz / 1e6),
                        None => format!("channel {}", coverage.channel),
                    },
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

    /// The parts of a stretch of time, s, in which there were observations: those for which positions came, not by their
    /// edges alone. Where there are none, all of it, at least a second.
    fn observed(&self, [a, b]: [f64; 2]) -> Vec<[f64; 2]> {
        let (from, to) = (a.min(b), a.max(b));
        let segments = self.ephemeris.segments();
        let segments = segments.map(|segment| [segment.start.seconds(), segment.end().seconds()]);
        let within = segments.filter(|[start, end]| (from..=to).contains(&(0.5 * (start + end))));
        let parts: Vec<[f64; 2]> = within.map(|[start, end]| [start.max(from), end.min(to)]).collect();
        if parts.is_empty() { vec![[from, to.max(from + 1.0)]] } else { parts }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::EphemerisSegment;
    use crate::units::MissionTime;

    #[test]
    fn what_is_missing_was_observed_where_positions_tell() {
        let mut survey = Survey::default();
        // Windows of 2400 s in every 9000 s; of the fourth no positions came.
        for window in [0, 1, 2, 4] {
            survey.ephemeris.insert(EphemerisSegment {
                start: MissionTime::from_seconds(9e3 * f64::from(window)),
                step_ticks: 300_000_000,
                satellites: 1,
                positions_m: vec![[0.0; 3]; 9],
            });
        }
        // The second window, of which the first and third came but for their edges; the third, by its last stream and its
        // own beginning; a part of one; and the fourth, of which nobody knows where it was.
        assert_eq!(survey.observed([2399.0, 18_001.0]), [[9000.0, 11_400.0]]);
        assert_eq!(survey.observed([20_400.0, 18_000.0]), [[18_000.0, 20_400.0]]);
        assert_eq!(survey.observed([18_100.0, 18_900.0]), [[18_100.0, 18_900.0]]);
        assert_eq!(survey.observed([20_399.0, 36_001.0]), [[20_399.0, 36_001.0]]);
        assert_eq!(survey.observed([5000.0, 5000.0]), [[5000.0, 5001.0]]);
    }
}
