//! Events, bursts in several channels at once, and their light curves.
//!
//! A light curve is that of the fit of short cells ([`Flux::fit_curve`]), averaged over the length of a usual integration: shorter averages are mostly
//! prior. Its errors are the larger of those by the scatter of pairs and by the model; their sum is too large, as measured.

use rayon::prelude::*;
use serde::Serialize;

use super::detect::{Entry, pairs_of, rows_of};
use super::flux::{Flux, affordable};
use super::rows::{BurstRow, Place};
use super::{BurstSearch, FoundBurst, PassCounts, SearchedChannel, find_bursts};
use crate::frames::PlacedVisibilities;
use crate::numerics::median;
use crate::sky::k_sr_per_jy;
use crate::units::vector::{Vec3, direction};

/// Least number of visibilities of a pair in a pass.
const VISIBILITIES_MIN: usize = 8;

/// Time that light curves begin before an event and end after it, in units of its length, and the least, s.
const MARGIN: f64 = 0.25;
const MARGIN_S: f64 = 30.0;

/// Cells of a fit that a value of a light curve is the mean of, at least.
const CELLS_OF_POINT: f64 = 2.0;

/// Work of a fit, as [`affordable`] counts it, for nine times the cells.
const WORK_MAX: f64 = 1e7;

/// Flux density of a burst in a short time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FluxPoint {
    /// Start, s since the epoch.
    pub from_s: f64,
    /// End, s.
    pub until_s: f64,
    /// Mean flux density, as an isotropic antenna sees it, Jy.
    pub flux_jy: f64,
    /// Standard error, Jy.
    pub sigma_jy: f64,
}

/// Light curve of an event in one channel.
#[derive(Clone, Debug, PartialEq)]
pub struct ChannelCurve {
    /// Channel, from 0.
    pub channel: u16,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Whether a burst was found in the channel; else the direction is that of another.
    pub is_found: bool,
    /// Values in the order of time, but where no visibility sees the direction.
    pub points: Vec<FluxPoint>,
}

/// Bursts that overlap in time, in any channels.
#[derive(Clone, Debug, PartialEq)]
pub struct BurstEvent {
    /// Start of the light curves, s since the epoch.
    pub from_s: f64,
    /// Their end, s.
    pub until_s: f64,
    /// The bursts, in the order of their starts.
    pub bursts: Vec<FoundBurst>,
    /// Light curves of all channels of the pass, in their order; empty if no burst has a direction.
    pub curves: Vec<ChannelCurve>,
}

/// Finds the events in the visibilities of a pass, by channel, and counts the pass.
#[must_use]
pub fn find_events(
    search: BurstSearch,
    channels: &[Vec<PlacedVisibilities>],
    counts: &mut PassCounts,
) -> Vec<BurstEvent> {
    let searched = |channel: &Vec<PlacedVisibilities>| -> SearchedChannel {
        find_bursts(search, &channel.iter().collect::<Vec<_>>())
    };
    let searched: Vec<SearchedChannel> = channels.iter().map(searched).collect();
    counts.add_pass(&searched);
    let mut bursts: Vec<FoundBurst> = searched.into_iter().flat_map(|channel| channel.bursts).collect();
    bursts.sort_by(|a, b| a.from_s.total_cmp(&b.from_s).then(a.channel.cmp(&b.channel)));
    let mut events: Vec<BurstEvent> = Vec::new();
    for burst in bursts {
        match events.last_mut().filter(|event| burst.from_s < event.until_s) {
            Some(event) => {
                event.until_s = event.until_s.max(burst.until_s);
                event.bursts.push(burst);
            }
            None => {
                let (from_s, until_s) = (burst.from_s, burst.until_s);
                events.push(BurstEvent { from_s, until_s, bursts: vec![burst], curves: Vec::new() });
            }
        }
    }
    events.iter_mut().for_each(|event| event.draw(search, channels));
    events
}

/// The likeliest direction of a burst, and its error, deg.
fn likeliest(burst: &FoundBurst) -> Option<(Vec3, f64)> {
    let [longitude_deg, latitude_deg] = *burst.positions_deg.first()?;
    Some((direction(longitude_deg, latitude_deg), burst.position_errors_deg.first()?[0]))
}

