//! Frames of many rows from a few.
//!
//! A sky turned into a frame, `t(R)`, is a sum of functions of the rotation R of degrees up to `l_max`. Planes of a pair's orbits change
//! little, and so do their frames: what is wanted at many of them is a combination of what it is at some,
//!
//! ```text
//! t(R_n) = sum_p w_{p n} t(R_p),
//! ```
//!
//! with the same weights for all skies and degrees. They are those that reproduce a number of waves `exp(i l_max a . R b)`, which hold all
//! degrees up to about `l_max`. The frames p are chosen one after the other: always that whose waves the ones before reproduce worst
//! (orthogonal triangular factors with pivots), until all are reproduced.

use faer::{Accum, MatMut, MatRef, Par};
use num_complex::Complex64;

use super::lanes::{LANES, Value};
use super::plan::RowNode;
use super::skies::{TurnedSkies, make_room};
use crate::numerics::trigonometry::sin_cos;
use crate::response::harmonic::degrees;
use crate::units::vector::{Vec3, dot};

/// Waves. More than twice as many numbers as frames may be chosen.
const WAVES: usize = 100;

/// Root mean square error of waves at which no more frames are chosen: below that of interpolation.
const ERROR: f64 = 1e-6;

/// Frames that have to be turned to are at most this part of all: else combining them takes longer than turning to all.
const PART: f64 = 0.5;

/// Frames that are combined of others.
#[derive(Clone, Debug)]
pub(super) struct Frames {
    /// Frames to which the sky is turned.
    pub(super) chosen: Vec<RowNode>,
    /// All of them.
    count: usize,
    /// `[chosen][frame]`.
    weights: Vec<Value>,
}

/// Directions spread evenly (on a spiral), of which pairs of number k and `WAVES - k` are far from any pattern.
fn direction(k: usize, golden: f64) -> Vec3 {
    let z = 1.0 - (2.0 * k as f64 + 1.0) / WAVES as f64;
    let (sin, cos) = (golden * k as f64).sin_cos();
    let radius = (1.0 - z * z).sqrt();
    [radius * cos, radius * sin, z]
}

/// The columns of `Rz(alpha) Ry(beta) Rz(gamma)` from the angles of a node.
fn axes(node: &RowNode) -> [Vec3; 3] {
    let [alpha, beta, gamma] = node.turns_rad;
    // Angles as they are for quarter turns: of alpha + pi / 2, beta + pi and gamma + pi / 2.
    let ((ca, sa), (cb, sb), (cg, sg)) = {
        let turned = |(s, c): (f64, f64)| (s, -c);
        let beta = sin_cos(beta);
        (turned(sin_cos(alpha)), (-beta.1, -beta.0), turned(sin_cos(gamma)))
    };
    [
        [ca * cb * cg - sa * sg, sa * cb * cg + ca * sg, -sb * cg],
        [-ca * cb * sg - sa * cg, -sa * cb * sg + ca * cg, sb * sg],
        [ca * sb, sa * sb, cb],
    ]
}

/// The waves of a frame: real parts, then imaginary ones.
fn waves(node: &RowNode, l_max: usize) -> Vec<f64> {
    let axes = axes(node);
    let (golden, other) = (2.399_963_229_728_653, 3.883_222_077_450_933);
    let wave = |k: usize| {
        let (a, b) = (direction(k, golden), direction((61 * k + 7) % WAVES, other));
        // a . R b with R's columns the axes.
        let along: f64 = axes.iter().zip(b).map(|(axis, b)| b * dot(a, *axis)).sum();
        Complex64::cis(l_max as f64 * along)
    };
    let waves: Vec<Complex64> = (0..WAVES).map(wave).collect();
    waves.iter().map(|z| z.re).chain(waves.iter().map(|z| z.im)).collect()
}

