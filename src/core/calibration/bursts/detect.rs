//! Detection of bursts in the visibilities of a pass.
//!
//! A point source adds its whole power to the visibilities of all pairs at once, while the steady sky, resolved by most baselines, leaves a
//! small part of its power in each. Two statistics in short bins of time see it:
//!
//! - **Visibilities.** The squared modulus of each visibility is divided by the upper quartile of its pair in the pass; the statistic is the
//!   median over pairs of this ratio. The squared modulus of Gaussian visibilities is exponential, so a ratio exceeds x with probability
//!   4^-x. The median of n pairs exceeds it if more than half of them do: for the least number of pairs, six or seven, with probability
//!   35 * 4^(-4 x) at most, which is 2e-18 for x = 8, and 1e-17 with quartiles of 190 visibilities (1e-10 of the least, 8). A mission of 30
//!   channels has some 4e7 bins in 5000 passes: one of 1e9 missions has a false alarm, as far as its sky is Gaussian.
//! - **Powers.** A visibility's variance, P_i P_j / (2 dnu dt), has the powers of its daughters. Their rise, median over pairs, above the
//!   medians of the seven minutes before and of those after is the statistic: the Moon's limb makes slopes and steps, which rise above
//!   one of them only. A power is known to 0.4 % after 8 s of 8 kHz, so that a rise of 5 % is twelve standard deviations. It does not
//!   depend on gains and phases. Weights without powers (of other instruments) never rise.
//!
//! Neither holds where one source outshines the rest: the Moon uncovers and hides it, and a short sight of it is taken for a burst.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::LN_2;
use std::ops::Range;

use super::flux::{Flux, affordable};
use super::locate::{Sample, locate};
use super::refine::{name, refine};
use super::rows::{BurstRow, Place};
use super::searched::{BIN_S, PAIRS_MIN, PAIRS_OF_POWERS_MIN, SearchedChannel, VISIBILITIES_MIN};
use super::{BurstChoice, BurstSearch, FoundBurst, LightCurve};
use crate::frames::{AntennaResponse, PlacedVisibilities};
use crate::numerics::{median, percentiles};
use crate::response::pixel::PairGeometry;
use crate::sky::{ecliptic_deg, k_sr_per_jy};
use crate::units::Pair;
use crate::units::vector::Vec3;

/// Ratio from which a bin is a detection.
const RATIO: f64 = 8.0;

/// Ratio down to which bins beside a detection belong to the burst. Without a burst the median is 0.5.
const RATIO_OF_EDGES: f64 = 1.0;

/// Rise of the powers from which a bin is a detection, and down to which bins beside one belong to the burst.
const RISES: [f64; 2] = [0.05, 0.01];

/// The same in units of the scatter of the powers in the pass.
const SCATTERS: [f64; 2] = [8.0, 3.0];

/// Time to either side that a median of the powers is of, s. Longer bursts have to be found in visibilities.
const LEVEL_S: f64 = 450.0;

/// Least number of bins with powers on either side. At the ends of a pass powers are not judged.
const LEVEL_BINS_MIN: usize = 3;

/// Number of bins, the brightest, that a position is found with.
const BRIGHTEST: usize = 3;

/// Work of a fit to the visibilities of a burst, as [`affordable`] counts it: those of a pass of the default array are 5e6.
const WORK_MAX: f64 = 1e8;

/// Number of visibilities of a pair in a bin that a position is found with.
const SAMPLES_OF_PAIR: usize = 2;

/// Limit of the number of bins. Time tags are untrusted.
const BINS_MAX: f64 = 1e5;

/// Bursts of a pass and channel that have a direction and a flux, the strongest. Each takes some 0.2 s of two cores (28 pairs, 22,000
/// visibilities), the search for all bursts 0.01 s. Others are left out, or kept, without.
const DESCRIBED_MAX: usize = 16;

/// A visibility of a pair.
pub(super) struct Entry<'a> {
    block: &'a PlacedVisibilities,
    k: usize,
    /// Its squared modulus over the upper quartile of its pair.
    ratio: f64,
    /// Mean power of its daughters over the median of its pair in the pass.
    power: f64,
    /// Mean squared modulus of the steady sky's visibilities of the pair, (K sr)^2.
    steady_k2_sr2: f64,
}

