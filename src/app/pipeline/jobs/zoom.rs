//! A patch of sky at the array's resolution, from downlink files.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::frames::{Channel, Instrument, VisibilityReason};
use crate::ground::{WAIT_BYTES, read_placed};
use crate::imaging::zoom::{Averager, AveragingCounts, AveragingSetup, KnownSource, Patch, Row, zoom};
use crate::pipeline::config::{Config, PipelineError};
use crate::pipeline::graph::calibrate_products::write_json;
use crate::pipeline::graph::run::lock_folder;
use crate::products::create_folder;
use crate::products::{ListedSource, ZoomSummary, write_zoom};
use crate::runtime::{Ledger, LedgerReport};
use crate::sky::fits::Card;
use crate::sky::generated::{AddedSkyError, CataloguePoint, read_catalogue};
use crate::units::vector::Vec3;
use crate::units::{ChannelId, InvalidValue};

/// What is imaged, of which data.
#[derive(Clone, Debug)]
pub struct ZoomJob<'a> {
    /// Settings of the ground; only those of calibration are used.
    pub config: &'a Config,
    /// Downlink files.
    pub files: &'a [PathBuf],
    /// Centre of the patch.
    pub centre: ZoomCentre,
    /// Radius of the patch, degrees.
    pub radius_deg: f64,
    /// Side of a pixel, arcmin; `None` for a third of the finest fringe.
    pub pixel_arcmin: Option<f64>,
    /// Channel.
    pub channel: ChannelId,
    /// Table of known sources, by which those found are named.
    pub catalogue: Option<&'a Path>,
    /// Flux density at which known sources outside the patch are subtracted, Jy; `None` for none.
    pub subtract_jy: Option<f64>,
    /// Shortest and longest baseline that is used, wavelengths.
    pub baselines_wavelengths: [Option<f64>; 2],
    /// Folder for the products.
    pub out: &'a Path,
}

/// Centre of a patch.
#[derive(Clone, Debug, PartialEq)]
pub enum ZoomCentre {
    /// Right ascension and declination (J2000), degrees.
    Equatorial([f64; 2]),
    /// A source of the catalogue.
    Named(String),
}

/// The result: what became of the visibilities, and what was found.
#[derive(Clone, Debug, Serialize)]
pub struct ZoomReport {
    /// Name of the source at the centre, if the centre is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub centre_name: Option<String>,
    /// All visibilities; those accumulated are in averages.
    pub ledger: LedgerReport<VisibilityReason>,
    /// Images and sources.
    #[serde(flatten)]
    pub zoom: ZoomSummary,
}

/// Images a patch, and writes its products and `summary.json`.
///
/// # Errors
/// Files that cannot be read or written; a centre or channel that does not exist; no data of the patch.
pub fn zoom_downlink(job: &ZoomJob<'_>) -> Result<ZoomReport, PipelineError> {
    let index = job.config.sky.generated.source_spectral_index;
    let read = |path: &Path| read_catalogue(path, index).map_err(AddedSkyError::from);
    let catalogue = job.catalogue.map(read).transpose()?.unwrap_or_default();
    let centre_deg = job.centre_deg(&catalogue)?;
    let patch = Patch::new(centre_deg, job.radius_deg);
    create_folder(job.out)?;
    let _lock = lock_folder(job.out)?;
    let ledger = Ledger::new();
    let (instrument, rows, counts) = job.averages(&patch, &catalogue, &ledger)?;
    post(&ledger, counts);
    let channel = channel_of(&instrument, job.channel)?;
    let zoomed = zoom((&rows, counts), &patch, job.pixel_arcmin)?;
    let listed: Vec<ListedSource> = catalogue
        .iter()
        .map(|point| ListedSource {
            name: point.name.clone(),
            direction: point.direction,
            flux_jy: point.flux_jy(channel.frequency_hz),
        })
        .collect();
    let of_data = (channel.frequency_hz, job.baselines_wavelengths, rows.len());
    let report = ZoomReport {
        centre_name: match &job.centre {
            ZoomCentre::Named(name) => Some(name.clone()),
            ZoomCentre::Equatorial(_) => None,
        },
        ledger: ledger.balanced_report()?,
        zoom: ZoomSummary::new(&zoomed, &patch, centre_deg, of_data, &listed),
    };
    write_zoom(job.out, &zoomed, &report.zoom, &cards(&instrument, counts))?;
    write_json(&job.out.join("summary.json"), &report)?;
    Ok(report)
}

