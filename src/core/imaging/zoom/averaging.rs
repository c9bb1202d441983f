//! Rotates visibilities to the centre of a patch, and averages each track while the patch's edge hardly turns.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fmt;

use num_complex::Complex64;
use serde::Serialize;

use super::patch::{Patch, PatchView};
use crate::array::hidden_by_moon;
use crate::frames::{AntennaResponse, PlacedVisibilities};
use crate::response::pixel::PairGeometry;
use crate::sky::k_sr_per_jy;
use crate::units::Pair;
use crate::units::vector::{Vec3, dot, norm, scale, sub};

/// Turns by which the patch's edge may turn within an average.
///
/// An average is a mean of two instants, which is exact to the third moment of the baseline: what is left of the fourth at the edge,
/// of a linear motion, is `(2 pi / 16)^4 (1/5 - 1/9) / 24 = 9e-5`.
const EDGE_TURNS_MAX: f64 = 0.125;

/// A gap in a track that ends an average, in lengths of an integration.
const GAP_MAX: f64 = 2.0;

/// Least antenna response to the patch's centre for a visibility to be used.
const RESPONSE_MIN: f64 = 0.05;

/// An average of visibilities of one pair: the visibility of the patch's centre at a mean baseline.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Mean baseline, wavelengths, on the patch's axes.
    pub u: Vec3,
    /// Standard deviation of the baseline along its motion, wavelengths.
    pub spread: Vec3,
    /// Mean of the rotated visibilities, Jy.
    pub value: Complex64,
    /// Inverse variance of the real part, Jy^-2.
    pub weight: f64,
}

/// A source of known flux that is subtracted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownSource {
    /// Direction, on ecliptic axes.
    pub direction: Vec3,
    /// Flux density, Jy.
    pub flux_jy: f64,
}

/// Numbers of visibilities by what became of them; they add up to those that were given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct AveragingCounts {
    /// In a row.
    pub averaged: u64,
    /// The Moon hides the patch.
    pub hidden: u64,
    /// The Moon's limb crosses the patch.
    pub limb: u64,
    /// The baseline is shorter than the limit.
    pub short: u64,
    /// The baseline is longer than the limit.
    pub long: u64,
    /// The antennas hardly respond to the patch.
    pub insensitive: u64,
    /// Value, weight or position cannot be used.
    pub unusable: u64,
}

impl AveragingCounts {
    /// All visibilities.
    #[must_use]
    pub fn total(&self) -> u64 {
        let Self { averaged, hidden, limb, short, long, insensitive, unusable } = self;
        averaged + hidden + limb + short + long + insensitive + unusable
    }
}

impl fmt::Display for AveragingCounts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { averaged, hidden, limb, short, long, insensitive, unusable } = self;
        write!(
            f,
            "Of {} visibilities {averaged} are in an average; of {hidden} the Moon hides the patch, of {limb} its limb crosses it, of {short} \
             the baseline is too short, of {long} too long, of {insensitive} the antennas hardly respond to the patch, and {unusable} have \
             no usable value, weight or position",
            self.total()
        )
    }
}

/// What an averager needs to know.
#[derive(Clone, Debug)]
pub struct AveragingSetup {
    /// The patch.
    pub patch: Patch,
    /// Radius of the Moon, m.
    pub moon_radius_m: f64,
    /// Antennas.
    pub response: AntennaResponse,
    /// Shortest and longest baseline that is used, wavelengths.
    pub baselines_wavelengths: [f64; 2],
    /// Sources that are subtracted before averaging.
    pub known: Vec<KnownSource>,
}

/// Averages the visibilities of a channel. It holds one open average for each pair and sub-band.
#[derive(Clone, Debug)]
pub struct Averager {
    setup: AveragingSetup,
    open: BTreeMap<(Pair, u16), Cell>,
    rows: Vec<Row>,
    counts: AveragingCounts,
}

/// The sums of an open average.
#[derive(Clone, Copy, Debug)]
struct Cell {
    /// Baseline of the first visibility, about which sums are taken.
    first: Vec3,
    /// Baseline and end of the latest visibility.
    latest: (Vec3, f64),
    weight: f64,
    value: Complex64,
    /// Sums of weighted components of the baseline less `first`, and of their squares along the motion.
    offset: Vec3,
    square: f64,
}

impl Averager {
    /// An averager without data.
    #[must_use]
    pub fn new(setup: AveragingSetup) -> Self {
        Self { setup, open: BTreeMap::new(), rows: Vec::new(), counts: AveragingCounts::default() }
    }