impl Entry<'_> {
    pub(super) fn pair(&self) -> Pair {
        self.block.pair
    }

    pub(super) fn time_s(&self) -> f64 {
        self.block.time_s[self.k]
    }
}

/// Finds the bursts in the visibilities of a pass in one channel.
#[must_use]
pub fn find_bursts(search: BurstSearch, blocks: &[&PlacedVisibilities]) -> SearchedChannel {
    let nothing = SearchedChannel {
        channel: blocks.first().map_or(0, |block| block.channel.0),
        frequency_hz: blocks.first().map_or(0.0, |block| block.frequency_hz),
        visibilities: blocks.iter().map(|block| block.len()).sum(),
        ..SearchedChannel::default()
    };
    let pairs = pairs_of(blocks, VISIBILITIES_MIN);
    let Some(bins) = Bins::new(&pairs) else { return nothing };
    let bins = bins.judged(&pairs, 0, |_| true);
    let ranges = bins.detections();
    let described = bins.strongest(&ranges, DESCRIBED_MAX);
    let burst = |(index, range): (usize, &Range<usize>)| {
        let noted = note(search, &bins, range, &pairs)?;
        Some(if described.contains(&index) { describe(search, &bins, range, &pairs, noted) } else { noted })
    };
    let bursts = ranges.iter().enumerate().filter_map(burst).collect();
    SearchedChannel { judged: bins.judged_visibilities(&pairs), bursts, ..nothing }
}

/// The visibilities of each pair and band that has some number of them.
pub(super) fn pairs_of<'a>(blocks: &[&'a PlacedVisibilities], least: usize) -> Vec<Vec<Entry<'a>>> {
    let mut pairs: BTreeMap<(Pair, u16), Vec<&PlacedVisibilities>> = BTreeMap::new();
    for block in blocks {
        pairs.entry((block.pair, block.band)).or_default().push(block);
    }
    // Sums in another order have other bits, and the visibilities that a direction is found with are every so many of a pair.
    pairs.values_mut().for_each(|blocks| blocks.sort_by(|a, b| by_time(a, b)));
    pairs.into_values().filter_map(|blocks| entries_of(&blocks, least)).collect()
}

/// The order of the blocks of a pair, whatever the order in which they arrive: by time, or else by what differs.
fn by_time(a: &PlacedVisibilities, b: &PlacedVisibilities) -> Ordering {
    let numbers = |block: &PlacedVisibilities, k: usize| {
        let (value, duration_s) = (block.value_k_sr[k], block.duration_s.get(k).copied().unwrap_or(0.0));
        [block.time_s[k], value.re, value.im, block.weight[k], f64::from(duration_s)]
    };
    let both = (0..a.len().min(b.len())).flat_map(|k| numbers(a, k).into_iter().zip(numbers(b, k)));
    let differing = both.map(|(a, b)| a.total_cmp(&b)).find(|order| order.is_ne());
    differing.unwrap_or(a.len().cmp(&b.len()))
}

/// The visibilities of a pair; `None` if they are too few, or mostly zero.
fn entries_of<'a>(blocks: &[&'a PlacedVisibilities], least: usize) -> Option<Vec<Entry<'a>>> {
    let all = || blocks.iter().flat_map(|&block| (0..block.len()).map(move |k| (block, k)));
    let square = |(block, k): (&PlacedVisibilities, usize)| block.value_k_sr[k].norm_sqr();
    let squares: Vec<f64> = all().map(square).filter(|square| square.is_finite()).collect();
    if squares.len() < least {
        return None;
    }
    let (middle, quartile) = percentiles(squares, 50.0, 75.0)?;
    let steady_k2_sr2 = middle / LN_2;
    let power = |(block, k): (&PlacedVisibilities, usize)| {
        let duration_s = block.duration_s.get(k).copied().map_or(1.0, f64::from);
        (block.weight[k] * duration_s).sqrt().recip()
    };
    let usual = median(all().map(power).filter(|power| power.is_finite()).collect())?;
    let entry = |(block, k)| Entry {
        block,
        k,
        ratio: square((block, k)) / quartile,
        power: power((block, k)) / usual,
        steady_k2_sr2,
    };
    let entries = all().map(entry).filter(|entry| entry.ratio.is_finite());
    (quartile > 0.0 && middle > 0.0).then(|| entries.collect())
}