impl ZoomJob<'_> {
    /// Right ascension and declination of the centre, degrees.
    fn centre_deg(&self, catalogue: &[CataloguePoint]) -> Result<[f64; 2], PipelineError> {
        let name = match &self.centre {
            ZoomCentre::Equatorial(centre_deg) => return Ok(*centre_deg),
            ZoomCentre::Named(name) => name,
        };
        let plain = |name: &str| name.split_whitespace().collect::<String>().to_lowercase();
        let found = catalogue.iter().find(|point| plain(&point.name) == plain(name));
        let found = found.ok_or_else(|| {
            let expected = "right ascension and declination in degrees, such as 83.6,22.0, or the name of a source of --catalogue";
            invalid("--centre", name, expected)
        })?;
        Ok(Patch::equatorial_of(found.direction))
    }

    /// The averages of the channel.
    fn averages(
        &self,
        patch: &Patch,
        catalogue: &[CataloguePoint],
        ledger: &Ledger<VisibilityReason>,
    ) -> Result<(Instrument, Vec<Row>, AveragingCounts), PipelineError> {
        let mut ground = self.config.ground(WAIT_BYTES);
        ground.group = Some([self.channel].into());
        let mut averager: Option<(Instrument, Averager)> = None;
        read_placed(&ground, self.files, ledger, &mut |instrument, placed| {
            if placed.channel != self.channel {
                return ledger.add_left_out(VisibilityReason::ChannelNotMapped, placed.len() as u64);
            }
            let open = || {
                (
                    instrument.clone(),
                    Averager::new(self.setup(patch, catalogue, instrument, placed.frequency_hz)),
                )
            };
            averager.get_or_insert_with(open).1.add(placed);
        })?;
        let Some((instrument, averager)) = averager else {
            let found = format!("{} ({} visibilities in all)", self.channel, ledger.report().sampled);
            return Err(invalid(
                "--channel",
                &found,
                "a channel with visibilities whose positions are known",
            ));
        };
        let (rows, counts) = averager.finish();
        Ok((instrument, rows, counts))
    }

    fn setup(
        &self,
        patch: &Patch,
        catalogue: &[CataloguePoint],
        instrument: &Instrument,
        frequency_hz: f64,
    ) -> AveragingSetup {
        let is_outside = |direction: Vec3| {
            let [l, m, n] = patch.on_axes(direction);
            n < 0.0 || l.hypot(m) > patch.radius_rad().sin()
        };
        let known = catalogue
            .iter()
            .map(|point| KnownSource { direction: point.direction, flux_jy: point.flux_jy(frequency_hz) });
        let least_jy = self.subtract_jy.unwrap_or(f64::INFINITY);
        let known = known.filter(|one| one.flux_jy >= least_jy && is_outside(one.direction)).collect();
        let [shortest, longest] = self.baselines_wavelengths;
        AveragingSetup {
            patch: *patch,
            moon_radius_m: instrument.moon_radius_m,
            response: instrument.response,
            baselines_wavelengths: [shortest.unwrap_or(0.0), longest.unwrap_or(f64::INFINITY)],
            known,
        }
    }
}

fn invalid(key: &str, value: &str, expected: &'static str) -> PipelineError {
    InvalidValue { key: key.to_owned(), value: value.to_owned(), expected: expected.into() }.into()
}

fn channel_of(instrument: &Instrument, channel: ChannelId) -> Result<Channel, PipelineError> {
    let found = instrument.channels.get(usize::from(channel.0)).copied();
    found.ok_or_else(|| {
        invalid("--channel", &channel.to_string(), "a channel of the instrument, counted from 0")
    })
}

/// Posts what became of the visibilities of the channel.
fn post(ledger: &Ledger<VisibilityReason>, counts: AveragingCounts) {
    let AveragingCounts { averaged, hidden, limb, short, long, insensitive, unusable } = counts;
    ledger.add_accumulated(averaged);
    for (reason, count) in [
        (VisibilityReason::PatchHidden, hidden),
        (VisibilityReason::PatchOnLimb, limb),
        (VisibilityReason::BaselineShort, short),
        (VisibilityReason::BaselineBeyondMap, long),
        (VisibilityReason::PatchInsensitive, insensitive),
        (VisibilityReason::ValueNotFinite, unusable),
    ] {
        ledger.add_left_out(reason, count);
    }
}

/// Cards of the origin of the data.
fn cards(instrument: &Instrument, counts: AveragingCounts) -> Vec<Card> {
    vec![
        Card::text("TELESCOP", "lunarray", "array of satellites in lunar orbit"),
        Card::integer("NVIS", counts.averaged.try_into().unwrap_or(i64::MAX), "visibilities used"),
        Card::text("SEED", &format!("{:016x}", instrument.seed), "seed of the space segment, hexadecimal"),
        Card::text(
            "HASHSPAC",
            &format!("{:016x}", instrument.configuration_hash),
            "configuration, space segment",
        ),
    ]
}
