//! Buffers of one thread for applying the operator to a block of alphas, for one or several skies.

use std::sync::Arc;

use num_complex::Complex32;
use rustfft::{Fft, FftPlanner};

use super::grid::{ALPHAS, NODE_GROUP};
use crate::response::harmonic::degree_count;

/// The range of nodes with data, extended to whole groups.
#[derive(Clone, Copy)]
pub(super) struct NodeRange {
    pub(super) first: usize,
    pub(super) count: usize,
}

/// Fourier transforms along gamma, with scratch memory.
pub(super) struct Transforms {
    forward: Arc<dyn Fft<f32>>,
    inverse: Arc<dyn Fft<f32>>,
    scratch: Vec<Complex32>,
}

/// The buffers of one thread.
pub(super) struct Workspace {
    l_max: usize,
    range: NodeRange,
    /// Number of columns: the alphas of the first sky, of the second, and so on.
    pub(super) columns: usize,
    /// The rotated skies by mu: `[re of columns, im of columns][l]`.
    pub(super) rotated: Vec<f32>,
    /// Products with the patterns by mu: `[re of columns, im of columns][node][mu, -mu]`.
    pub(super) products: Vec<f32>,
    /// A ring buffer of two groups of nodes on the grid in gamma.
    pub(super) ring: Vec<Vec<Complex32>>,
    /// Results for one group of nodes.
    pub(super) group: Vec<Vec<Complex32>>,
    pub(super) transforms: Transforms,
}

impl Workspace {
    pub(super) fn new(l_max: usize, points: usize, range: NodeRange, skies: usize) -> Self {
        let columns = skies * ALPHAS;
        let line = || vec![Complex32::ZERO; points];
        let rotated: usize = (0..=l_max).map(|mu| degree_count(l_max, mu)).sum();
        Self {
            l_max,
            range,
            columns,
            rotated: vec![0.0; 2 * columns * rotated],
            products: vec![0.0; (l_max + 1) * 2 * columns * 2 * range.count],
            ring: (0..2 * NODE_GROUP).map(|_| line()).collect(),
            group: (0..NODE_GROUP).map(|_| line()).collect(),
            transforms: Transforms::new(points),
        }
    }

    /// Copies the products of a group of nodes and a column to one half of the ring, and transforms them from orders to gamma.
    pub(super) fn gather(&mut self, column: usize, group: usize) {
        let half = group % (2 * NODE_GROUP);
        let lines = &mut self.ring[half..half + NODE_GROUP];
        if group >= self.range.count {
            lines.iter_mut().for_each(|line| line.fill(Complex32::ZERO));
            return;
        }
        let points = lines[0].len();
        let stride = 2 * self.range.count;
        for line in lines.iter_mut() {
            line[self.l_max + 1..points - self.l_max].fill(Complex32::ZERO);
        }
        for (mu, products) in self.products.chunks_exact(2 * self.columns * stride).enumerate() {
            let (re, im) = products.split_at(self.columns * stride);
            let [re, im] = [re, im].map(|part| &part[column * stride + 2 * group..][..2 * NODE_GROUP]);
            for (k, line) in lines.iter_mut().enumerate() {
                line[mu] = Complex32::new(re[2 * k], im[2 * k]);
                if mu > 0 {
                    line[points - mu] = Complex32::new(re[2 * k + 1], -im[2 * k + 1]);
                }
            }
        }
        lines.iter_mut().for_each(|line| self.transforms.forward(line));
    }

    /// Copies the lines of the group, except the first `skipped`, to the products of a column for the nodes from `first` on: orders mu and
    /// -mu, the latter conjugated.
    pub(super) fn scatter(&mut self, column: usize, skipped: usize, first: usize) {
        let stride = 2 * self.range.count;
        let lines = &self.group[skipped..];
        let points = self.group[0].len();
        let count = lines.len().min(self.range.count.saturating_sub(first));
        for (mu, products) in self.products.chunks_exact_mut(2 * self.columns * stride).enumerate() {
            let (re, im) = products.split_at_mut(self.columns * stride);
            for (k, line) in lines[..count].iter().enumerate() {
                let minus = if mu > 0 { line[points - mu] } else { Complex32::ZERO };
                let index = column * stride + 2 * (first + k);
                re[index] = line[mu].re;
                re[index + 1] = minus.re;
                im[index] = line[mu].im;
                im[index + 1] = -minus.im;
            }
        }
    }
}

impl Transforms {
    fn new(points: usize) -> Self {
        let mut planner = FftPlanner::new();
        let (forward, inverse) = (planner.plan_fft_forward(points), planner.plan_fft_inverse(points));
        let scratch = forward.get_inplace_scratch_len().max(inverse.get_inplace_scratch_len());
        Self { forward, inverse, scratch: vec![Complex32::ZERO; scratch] }
    }

    fn forward(&mut self, line: &mut [Complex32]) {
        self.forward.process_with_scratch(line, &mut self.scratch);
    }

    pub(super) fn inverse(&mut self, line: &mut [Complex32]) {
        self.inverse.process_with_scratch(line, &mut self.scratch);
    }
}
