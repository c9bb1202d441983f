//! Plans which rows of B are computed, and which are interpolated from them.
//!
//! With P(t) the axes that follow the normal z(t) of the pair's plane without turning about it, and gamma(t) the angle from
//! there to the pair's own x, the row of a pair at time t is
//!
//! ```text
//! V(t) = sum_mu exp(-i mu gamma(t)) g_mu(t)
//! ```
//!
//! where g depends on P, on the baseline's length and on the radii: slowly along an orbit, and smoothly however its plane,
//! altitude, pitch and yaw change. So g is computed at Chebyshev's points of a track of one pair, where positions follow from
//! those of the visibilities, and interpolated by the polynomial through them. Their number follows from how far the pattern's phases can
//! move; where that is no fewer than the visibilities, each row is computed for itself.

use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::ops::Range;

use num_complex::Complex64;
use rayon::prelude::*;

use super::antennas::PairResponse;
use super::classes::{Classes, NodeClass};
use super::instants::{Instant, Instants};
use super::view::{Axes, PairView, euler, transported};
use super::{PairAt, RowsError, RowsRefusal, RowsSetup};
use crate::units::vector::{Vec3, add, dot, norm, scale, sub};

/// A gap in a pair's data that ends a track, s: polynomials do not reach across times without data.
const GAP_S: f64 = 900.0;

/// Number of times from whose positions a node's are interpolated, and their greatest distance, s: 0.09 rad of a low orbit, so that positions err
/// by 0.1 mm.
const POSITIONS: usize = 8;
const POSITION_STEP_S_MAX: f64 = 120.0;

/// Sudden change of a velocity, m/s, that divides a track: rows are not smooth there. The turnarounds of a
/// breathing formation change it by 0.2 m/s.
const KINK_M_S: f64 = 1e-4;

/// Visibilities from one that is looked at for a kink to the next, and the longest steps, s, for which the polynomial goes through as
/// distant ones: longer it would not follow a smooth orbit.
const KINK_STRIDE: usize = 4;
const KINK_STEP_S_MAX: f64 = 20.0;

/// Most rows from which others are interpolated together: more take longer and are not more exact.
const NODES_MAX: usize = 40;

/// Error of the rows' angles gamma, interpolated from a track's nodes, rad, above which the nodes do not say how rows move.
const GAMMA_ERROR_RAD: f64 = 1e-4;

/// Rows that a task computes together, and whose patterns a product with `Bt W B` holds: 0.3 MB each at l = 191.
pub(super) const GROUP_NODES: usize = 256;

/// One row that is computed.
#[derive(Clone, Copy, Debug)]
pub(super) struct RowNode {
    /// Angles whose multiples turn a sky into P: about z, then between the quarter turns, then about the new z.
    pub(super) turns_rad: [f64; 3],
    pub(super) view: PairView,
    /// Its class.
    pub(super) class: u32,
}

/// Consecutive visibilities of a pair, and the nodes of their rows.
#[derive(Clone, Debug)]
pub(super) struct Track {
    pub(super) rows: Range<usize>,
    pub(super) nodes: Range<usize>,
    /// Times of the nodes, -1 to 1, and their barycentric weights; empty if each row has its node.
    pub(super) tau: Vec<f64>,
    pub(super) weights: Vec<f64>,
    /// Angles gamma of the nodes, rad, without jumps; empty where rows are of instants.
    pub(super) gamma_rad: Vec<f64>,
    /// Motion of phases in a unit of tau, rad: of the fringe, and of the limb's highest degree. `None` where rows are of instants.
    pub(super) rate_rad: Option<[f64; 2]>,
}

/// Integration times and antenna responses.
#[derive(Clone, Copy, Default)]
pub struct Observed<'a> {
    /// Length of each integration, s, about the time of its positions; those beyond the list are instants.
    pub duration_s: &'a [f32],
    /// Response of the pair of each visibility, times that of the rows' setup: of a degree up to the setup's.
    pub response: Option<&'a (dyn Fn(usize) -> PairResponse + Sync)>,
}