impl Frames {
    /// The frames of nodes; `None` if they have too little in common.
    pub(super) fn new(nodes: &[RowNode], l_max: usize) -> Option<Self> {
        let most = ((PART * nodes.len() as f64) as usize).min(WAVES);
        let mut left: Vec<Vec<f64>> = nodes.iter().map(|node| waves(node, l_max)).collect();
        let enough = ERROR * ERROR * WAVES as f64;
        let mut chosen: Vec<usize> = Vec::new();
        // By chosen: its part in each frame.
        let mut triangle: Vec<Vec<f64>> = Vec::new();
        loop {
            let power = |column: &Vec<f64>| column.iter().map(|x| x * x).sum::<f64>();
            let (worst, worst_power) = left
                .iter()
                .map(power)
                .enumerate()
                .fold((0, 0.0), |worst, (k, power)| if power > worst.1 { (k, power) } else { worst });
            if worst_power <= enough {
                break;
            }
            if chosen.len() == most {
                return None;
            }
            let unit: Vec<f64> = left[worst].iter().map(|x| x / worst_power.sqrt()).collect();
            let parts = left.iter_mut().map(|column| {
                let part: f64 = unit.iter().zip(&*column).map(|(a, b)| a * b).sum();
                column.iter_mut().zip(&unit).for_each(|(x, unit)| *x -= part * unit);
                part
            });
            triangle.push(parts.collect());
            chosen.push(worst);
        }
        let weights = weights(&chosen, &triangle, nodes.len());
        let chosen = chosen.into_iter().map(|k| nodes[k]).collect();
        Some(Self { chosen, count: nodes.len(), weights })
    }

    /// Writes the weights of the chosen frames in some, `[chosen, and what fills the last vector][frame, and what fills the last vector]`.
    pub(super) fn weights_of(&self, places: &[usize], out: &mut Vec<Value>) {
        let lanes = places.len().next_multiple_of(LANES);
        out.clear();
        out.resize(self.chosen.len().next_multiple_of(LANES) * lanes, 0.0);
        for (out, weights) in out.chunks_exact_mut(lanes).zip(self.weights.chunks_exact(self.count)) {
            out.iter_mut().zip(places).for_each(|(out, place)| *out = weights[*place]);
        }
    }

    /// Writes skies in some frames from those in the chosen ones.
    pub(super) fn combined(
        &self,
        turned: &TurnedSkies,
        weights: &[Value],
        [l_max, skies]: [usize; 2],
        out: &mut TurnedSkies,
    ) {
        let (chosen, lanes) = self.shape(weights);
        make_room(out, l_max, skies * lanes);
        for (mu, (from, to)) in turned.iter().zip(out).enumerate() {
            let rows = degrees(l_max, mu) * skies;
            for (from, to) in from.iter().zip(to) {
                faer::linalg::matmul::matmul(
                    MatMut::from_row_major_slice_mut(to, rows, lanes),
                    Accum::Replace,
                    MatRef::from_row_major_slice(from, rows, chosen),
                    MatRef::from_row_major_slice(weights, chosen, lanes),
                    1.0,
                    Par::Seq,
                );
            }
        }
    }

    /// The transpose of [`Self::combined`], added to `out`.
    pub(super) fn shared(
        &self,
        turned: &TurnedSkies,
        weights: &[Value],
        out: &mut TurnedSkies,
        [l_max, skies]: [usize; 2],
    ) {
        let (chosen, lanes) = self.shape(weights);
        for (mu, (from, to)) in turned.iter().zip(out).enumerate() {
            let rows = degrees(l_max, mu) * skies;
            for (from, to) in from.iter().zip(to) {
                faer::linalg::matmul::matmul(
                    MatMut::from_row_major_slice_mut(to, rows, chosen),
                    Accum::Add,
                    MatRef::from_row_major_slice(from, rows, lanes),
                    MatRef::from_row_major_slice(weights, chosen, lanes).transpose(),
                    1.0,
                    Par::Seq,
                );
            }
        }
    }

    /// Lanes of the chosen frames, and of those that these weights are of.
    fn shape(&self, weights: &[Value]) -> (usize, usize) {
        let chosen = self.chosen.len().next_multiple_of(LANES);
        (chosen, weights.len() / chosen.max(1))
    }
}

