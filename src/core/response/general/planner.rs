//! Planning of rows: division of visibilities into tracks, and the nodes of each track.

use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::ops::Range;

use rayon::prelude::*;

use super::antennas::PairResponse;
use super::classes::Classes;
use super::plan::{ObservationDetails, POSITION_STEP_S_MAX, RowNode, RowPlan, Track, has_known_motion};
use super::view::{Axes, PairView, euler_angles, transported};
use super::{RowsError, RowsRefusal, RowsSetup, TimedPair};
use crate::numerics::lagrange_weights;
use crate::units::vector::{Vec3, add, dot, norm, scale, sub};

/// Gap in a pair's data that ends a track, s: polynomials do not extend over times without data.
const GAP_S: f64 = 900.0;

/// Number of times from which the positions of a node are interpolated.
const INTERPOLATION_TIMES: usize = 8;

/// Sudden change of a velocity, m/s, that divides a track, because rows are not smooth there. The turnarounds of a
/// breathing formation change it by 0.2 m/s.
const KINK_M_S: f64 = 1e-4;

/// Stride of the visibilities that are tested for a kink.
const KINK_STRIDE: usize = 4;

/// Longest step, s, for which the test's polynomial goes through visibilities that far apart: beyond, it would not follow a smooth
/// orbit.
const KINK_STEP_S_MAX: f64 = 20.0;

/// Maximum number of rows from which others are interpolated: more take longer and are not more exact.
const NODES_MAX: usize = 40;

/// Maximum error of gamma interpolated from a track's nodes, rad, for which the nodes describe the motion of its rows.
const GAMMA_ERROR_RAD: f64 = 1e-4;

impl RowPlan {
    /// Plans rows for visibilities; consecutive ones of a pair in the order of time weight nodes. With `direct` each row is computed
    /// on its own.
    ///
    /// # Errors
    /// [`RowsError`] for the first visibility that has no row.
    pub(super) fn new(
        setup: &RowsSetup,
        pairs: &[TimedPair],
        observed: &ObservationDetails<'_>,
        direct: bool,
    ) -> Result<Self, RowsError> {
        let views: Vec<PairView> = pairs
            .par_iter()
            .enumerate()
            .map(|(index, at)| {
                PairView::new(at.r_i_m, at.r_j_m, setup.moon_radius_m)
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
            half_tau: vec![0.0; if observed.duration_s.is_empty() { 0 } else { pairs.len() }],
            coefficients: coefficients(setup.polynomial_degree, pairs.len(), observed)?,
            instants: observed
                .duration_s
                .iter()
                .filter(|length_s| !has_known_motion((**length_s).into()))
                .count(),
            classes: classes.node_classes(),
            direct,
        };
        let mut first = 0;
        while first < pairs.len() {
            let continues_track = |k: &usize| {
                let step_s = pairs[*k].time_s - pairs[*k - 1].time_s;
                pairs[*k].pair == pairs[first].pair && (0.0..=GAP_S).contains(&step_s)
            };
            let end =
                (first + 1..pairs.len()).take_while(continues_track).last().map_or(first + 1, |k| k + 1);
            let duration_s = observed.duration_s;
            let track = TrackBuilder { setup, pairs, duration_s, views: &views, classes: &classes, direct };
            if direct {
                track.plan_each(first..end, &mut plan);
            } else {
                track.plan_between_kinks(first..end, &mut plan);
            }
            first = end;
        }
        plan.group();
        Ok(plan)
    }
}

const ROWS_PER_TASK: usize = 4096;

/// Returns the coefficients of the responses of rows as polynomials of degree `degree_max`; none if rows have the setup's response.
fn coefficients(
    degree_max: usize,
    rows: usize,
    observed: &ObservationDetails<'_>,
) -> Result<Vec<f32>, RowsError> {
    let row_coefficients = |index: usize| {
        let response =
            observed.response.map_or_else(PairResponse::isotropic, |response_of| response_of(index));
        match response.degree() {
            degree if degree > degree_max => {
                Err(RowsError { index, refusal: RowsRefusal::Degree { degree, degree_max } })
            }
            _ => Ok(response.coefficients_of_degree(degree_max)),
        }
    };
    if degree_max == 0 && observed.response.is_none() {
        return Ok(Vec::new());
    }
    let task = |first: usize| -> Result<Vec<f32>, RowsError> {
        let mut out = Vec::new();
        for row in first..rows.min(first + ROWS_PER_TASK) {
            out.extend(row_coefficients(row)?.into_iter().map(|a| a as f32));
        }
        Ok(out)
    };
    let parts = (0..rows.div_ceil(ROWS_PER_TASK)).into_par_iter().map(|k| task(k * ROWS_PER_TASK));
    Ok(parts.collect::<Result<Vec<_>, _>>()?.concat())
}

/// Plans the tracks of a list of visibilities.
struct TrackBuilder<'a> {
    setup: &'a RowsSetup,
    pairs: &'a [TimedPair],
    duration_s: &'a [f32],
    views: &'a [PairView],
    classes: &'a Classes,
    direct: bool,
}