/// How to compute the rows of a list of visibilities.
#[derive(Clone, Debug)]
pub struct RowPlan {
    pub(super) nodes: Vec<RowNode>,
    pub(super) tracks: Vec<Track>,
    /// Tracks that a task takes together.
    pub(super) groups: Vec<Range<usize>>,
    /// By row: angle gamma, rad.
    pub(super) gamma_rad: Vec<f64>,
    /// By row: its time within the track, -1 to 1.
    pub(super) tau: Vec<f64>,
    /// By row: half of its integration in units of tau; empty for instants.
    pub(super) reach: Vec<f32>,
    /// By row: coefficients of its response; empty if it is that of the setup.
    pub(super) coefficients: Vec<f32>,
    /// Averages that are treated as instants in their middle, as the motion of their pair is not known.
    instants: usize,
    pub(super) classes: Vec<NodeClass>,
    /// Whether each row is computed for itself, with nothing in common with others.
    pub(super) direct: bool,
}

impl RowPlan {
    /// Plans rows for visibilities; consecutive ones of a pair in the order of time share rows. `direct` computes each row for
    /// itself.
    ///
    /// # Errors
    /// The first visibility that has no row.
    pub(super) fn new(
        setup: &RowsSetup,
        pairs: &[PairAt],
        observed: &Observed<'_>,
        direct: bool,
    ) -> Result<Self, RowsError> {
        let views: Vec<PairView> = pairs
            .par_iter()
            .enumerate()
            .map(|(index, at)| {
                PairView::of(at.r_i_m, at.r_j_m, setup.moon_radius_m)
                    .map_err(|refusal| RowsError { index, refusal: refusal.into() })
            })
            .collect::<Result<_, _>>()?;
        let u_max = views.iter().map(|view| view.baseline_m / setup.wavelength_m).fold(0.0, f64::max);
        let classes = Classes::new(setup.l_max, &views, u_max);
        let mut plan = Self {
            nodes: Vec::new(),
            tracks: Vec::new(),
            groups: Vec::new(),
            gamma_rad: vec![0.0; pairs.len()],
            tau: vec![0.0; pairs.len()],
            reach: vec![0.0; if observed.duration_s.is_empty() { 0 } else { pairs.len() }],
            coefficients: coefficients(setup.polynomial_degree, pairs.len(), observed)?,
            instants: observed.duration_s.iter().filter(|length_s| !is_known((**length_s).into())).count(),
            classes: classes.all(),
            direct,
        };
        let mut first = 0;
        while first < pairs.len() {
            let together = |k: &usize| {
                let step_s = pairs[*k].time_s - pairs[*k - 1].time_s;
                pairs[*k].pair == pairs[first].pair && (0.0..=GAP_S).contains(&step_s)
            };
            let end = (first + 1..pairs.len()).take_while(together).last().map_or(first + 1, |k| k + 1);
            let duration_s = observed.duration_s;
            let track = TrackBuilder { setup, pairs, duration_s, views: &views, classes: &classes, direct };
            if direct {
                track.each(first..end, &mut plan);
            } else {
                track.smooth(first..end, &mut plan);
            }
            first = end;
        }
        plan.group();
        Ok(plan)
    }

