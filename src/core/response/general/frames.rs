//! Interpolation of rotated skies between frames.
//!
//! A sky rotated into a frame, `t(R)`, is a band-limited function of the rotation R, of degrees up to `l_max`. The planes of a pair's
//! orbits change little, and so do their frames: the rotated skies in many frames are combinations of those in a few,
//!
//! ```text
//! t(R_n) = sum_p w_{p n} t(R_p),
//! ```
//!
//! with the same weights for all skies and degrees. The weights are those that reproduce a number of waves `exp(i l_max a . R b)`, which
//! contain all degrees up to about `l_max`. The frames p are chosen one by one, each time the one whose waves the previous frames
//! reproduce worst (pivoted QR), until all are reproduced.

use faer::{Accum, MatMut, MatRef, Par};
use num_complex::Complex64;

use super::lanes::{LANES, Value};
use super::plan::RowNode;
use super::skies::{RotatedSkies, resize_buffers};
use crate::numerics::trigonometry::sin_cos;
use crate::response::harmonic::degree_count;
use crate::units::vector::{Vec3, dot};

/// Number of waves, which is also the maximum number of chosen frames: real and imaginary parts are twice as many conditions.
const WAVES: usize = 100;

/// Maximum rms error of the waves, below the error of interpolation in time.
const WAVE_ERROR_MAX: f64 = 1e-6;

/// Maximum fraction of frames that are chosen: beyond it, rotating to all frames is faster than combining.
const CHOSEN_FRACTION_MAX: f64 = 0.5;

/// Frames that are combined from a chosen few.
#[derive(Clone, Debug)]
pub(super) struct Frames {
    /// Frames into which skies are rotated.
    pub(super) chosen: Vec<RowNode>,
    count: usize,
    /// Weights `[chosen][frame]`.
    weights: Vec<Value>,
}

/// Returns the k-th of [`WAVES`] directions that are spread evenly on a spiral.
fn direction(k: usize, golden: f64) -> Vec3 {
    let z = 1.0 - (2.0 * k as f64 + 1.0) / WAVES as f64;
    let (sin, cos) = (golden * k as f64).sin_cos();
    let radius = (1.0 - z * z).sqrt();
    [radius * cos, radius * sin, z]
}

/// Returns the columns of `Rz(alpha) Ry(beta) Rz(gamma)` for the angles of a node.
fn axes(node: &RowNode) -> [Vec3; 3] {
    let [alpha, beta, gamma] = node.turns_rad;
    // The node has the angles between quarter turns: alpha + pi / 2, beta + pi and gamma + pi / 2.
    let ((ca, sa), (cb, sb), (cg, sg)) = {
        let rotated = |(s, c): (f64, f64)| (s, -c);
        let beta = sin_cos(beta);
        (rotated(sin_cos(alpha)), (-beta.1, -beta.0), rotated(sin_cos(gamma)))
    };
    [
        [ca * cb * cg - sa * sg, sa * cb * cg + ca * sg, -sb * cg],
        [-ca * cb * sg - sa * cg, -sa * cb * sg + ca * cg, sb * sg],
        [ca * sb, sa * sb, cb],
    ]
}