impl TrackBuilder<'_> {
    /// Plans these rows, divided where a satellite's velocity jumps; the few rows around a jump are computed on their own.
    fn plan_between_kinks(&self, rows: Range<usize>, plan: &mut RowPlan) {
        let is_new =
            |row: &usize| *row == rows.start || self.pairs[*row].time_s > self.pairs[*row - 1].time_s;
        let distinct: Vec<usize> = rows.clone().filter(is_new).collect();
        let change = |k: usize, stride: usize| self.change_m_s(&distinct, k, stride);
        let (mut first, mut k) = (rows.start, INTERPOLATION_TIMES / 2);
        let mut begin = 0;
        while k + INTERPOLATION_TIMES / 2 < distinct.len() {
            // Long steps do not fit at the ends.
            let reach = INTERPOLATION_TIMES / 2 * KINK_STRIDE;
            let is_inside = k >= begin + reach && k + reach < distinct.len();
            let step_s = self.pairs[distinct[k]].time_s - self.pairs[distinct[k - 1]].time_s;
            let stride = if is_inside && step_s <= KINK_STEP_S_MAX { KINK_STRIDE } else { 1 };
            if change(k, stride) > KINK_M_S {
                let near = (k - KINK_STRIDE).max(begin + INTERPOLATION_TIMES / 2)..=k + KINK_STRIDE;
                let near = near.filter(|k| k + INTERPOLATION_TIMES / 2 < distinct.len());
                let at = near.max_by(|a, b| change(*a, 1).total_cmp(&change(*b, 1))).unwrap_or(k);
                let [from, to] = [at - 2, at + 3].map(|place| distinct[place]);
                self.plan_track(first..from, plan);
                self.plan_each(from..to, plan);
                // Rows after the change do not depend on those before.
                (first, begin, k) = (to, at + 3, at + 3 + INTERPOLATION_TIMES / 2);
            } else {
                k += KINK_STRIDE;
            }
        }
        self.plan_track(first..rows.end, plan);
    }

    /// Estimates the jump of a satellite's velocity at the k-th of the distinct rows: the distance from the polynomial through four
    /// rows on either side, `stride` apart, is about `2 / 7` of the jump times a step.
    fn change_m_s(&self, distinct: &[usize], k: usize, stride: usize) -> f64 {
        let at = |place: usize| &self.pairs[distinct[place]];
        let others = || (1..=INTERPOLATION_TIMES / 2).flat_map(|n| [k - n * stride, k + n * stride]);
        let mut off = [at(k).r_i_m, at(k).r_j_m];
        for other in others() {
            let rest = others().filter(|rest| *rest != other);
            let weight: f64 = rest
                .map(|rest| (at(k).time_s - at(rest).time_s) / (at(other).time_s - at(rest).time_s))
                .product();
            off = [sub(off[0], scale(weight, at(other).r_i_m)), sub(off[1], scale(weight, at(other).r_j_m))];
        }
        let step_s = 0.5 * (at(k + stride).time_s - at(k - stride).time_s);
        off.into_iter().map(norm).fold(0.0, f64::max) * 3.5 / step_s
    }

    /// Plans these rows as one track, or bisects them.
    fn plan_track(&self, rows: Range<usize>, plan: &mut RowPlan) {
        let count = rows.len();
        if count == 0 {
            return;
        }
        let needed = self.nodes_needed(&rows);
        if needed >= count {
            self.plan_each(rows, plan);
        } else if needed > NODES_MAX {
            let middle = rows.start + count / 2;
            self.plan_track(rows.start..middle, plan);
            self.plan_track(middle..rows.end, plan);
        } else if !self.plan_interpolated(rows.clone(), needed, plan) {
            self.plan_each(rows, plan);
        }
    }

    /// Number of nodes that interpolate `exp(i h tau)` to far below 1e-4, with h the motion of the pattern's phases.
    ///
    /// Where the limb moves by an angle, the phase of a harmonic moves by up to l times that angle, and the phase of the fringe by its
    /// slope along the limb's normal. The baseline is horizontal, and the normal is as far above the horizontal as the limb is below.
    fn nodes_needed(&self, rows: &Range<usize>) -> usize {
        let views = &self.views[rows.clone()];
        let middle = views[views.len() / 2].axes[2];
        let half_range = |quantity: &dyn Fn(&PairView) -> f64| {
            let (low, high) = views
                .iter()
                .map(quantity)
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
            0.5 * (high - low)
        };
        let tilt = views.iter().map(|view| norm(sub(view.axes[2], middle))).fold(0.0, f64::max);
        let pitch = |view: &PairView| 0.5 * (view.angle_rad[0] + view.angle_rad[1]);
        // Pitch lowers the limb ahead and raises it behind; its effect is smaller in between.
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

    /// Returns axes with this z that vary slowly with z: the ecliptic axes under the smallest rotation.
    fn reference_axes(z: Vec3) -> Axes {
        let north = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let south = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]];
        transported(if z[2] < 0.0 { &south } else { &north }, z)
    }

    /// Transports `reference` to the plane of a view, and returns the axes with the angle gamma to the pair's own x.
    fn transport_to(reference: &Axes, view: &PairView) -> (Axes, f64) {
        let axes = view.axes;
        let followed = transported(reference, axes[2]);
        (followed, dot(axes[0], followed[1]).atan2(dot(axes[0], followed[0])))
    }

    fn node(&self, axes: &Axes, view: PairView) -> RowNode {
        let [alpha, beta, gamma] = euler_angles(axes);
        RowNode {
            turns_rad: [alpha + FRAC_PI_2, beta + PI, gamma + FRAC_PI_2],
            view,
            class: self.classes.class_of(view.cap_rad(), self.wavelengths(&view)),
        }
    }

    /// Half of a row's integration, s; 0 for an instant, and where the integration is too long to interpolate positions.
    fn half_s(&self, row: usize) -> f64 {
        let duration_s = self.duration_s.get(row).map_or(0.0, |duration_s| f64::from(*duration_s));
        if has_known_motion(duration_s) { 0.5 * duration_s } else { 0.0 }
    }

    fn plan_each(&self, rows: Range<usize>, plan: &mut RowPlan) {
        let first = plan.nodes.len();
        for row in rows.clone() {
            let view = self.views[row];
            let axes = if self.direct { view.axes } else { Self::reference_axes(view.axes[2]) };
            plan.gamma_rad[row] = Self::transport_to(&axes, &view).1;
            plan.nodes.push(self.node(&axes, view));
        }
        let nodes = first..plan.nodes.len();
        plan.instants += rows.clone().filter(|row| self.half_s(*row) > 0.0).count();
        let [tau, weights, gamma_rad] = [const { Vec::new() }; 3];
        plan.tracks.push(Track { rows, nodes, tau, weights, gamma_rad, rate_rad: None });
    }

    /// Sets the motion of a track's rows within their integrations. If the nodes do not reproduce the angles of the rows, all
    /// are treated as instants.
    fn set_motion(&self, track: &mut Track, length_s: f64, plan: &mut RowPlan) {
        for k in 1..track.gamma_rad.len() {
            let turns = ((track.gamma_rad[k] - track.gamma_rad[k - 1]) / TAU).round();
            track.gamma_rad[k] -= turns * TAU;
        }
        let mut node_weights = Vec::new();
        let is_reproduced = |row: usize| {
            track.node_weights(plan.tau[row], &mut node_weights);
            let interpolated: f64 = node_weights.iter().zip(&track.gamma_rad).map(|(a, b)| a * b).sum();
            let off = (interpolated - plan.gamma_rad[row]) / TAU;
            (off - off.round()).abs() * TAU < GAMMA_ERROR_RAD
        };
        if !track.rows.clone().all(is_reproduced) {
            plan.instants += track.rows.clone().filter(|row| self.half_s(*row) > 0.0).count();
            return;
        }
        for row in track.rows.clone() {
            plan.half_tau[row] = (2.0 * self.half_s(row) / length_s) as f32;
        }
        let steps = track.tau.windows(2).zip(track.gamma_rad.windows(2));
        let turn =
            steps.map(|(tau, gamma)| ((gamma[1] - gamma[0]) / (tau[1] - tau[0])).abs()).fold(0.0, f64::max);
        let lengths = track.rows.clone().map(|row| self.wavelengths(&self.views[row]));
        let (low, high) = lengths.fold((f64::INFINITY, 0.0_f64), |(a, b), u| (a.min(u), b.max(u)));
        track.rate_rad = Some([TAU * (high * turn + 0.5 * (high - low)), self.setup.l_max as f64 * turn]);
    }

    /// Plans `count` nodes at Chebyshev points for all rows; returns whether the positions allow it.
    fn plan_interpolated(&self, rows: Range<usize>, count: usize, plan: &mut RowPlan) -> bool {
        let times = &self.pairs[rows.clone()];
        let (first_s, last_s) = (times[0].time_s, times[times.len() - 1].time_s);
        // The first integration begins before its middle, and the last ends after it.
        let half_s = rows.clone().map(|row| self.half_s(row)).fold(0.0, f64::max);
        let (from_s, to_s) = (first_s - half_s, last_s + half_s);
        // Rows of equal times have equal positions.
        let is_new =
            |row: &usize| *row == rows.start || self.pairs[*row].time_s > self.pairs[*row - 1].time_s;
        let distinct: Vec<&TimedPair> = rows.clone().filter(is_new).map(|row| &self.pairs[row]).collect();
        let is_close = |two: &[&TimedPair]| two[1].time_s - two[0].time_s <= POSITION_STEP_S_MAX;
        if distinct.len() < count.max(INTERPOLATION_TIMES) || !distinct.windows(2).all(is_close) {
            return false;
        }
        let reference = Self::reference_axes(self.views[rows.start + rows.len() / 2].axes[2]);
        let tau: Vec<f64> = (0..count).map(|k| -(PI * k as f64 / (count - 1) as f64).cos()).collect();
        let nodes: Option<Vec<(RowNode, f64)>> = tau
            .iter()
            .map(|tau| {
                let [r_i_m, r_j_m] = positions(&distinct, from_s + 0.5 * (tau + 1.0) * (to_s - from_s));
                let view = PairView::new(r_i_m, r_j_m, self.setup.moon_radius_m).ok()?;
                let (axes, gamma_rad) = Self::transport_to(&reference, &view);
                Some((self.node(&axes, view), gamma_rad))
            })
            .collect();
        let Some(nodes) = nodes else { return false };
        let (nodes, gamma_rad): (Vec<RowNode>, Vec<f64>) = nodes.into_iter().unzip();
        for row in rows.clone() {
            plan.gamma_rad[row] = Self::transport_to(&reference, &self.views[row]).1;
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
            self.set_motion(&mut track, to_s - from_s, plan);
        }
        plan.tracks.push(track);
        true
    }
}

/// Interpolates positions at a time by the polynomial through the nearest times.
fn positions(known: &[&TimedPair], time_s: f64) -> [Vec3; 2] {
    let after = known.partition_point(|at| at.time_s < time_s);
    let first =
        after.saturating_sub(INTERPOLATION_TIMES / 2).min(known.len().saturating_sub(INTERPOLATION_TIMES));
    let near = &known[first..(first + INTERPOLATION_TIMES).min(known.len())];
    let mut out = [[0.0; 3]; 2];
    let times_s: Vec<f64> = near.iter().map(|at| at.time_s).collect();
    for (at, weight) in near.iter().zip(lagrange_weights(&times_s, time_s)) {
        out = [add(out[0], scale(weight, at.r_i_m)), add(out[1], scale(weight, at.r_j_m))];
    }
    out
}
