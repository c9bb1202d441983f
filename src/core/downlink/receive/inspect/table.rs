//! Renders the contents of a downlink file as tables.

use std::collections::BTreeMap;
use std::fmt;

use super::{Contents, HousekeepingSummary, VisibilityCounts};
use crate::downlink::receive::{Listing, ReceptionCounters};
use crate::units::printable;

const CHANNELS_PER_ROW: usize = 6;

/// Maximum number of entries shown per list; `--json` shows more.
const SHOWN_MAX: usize = 10;

impl fmt::Display for Contents {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}: {} bytes, {} packets", self.file, self.bytes, self.reception.packets())?;
        self.show_head(f)?;
        if let Some(frames) = &self.reception.frames {
            writeln!(f, "\n{frames}")?;
        }
        self.show_packets(f)?;
        self.show_channels(f)?;
        self.show_baselines(f)?;
        self.show_damage(f)
    }
}

/// A duration in a convenient unit.
fn duration(s: f64) -> String {
    match s {
        s if s >= 2.0 * 86_400.0 => format!("{:.2} d", s / 86_400.0),
        s if s >= 7_200.0 => format!("{:.2} h", s / 3_600.0),
        s => format!("{s:.3} s"),
    }
}

impl Contents {
    fn show_head(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.instrument {
            None => {
                writeln!(f, "\ninstrument    no description found: nothing else can be decoded without it")?
            }
            Some(i) => {
                writeln!(
                    f,
                    "\ninstrument    {}: {} satellites, response {}",
                    printable(&i.name),
                    i.satellites,
                    i.response
                )?;
                writeln!(
                    f,
                    "              epoch {} TAI, {} UTC, Moon {} m",
                    i.epoch_tai, i.epoch_utc, i.moon_radius_m
                )?;
                writeln!(f, "              seed {}, configuration {}", i.seed, i.configuration_hash)?;
                if let Some(spectrometer) = &i.spectrometer {
                    writeln!(
                        f,
                        "              satellite {} is a spectrometer: {spectrometer}",
                        i.satellites + 1
                    )?;
                }
            }
        }
        if let Some(span) = &self.span {
            let total = duration(span.end_s - span.start_s);
            writeln!(f, "span          {:.6} s to {:.6} s ({total})", span.start_s, span.end_s)?;
            writeln!(f, "              {} to {} UTC", span.start_utc, span.end_utc)?;
        }
        let VisibilityCounts { count, integration_s, flagged } = self.visibilities;
        let integration = duration(integration_s);
        writeln!(
            f,
            "visibilities  {count}, with a total integration time of {integration}; {flagged} flagged"
        )?;
        if let Some(counts) = &self.housekeeping {
            let (sampled, dropped) = (counts.sampled, counts.dropped);
            let until = match counts.time_s {
                Some(time_s) => format!("{time_s:.0} s"),
                None => "the end of the mission".to_owned(),
            };
            writeln!(f, "on board      {sampled} sampled, {dropped} dropped until {until}")?;
        }
        let ephemeris = &self.ephemeris;
        let (segments, intervals) = (ephemeris.segments, ephemeris.covered.count);
        let covered = duration(ephemeris.covered_s);
        writeln!(f, "ephemeris     {segments} segments over {covered} in {intervals} intervals")?;
        match ephemeris.contradictory {
            0 => {}
            1 => writeln!(f, "              1 segment contradicts another that begins at the same time")?,
            count => {
                writeln!(f, "              {count} segments contradict others that begin at the same time")?
            }
        }
        if segments > 0 {
            let hidden = ephemeris.earth_hidden_by_date;
            write!(
                f,
                "              the Moon hides the Earth at these dates in {hidden} of {segments} segments"
            )?;
            writeln!(f, "{}", if hidden < segments { ": the mission's Earth is idealised" } else { "" })?;
        }
        match ephemeris.interpolation_error_m_max {
            Some(error_m) => writeln!(f, "              positions between nodes within {}", length(error_m)),
            None => Ok(()),
        }
    }