    /// Rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.gamma_rad.len()
    }

    /// Rows that are computed; the others are interpolated.
    #[must_use]
    pub fn computed(&self) -> usize {
        self.nodes.len()
    }

    /// Averages over integrations that are treated as instants in their middle: their pair has too few visibilities nearby to know its
    /// motion.
    #[must_use]
    pub fn instants(&self) -> usize {
        self.instants
    }

    fn group(&mut self) {
        let mut start = 0;
        let mut nodes = 0;
        for (k, track) in self.tracks.iter().enumerate() {
            nodes += track.nodes.len();
            if nodes >= GROUP_NODES || k + 1 == self.tracks.len() {
                self.groups.push(start..k + 1);
                (start, nodes) = (k + 1, 0);
            }
        }
    }

    /// The instants of a row of a track.
    pub(super) fn instants_of<'a>(&self, track: &Track, row: usize, all: &'a Instants) -> &'a [Instant] {
        let reach = self.reach.get(row).map_or(0.0, |reach| f64::from(*reach));
        match track.rate_rad {
            Some(rates_rad) => all.for_phases(rates_rad.map(|rate_rad| rate_rad * reach)),
            None => all.middle(),
        }
    }

    /// The share of each node of a track in a row at an instant; returns the angle gamma.
    pub(super) fn strides(
        &self,
        track: &Track,
        row: usize,
        instant: &Instant,
        strides: &mut Vec<f64>,
    ) -> f64 {
        let (tau, gamma_rad) = (self.tau[row], self.gamma_rad[row]);
        if instant.offset == 0.0 {
            track.strides(tau, strides);
            return gamma_rad;
        }
        let interpolated =
            |strides: &[f64]| -> f64 { strides.iter().zip(&track.gamma_rad).map(|(a, b)| a * b).sum() };
        track.strides(tau, strides);
        let middle_rad = interpolated(strides);
        track.strides(tau + f64::from(self.reach[row]) * instant.offset, strides);
        gamma_rad + interpolated(strides) - middle_rad
    }

    /// Adds a row's values of all skies to their lists, from the values of the skies' products.
    pub(super) fn combine(&self, row: usize, products: &[Complex64], out: &mut [Vec<Complex64>]) {
        let count = products.len() / out.len().max(1);
        for (out, products) in out.iter_mut().zip(products.chunks_exact(count.max(1))) {
            out.push(match self.coefficients.is_empty() {
                true => products[0],
                false => self.of_row(row, count).zip(products).map(|(a, value)| a * value).sum(),
            });
        }
    }

    /// The transpose of [`Self::combine`].
    pub(super) fn divide(
        &self,
        row: usize,
        values: impl ExactSizeIterator<Item = Complex64>,
        out: &mut [Complex64],
    ) {
        let count = out.len() / values.len().max(1);
        for (out, value) in out.chunks_exact_mut(count.max(1)).zip(values) {
            match self.coefficients.is_empty() {
                true => out[0] = value,
                false => out.iter_mut().zip(self.of_row(row, count)).for_each(|(out, a)| *out = a * value),
            }
        }
    }

    fn of_row(&self, row: usize, count: usize) -> impl Iterator<Item = f64> {
        self.coefficients[row * count..][..count].iter().map(|a| f64::from(*a))
    }
}

/// Whether positions are known throughout an integration of this length, s: as between visibilities.
fn is_known(duration_s: f64) -> bool {
    (0.0..=POSITION_STEP_S_MAX).contains(&duration_s)
}

/// Rows whose responses a task finds.
const ROWS_AT_ONCE: usize = 4096;

/// Coefficients of the responses of rows, as polynomials of degree `most`; none if rows have that of the setup.
fn coefficients(most: usize, rows: usize, observed: &Observed<'_>) -> Result<Vec<f32>, RowsError> {
    let of_row = |index: usize| {
        let response = observed.response.map_or_else(PairResponse::isotropic, |of| of(index));
        match response.degree() {
            degree if degree > most => {
                Err(RowsError { index, refusal: RowsRefusal::Degree { degree, most } })
            }
            _ => Ok(response.coefficients_of(most)),
        }
    };
    if most == 0 && observed.response.is_none() {
        return Ok(Vec::new());
    }
    let of_rows = |first: usize| -> Result<Vec<f32>, RowsError> {
        let mut out = Vec::new();
        for row in first..rows.min(first + ROWS_AT_ONCE) {
            out.extend(of_row(row)?.into_iter().map(|a| a as f32));
        }
        Ok(out)
    };
    let parts = (0..rows.div_ceil(ROWS_AT_ONCE)).into_par_iter().map(|k| of_rows(k * ROWS_AT_ONCE));
    Ok(parts.collect::<Result<Vec<_>, _>>()?.concat())
}

impl Track {
    /// The share of each node at a time.
    fn strides(&self, tau: f64, strides: &mut Vec<f64>) {
        strides.clear();
        if let Some(at) = self.tau.iter().position(|node| *node == tau) {
            strides.extend((0..self.tau.len()).map(|k| f64::from(u8::from(k == at))));
            return;
        }
        strides.extend(self.tau.iter().zip(&self.weights).map(|(node, weight)| weight / (tau - node)));
        let sum: f64 = strides.iter().sum();
        strides.iter_mut().for_each(|share| *share /= sum);
    }
}

/// Divides tracks.
struct TrackBuilder<'a> {
    setup: &'a RowsSetup,
    pairs: &'a [PairAt],
    duration_s: &'a [f32],
    views: &'a [PairView],
    classes: &'a Classes,
    direct: bool,
}

