//! Between an image of a patch and its visibilities: `V(u) = sum I exp(-2 pi i (u l + v m + w (n - 1)))`, and the adjoint.
//!
//! A non-uniform FFT in three dimensions: visibilities are spread on planes of constant w (Offringa et al. 2014, Arras et al. 2021: w
//! stacking with a gridding kernel in w, too), each plane is transformed in two dimensions, and the kernel's transform is divided out. As
//! images are real, all baselines are turned to w >= 0, which halves the planes.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use num_complex::Complex64;
use rayon::prelude::*;
use rustfft::{Fft, FftPlanner};

use super::averaging::Row;
use crate::numerics::fft_length;
use crate::numerics::trigonometry::sin_cos;
use crate::response::harmonic::gridding_kernel::Kernel;

/// Accuracy of the gridding kernel.
const TOLERANCE: f64 = 1e-6;
/// Nodes for each pixel of the image, and planes for each of the least that w needs; at least.
const OVERSAMPLING: f64 = 1.5;
/// Rows or columns of the grid that are transformed together, so that strided reads use whole cache lines.
const TOGETHER: usize = 4;
/// Samples of the kernel's transform in w, between which it is interpolated linearly, to 3e-8.
const W_SAMPLES: usize = 20_001;

/// The pixels of a patch: a square of direction cosines, of which those within the patch's radius are used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelGrid {
    /// Pixels along a side; even. The centre of the patch is that of pixel `side / 2`, counted from 0.
    pub side: usize,
    /// Side of a pixel in direction cosines (rad at the centre).
    pub step: f64,
    /// Sine of the patch's radius.
    pub reach: f64,
}

impl PixelGrid {
    /// The grid of a patch.
    #[must_use]
    pub fn new(radius_rad: f64, step: f64) -> Self {
        let reach = radius_rad.sin();
        Self { side: 2 * ((reach / step).ceil() as usize + 1), step, reach }
    }

    /// Direction cosines l, m of a pixel: l falls with the column, m rises with the row. Pixels are in columns.
    #[must_use]
    pub fn place(&self, index: usize) -> [f64; 2] {
        let at = |k: usize| (k as f64 - (self.side / 2) as f64) * self.step;
        [-at(index / self.side), at(index % self.side)]
    }

    /// Whether a pixel is within the patch.
    #[must_use]
    pub fn is_inside(&self, index: usize) -> bool {
        let [l, m] = self.place(index);
        l * l + m * m <= self.reach * self.reach
    }

    /// Number of pixels, with the square's corners.
    #[must_use]
    pub fn len(&self) -> usize {
        self.side * self.side
    }

    /// Whether there are no pixels; never.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.side == 0
    }

    /// `1 - n` at the edge.
    fn depth(&self) -> f64 {
        1.0 - (1.0 - self.reach * self.reach).max(0.0).sqrt()
    }
}

/// One of the two instants of a row, on the grid.
#[derive(Clone, Copy, Debug)]
struct Point {
    /// Place on the grid, in nodes and planes.
    x: f64,
    y: f64,
    plane: f64,
    row: u32,
    /// Whether it was turned to the opposite baseline.
    is_turned: bool,
}

/// The transforms for a set of rows.
pub struct PatchTransform {
    grid: PixelGrid,
    /// Sorted by plane.
    points: Vec<Point>,
    rows: usize,
    nodes: usize,
    planes: usize,
    plane_wavelengths: f64,
    kernel: Kernel,
    kernel_w: Kernel,
    /// Inverse of the kernel's transform by column or row.
    correction: Vec<f64>,
    /// Inverse of the kernel's transform in w, from the one end of its band to the other.
    correction_w: Vec<f64>,
    towards_nodes: Arc<dyn Fft<f64>>,
    towards_pixels: Arc<dyn Fft<f64>>,
}