    /// Adds visibilities of the channel.
    pub fn add(&mut self, placed: &PlacedVisibilities) {
        let hz = placed.frequency_hz;
        let k_sr_per_jy = k_sr_per_jy(hz);
        for k in 0..placed.len() {
            let pair = PairGeometry {
                r_i_m: placed.r_i_m[k],
                r_j_m: placed.r_j_m[k],
                frequency_hz: hz,
                moon_radius_m: self.setup.moon_radius_m,
                response: self.setup.response,
            };
            let Some(response) = self.response(&pair) else { continue };
            let value = placed.value_k_sr[k] / k_sr_per_jy - self.known(&pair);
            let weight = placed.weight[k] * (k_sr_per_jy * response).powi(2);
            if !(value.is_finite() && weight.is_finite() && weight > 0.0) {
                self.counts.unusable += 1;
                continue;
            }
            self.counts.averaged += 1;
            let duration_s = placed.duration_s.get(k).map_or(f64::INFINITY, |&s| f64::from(s));
            let u = self.setup.patch.on_axes(pair.baseline_wavelengths());
            let turned = value / response * Complex64::cis(TAU * (u[2] - u[2].round()));
            self.put((placed.pair, placed.band), u, (turned, weight), [placed.time_s[k], duration_s]);
        }
    }

    /// The response to the patch's centre; `None`, after counting the reason, if the visibility is left out.
    fn response(&mut self, pair: &PairGeometry) -> Option<f64> {
        let AveragingSetup { patch, moon_radius_m, baselines_wavelengths: [shortest, longest], .. } =
            self.setup;
        let length = norm(pair.baseline_wavelengths());
        let count = match patch.view_of_pair([pair.r_i_m, pair.r_j_m], moon_radius_m) {
            _ if !length.is_finite() => &mut self.counts.unusable,
            _ if length < shortest => &mut self.counts.short,
            _ if length > longest => &mut self.counts.long,
            PatchView::Hidden => &mut self.counts.hidden,
            PatchView::Limb => &mut self.counts.limb,
            PatchView::Whole => match pair.antenna(patch.centre()) {
                response if response >= RESPONSE_MIN => return Some(response),
                _ => &mut self.counts.insensitive,
            },
        };
        *count += 1;
        None
    }

    /// Visibility of the known sources, Jy.
    fn known(&self, pair: &PairGeometry) -> Complex64 {
        let u = pair.baseline_wavelengths();
        let is_seen = |source: &&KnownSource| {
            let hidden = |r_m| hidden_by_moon(r_m, source.direction, pair.moon_radius_m);
            !hidden(pair.r_i_m) && !hidden(pair.r_j_m)
        };
        let visibility = |source: &KnownSource| {
            let turns = dot(u, source.direction);
            source.flux_jy * pair.antenna(source.direction) * Complex64::cis(-TAU * (turns - turns.round()))
        };
        self.setup.known.iter().filter(is_seen).map(visibility).sum()
    }

    /// Adds a visibility to the open average of its track, or ends that and opens another.
    fn put(
        &mut self,
        key: (Pair, u16),
        u: Vec3,
        (value, weight): (Complex64, f64),
        [time_s, duration_s]: [f64; 2],
    ) {
        let ends = |cell: &Cell| {
            let gap_s = (time_s - cell.latest.1).abs();
            gap_s > GAP_MAX * duration_s || self.setup.patch.edge_turns(sub(u, cell.first)) > EDGE_TURNS_MAX
        };
        if self.open.get(&key).is_some_and(ends) {
            self.rows.extend(self.open.remove(&key).map(Cell::row));
        }
        let empty = Cell {
            first: u,
            latest: (u, time_s),
            weight: 0.0,
            value: Complex64::ZERO,
            offset: [0.0; 3],
            square: 0.0,
        };
        let cell = self.open.entry(key).or_insert(empty);
        let offset = sub(u, cell.first);
        cell.weight += weight;
        cell.value += weight * value;
        (0..3).for_each(|k| cell.offset[k] += weight * offset[k]);
        cell.square += weight * dot(offset, offset);
        cell.latest = (u, time_s);
    }

    /// The rows, and what became of all visibilities.
    #[must_use]
    pub fn finish(mut self) -> (Vec<Row>, AveragingCounts) {
        self.rows.extend(self.open.into_values().map(Cell::row));
        (self.rows, self.counts)
    }
}