/// Computes the waves of a frame: real parts, then imaginary parts.
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
    /// Chooses frames among those of nodes; `None` if the frames have too little in common.
    pub(super) fn new(nodes: &[RowNode], l_max: usize) -> Option<Self> {
        let chosen_max = ((CHOSEN_FRACTION_MAX * nodes.len() as f64) as usize).min(WAVES);
        let mut residuals: Vec<Vec<f64>> = nodes.iter().map(|node| waves(node, l_max)).collect();
        let tolerance = WAVE_ERROR_MAX * WAVE_ERROR_MAX * WAVES as f64;
        let mut chosen: Vec<usize> = Vec::new();
        // Coefficient of each chosen frame in each frame.
        let mut triangle: Vec<Vec<f64>> = Vec::new();
        loop {
            let power = |column: &Vec<f64>| column.iter().map(|x| x * x).sum::<f64>();
            let (worst, worst_power) = residuals
                .iter()
                .map(power)
                .enumerate()
                .fold((0, 0.0), |worst, (k, power)| if power > worst.1 { (k, power) } else { worst });
            if worst_power <= tolerance {
                break;
            }
            if chosen.len() == chosen_max {
                return None;
            }
            let unit: Vec<f64> = residuals[worst].iter().map(|x| x / worst_power.sqrt()).collect();
            let parts = residuals.iter_mut().map(|column| {
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

    /// Writes the weights of the chosen frames in the frames `indices`, `[chosen][frame]`, both padded to whole vectors.
    pub(super) fn weights_for(&self, indices: &[usize], out: &mut Vec<Value>) {
        let lanes = indices.len().next_multiple_of(LANES);
        out.clear();
        out.resize(self.chosen.len().next_multiple_of(LANES) * lanes, 0.0);
        for (out, weights) in out.chunks_exact_mut(lanes).zip(self.weights.chunks_exact(self.count)) {
            out.iter_mut().zip(indices).for_each(|(out, index)| *out = weights[*index]);
        }
    }

    /// Computes skies in some frames from those in the chosen ones.
    pub(super) fn combine(
        &self,
        rotated: &RotatedSkies,
        weights: &[Value],
        [l_max, skies]: [usize; 2],
        out: &mut RotatedSkies,
    ) {
        let (chosen, lanes) = self.shape(weights);
        resize_buffers(out, l_max, skies * lanes);
        for (mu, (from, to)) in rotated.iter().zip(out).enumerate() {
            let rows = degree_count(l_max, mu) * skies;
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

    /// Adds the transpose of [`Self::combine`] to `out`.
    pub(super) fn combine_transposed(
        &self,
        rotated: &RotatedSkies,
        weights: &[Value],
        out: &mut RotatedSkies,
        [l_max, skies]: [usize; 2],
    ) {
        let (chosen, lanes) = self.shape(weights);
        for (mu, (from, to)) in rotated.iter().zip(out).enumerate() {
            let rows = degree_count(l_max, mu) * skies;
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

    /// Returns the padded numbers of chosen frames and of frames that these weights have.
    fn shape(&self, weights: &[Value]) -> (usize, usize) {
        let chosen = self.chosen.len().next_multiple_of(LANES);
        (chosen, weights.len() / chosen.max(1))
    }
}

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

    use super::super::view::{PairView, euler_angles, transported};
    use super::*;

    /// Frames of planes that precess from one arc to the next and swing within each.
    fn nodes() -> Vec<RowNode> {
        let view = PairView::new([2.037e6, 1e3, 0.0], [2.037e6, -1e3, 0.0], 1.7371e6).unwrap();
        let north = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let node = |k: usize| {
            let (pass, phase) = ((k / 20) as f64, 0.1 * (k % 20) as f64);
            let (longitude, inclination) = (0.3 + 1.3e-3 * pass, 0.52 + 0.02 * phase.sin());
            let ((si, ci), (so, co)) = (inclination.sin_cos(), (longitude + 0.04 * phase.cos()).sin_cos());
            let [alpha, beta, gamma] = euler_angles(&transported(&north, [si * so, -si * co, ci]));
            RowNode { turns_rad: [alpha + FRAC_PI_2, beta + PI, gamma + FRAC_PI_2], view, class: 0 }
        };
        (0..240).map(node).collect()
    }

    #[test]
    fn axes_are_those_of_the_angles() {
        for node in nodes() {
            let [x, y, z] = axes(&node);
            let [alpha, beta, gamma] = node.turns_rad;
            for (a, b) in
                euler_angles(&[x, y, z]).iter().zip([alpha - FRAC_PI_2, beta - PI, gamma - FRAC_PI_2])
            {
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
        let indices: Vec<usize> = (0..nodes.len()).collect();
        let mut weights = Vec::new();
        frames.weights_for(&indices, &mut weights);
        let combined = |k: usize, of: &dyn Fn(&RowNode) -> Complex64| -> Complex64 {
            let weight = |p: usize| f64::from(weights[p * lanes + k]);
            frames.chosen.iter().enumerate().map(|(p, node)| weight(p) * of(node)).sum()
        };
        // Degree 0, degree 1, and waves of other degrees and directions than those from which the weights come.
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
                // The waves are reproduced to 1e-6 (rms), and weights are in f32.
                let error = (combined(k, of) - of(node)).norm();
                assert!(error < 1e-5, "{k}: {error:e}");
            }
        }
    }

    #[test]
    fn frames_that_have_nothing_in_common_are_not_combined() {
        let rotated = |k: usize| {
            let mut node = nodes()[0];
            node.turns_rad = [1.7 * k as f64, 2.9 * k as f64, 0.3 * k as f64];
            node
        };
        let nodes: Vec<RowNode> = (0..40).map(rotated).collect();
        assert!(Frames::new(&nodes, 160).is_none());
    }
}