impl PatchTransform {
    /// Prepares the transforms between the pixels of `grid` and `rows`.
    #[must_use]
    pub fn new(grid: PixelGrid, rows: &[Row]) -> Self {
        let nodes = fft_length((OVERSAMPLING * grid.side as f64).ceil() as usize);
        let kernel = Kernel::new(TOLERANCE, nodes as f64 / grid.side as f64);
        let kernel_w = Kernel::new(TOLERANCE, OVERSAMPLING);
        let plane_wavelengths = 1.0 / (OVERSAMPLING * grid.depth().max(1e-12));
        let half_w = 0.5 * kernel_w.width() as f64;
        let node = grid.step * nodes as f64;
        let points = rows.iter().zip(0_u32..).flat_map(|(row, number)| {
            [1.0, -1.0].map(|sign| {
                let at = |k: usize| row.u[k] + sign * row.spread[k];
                let turn = if at(2) < 0.0 { -1.0 } else { 1.0 };
                // l falls with the column.
                let (x, y) = (-turn * at(0) * node, turn * at(1) * node);
                let plane = turn * at(2) / plane_wavelengths + half_w;
                Point { x, y, plane, row: number, is_turned: turn < 0.0 }
            })
        });
        let mut points: Vec<Point> = points.collect();
        points.par_sort_by(|a, b| a.plane.total_cmp(&b.plane).then(a.row.cmp(&b.row)));
        let planes = points.last().map_or(0.0, |point| point.plane + half_w).floor() as usize + 1;
        let frequencies: Vec<f64> =
            (0..grid.side).map(|k| (k as f64 - (grid.side / 2) as f64) / nodes as f64).collect();
        let inverse = |transforms: Vec<f64>| transforms.into_iter().map(f64::recip).collect::<Vec<f64>>();
        let across = |k: usize| (k as f64 / (W_SAMPLES - 1) as f64 - 0.5) * grid.depth() * plane_wavelengths;
        let frequencies_w: Vec<f64> = (0..W_SAMPLES).map(across).collect();
        let mut planner = FftPlanner::new();
        Self {
            grid,
            points,
            rows: rows.len(),
            nodes,
            planes,
            plane_wavelengths,
            correction: inverse(kernel.transforms(&frequencies)),
            correction_w: inverse(kernel_w.transforms(&frequencies_w)),
            kernel,
            kernel_w,
            towards_nodes: planner.plan_fft_forward(nodes),
            towards_pixels: planner.plan_fft_inverse(nodes),
        }
    }

    /// The pixels.
    #[must_use]
    pub fn grid(&self) -> &PixelGrid {
        &self.grid
    }

    /// `Re B' v`: the sum of the conjugate rows of B times `values`, at each pixel; 0 outside the patch.
    #[must_use]
    pub fn adjoint(&self, values: &[Complex64]) -> Vec<f64> {
        let terms: Vec<Complex64> = self
            .points
            .par_iter()
            .map(|point| {
                let value = values[point.row as usize];
                let value = if point.is_turned { value.conj() } else { value };
                0.5 * value * self.shift(point).conj()
            })
            .collect();
        let mut image = vec![0.0; self.grid.len()];
        let mut nodes = vec![Complex64::ZERO; self.nodes * self.nodes];
        for plane in 0..self.planes {
            let (points, first) = self.points_near(plane);
            if points.is_empty() {
                continue;
            }
            nodes.par_iter_mut().for_each(|node| *node = Complex64::ZERO);
            self.spread(plane, points, &terms[first..], &mut nodes);
            nodes
                .par_chunks_mut(self.nodes)
                .filter(|row| row.iter().any(|node| *node != Complex64::ZERO))
                .for_each(|row| self.towards_pixels.process(row));
            self.add_plane(plane, &nodes, &mut image);
        }
        image.par_iter_mut().enumerate().for_each(|(k, value)| *value *= self.correction_at(k));
        image
    }