impl TrackBuilder<'_> {
    /// Plans these rows, divided where a satellite changes its velocity; a few about such a place each for itself.
    fn smooth(&self, rows: Range<usize>, plan: &mut RowPlan) {
        let is_new =
            |row: &usize| *row == rows.start || self.pairs[*row].time_s > self.pairs[*row - 1].time_s;
        let distinct: Vec<usize> = rows.clone().filter(is_new).collect();
        let change = |k: usize, stride: usize| self.change_m_s(&distinct, k, stride);
        let (mut first, mut k) = (rows.start, POSITIONS / 2);
        let mut begin = 0;
        while k + POSITIONS / 2 < distinct.len() {
            // At the ends there is no room for long steps.
            let reach = POSITIONS / 2 * KINK_STRIDE;
            let is_inside = k >= begin + reach && k + reach < distinct.len();
            let step_s = self.pairs[distinct[k]].time_s - self.pairs[distinct[k - 1]].time_s;
            let stride = if is_inside && step_s <= KINK_STEP_S_MAX { KINK_STRIDE } else { 1 };
            if change(k, stride) > KINK_M_S {
                let near = (k - KINK_STRIDE).max(begin + POSITIONS / 2)..=k + KINK_STRIDE;
                let near = near.filter(|k| k + POSITIONS / 2 < distinct.len());
                let at = near.max_by(|a, b| change(*a, 1).total_cmp(&change(*b, 1))).unwrap_or(k);
                let [from, to] = [at - 2, at + 3].map(|place| distinct[place]);
                self.split(first..from, plan);
                self.each(from..to, plan);
                // Rows after the change are independent of those before.
                (first, begin, k) = (to, at + 3, at + 3 + POSITIONS / 2);
            } else {
                k += KINK_STRIDE;
            }
        }
        self.split(first..rows.end, plan);
    }

    /// About the change of a satellite's velocity at the k-th of some rows: how far it is from the polynomial through four rows on
    /// either side, `stride` apart, which at a kink is `2 / 7` of the change times a step (more or less if steps differ).
    fn change_m_s(&self, distinct: &[usize], k: usize, stride: usize) -> f64 {
        let at = |place: usize| &self.pairs[distinct[place]];
        let others = || (1..=POSITIONS / 2).flat_map(|n| [k - n * stride, k + n * stride]);
        let mut off = [at(k).r_i_m, at(k).r_j_m];
        for other in others() {
            let rest = others().filter(|rest| *rest != other);
            let share: f64 = rest
                .map(|rest| (at(k).time_s - at(rest).time_s) / (at(other).time_s - at(rest).time_s))
                .product();
            off = [sub(off[0], scale(share, at(other).r_i_m)), sub(off[1], scale(share, at(other).r_j_m))];
        }
        let step_s = 0.5 * (at(k + stride).time_s - at(k - stride).time_s);
        off.into_iter().map(norm).fold(0.0, f64::max) * 3.5 / step_s
    }

    /// Plans these rows, as one track or divided in two.
    fn split(&self, rows: Range<usize>, plan: &mut RowPlan) {
        let count = rows.len();
        if count == 0 {
            return;
        }
        let needed = self.nodes_needed(&rows);
        if needed >= count {
            self.each(rows, plan);
        } else if needed > NODES_MAX {
            let middle = rows.start + count / 2;
            self.split(rows.start..middle, plan);
            self.split(middle..rows.end, plan);
        } else if !self.interpolated(rows.clone(), needed, plan) {
            self.each(rows, plan);
        }
    }

    /// Number of nodes that interpolate `exp(i h tau)` to far below 1e-4, with h the motion of the pattern's phases.
    ///
    /// Where the limb moves by an angle, the phase of a harmonic moves by up to l times that, and that of the fringe by the
    /// slope along the limb's normal: the baseline lies in the horizontal, the normal as much above it as the limb is below.
    fn nodes_needed(&self, rows: &Range<usize>) -> usize {
        let views = &self.views[rows.clone()];
        let middle = views[views.len() / 2].axes[2];
        let half_range = |of: &dyn Fn(&PairView) -> f64| {
            let (low, high) = views
                .iter()
                .map(of)
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
            0.5 * (high - low)
        };
        let tilt = views.iter().map(|view| norm(sub(view.axes[2], middle))).fold(0.0, f64::max);
        let pitch = |view: &PairView| 0.5 * (view.angle_rad[0] + view.angle_rad[1]);
        // Pitch lowers the limb ahead and raises it behind; in between it does less.
        let limb = half_range(&|view| view.limb_rad() + pitch(view))
            .max(half_range(&|view| view.limb_rad() - pitch(view)));
        let wavelengths = |view: &PairView| self.wavelengths(view);
        let slope = views.iter().map(|view| wavelengths(view) * view.limb_rad().sin()).fold(0.0, f64::max);
        let l_max = self.setup.l_max as f64;
        let h = l_max * tilt + (l_max + TAU * slope) * limb + TAU * half_range(&wavelengths);
        (h + 2.5 * h.cbrt() + 4.0).ceil() as usize
    }

    fn wavelengths(&self, view: &PairView) -> f64 {
        view.baseline_m / self.setup.wavelength_m
    }

    /// Axes with this z that turn little with it: those of the ecliptic, taken there by the least rotation.
    fn upright(z: Vec3) -> Axes {
        let north = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let south = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]];
        transported(if z[2] < 0.0 { &south } else { &north }, z)
    }

    /// The axes of P at a view, and the angle to the pair's own.
    fn place(reference: &Axes, view: &PairView) -> (Axes, f64) {
        let axes = view.axes;
        let followed = transported(reference, axes[2]);
        (followed, dot(axes[0], followed[1]).atan2(dot(axes[0], followed[0])))
    }

    fn node(&self, axes: &Axes, view: PairView) -> RowNode {
        let [alpha, beta, gamma] = euler(axes);
        RowNode {
            turns_rad: [alpha + FRAC_PI_2, beta + PI, gamma + FRAC_PI_2],
            view,
            class: self.classes.of(view.cap_rad(), self.wavelengths(&view)),
        }
    }

    /// Half of the integration of a row, s; 0 for an instant, and where it is too long to know its positions.
    fn half_s(&self, row: usize) -> f64 {
        let duration_s = self.duration_s.get(row).map_or(0.0, |duration_s| f64::from(*duration_s));
        if is_known(duration_s) { 0.5 * duration_s } else { 0.0 }
    }

    /// A node for each row.
    fn each(&self, rows: Range<usize>, plan: &mut RowPlan) {
        let first = plan.nodes.len();
        for row in rows.clone() {
            let view = self.views[row];
            let axes = if self.direct { view.axes } else { Self::upright(view.axes[2]) };
            plan.gamma_rad[row] = Self::place(&axes, &view).1;
            plan.nodes.push(self.node(&axes, view));
        }
        let nodes = first..plan.nodes.len();
        plan.instants += rows.clone().filter(|row| self.half_s(*row) > 0.0).count();
        let [tau, weights, gamma_rad] = [const { Vec::new() }; 3];
        plan.tracks.push(Track { rows, nodes, tau, weights, gamma_rad, rate_rad: None });
    }

    /// Sets how the rows of a track move within their integrations. Where its nodes do not give the angles of its rows, rows are
    /// treated as instants.
    fn move_through(&self, track: &mut Track, length_s: f64, plan: &mut RowPlan) {
        for k in 1..track.gamma_rad.len() {
            let turns = ((track.gamma_rad[k] - track.gamma_rad[k - 1]) / TAU).round();
            track.gamma_rad[k] -= turns * TAU;
        }
        let mut strides = Vec::new();
        let is_told = |row: usize| {
            track.strides(plan.tau[row], &mut strides);
            let told: f64 = strides.iter().zip(&track.gamma_rad).map(|(a, b)| a * b).sum();
            let off = (told - plan.gamma_rad[row]) / TAU;
            (off - off.round()).abs() * TAU < GAMMA_ERROR_RAD
        };
        if !track.rows.clone().all(is_told) {
            plan.instants += track.rows.clone().filter(|row| self.half_s(*row) > 0.0).count();
            return;
        }
        for row in track.rows.clone() {
            plan.reach[row] = (2.0 * self.half_s(row) / length_s) as f32;
        }
        let steps = track.tau.windows(2).zip(track.gamma_rad.windows(2));
        let turn =
            steps.map(|(tau, gamma)| ((gamma[1] - gamma[0]) / (tau[1] - tau[0])).abs()).fold(0.0, f64::max);
        let lengths = track.rows.clone().map(|row| self.wavelengths(&self.views[row]));
        let (low, high) = lengths.fold((f64::INFINITY, 0.0_f64), |(a, b), u| (a.min(u), b.max(u)));
        track.rate_rad = Some([TAU * (high * turn + 0.5 * (high - low)), self.setup.l_max as f64 * turn]);
    }

    /// `count` nodes for all rows, at Chebyshev's points. Returns whether the positions allow it.
    fn interpolated(&self, rows: Range<usize>, count: usize, plan: &mut RowPlan) -> bool {
        let times = &self.pairs[rows.clone()];
        let (first_s, last_s) = (times[0].time_s, times[times.len() - 1].time_s);
        // Integrations begin before the middle of the first, and end after that of the last.
        let half_s = rows.clone().map(|row| self.half_s(row)).fold(0.0, f64::max);
        let (from_s, to_s) = (first_s - half_s, last_s + half_s);
        // Rows of equal times have equal positions.
        let is_new =
            |row: &usize| *row == rows.start || self.pairs[*row].time_s > self.pairs[*row - 1].time_s;
        let distinct: Vec<&PairAt> = rows.clone().filter(is_new).map(|row| &self.pairs[row]).collect();
        let is_close = |two: &[&PairAt]| two[1].time_s - two[0].time_s <= POSITION_STEP_S_MAX;
        if distinct.len() < count.max(POSITIONS) || !distinct.windows(2).all(is_close) {
            return false;
        }
        let reference = Self::upright(self.views[rows.start + rows.len() / 2].axes[2]);
        let tau: Vec<f64> = (0..count).map(|k| -(PI * k as f64 / (count - 1) as f64).cos()).collect();
        let nodes: Option<Vec<(RowNode, f64)>> = tau
            .iter()
            .map(|tau| {
                let [r_i_m, r_j_m] = positions(&distinct, from_s + 0.5 * (tau + 1.0) * (to_s - from_s));
                let view = PairView::of(r_i_m, r_j_m, self.setup.moon_radius_m).ok()?;
                let (axes, gamma_rad) = Self::place(&reference, &view);
                Some((self.node(&axes, view), gamma_rad))
            })
            .collect();
        let Some(nodes) = nodes else { return false };
        let (nodes, gamma_rad): (Vec<RowNode>, Vec<f64>) = nodes.into_iter().unzip();
        for row in rows.clone() {
            plan.gamma_rad[row] = Self::place(&reference, &self.views[row]).1;
            plan.tau[row] = 2.0 * (self.pairs[row].time_s - from_s) / (to_s - from_s) - 1.0;
        }
        let first = plan.nodes.len();
        plan.nodes.extend(nodes);
        let weights = tau
            .iter()
            .enumerate()
            .map(|(k, a)| {
                let others = tau.iter().enumerate().filter(|(other, _)| *other != k);
                1.0 / others.map(|(_, b)| 2.0 * (a - b)).product::<f64>()
            })
            .collect();
        let nodes = first..plan.nodes.len();
        let mut track = Track { rows, nodes, tau, weights, gamma_rad, rate_rad: None };
        if half_s > 0.0 {
            self.move_through(&mut track, to_s - from_s, plan);
        }
        plan.tracks.push(track);
        true
    }
}

/// Positions at a time, by the polynomial through those of the nearest times.
fn positions(known: &[&PairAt], time_s: f64) -> [Vec3; 2] {
    let after = known.partition_point(|at| at.time_s < time_s);
    let first = after.saturating_sub(POSITIONS / 2).min(known.len().saturating_sub(POSITIONS));
    let near = &known[first..(first + POSITIONS).min(known.len())];
    let mut out = [[0.0; 3]; 2];
    for (k, at) in near.iter().enumerate() {
        let others = near.iter().enumerate().filter(|(other, _)| *other != k);
        let share: f64 =
            others.map(|(_, other)| (time_s - other.time_s) / (at.time_s - other.time_s)).product();
        out = [add(out[0], scale(share, at.r_i_m)), add(out[1], scale(share, at.r_j_m))];
    }
    out
}