impl Cell {
    fn row(self) -> Row {
        let mean = scale(1.0 / self.weight, self.offset);
        let variance = (self.square / self.weight - dot(mean, mean)).max(0.0);
        let moved = sub(self.latest.0, self.first);
        let length = norm(moved);
        let spread = if length > 0.0 { scale(variance.sqrt() / length, moved) } else { [0.0; 3] };
        Row {
            u: std::array::from_fn(|k| self.first[k] + mean[k]),
            spread,
            value: self.value / self.weight,
            weight: self.weight,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::{Frame, rotate};
    use crate::units::constants::SPEED_OF_LIGHT_M_S;
    use crate::units::vector::direction;

    /// Two satellites on a circle of 2.037e6 m whose baseline is some 2,000 wavelengths at 10 MHz, at 2,000 instants.
    fn track(sources: &[KnownSource], moon_radius_m: f64) -> PlacedVisibilities {
        let at =
            |angle: f64| [2.037e6 * angle.cos(), 2.037e6 * angle.sin() * 0.8, 2.037e6 * angle.sin() * 0.6];
        let mut placed = PlacedVisibilities { frequency_hz: 1e7, ..PlacedVisibilities::default() };
        for k in 0..2000 {
            let time_s = 0.1 * f64::from(k);
            let angle = 7.6e-4 * time_s;
            let (r_i_m, r_j_m) = (at(angle), at(angle + 0.03));
            let seen = |n: Vec3| [r_i_m, r_j_m].iter().all(|&r_m| !hidden_by_moon(r_m, n, moon_radius_m));
            let u = scale(1e7 / SPEED_OF_LIGHT_M_S, sub(r_i_m, r_j_m));
            let value: Complex64 = sources
                .iter()
                .filter(|one| seen(one.direction))
                .map(|one| one.flux_jy * Complex64::cis(-TAU * dot(u, one.direction)))
                .sum();
            placed.time_s.push(time_s);
            placed.r_i_m.push(r_i_m);
            placed.r_j_m.push(r_j_m);
            placed.value_k_sr.push(value * k_sr_per_jy(1e7));
            placed.weight.push(1.0);
            placed.duration_s.push(0.1);
        }
        placed
    }

    #[test]
    fn counts_are_told_in_words() {
        let counts = AveragingCounts {
            averaged: 1,
            hidden: 20,
            limb: 3,
            short: 400,
            long: 5,
            insensitive: 6,
            unusable: 7,
        };
        let said = super::super::ZoomError::NoRows(counts).to_string();
        for part in [
            "Of 442 visibilities 1 are in an average",
            "of 20 the Moon hides",
            "of 400 the baseline is too short",
            "7 have",
        ] {
            assert!(said.contains(part), "{part}: {said}");
        }
    }

    fn setup(patch: Patch, known: Vec<KnownSource>) -> AveragingSetup {
        AveragingSetup {
            patch,
            moon_radius_m: 1.7371e6,
            response: AntennaResponse::Isotropic,
            baselines_wavelengths: [1.0, 1e5],
            known,
        }
    }

    fn at_edge(patch: &Patch, angle: f64, rho: f64) -> (KnownSource, [f64; 2]) {
        let place = [rho * angle.cos(), rho * angle.sin()];
        let [ra, dec] = patch.equatorial_deg(place);
        let direction = rotate(&Frame::Equatorial.to_ecliptic(), direction(ra, dec));
        (KnownSource { direction, flux_jy: 3.0 }, place)
    }

    #[test]
    fn averages_are_those_of_their_sources() {
        let patch = Patch::new([20.0, 40.0], 5.0);
        for (angle, rho) in [(0.3, 5.0_f64), (2.0, 5.0), (4.0, 2.5), (0.0, 0.0)] {
            let (source, [l, m]) = at_edge(&patch, angle, rho.to_radians().sin());
            let mut averager = Averager::new(setup(patch, Vec::new()));
            averager.add(&track(&[source], 1.7371e6));
            let (rows, counts) = averager.finish();
            assert_eq!((counts.averaged, counts.total()), (2000, 2000));
            assert!(rows.len() < 2000 / 8, "{}", rows.len());
            let delta = [l, m, (1.0 - l * l - m * m).sqrt() - 1.0];
            for row in &rows {
                let turns = dot(row.u, delta);
                let expected = 3.0 * Complex64::cis(-TAU * turns) * (TAU * dot(row.spread, delta)).cos();
                // The fourth moment at the edge (see EDGE_TURNS_MAX), relative to 3 Jy; it falls with the fourth power of rho.
                let tolerance = 3.0 * (9e-5 * (rho / 5.0).powi(4)) + 1e-6;
                assert!((row.value - expected).norm() < tolerance, "{rho}: {} {expected}", row.value);
            }
        }
    }

    #[test]
    fn what_the_moon_hides_is_left_out_and_counted() {
        // The centre is opposite the satellites, or just on the limb.
        let placed = track(&[], 1.7371e6);
        for (ra, which) in [(180.0, 0), (180.0 - 58.5, 1), (0.0, 2)] {
            let mut averager = Averager::new(setup(Patch::new([ra, 0.0], 5.0), Vec::new()));
            averager.add(&placed);
            let (rows, counts) = averager.finish();
            let by_view = [counts.hidden, counts.limb, counts.averaged];
            assert_eq!(counts.total(), 2000);
            assert!(by_view[which] > 1500, "{ra}: {counts:?}");
            assert_eq!(rows.is_empty(), counts.averaged == 0);
        }
    }

    #[test]
    fn a_known_source_is_subtracted_while_it_is_seen() {
        let patch = Patch::new([20.0, 40.0], 5.0);
        // One far away that stays in sight, and one that the Moon hides after a while.
        let source = |ra: f64, dec| KnownSource {
            direction: rotate(&Frame::Equatorial.to_ecliptic(), direction(ra, dec)),
            flux_jy: 1e4,
        };
        let sources = vec![source(300.0, 20.0), source(118.0, 1.0)];
        let mut averager = Averager::new(setup(patch, sources.clone()));
        averager.add(&track(&sources, 1.7371e6));
        let (rows, _) = averager.finish();
        // Roundings of 1e4 Jy at a phase of 1e4 rad.
        assert!(rows.iter().all(|row| row.value.norm() < 1e-6));
    }
}
