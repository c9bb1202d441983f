//! Metrics for Prometheus: the status in the OpenMetrics text format.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric, text};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::{Registry, Unit};

use super::console::Console;
use super::status::{Phase, Status};
use crate::downlink::PacketKind;
use crate::downlink::transport::socket::ConnectionEnd;
use crate::files::disk_space;
use crate::pipeline::MemoryLimit;
use crate::runtime::{DurationCounts, StageProgress};
use crate::units::Reason;

pub(super) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Writes all metrics as text.
///
/// # Errors
/// None in practice: writing to a string does not fail.
pub(super) fn scrape(console: &Arc<Console>) -> Result<String, fmt::Error> {
    let mut registry = Registry::with_prefix("lunarray");
    let (status, progress, folders) = (console.status(), console.progress(), console.folders.clone());
    registry.register_collector(Box::new(Scrape { folders, status, progress }));
    let mut out = String::new();
    text::encode(&mut out, &registry)?;
    Ok(out)
}

/// The state of a run at the time of a scrape.
#[derive(Debug)]
struct Scrape {
    folders: Vec<(&'static str, PathBuf)>,
    status: Status,
    progress: Vec<StageProgress>,
}

/// Resident memory of this process, bytes; `None` if the system does not report it.
fn resident_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    line.split_whitespace().next()?.parse::<u64>().ok().map(|kib| kib * 1024)
}