    /// `B x`: the visibility of each row.
    #[must_use]
    pub fn forward(&self, image: &[f64]) -> Vec<Complex64> {
        let corrected: Vec<f64> =
            image.par_iter().enumerate().map(|(k, value)| value * self.correction_at(k)).collect();
        let mut values = vec![Complex64::ZERO; self.points.len()];
        let mut columns = vec![Complex64::ZERO; self.grid.side * self.nodes];
        let mut nodes = vec![Complex64::ZERO; self.nodes * self.nodes];
        for plane in 0..self.planes {
            let (points, first) = self.points_near(plane);
            if points.is_empty() {
                continue;
            }
            self.columns_of_plane(plane, &corrected, &mut columns);
            self.rows_of_plane(&columns, &mut nodes);
            let of_points = values[first..first + points.len()].par_iter_mut().zip(points);
            of_points.for_each(|(value, point)| *value += self.interpolated(plane, point, &nodes));
        }
        let mut sums = vec![Complex64::ZERO; self.rows];
        for (point, value) in self.points.iter().zip(values) {
            let value = 0.5 * value * self.shift(point);
            sums[point.row as usize] += if point.is_turned { value.conj() } else { value };
        }
        sums
    }

    /// The factor `exp(i pi w (1 - n at the edge))`, as planes are symmetric about the middle of the patch's depth.
    fn shift(&self, point: &Point) -> Complex64 {
        let w = (point.plane - 0.5 * self.kernel_w.width() as f64) * self.plane_wavelengths;
        Complex64::cis(PI * w * self.grid.depth())
    }

    /// The points whose kernel reaches a plane, and the number of the first.
    fn points_near(&self, plane: usize) -> (&[Point], usize) {
        let half = 0.5 * self.kernel_w.width() as f64;
        let first = self.points.partition_point(|point| point.plane <= plane as f64 - half);
        let end = self.points.partition_point(|point| point.plane < plane as f64 + half);
        (&self.points[first..end], first)
    }

    fn correction_at(&self, index: usize) -> f64 {
        if !self.grid.is_inside(index) {
            return 0.0;
        }
        let place = (self.depth_at(index) / self.grid.depth() + 0.5).clamp(0.0, 1.0) * (W_SAMPLES - 1) as f64;
        let below = (place as usize).min(W_SAMPLES - 2);
        let part = place - below as f64;
        let w = (1.0 - part) * self.correction_w[below] + part * self.correction_w[below + 1];
        w * self.correction[index / self.grid.side] * self.correction[index % self.grid.side]
    }

    /// `n - 1` of a pixel, from the middle of its range.
    fn depth_at(&self, index: usize) -> f64 {
        let [l, m] = self.grid.place(index);
        (1.0 - l * l - m * m).max(0.0).sqrt() - 1.0 + 0.5 * self.grid.depth()
    }

    /// Wavelengths of a plane.
    fn w(&self, plane: usize) -> f64 {
        (plane as f64 - 0.5 * self.kernel_w.width() as f64) * self.plane_wavelengths
    }

    /// The kernel in w of a point at a plane.
    fn weight_w(&self, plane: usize, point: &Point) -> f64 {
        let (first, lanes) = self.kernel_w.spread(point.plane);
        usize::try_from(plane as i64 - first).ok().and_then(|k| lanes.get(k)).map_or(0.0, |&w| f64::from(w))
    }

    fn wrapped(&self, node: i64) -> usize {
        node.rem_euclid(self.nodes as i64) as usize
    }