/// The statistics by time.
pub(super) struct Bins {
    first_s: f64,
    pub(super) width_s: f64,
    pub(super) count: usize,
    /// Median over pairs of the mean ratio; 0 in a bin of too few pairs.
    ratios: Vec<f64>,
    /// Rise of the powers; 0 in a bin of too few pairs, and at the ends.
    rises: Vec<f64>,
    /// Rises of a detection, and of the bins beside it.
    limits: [f64; 2],
}

impl Bins {
    /// `None` if the visibilities are too few or too sparse.
    pub(super) fn new(pairs: &[Vec<Entry>]) -> Option<Self> {
        let times_s = || pairs.iter().flatten().map(Entry::time_s);
        let (first_s, last_s) =
            times_s().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), t_s| (a.min(t_s), b.max(t_s)));
        let spacing = |pair: &Vec<Entry>| {
            let (first, last) = pair.first().zip(pair.last())?;
            Some((last.time_s() - first.time_s()) / (pair.len() - 1).max(1) as f64)
        };
        let spacing_s = median(pairs.iter().filter_map(spacing).collect())?;
        let width_s = (2.0 * spacing_s).max(BIN_S[0]);
        let count = ((last_s - first_s) / width_s).floor();
        if pairs.len() < PAIRS_OF_POWERS_MIN || width_s > BIN_S[1] || !(0.0..BINS_MAX).contains(&count) {
            return None;
        }
        let count = count as usize + 1;
        Some(Self { first_s, width_s, count, ratios: Vec::new(), rises: Vec::new(), limits: RISES })
    }

    /// With the statistics of those bins that are to be judged; powers only if enough of them have some.
    pub(super) fn judged(
        mut self,
        pairs: &[Vec<Entry>],
        powers_min: usize,
        is_judged: impl Fn(usize) -> bool,
    ) -> Self {
        let of_judged = |pairs_min: usize, value: &dyn Fn(&Entry) -> f64| -> Vec<f64> {
            let medians = self.medians(pairs, pairs_min, value).into_iter().enumerate();
            medians.map(|(bin, median)| if is_judged(bin) { median } else { 0.0 }).collect()
        };
        let ratios = of_judged(PAIRS_MIN, &|entry| entry.ratio);
        let mut powers = of_judged(PAIRS_OF_POWERS_MIN, &|entry| entry.power);
        if powers.iter().filter(|power| **power > 0.0).count() < powers_min {
            powers.fill(0.0);
        }
        self.ratios = ratios;
        self.rises = self.rises_of(&powers);
        let scatter = scatter_of(&powers);
        self.limits = [0, 1].map(|k| RISES[k].max(SCATTERS[k] * scatter));
        self
    }

    /// Median over pairs of the mean of a value in each bin; 0 in a bin of too few pairs.
    fn medians(&self, pairs: &[Vec<Entry>], pairs_min: usize, value: &dyn Fn(&Entry) -> f64) -> Vec<f64> {
        let mut means: Vec<Vec<f64>> = vec![Vec::new(); self.count];
        for pair in pairs {
            let mut sums: BTreeMap<usize, [f64; 2]> = BTreeMap::new();
            for entry in pair {
                let [sum, number] = sums.entry(self.bin(entry.time_s())).or_default();
                (*sum, *number) = (*sum + value(entry), *number + 1.0);
            }
            for (bin, [sum, number]) in sums {
                means[bin].push(sum / number);
            }
        }
        let median = |means: Vec<f64>| if means.len() < pairs_min { None } else { lower_median(means) };
        means.into_iter().map(|means| median(means).unwrap_or(0.0)).collect()
    }

    /// Powers over the larger of the medians before and after, less 1.
    fn rises_of(&self, powers: &[f64]) -> Vec<f64> {
        let reach = (LEVEL_S / self.width_s).ceil() as usize;
        let level = |near: &[f64]| {
            let known: Vec<f64> = near.iter().copied().filter(|power| *power > 0.0).collect();
            if known.len() < LEVEL_BINS_MIN { None } else { median(known) }
        };
        let rise = |bin: usize| {
            let before = level(&powers[bin.saturating_sub(reach)..bin])?;
            let after = level(&powers[bin + 1..(bin + 1 + reach).min(powers.len())])?;
            (powers[bin] > 0.0).then(|| powers[bin] / before.max(after) - 1.0)
        };
        (0..powers.len()).map(|bin| rise(bin).unwrap_or(0.0)).collect()
    }

    /// Number of visibilities in bins with a statistic. Powers that are all the same, of weights without any, have none.
    fn judged_visibilities(&self, pairs: &[Vec<Entry>]) -> usize {
        let is_judged = |bin: usize| self.ratios[bin] > 0.0 || self.rises[bin] != 0.0;
        pairs.iter().flatten().filter(|entry| is_judged(self.bin(entry.time_s()))).count()
    }

    /// The bins of each burst.
    pub(super) fn detections(&self) -> Vec<Range<usize>> {
        let (mut found, mut next) = (Vec::new(), 0);
        while let Some(seed) = (next..self.ratios.len()).find(|&bin| self.is_detection(bin)) {
            let range = self.extent(seed, next);
            next = range.end;
            found.push(range);
        }
        found
    }

    fn is_detection(&self, bin: usize) -> bool {
        self.strength(bin) > 1.0
    }

    /// The larger of the statistics, in units of its limit.
    fn strength(&self, bin: usize) -> f64 {
        (self.ratios[bin] / RATIO).max(self.rises[bin] / self.limits[0])
    }

    /// Indices of the strongest of some ranges.
    fn strongest(&self, ranges: &[Range<usize>], most: usize) -> BTreeSet<usize> {
        let strength = |range: &Range<usize>| range.clone().map(|bin| self.strength(bin)).fold(0.0, f64::max);
        let mut all: Vec<(f64, usize)> = ranges.iter().map(strength).zip(0..).collect();
        all.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        all.into_iter().take(most).map(|(_, index)| index).collect()
    }

    pub(super) fn bin(&self, time_s: f64) -> usize {
        ((time_s - self.first_s) / self.width_s) as usize
    }

    pub(super) fn start_s(&self, bin: usize) -> f64 {
        self.first_s + self.width_s * bin as f64
    }

    /// The bins of the burst with a detection in `seed`, not before `least`. A burst falls more slowly than it rises, and the visibilities
    /// of its tail are below the steady sky's: if powers do not show it, the end is moved by the time from the brightest bin on.
    fn extent(&self, seed: usize, least: usize) -> Range<usize> {
        let is_in = |bin: &usize| self.ratios[*bin] > RATIO_OF_EDGES || self.rises[*bin] > self.limits[1];
        let before = (least..seed).rev().take_while(is_in).count();
        let after = (seed..self.ratios.len()).take_while(is_in).count();
        let until = seed + after;
        let brightest = self.brightest(seed..until).first().copied().unwrap_or(seed);
        let from = (seed - before).saturating_sub(1).max(least);
        let end = if self.has_power(seed..until) { until + 1 } else { 2 * until - brightest };
        from..end.min(self.ratios.len())
    }

    /// Whether powers show the burst in a range.
    fn has_power(&self, range: Range<usize>) -> bool {
        self.rises[range].iter().any(|rise| *rise > self.limits[0])
    }

    /// Bins of a range, the brightest first: by what shows the burst, and visibilities before powers, as they have the position.
    pub(super) fn brightest(&self, range: Range<usize>) -> Vec<usize> {
        let is_visible = self.ratios[range.clone()].iter().any(|ratio| *ratio > RATIO);
        let by = if is_visible { &self.ratios } else { &self.rises };
        let mut bins: Vec<usize> = range.filter(|bin| by[*bin] > 0.0).collect();
        bins.sort_by(|a, b| by[*b].total_cmp(&by[*a]));
        bins
    }
}