/// Weights `[chosen][frame]` by back substitution.
fn weights(chosen: &[usize], triangle: &[Vec<f64>], count: usize) -> Vec<Value> {
    let mut weights: Vec<Vec<f64>> = triangle.to_vec();
    for row in (0..chosen.len()).rev() {
        let (above, rest) = weights.split_at_mut(row);
        let solved = &mut rest[0];
        let diagonal = triangle[row][chosen[row]];
        solved.iter_mut().for_each(|x| *x /= diagonal);
        for (k, above) in above.iter_mut().enumerate() {
            let part = triangle[k][chosen[row]];
            above.iter_mut().zip(&*solved).for_each(|(x, solved)| *x -= part * solved);
        }
    }
    let mut out = vec![0.0; chosen.len() * count];
    for (out, weights) in out.chunks_exact_mut(count).zip(&weights) {
        out.iter_mut().zip(weights).for_each(|(out, weight)| *out = *weight as Value);
    }
    out
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use super::super::view::{PairView, euler, transported};
    use super::*;

    /// Frames of planes that precess from pass to pass and swing within each.
    fn nodes() -> Vec<RowNode> {
        let view = PairView::of([2.037e6, 1e3, 0.0], [2.037e6, -1e3, 0.0], 1.7371e6).unwrap();
        let north = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let node = |k: usize| {
            let (pass, phase) = ((k / 20) as f64, 0.1 * (k % 20) as f64);
            let (longitude, inclination) = (0.3 + 1.3e-3 * pass, 0.52 + 0.02 * phase.sin());
            let ((si, ci), (so, co)) = (inclination.sin_cos(), (longitude + 0.04 * phase.cos()).sin_cos());
            let [alpha, beta, gamma] = euler(&transported(&north, [si * so, -si * co, ci]));
            RowNode { turns_rad: [alpha + FRAC_PI_2, beta + PI, gamma + FRAC_PI_2], view, class: 0 }
        };
        (0..240).map(node).collect()
    }

    #[test]
    fn axes_are_those_of_the_angles() {
        for node in nodes() {
            let [x, y, z] = axes(&node);
            let [alpha, beta, gamma] = node.turns_rad;
            for (a, b) in euler(&[x, y, z]).iter().zip([alpha - FRAC_PI_2, beta - PI, gamma - FRAC_PI_2]) {
                assert!((a - b).abs() < 1e-12, "{a} {b}");
            }
        }
    }

    #[test]
    fn few_frames_make_all_of_them_at_every_degree() {
        let nodes = nodes();
        let frames = Frames::new(&nodes, 160).unwrap();
        assert!(frames.chosen.len() < nodes.len() / 3, "{}", frames.chosen.len());
        let lanes = nodes.len().next_multiple_of(LANES);
        let places: Vec<usize> = (0..nodes.len()).collect();
        let mut weights = Vec::new();
        frames.weights_of(&places, &mut weights);
        let combined = |k: usize, of: &dyn Fn(&RowNode) -> Complex64| -> Complex64 {
            let weight = |p: usize| f64::from(weights[p * lanes + k]);
            frames.chosen.iter().enumerate().map(|(p, node)| weight(p) * of(node)).sum()
        };
        // Degree 0, degree 1, and waves of lower degrees and other directions than those that the weights were found for.
        let (a, b) = ([0.36, 0.48, -0.8], [-0.6, 0.0, 0.8]);
        let along = |node: &RowNode| axes(node).iter().zip(b).map(|(axis, b)| b * dot(a, *axis)).sum::<f64>();
        let functions: [&dyn Fn(&RowNode) -> Complex64; 4] = [
            &|_| Complex64::ONE,
            &|node| Complex64::new(along(node), 0.0),
            &|node| Complex64::cis(70.0 * along(node)),
            &|node| Complex64::cis(158.0 * along(node)),
        ];
        for of in functions {
            for (k, node) in nodes.iter().enumerate() {
                // Waves hold to 1e-6 (rms), weights are in f32.
                let error = (combined(k, of) - of(node)).norm();
                assert!(error < 1e-5, "{k}: {error:e}");
            }
        }
    }

    #[test]
    fn frames_that_have_nothing_in_common_are_not_combined() {
        let turned = |k: usize| {
            let mut node = nodes()[0];
            node.turns_rad = [1.7 * k as f64, 2.9 * k as f64, 0.3 * k as f64];
            node
        };
        let nodes: Vec<RowNode> = (0..40).map(turned).collect();
        assert!(Frames::new(&nodes, 160).is_none());
    }
}