    /// Spreads terms over the nodes of a plane. Each band of rows has its own thread, which meets the points in their order.
    fn spread(&self, plane: usize, points: &[Point], terms: &[Complex64], nodes: &mut [Complex64]) {
        let (width, side) = (self.kernel.width(), self.nodes);
        let band = side.div_ceil(2 * rayon::current_num_threads());
        nodes.par_chunks_mut(band * side).enumerate().for_each(|(number, nodes)| {
            let rows = number * band..(number * band + nodes.len() / side);
            for (point, term) in points.iter().zip(terms) {
                let start = self.wrapped((point.y - 0.5 * width as f64).ceil() as i64);
                // The band may be narrower than the kernel.
                let before_band = (rows.start + side - start) % side;
                if before_band >= width && !rows.contains(&start) {
                    continue;
                }
                let term = self.weight_w(plane, point) * term;
                let (first_x, along) = self.kernel.spread(point.x);
                let (_, up) = self.kernel.spread(point.y);
                let first_x = self.wrapped(first_x);
                for (k, weight) in up[..width].iter().enumerate() {
                    let row = (start + k) % side;
                    if !rows.contains(&row) {
                        continue;
                    }
                    let term = f64::from(*weight) * term;
                    let row = &mut nodes[(row - rows.start) * side..][..side];
                    for (j, weight) in along[..width].iter().enumerate() {
                        row[(first_x + j) % side] += f64::from(*weight) * term;
                    }
                }
            }
        });
    }

    /// The plane at a point, between its nodes.
    fn interpolated(&self, plane: usize, point: &Point, nodes: &[Complex64]) -> Complex64 {
        let (width, side) = (self.kernel.width(), self.nodes);
        let (first_x, along) = self.kernel.spread(point.x);
        let (first_y, up) = self.kernel.spread(point.y);
        let (first_x, first_y) = (self.wrapped(first_x), self.wrapped(first_y));
        let mut sum = Complex64::ZERO;
        for (k, weight) in up[..width].iter().enumerate() {
            let row = &nodes[(first_y + k) % side * side..][..side];
            let across = (0..width).map(|j| f64::from(along[j]) * row[(first_x + j) % side]);
            sum += f64::from(*weight) * across.sum::<Complex64>();
        }
        self.weight_w(plane, point) * sum
    }

    /// Transforms the columns of a plane's nodes, whose rows are transformed, and adds them to the image.
    fn add_plane(&self, plane: usize, nodes: &[Complex64], image: &mut [f64]) {
        let (side, w) = (self.grid.side, self.w(plane));
        image.par_chunks_mut(TOGETHER * side).enumerate().for_each(|(number, image)| {
            let first = number * TOGETHER;
            let columns = image.len() / side;
            let mut buffer = vec![Complex64::ZERO; columns * self.nodes];
            for (row, nodes) in nodes.chunks_exact(self.nodes).enumerate() {
                for k in 0..columns {
                    buffer[k * self.nodes + row] = nodes[self.node_of_pixel(first + k)];
                }
            }
            self.towards_pixels.process(&mut buffer);
            for (k, image) in image.chunks_exact_mut(side).enumerate() {
                for (row, value) in image.iter_mut().enumerate() {
                    let node = buffer[k * self.nodes + self.node_of_pixel(row)];
                    let (sin, cos) = sin_cos(TAU * w * self.depth_at((first + k) * side + row));
                    *value += node.re * cos - node.im * sin;
                }
            }
        });
    }

    /// Multiplies an image by the phases of a plane, and transforms its columns.
    fn columns_of_plane(&self, plane: usize, image: &[f64], columns: &mut [Complex64]) {
        let (side, w) = (self.grid.side, self.w(plane));
        let both = columns.par_chunks_mut(self.nodes).zip(image.par_chunks(side)).enumerate();
        both.for_each(|(column, (nodes, image))| {
            nodes.fill(Complex64::ZERO);
            for (row, value) in image.iter().enumerate().filter(|(_, value)| **value != 0.0) {
                let (sin, cos) = sin_cos(TAU * w * self.depth_at(column * side + row));
                nodes[self.node_of_pixel(row)] = Complex64::new(value * cos, -value * sin);
            }
            self.towards_nodes.process(nodes);
        });
    }