/// Standard deviation of powers, each compared with the mean of its neighbours: of Gaussian ones, whose variance the mean halves.
fn scatter_of(powers: &[f64]) -> f64 {
    let off = |near: &[f64]| (near[1] - 0.5 * (near[0] + near[2])).abs();
    let known = powers.windows(3).filter(|near| near.iter().all(|power| *power > 0.0));
    1.4826 * (2.0_f64 / 3.0).sqrt() * median(known.map(off).collect()).unwrap_or(0.0)
}

/// The median; the lower one of an even number of values, so that half of them have to exceed it.
fn lower_median(values: Vec<f64>) -> Option<f64> {
    median(values.into_iter().map(|value| -value).collect()).map(|value| -value)
}

/// A burst in a range of bins, without position and flux.
fn note(search: BurstSearch, bins: &Bins, range: &Range<usize>, pairs: &[Vec<Entry>]) -> Option<FoundBurst> {
    let (peak, block) = (*bins.brightest(range.clone()).first()?, pairs.first()?.first()?.block);
    let span_s = [range.start, range.end].map(|bin| bins.start_s(bin));
    Some(FoundBurst {
        channel: block.channel.0,
        frequency_hz: block.frequency_hz,
        from_s: span_s[0],
        until_s: span_s[1],
        peak_s: bins.start_s(peak) + 0.5 * bins.width_s,
        peak_span_s: [peak, peak + 1].map(|bin| bins.start_s(bin)),
        significance: f64::NAN,
        flux_jy: f64::NAN,
        flux_sigma_jy: f64::NAN,
        positions_deg: Vec::new(),
        position_errors_deg: Vec::new(),
        name: None,
        seen_from_m: seen_from_m(pairs, span_s),
        moon_radius_m: search.moon_radius_m,
        light_curve: None,
    })
}