type Sample<const N: usize, V> = ([(&'static str, String); N], V);

struct MetricInfo(&'static str, &'static str, Option<Unit>);

fn items() -> Option<Unit> {
    Some(Unit::Other("items".into()))
}

fn gauges<const N: usize>(
    out: &mut DescriptorEncoder<'_>,
    MetricInfo(name, help, unit): MetricInfo,
    samples: impl IntoIterator<Item = Sample<N, f64>>,
) -> fmt::Result {
    let mut metric = out.encode_descriptor(name, help, unit.as_ref(), MetricType::Gauge)?;
    for (labels, value) in samples {
        ConstGauge::new(value).encode(metric.encode_family(&labels)?)?;
    }
    Ok(())
}

fn counters<const N: usize>(
    out: &mut DescriptorEncoder<'_>,
    MetricInfo(name, help, unit): MetricInfo,
    samples: impl IntoIterator<Item = Sample<N, u64>>,
) -> fmt::Result {
    let mut metric = out.encode_descriptor(name, help, unit.as_ref(), MetricType::Counter)?;
    for (labels, value) in samples {
        ConstCounter::new(value).encode(metric.encode_family(&labels)?)?;
    }
    Ok(())
}

fn gauge(out: &mut DescriptorEncoder<'_>, about: MetricInfo, value: f64) -> fmt::Result {
    let MetricInfo(name, help, unit) = about;
    let value = ConstGauge::new(value);
    value.encode(out.encode_descriptor(name, help, unit.as_ref(), MetricType::Gauge)?)
}

fn gauge_if(out: &mut DescriptorEncoder<'_>, about: MetricInfo, value: Option<f64>) -> fmt::Result {
    value.map_or(Ok(()), |value| gauge(out, about, value))
}

fn counter(out: &mut DescriptorEncoder<'_>, about: MetricInfo, value: u64) -> fmt::Result {
    let MetricInfo(name, help, unit) = about;
    let value = ConstCounter::new(value);
    value.encode(out.encode_descriptor(name, help, unit.as_ref(), MetricType::Counter)?)
}

impl Collector for Scrape {
    fn encode(&self, mut out: DescriptorEncoder<'_>) -> fmt::Result {
        self.run(&mut out)?;
        self.stages(&mut out)?;
        self.ground(&mut out)?;
        self.senders(&mut out)?;
        self.maps(&mut out)?;
        self.machine(&mut out)?;
        self.visitors(&mut out)
    }
}

impl Scrape {
    fn run(&self, out: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let Status { version, name, segment, phase, up_s, .. } = &self.status;
        let build = [
            ("version", (*version).to_owned()),
            ("pipeline", name.clone()),
            ("segment", (*segment).to_owned()),
        ];
        gauges(
            out,
            MetricInfo("build_info", "Version, name of the pipeline, part of the chain", None),
            [(build, 1.0)],
        )?;
        let uptime = MetricInfo("uptime", "Time since the server started", Some(Unit::Seconds));
        gauge(out, uptime, *up_s)?;
        let phases = Phase::ALL.map(|p| ([("phase", p.name().to_owned())], f64::from(u8::from(p == *phase))));
        gauges(out, MetricInfo("run_phase", "1 for the current phase of the run", None), phases)
    }

    fn stages(&self, out: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let stages = &self.status.stages;
        let label = |name: &str| [("stage", name.to_owned())];
        let queued = stages.iter().filter_map(|s| Some((label(&s.name), s.queue?)));
        let depth = queued.clone().map(|(label, queue)| (label, queue.depth as f64));
        gauges(out, MetricInfo("stage_queue", "Items that wait before a stage", items()), depth)?;
        let capacity = queued.map(|(label, queue)| (label, queue.capacity as f64));
        gauges(
            out,
            MetricInfo("stage_queue_capacity", "Items that can wait before a stage", items()),
            capacity,
        )?;
        let busy = stages.iter().map(|s| (label(&s.name), s.busy));
        let about = MetricInfo(
            "stage_busy",
            "Fraction of the last seconds in which a stage worked",
            Some(Unit::Ratios),
        );
        gauges(out, about, busy)?;
        let received = stages.iter().map(|s| (label(&s.name), s.items_in));
        counters(out, MetricInfo("stage_received", "Items that a stage has taken", items()), received)?;
        let sent = stages.iter().map(|s| (label(&s.name), s.items_out));
        counters(out, MetricInfo("stage_sent", "Items that a stage has passed on", items()), sent)?;
        let units = stages.iter().filter(|s| !s.unit.is_empty());
        let units = units.map(|s| ([("stage", s.name.clone()), ("unit", s.unit.to_owned())], s.units));
        counters(out, MetricInfo("stage_units", "What a stage has processed, in its own unit", None), units)?;
        let ended = stages.iter().map(|s| (label(&s.name), f64::from(u8::from(s.ended))));
        gauges(out, MetricInfo("stage_ended", "1 for a stage that has ended", None), ended)?;
        let step = MetricInfo("stage_step", "Work of a stage on one item", Some(Unit::Seconds));
        self.histogram(out, step, |stage| &stage.working)?;
        let about = MetricInfo(
            "stage_latency",
            "From the source's push to the end of a stage's step",
            Some(Unit::Seconds),
        );
        self.histogram(out, about, |stage| &stage.since_source)
    }

    fn histogram(
        &self,
        out: &mut DescriptorEncoder<'_>,
        MetricInfo(name, help, unit): MetricInfo,
        durations_of: impl Fn(&StageProgress) -> &DurationCounts,
    ) -> fmt::Result {
        let mut metric = out.encode_descriptor(name, help, unit.as_ref(), MetricType::Histogram)?;
        for stage in self.progress.iter().filter(|stage| durations_of(stage).count() > 0) {
            let durations = durations_of(stage);
            let mut classes: Vec<(f64, u64)> = durations.classes().collect();
            // The last class also counts all longer durations.
            if let Some(last) = classes.last_mut() {
                last.0 = f64::INFINITY;
            }
            let labels = [("stage", stage.name.clone())];
            let mut encoder = metric.encode_family(&labels)?;
            encoder.encode_histogram::<[(&str, String); 1]>(
                durations.total_s,
                durations.count(),
                &classes,
                None,
            )?;
        }
        Ok(())
    }

    fn ground(&self, out: &mut DescriptorEncoder<'_>) -> fmt::Result {
        self.ledger(out)?;
        self.reception(out)?;
        if let Some(waiting) = self.status.waiting_bytes {
            let about = "Visibilities that wait for their positions";
            gauge(out, MetricInfo("waiting", about, Some(Unit::Bytes)), waiting as f64)?;
        }
        if let Some(bursts) = self.status.bursts {
            let about = "Bursts of point sources found, counted in each channel";
            counter(out, MetricInfo("bursts", about, None), bursts)?;
        }
        if let Some(alerts) = self.status.burst_alerts {
            let about = "Alerts of bursts before their passes ended, in this session";
            counter(out, MetricInfo("burst_alerts", about, None), alerts)?;
        }
        if let Some(untold) = self.status.burst_alerts_untold {
            let about =
                "Alerts of bursts that were only counted, as their passes had eight in their channels";
            counter(out, MetricInfo("burst_alerts_untold", about, None), untold)?;
        }
        self.saving(out)?;
        let Some(products) = &self.status.products else { return Ok(()) };
        let about = "Attempts to write maps and pictures that failed";
        counter(out, MetricInfo("products_failed", about, None), products.failed)?;
        let about = "1 if the last attempt to write maps and pictures failed";
        let unwritten = f64::from(u8::from(products.unwritten.is_some()));
        gauge(out, MetricInfo("products_unwritten", about, None), unwritten)
    }

    /// Writes the ledger as gauges, not counters: retracted visibilities are subtracted.
    fn ledger(&self, out: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let Some(ledger) = &self.status.ledger else { return Ok(()) };
        let visibilities = || Some(Unit::Other("visibilities".into()));
        let entry = |entry: &str, count: u64| ([("entry", entry.to_owned())], count as f64);
        let sampled = ledger.sampled.map(|(sampled, _)| entry("sampled", sampled));
        let entries = sampled.into_iter().chain([entry("accumulated", ledger.report.accumulated)]);
        gauges(out, MetricInfo("ledger", "Visibilities by outcome", visibilities()), entries)?;
        let left_out = ledger.report.left_out.iter().map(|(reason, &count)| {
            let stage = reason.lost_in().unwrap_or("");
            ([("reason", reason.text().to_owned()), ("lost_in", stage.to_owned())], count as f64)
        });
        let about = "Visibilities flagged, or lost in a stage";
        gauges(out, MetricInfo("ledger_left_out", about, visibilities()), left_out)?;
        let about =
            "Visibilities without an entry at the end of a run; not zero if the ledger does not balance";
        let unaccounted = ledger.sampled.map(|(_, rest)| rest as f64);
        gauge_if(out, MetricInfo("ledger_unaccounted", about, visibilities()), unaccounted)
    }

    fn reception(&self, out: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let Some(reception) = &self.status.reception else { return Ok(()) };
        let packets = || Some(Unit::Other("packets".into()));
        let kinds = |count: &dyn Fn(PacketKind) -> u64| {
            PacketKind::ALL.map(|kind| ([("kind", kind.to_string())], count(kind) as f64))
        };
        let sound = kinds(&|kind| reception.kind(kind).packets);
        gauges(out, MetricInfo("reception", "Valid packets received, without duplicates", packets()), sound)?;
        let missing = kinds(&|kind| reception.kind(kind).missing);
        let about = "Packets missing between those received";
        gauges(out, MetricInfo("reception_missing", about, packets()), missing)?;
        let damaged = kinds(&|kind| reception.kind(kind).damaged);
        gauges(out, MetricInfo("reception_damaged", "Packets with a bad checksum", packets()), damaged)?;
        let duplicates = kinds(&|kind| reception.kind(kind).duplicates);
        gauges(out, MetricInfo("reception_duplicate", "Duplicate packets", packets()), duplicates)
    }

    fn saving(&self, out: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let Some(saving) = &self.status.saving else { return Ok(()) };
        let about = "Checkpoints written in this session";
        counter(out, MetricInfo("checkpoints_written", about, None), saving.written)?;
        let about = "Checkpoints that could not be written";
        counter(out, MetricInfo("checkpoints_failed", about, None), saving.failed)?;
        let about = "1 if the last checkpoint could not be written";
        let unsaved = f64::from(u8::from(saving.unsaved.is_some()));
        gauge(out, MetricInfo("state_unsaved", about, None), unsaved)?;
        let about = "Received since the newest checkpoint";
        gauge(out, MetricInfo("state_unsaved", about, Some(Unit::Bytes)), saving.unsaved_bytes as f64)?;
        let about = "Age of the oldest packet that no checkpoint holds";
        gauge(out, MetricInfo("state_unsaved_age", about, Some(Unit::Seconds)), saving.unsaved_s)?;
        let about = "Age of the newest checkpoint of this session";
        gauge_if(out, MetricInfo("checkpoint_age", about, Some(Unit::Seconds)), saving.checkpoint_s)
    }

    /// Writes free space of disks, and memory.
    fn machine(&self, out: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let disks: Vec<_> =
            self.folders.iter().filter_map(|(name, path)| Some((*name, disk_space(path)?))).collect();
        let label = |name: &str| [("folder", name.to_owned())];
        let free = disks.iter().map(|(name, [free, _])| (label(name), *free as f64));
        gauges(out, MetricInfo("disk_free", "Free space on the disk of a folder", Some(Unit::Bytes)), free)?;
        let size = disks.iter().map(|(name, [_, size])| (label(name), *size as f64));
        gauges(out, MetricInfo("disk_size", "Size of the disk of a folder", Some(Unit::Bytes)), size)?;
        let available = MemoryLimit::of_machine().map(|limit| limit.bytes as f64);
        let about = "Memory available to this process: of the machine, or below its own limit or that of its control group";
        gauge_if(out, MetricInfo("memory_available", about, Some(Unit::Bytes)), available)?;
        let resident = resident_bytes().map(|bytes| bytes as f64);
        gauge_if(out, MetricInfo("memory_resident", "Memory of this process", Some(Unit::Bytes)), resident)
    }

    fn senders(&self, out: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let Some(listening) = &self.status.listening else { return Ok(()) };
        let report = &listening.report;
        gauge(out, MetricInfo("senders_open", "Senders that are connected", None), listening.open as f64)?;
        counter(
            out,
            MetricInfo("senders_accepted", "Connections accepted from senders", None),
            report.connections,
        )?;
        counter(out, MetricInfo("senders_refused", "Connections of senders refused", None), report.refused)?;
        counter(out, MetricInfo("senders_read", "Read from senders", Some(Unit::Bytes)), listening.bytes)?;
        let about = "Read from senders and not taken by the ground yet";
        gauge(out, MetricInfo("senders_backlog", about, Some(Unit::Bytes)), listening.backlog_bytes as f64)?;
        let up_s = self.status.up_s;
        let silence_s = listening.silence_s.unwrap_or(up_s);
        let about = "Time since the last valid packet from any sender, or since the server started";
        gauge(out, MetricInfo("senders_silence", about, Some(Unit::Seconds)), silence_s)?;
        if let Some(archive) = &listening.archive {
            gauge(
                out,
                MetricInfo("archive", "Packets in the raw archive", Some(Unit::Bytes)),
                archive.bytes as f64,
            )?;
            let about =
                MetricInfo("archive_failed", "Pieces that could not be written into the raw archive", None);
            counter(out, about, archive.failed)?;
            let about = "1 if the last piece could not be written into the raw archive";
            let unwritten = f64::from(u8::from(archive.unwritten.is_some()));
            gauge(out, MetricInfo("archive_unwritten", about, None), unwritten)?;
            let about = "1 while the raw archive reaches back to the first packet";
            gauge(out, MetricInfo("archive_whole", about, None), f64::from(u8::from(archive.is_whole)))?;
        }
        if let Some(datagrams) = &report.datagrams {
            let counts = [
                ("taken", datagrams.received - datagrams.malformed - datagrams.refused),
                ("malformed", datagrams.malformed),
                ("refused", datagrams.refused),
                ("dropped", datagrams.dropped_by_system.unwrap_or(0)),
            ];
            let about = MetricInfo("datagrams", "Datagrams by outcome; `dropped` by the system", None);
            counters(out, about, counts.map(|(end, count)| ([("end", end.to_owned())], count)))?;
        }
        // Export zeros: Prometheus computes increases only from an existing value.
        let ended = ConnectionEnd::ALL.iter().filter_map(|end| {
            let name = serde_json::to_value(end).ok()?.as_str()?.to_owned();
            Some(([("end", name)], report.ended.get(end).copied().unwrap_or(0)))
        });
        counters(out, MetricInfo("senders_ended", "Connections of senders by how they ended", None), ended)?;
        let stations = || report.stations.iter().map(|(name, counts)| ([("station", name.clone())], counts));
        let about = MetricInfo("station_read", "Read from a station known by its token", Some(Unit::Bytes));
        counters(out, about, stations().map(|(label, counts)| (label, counts.bytes)))?;
        let silences = stations()
            .map(|(label, counts)| (label, counts.heard.map_or(up_s, |heard| heard.elapsed().as_secs_f64())));
        let about = "Time since the last valid packet from a station, or since the server started";
        let about = MetricInfo("station_silence", about, Some(Unit::Seconds));
        gauges(out, about, silences)?;
        let about = MetricInfo("station_connections", "Connections of a station that have ended", None);
        counters(out, about, stations().map(|(label, counts)| (label, counts.connections)))
    }

    fn maps(&self, out: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let channels = &self.status.channels;
        let label = |frequency_hz: f64| [("frequency_mhz", format!("{:.3}", frequency_hz / 1e6))];
        let known = || channels.iter().filter_map(|c| Some((label(c.frequency_hz), c.figures.as_ref()?)));
        let numbers = known().map(|(label, figures)| (label, f64::from(figures.number)));
        gauges(out, MetricInfo("map_snapshot", "Number of the last map of a channel", None), numbers)?;
        let counts = known().map(|(label, figures)| (label, figures.visibilities as f64));
        let unit = Some(Unit::Other("visibilities".into()));
        gauges(out, MetricInfo("map", "Visibilities in the last map of a channel", unit), counts)?;
        let times = known().map(|(label, figures)| (label, figures.until_s));
        let about =
            MetricInfo("map_until", "Mission time of the last data in a channel's map", Some(Unit::Seconds));
        gauges(out, about, times)?;
        let ages = channels.iter().map(|channel| (label(channel.frequency_hz), channel.age_s));
        gauges(
            out,
            MetricInfo("map_age", "Time since the last map of a channel was made", Some(Unit::Seconds)),
            ages,
        )?;
        let noise = channels.iter().map(|channel| (label(channel.frequency_hz), channel.noise_rms_k));
        let unit = Some(Unit::Other("kelvin".into()));
        gauges(out, MetricInfo("map_noise_rms", "RMS of the noise-only map of a channel", unit), noise)?;
        let solving = self.status.solving.as_ref();
        let is_solving = f64::from(u8::from(solving.is_some()));
        gauge(
            out,
            MetricInfo("solver_active", "1 while a map is being solved by iteration", None),
            is_solving,
        )?;
        if let Some(solving) = solving {
            gauge(
                out,
                MetricInfo("solver_iteration", "Iterations of the solution in progress", None),
                solving.iteration as f64,
            )?;
            gauge(
                out,
                MetricInfo("solver_residual", "Residual of the solution in progress", Some(Unit::Ratios)),
                solving.residual,
            )?;
            gauge(
                out,
                MetricInfo("solver_target", "Residual at which the solution ends", Some(Unit::Ratios)),
                solving.target,
            )?;
        }
        Ok(())
    }

    fn visitors(&self, out: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let visitors = self.status.visitors;
        gauge(
            out,
            MetricInfo("http_connections", "Open connections to this server", None),
            visitors.open as f64,
        )?;
        counter(
            out,
            MetricInfo("http_refused", "Connections refused as too many were open", None),
            visitors.refused,
        )?;
        counter(
            out,
            MetricInfo("http_cut", "Connections closed by the server: silent, slow or not HTTP", None),
            visitors.cut,
        )?;
        counter(out, MetricInfo("http_requests", "Requests answered", None), visitors.requests)
    }
}