    /// Transforms the rows of a plane from its columns.
    fn rows_of_plane(&self, columns: &[Complex64], nodes: &mut [Complex64]) {
        nodes.par_chunks_mut(TOGETHER * self.nodes).enumerate().for_each(|(number, nodes)| {
            nodes.fill(Complex64::ZERO);
            let rows = nodes.len() / self.nodes;
            for (column, values) in columns.chunks_exact(self.nodes).enumerate() {
                let node = self.node_of_pixel(column);
                for row in 0..rows {
                    nodes[row * self.nodes + node] = values[number * TOGETHER + row];
                }
            }
            self.towards_nodes.process(nodes);
        });
    }

    /// The node at the place of a column or row: the patch's centre is at node 0.
    fn node_of_pixel(&self, pixel: usize) -> usize {
        (pixel + self.nodes - self.grid.side / 2) % self.nodes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::vector::dot;

    /// Repeatable numbers of -1 to 1.
    fn numbers() -> impl FnMut() -> f64 {
        let mut state = 7_u64;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        }
    }

    fn rows(count: usize, wavelengths: f64) -> Vec<Row> {
        let mut next = numbers();
        let mut vector = |size: f64| [size * next(), size * next(), size * next()];
        let row = |_| Row { u: vector(wavelengths), spread: vector(0.3), value: Complex64::ONE, weight: 1.0 };
        (0..count).map(row).collect()
    }

    /// Row of B at direction cosines, by its definition.
    fn direct(row: &Row, [l, m]: [f64; 2]) -> Complex64 {
        let delta = [l, m, (1.0 - l * l - m * m).sqrt() - 1.0];
        let at = |sign: f64| Complex64::cis(-TAU * (dot(row.u, delta) + sign * dot(row.spread, delta)));
        0.5 * (at(1.0) + at(-1.0))
    }

    fn rms(values: impl Iterator<Item = f64>) -> f64 {
        let (mut sum, mut count) = (0.0, 0.0);
        values.for_each(|value| (sum, count) = (sum + value * value, count + 1.0));
        f64::sqrt(sum / count)
    }

    /// Baselines of all directions as long as the pixels permit (their fringes turn by less than half a pixel), in a patch of 8 degrees:
    /// some 12 planes, and one of 1 degree: hardly any; the last has bands of rows narrower than the kernel.
    #[test]
    fn both_ways_are_direct_sums() {
        for (radius_deg, pixels) in [(8.0_f64, 60.0), (1.0, 40.0), (1.0, 10.0)] {
            let radius = radius_deg.to_radians();
            let grid = PixelGrid::new(radius, 2.0 * radius / pixels);
            let rows = rows(700, 0.45 / grid.step);
            let transform = PatchTransform::new(grid, &rows);
            let mut next = numbers();
            let image: Vec<f64> =
                (0..grid.len()).map(|k| if grid.is_inside(k) { next() } else { 0.0 }).collect();
            let inside: Vec<usize> = (0..grid.len()).filter(|&k| grid.is_inside(k)).collect();
            let found = transform.forward(&image);
            let expected: Vec<Complex64> = rows
                .iter()
                .map(|row| inside.iter().map(|&k| image[k] * direct(row, grid.place(k))).sum())
                .collect();
            let error = rms(found.iter().zip(&expected).map(|(a, b)| (a - b).norm()));
            let size = rms(expected.iter().map(|value| value.norm()));
            // The kernel's tolerance is 1e-6 in each of three dimensions.
            assert!(error < 5e-6 * size, "forward: {:e}", error / size);
            let values: Vec<Complex64> = rows.iter().map(|_| Complex64::new(next(), next())).collect();
            let found = transform.adjoint(&values);
            let sum = |k: &usize| -> f64 {
                rows.iter().zip(&values).map(|(row, v)| (direct(row, grid.place(*k)).conj() * v).re).sum()
            };
            let expected: Vec<f64> = inside.iter().map(sum).collect();
            let error = rms(inside.iter().zip(&expected).map(|(&k, b)| found[k] - b));
            let size = rms(expected.iter().copied());
            assert!(error < 5e-6 * size, "adjoint: {:e}", error / size);
            assert!((0..grid.len()).all(|k| grid.is_inside(k) || found[k] == 0.0));
        }
    }
}