/// A burst with its position, flux and significance, as far as visibilities determine them.
fn describe(
    search: BurstSearch,
    bins: &Bins,
    range: &Range<usize>,
    pairs: &[Vec<Entry>],
    noted: FoundBurst,
) -> FoundBurst {
    let mut brightest = bins.brightest(range.clone());
    brightest.truncate(BRIGHTEST);
    // A power for each half of a bin, as a burst may be as short as an integration, of which a bin holds two or more.
    let samples: Vec<Vec<Sample>> = brightest
        .iter()
        .flat_map(|bin| [false, true].map(|is_late| (*bin, is_late)))
        .map(|(bin, is_late)| {
            let middle_s = bins.start_s(bin) + 0.5 * bins.width_s;
            let is_in = |time_s: f64| bins.bin(time_s) == bin && (time_s >= middle_s) == is_late;
            pairs.iter().flat_map(|pair| samples_of(pair, is_in)).collect()
        })
        .collect();
    let span_s = [noted.from_s, noted.until_s];
    let all = rows_of(pairs, span_s);
    let rows = affordable(&all, span_s, WORK_MAX);
    let candidates = locate(&samples, search.moon_radius_m);
    let Some(likeliest) = candidates.first() else { return noted };
    let (located, smears) = refine(search, &candidates, &rows, span_s);
    let hat = located.first().map_or(likeliest.hat, |place| place.hat);
    let place = Place { hat, moon_radius_m: search.moon_radius_m, smears };
    // Rows that determine no flux, as of one daughter behind the Moon, are a burst still.
    let flux = Flux::fit(&rows, place, span_s);
    let [power_k_sr, power_sigma_k_sr] =
        flux.map_or([f64::NAN; 2], |flux| flux.mean_k_sr(&rows, noted.peak_span_s));
    let jy = k_sr_per_jy(noted.frequency_hz).recip();
    let fit = || LightCurve::fit(&all, place, span_s);
    FoundBurst {
        significance: likeliest.twice_log.max(0.0).sqrt(),
        flux_jy: jy * power_k_sr,
        flux_sigma_jy: jy * power_sigma_k_sr,
        positions_deg: located.iter().map(|place| ecliptic_deg(place.hat)).collect(),
        position_errors_deg: located.iter().map(|place| place.errors_rad.map(f64::to_degrees)).collect(),
        name: name(search, noted.peak_s, &located).map(str::to_owned),
        light_curve: if search.choice == BurstChoice::Peel { fit() } else { None },
        ..noted
    }
}

/// Where a daughter was in the middles of the three thirds of a span: at the nearest visibilities.
fn seen_from_m(pairs: &[Vec<Entry>], [from_s, until_s]: [f64; 2]) -> [Vec3; 3] {
    [1.0, 3.0, 5.0].map(|sixths| {
        let t_s = from_s + sixths / 6.0 * (until_s - from_s);
        let off_s = |entry: &&Entry| (entry.time_s() - t_s).abs();
        let nearest = pairs.iter().flatten().min_by(|a, b| off_s(a).total_cmp(&off_s(b)));
        nearest.map_or([0.0; 3], |entry| entry.block.r_i_m[entry.k])
    })
}