impl BurstEvent {
    /// Fits the light curves, and widens the span to theirs.
    fn draw(&mut self, search: BurstSearch, channels: &[Vec<PlacedVisibilities>]) {
        let margin_s = (MARGIN * (self.until_s - self.from_s)).max(MARGIN_S);
        (self.from_s, self.until_s) = (self.from_s - margin_s, self.until_s + margin_s);
        let known = self.bursts.iter().filter_map(|burst| Some((burst.channel, likeliest(burst)?)));
        let Some((best, (hat, _))) = known.min_by(|(_, (_, a)), (_, (_, b))| a.total_cmp(b)) else { return };
        let moon_radius_m = search.moon_radius_m;
        let pairs: Vec<Vec<Vec<Entry>>> = channels
            .iter()
            .map(|blocks| pairs_of(&blocks.iter().collect::<Vec<_>>(), VISIBILITIES_MIN))
            .collect();
        let span_s = [self.from_s, self.until_s];
        let is_best = |blocks: &Vec<PlacedVisibilities>| blocks.iter().any(|block| block.channel.0 == best);
        let smears = channels.iter().position(is_best).is_some_and(|index| {
            let rows = rows_in(&pairs[index], span_s);
            let squares = |smears: bool| {
                let flux = Flux::fit(&rows, Place { hat, moon_radius_m, smears }, span_s)?;
                Some(flux.squares(&rows))
            };
            squares(true).zip(squares(false)).is_some_and(|(smeared, middle)| smeared < middle)
        });
        let curve = |(blocks, pairs): (&Vec<PlacedVisibilities>, &Vec<Vec<Entry<'_>>>)| {
            let PlacedVisibilities { channel, frequency_hz, .. } = blocks.first()?;
            let own = self.bursts.iter().filter(|burst| burst.channel == channel.0);
            let nearest = own.clone().filter_map(likeliest).min_by(|(_, a), (_, b)| a.total_cmp(b));
            let hat = nearest.map_or(hat, |(own, _)| own);
            let place = Place { hat, moon_radius_m, smears };
            let points = light_curve(&rows_in(pairs, span_s), place, span_s, k_sr_per_jy(*frequency_hz));
            let (channel, frequency_hz, is_found) = (channel.0, *frequency_hz, own.count() > 0);
            Some(ChannelCurve { channel, frequency_hz, is_found, points })
        };
        self.curves = channels.par_iter().zip(&pairs).filter_map(curve).collect();
    }
}

fn rows_in<'a>(pairs: &[Vec<Entry<'a>>], span_s: [f64; 2]) -> Vec<BurstRow<'a>> {
    affordable(&rows_of(pairs, span_s), span_s, WORK_MAX)
}

/// Flux densities by time; none where the visibilities do not determine them.
pub(super) fn light_curve(
    rows: &[BurstRow],
    place: Place,
    span_s: [f64; 2],
    k_sr_per_jy: f64,
) -> Vec<FluxPoint> {
    let usual_s = median(rows.iter().map(BurstRow::duration_s).collect());
    let Some((flux, usual_s)) = Flux::fit_curve(rows, place, span_s).zip(usual_s) else { return Vec::new() };
    let length_s = flux.cell_s() * (usual_s / flux.cell_s()).ceil().max(CELLS_OF_POINT);
    let residuals = flux.residuals(rows);
    let point = |index: usize| {
        let from_s = span_s[0] + length_s * index as f64;
        let until_s = from_s + length_s;
        let mean = flux.mean(&residuals, [from_s, until_s]);
        let sigma_jy = mean.by_pairs.max(mean.by_model).sqrt() / k_sr_per_jy;
        let flux_jy = mean.power_k_sr / k_sr_per_jy;
        (mean.is_seen && sigma_jy.is_finite()).then_some(FluxPoint { from_s, until_s, flux_jy, sigma_jy })
    };
    let count = ((span_s[1] - span_s[0]) / length_s) as usize;
    (0..count).filter_map(point).collect()
}