    fn show_packets(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "\n{:<13} {:>6} {:>10} {:>14} {:>8} {:>8} {:>9} {:>8} {:>8}",
            "kind", "APID", "packets", "bytes", "missing", "damaged", "duplicate", "late", "orphans"
        )?;
        for row in &self.packets {
            let (kind, counts) = (row.kind, self.reception.kind(row.kind));
            writeln!(
                f,
                "{kind:<13} {:>#6x} {:>10} {:>14} {:>8} {:>8} {:>9} {:>8} {:>8}",
                row.apid,
                row.packets,
                row.bytes,
                counts.missing,
                counts.damaged,
                counts.duplicates,
                counts.late,
                counts.orphans
            )?;
        }
        Ok(())
    }

    fn show_channels(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.channels.is_empty() {
            return Ok(());
        }
        let titles = ["channel", "frequency", "width", "visibilities", "integration", "flagged"];
        let [channel, frequency, width, count, integration, flagged] = titles;
        writeln!(
            f,
            "\n{channel:<8} {frequency:>13} {width:>10} {count:>14} {integration:>14} {flagged:>10}"
        )?;
        for row in &self.channels {
            let VisibilityCounts { count, integration_s, flagged } = row.visibilities;
            let frequency = format!("{:.4} MHz", row.frequency_hz / 1e6);
            let (channel, integration) = (row.channel, duration(integration_s));
            let width = format!("{:.2} kHz", row.width_hz / 1e3);
            writeln!(
                f,
                "{channel:<8} {frequency:>13} {width:>10} {count:>14} {integration:>14} {flagged:>10}"
            )?;
        }
        Ok(())
    }

    /// Visibilities by pair (down) and channel (across).
    fn show_baselines(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut pairs: Vec<&str> = self.baselines.iter().map(|row| row.pair.as_str()).collect();
        pairs.dedup();
        let rows = self.baselines.iter().map(|row| ((&*row.pair, row.channel), row.visibilities.count));
        let counts: BTreeMap<(&str, u16), u64> = rows.collect();
        // Spectrometer channels are not in this table.
        pairs.retain(|pair| self.channels.iter().any(|row| counts.contains_key(&(*pair, row.channel))));
        for channels in self.channels.chunks(CHANNELS_PER_ROW) {
            if pairs.is_empty() {
                break;
            }
            write!(f, "\n{:<8}", "baseline")?;
            for channel in channels {
                write!(f, " {:>13}", format!("{:.3} MHz", channel.frequency_hz / 1e6))?;
            }
            writeln!(f)?;
            for pair in &pairs {
                write!(f, "{pair:<8}")?;
                for channel in channels {
                    let count = counts.get(&(pair, channel.channel)).copied().unwrap_or_default();
                    write!(f, " {count:>13}")?;
                }
                writeln!(f)?;
            }
        }
        Ok(())
    }

    /// The verdict on a file that is not known to be sound.
    fn show_verdict(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.is_usable() {
            let (without, bad) = (self.without_positions, self.reception.visibilities_bad_value);
            writeln!(
                f,
                "\nnot sound: {without} good visibilities have no positions in this file, and {bad} no finite value and positive weight"
            )?;
        }
        let verdict = match self.is_undamaged() {
            true if !self.is_usable() => "otherwise",
            true => "not known to be sound: no gaps, no bad checksums, no garbage, not truncated, but",
            false => "not sound: packets are missing, damaged or not readable, as listed below;",
        };
        match self.found_minus_reported().zip(self.housekeeping.as_ref()) {
            None => writeln!(
                f,
                "\n{verdict} no report of the spacecraft's counts: it is not known whether visibilities are missing"
            ),
            Some((excess, HousekeepingSummary { sampled, dropped, .. })) if excess < 0 => writeln!(
                f,
                "\nnot sound: {} of {sampled} visibilities that were sampled are not in this file ({dropped} were dropped on board)",
                excess.unsigned_abs()
            ),
            Some((excess, _)) if excess > 0 => writeln!(
                f,
                "\n{verdict} {excess} visibilities follow the last report of the spacecraft's counts: it is not known whether others are missing"
            ),
            Some(_) => writeln!(
                f,
                "\n{verdict} all visibilities that were sampled and not dropped on board are in this file"
            ),
        }
    }

    fn show_damage(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(restarts) = self.reception.restarts_text() {
            writeln!(f, "\n{restarts}")?;
        }
        if self.is_sound() {
            return writeln!(
                f,
                "\nsound: no gaps, no bad checksums, no garbage, not truncated; complete: all visibilities that were sampled and not \
                 dropped on board are in this file"
            );
        }
        self.show_verdict(f)?;
        show_list(f, "gaps", &self.gaps, |gap| {
            format!(
                "{}: {} to {}, {} packets, before byte {}",
                gap.kind, gap.from, gap.to, gap.count, gap.offset
            )
        })?;
        show_list(f, "bad checksums", &self.bad_checksums, |bad| {
            format!("byte {}: {} packet {} of {} bytes", bad.offset, bad.kind, bad.count, bad.bytes)
        })?;
        show_list(f, "garbage", &self.garbage, |garbage| {
            format!("byte {}: {} bytes", garbage.offset, garbage.bytes)
        })?;
        show_list(f, "refused payloads", &self.faults, |fault| {
            format!("byte {}: {}", fault.offset, fault.reason)
        })?;
        if self.truncated_bytes > 0 {
            writeln!(
                f,
                "\ntruncated: the last {} bytes are the beginning of a packet",
                self.truncated_bytes
            )?;
        }
        if self.reception.payloads_before_instrument > 0 {
            let ReceptionCounters { payloads_before_instrument: payloads, .. } = self.reception;
            let visibilities = self.reception.visibilities_before_instrument;
            writeln!(
                f,
                "\n{payloads} payloads with {visibilities} visibilities could not be read, as no instrument description came in time; they \
                 are in no table above"
            )?;
        }
        if self.reception.instruments_contradictory > 0 {
            let count = self.reception.instruments_contradictory;
            writeln!(
                f,
                "\n{count} instrument descriptions contradict the first; the payloads after them were refused"
            )?;
        }
        Ok(())
    }
}

fn show_list<T>(
    f: &mut fmt::Formatter<'_>,
    title: &str,
    listing: &Listing<T>,
    text: impl Fn(&T) -> String,
) -> fmt::Result {
    if listing.count == 0 {
        return Ok(());
    }
    writeln!(f, "\n{title}: {}", listing.count)?;
    for entry in listing.listed.iter().take(SHOWN_MAX) {
        writeln!(f, "  {}", text(entry))?;
    }
    match listing.count.saturating_sub(SHOWN_MAX as u64) {
        0 => Ok(()),
        more => writeln!(f, "  and {more} more"),
    }
}

/// A length in a convenient unit.
fn length(length_m: f64) -> String {
    match length_m {
        m if m < 1e-4 => format!("{:.2} um", 1e6 * m),
        m if m < 1e-1 => format!("{:.2} mm", 1e3 * m),
        m => format!("{m:.3} m"),
    }
}