/// The visibilities in a span of time, for the fit of a light curve.
pub(super) fn rows_of<'a>(pairs: &[Vec<Entry<'a>>], [from_s, until_s]: [f64; 2]) -> Vec<BurstRow<'a>> {
    let row = |entry: &Entry<'a>| {
        let Entry { block, k, steady_k2_sr2, .. } = *entry;
        let half_s = 0.5 * block.duration_s.get(k).copied().map_or(0.0, f64::from);
        let is_in = entry.time_s() + half_s > from_s && entry.time_s() - half_s < until_s;
        is_in.then_some(BurstRow { block, k, steady_k2_sr2 })
    };
    pairs.iter().flatten().filter_map(row).collect()
}

/// The visibilities of a pair in a bin: at most a few of them, evenly. The steady sky hardly changes in a bin, and so counts once.
fn samples_of(pair: &[Entry], is_in: impl Fn(f64) -> bool) -> Vec<Sample> {
    let inside: Vec<&Entry> = pair.iter().filter(|entry| is_in(entry.time_s())).collect();
    let step = inside.len().div_ceil(SAMPLES_OF_PAIR).max(1);
    let kept = inside.len().div_ceil(step) as f64;
    let sample = |entry: &&Entry| {
        let Entry { block, k, steady_k2_sr2, .. } = **entry;
        let geometry = PairGeometry {
            r_i_m: block.r_i_m[k],
            r_j_m: block.r_j_m[k],
            frequency_hz: block.frequency_hz,
            moon_radius_m: 0.0,
            response: AntennaResponse::Isotropic,
        };
        let variance_k2_sr2 = kept * steady_k2_sr2 + 2.0 / block.weight[k];
        let (value_k_sr, information) = (block.value_k_sr[k], variance_k2_sr2.recip());
        Sample { geometry, value_k_sr, information }
    };
    inside.iter().step_by(step).map(sample).collect()
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::units::all_pairs;

    #[test]
    fn ratios_of_few_visibilities_are_distributed_as_stated() {
        let mut stream = ChaCha8Rng::seed_from_u64(10);
        let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
        let (mut above, mut all) = (0, 0);
        for _ in 0..2000 {
            let block = PlacedVisibilities {
                weight: vec![1.0; 24],
                time_s: (0..24).map(f64::from).collect(),
                value_k_sr: (0..24).map(|_| Complex64::new(normal(), normal())).collect(),
                ..PlacedVisibilities::default()
            };
            let entries = entries_of(&[&block], 24).unwrap();
            above += entries.iter().filter(|entry| entry.ratio > 3.0).count();
            all += entries.len();
        }
        // Three times the 18th of 23 others is exceeded with probability 6 * 7 * 8 / (24 * 25 * 26), the 19th 5 * 6 * 7 / (24 * 25 * 26): the
        // quartile of 24 lies between them.
        let found = above as f64 / all as f64;
        assert!(all == 48_000 && (210.0 / 15_600.0..336.0 / 15_600.0).contains(&found), "{found}");
    }

    #[test]
    fn the_statistic_of_quiet_passes_is_distributed_as_stated() {
        let mut stream = ChaCha8Rng::seed_from_u64(9);
        let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
        let (mut above, mut all) = (0, 0);
        for _ in 0..20 {
            let mut block = |pair| PlacedVisibilities {
                pair,
                weight: vec![1.0; 800],
                time_s: (0..800).map(|k| 10.0 * f64::from(k)).collect(),
                // The level of each pair is its own.
                value_k_sr: (0..800)
                    .map(|_| Complex64::new(normal(), normal()) * f64::from(pair.j))
                    .collect(),
                ..PlacedVisibilities::default()
            };
            let blocks: Vec<PlacedVisibilities> = all_pairs(8).into_iter().map(&mut block).collect();
            let pairs: Vec<Vec<Entry>> =
                blocks.iter().filter_map(|block| entries_of(&[block], VISIBILITIES_MIN)).collect();
            let ratios = Bins::new(&pairs).unwrap().judged(&pairs, 0, |_| true).ratios;
            above += ratios.iter().filter(|ratio| **ratio > 0.75).count();
            all += ratios.len();
        }
        // A bin has two visibilities of each of 28 pairs. The sum of two exponentials exceeds y = 0.75 * 4 ln 2 with p = exp(-y) (1 + y) =
        // 0.38493, and 15 of 28 pairs do with 0.0757 (Python, binomial sum). Some 600 of 8000 bins: four standard deviations are 13 %, and
        // quartiles of 800 values move p by 1 %.
        let found = above as f64 / all as f64;
        assert!(all > 7900 && (found / 0.0757 - 1.0).abs() < 0.17, "{above} of {all}");
    }
}
