//! Products with rows of B that are computed for each product and not stored.
//!
//! Rows are computed in blocks: the tables of a chunk of pixels are read once for all rows of a block, and the rows stay in the
//! cache between `B x` and `Bt`. Pixels are in NESTED order, so that a chunk is a compact patch of the sky, which the Moon usually hides
//! fully or not at all: hidden chunks cost nothing, and fully visible chunks need no comparison with the limb.
//!
//! A product is a sum over a fixed number of parts, added in order, so that its bits do not depend on threads.

use multiversion::multiversion;
use num_complex::Complex64;
use rayon::prelude::*;

use super::average::Means;
use super::blocks::{BlockClass, GROUP};
use super::kernel::{KernelGeometry, dot64};
use super::order::PixelOrder;
use super::rows::{average, means_of_group};
use super::{PairGeometry, PixelMethod, ResponseError, RowMaker};
use crate::sky::healpix::{pixel_area_sr, pixel_directions};
use crate::units::arithmetic::{cos_sin_turns, fraction_of_turn, fused};
use crate::units::vector::{Vec3, add, norm, scale, sub};

/// Maximum number of rows that are computed together: they fit the cache of a core, and tables are read an eighth as often.
const ROWS: usize = 8;

/// Number of parts of a product, each with its own sums.
const PARTS: usize = 32;

const CHUNK: usize = GROUP;

const LANES: usize = 16;

/// Real and imaginary parts of a row over a chunk of pixels.
type Piece = [[f32; CHUNK]; 2];

/// A spherical cap that encloses a chunk of pixels.
#[derive(Clone, Copy, Debug)]
struct Cap {
    centre: Vec3,
    /// Maximum distance of a point of the chunk from `centre`.
    radius: f64,
}

/// Visibility of a chunk of pixels to a pair: hidden, crossed by a limb, or fully visible.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ChunkView {
    Hidden,
    Cut,
    Open,
}

/// Products with rows of B, which are not stored. Vectors are maps in RING order; rows include the area of the pixels.
#[derive(Debug)]
pub struct RowProducts {
    rows: RowMaker,
    /// RING number of each NESTED pixel.
    ring: Vec<usize>,
    chunks: Vec<[[f64; CHUNK]; 3]>,
    caps: Vec<Cap>,
}

/// Map in the layout of the kernels: chunks in NESTED order, scaled to at most 1.
struct ScaledMap {
    chunks: Vec<[f32; CHUNK]>,
    scale: f64,
}

/// Rows of a group, chunk by chunk.
struct ChunkedRows {
    pieces: Vec<[Piece; ROWS]>,
    views: Vec<[ChunkView; ROWS]>,
}

/// Rows that are computed together, with one class of blocks.
#[derive(Clone, Debug, PartialEq, Eq)]
struct RowGroup {
    first: usize,
    count: usize,
    class: Option<usize>,
}

/// Factors of the real and imaginary parts of each row of a block, by column.
type Factors = Vec<[[f32; 2]; ROWS]>;

type ChunkSums = Vec<[f64; CHUNK]>;

impl RowProducts {
    /// Prepares products for maps of `nside`.
    ///
    /// # Errors
    /// As [`RowMaker::new`].
    pub fn new(nside: usize, method: PixelMethod) -> Result<Self, ResponseError> {
        let order = PixelOrder::Nested;
        let rows = RowMaker::with_order(nside, method, order)?;
        let pixels = rows.pixels();
        let ring: Vec<usize> = (0..pixels).map(|place| order.ring(nside, place)).collect();
        let n = pixel_directions(nside);
        let (mut chunks, mut caps) = (Vec::new(), Vec::new());
        // No point of a pixel is farther from its centre than the root of its area.
        let margin = if method == PixelMethod::Centre { 1e-9 } else { rows.pixel_width_rad() };
        for places in ring.chunks(CHUNK) {
            let sum = places.iter().fold([0.0; 3], |sum, &pixel| add(sum, n[pixel]));
            let centre = scale(1.0 / places.len() as f64, sum);
            let radius = places.iter().map(|&pixel| norm(sub(n[pixel], centre))).fold(0.0, f64::max);
            caps.push(Cap { centre, radius: radius + margin });
            // The last chunk is padded with its last pixel, which counts only once.
            let mut chunk = [[0.0; CHUNK]; 3];
            for lane in 0..CHUNK {
                let pixel = places[lane.min(places.len() - 1)];
                (0..3).for_each(|axis| chunk[axis][lane] = n[pixel][axis]);
            }
            chunks.push(chunk);
        }
        Ok(Self { rows, ring, chunks, caps })
    }

    /// Number of pixels.
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.ring.len()
    }

    /// Memory of products of `columns` vectors together on `threads` threads, bytes: the rows of a group for each thread, and the sums
    /// of all parts.
    #[must_use]
    pub fn memory_bytes(nside: usize, columns: usize, threads: usize) -> u64 {
        let chunks = (12 * nside * nside).div_ceil(CHUNK);
        let row_bytes = chunks * (size_of::<[Piece; ROWS]>() + ROWS);
        // Tables of averages: centres, slopes and radii.
        let tables = chunks * CHUNK * (3 * 8 + 16 * 4 + 3 * 8 + 3 * 8 + 8);
        (threads.min(PARTS) * row_bytes + PARTS * columns * chunks * CHUNK * 8 + tables) as u64
    }

    /// Computes `Bt W B x` for several x, with W the weights of the pairs.
    #[must_use]
    pub fn normal(&self, pairs: &[PairGeometry], weights: &[f64], x: &[&[f64]]) -> Vec<Vec<f64>> {
        let scaled: Vec<ScaledMap> = x.iter().map(|x| self.scale_map(x)).collect();
        let largest = weights.iter().copied().fold(0.0, f64::max);
        let mut sums = self.sums(pairs, x.len(), &|group, chunked_rows, sums| {
            let visibilities = chunked_rows.forward(group.count, &scaled);
            let factors = |visibilities: &[[f64; 2]; ROWS]| {
                let mut factors = [[0.0; 2]; ROWS];
                for (row, factors) in factors.iter_mut().enumerate().take(group.count) {
                    let weight = weights[group.first + row] / largest;
                    *factors = visibilities[row].map(|part| (weight * part) as f32);
                }
                factors
            };
            chunked_rows.add_to(group.count, &visibilities.iter().map(factors).collect(), sums);
        });
        let area_sr = pixel_area_sr(self.rows.nside());
        for (sums, scaled) in sums.iter_mut().zip(&scaled) {
            let unit = area_sr * area_sr * largest * scaled.scale;
            sums.iter_mut().for_each(|sum| *sum *= unit);
        }
        sums
    }

    /// Computes `Bt v` for several v with one value per pair: real parts times real rows plus imaginary parts times imaginary rows.
    #[must_use]
    pub fn adjoint(&self, pairs: &[PairGeometry], values: &[&[Complex64]]) -> Vec<Vec<f64>> {
        let size =
            |values: &&[Complex64]| values.iter().map(|v| v.re.abs().max(v.im.abs())).fold(0.0, f64::max);
        let scales: Vec<f64> =
            values.iter().map(size).map(|size| if size > 0.0 { size } else { 1.0 }).collect();
        let mut sums = self.sums(pairs, values.len(), &|group, chunked_rows, sums| {
            let factors = |(values, scale): (&&[Complex64], &f64)| {
                let mut factors = [[0.0; 2]; ROWS];
                for (row, factors) in factors.iter_mut().enumerate().take(group.count) {
                    let value = values[group.first + row] / *scale;
                    *factors = [value.re as f32, value.im as f32];
                }
                factors
            };
            chunked_rows.add_to(group.count, &values.iter().zip(&scales).map(factors).collect(), sums);
        });
        let area_sr = pixel_area_sr(self.rows.nside());
        for (sums, scale) in sums.iter_mut().zip(&scales) {
            sums.iter_mut().for_each(|sum| *sum *= area_sr * scale);
        }
        sums
    }

    /// Computes `B x`: one value per pair.
    #[must_use]
    pub fn forward(&self, pairs: &[PairGeometry], x: &[f64]) -> Vec<Complex64> {
        let scaled = [self.scale_map(x)];
        let unit = pixel_area_sr(self.rows.nside()) * scaled[0].scale;
        let values_of_group = |chunked_rows: &mut ChunkedRows, group: &RowGroup| -> Vec<Complex64> {
            self.compute_rows(pairs, group, chunked_rows);
            let visibilities = chunked_rows.forward(group.count, &scaled);
            visibilities[0][..group.count]
                .iter()
                .map(|[re, im]| Complex64::new(re * unit, im * unit))
                .collect()
        };
        let groups = self.row_groups(pairs);
        groups
            .par_iter()
            .map_init(|| ChunkedRows::new(self.chunks.len()), values_of_group)
            .flatten_iter()
            .collect()
    }

    fn scale_map(&self, x: &[f64]) -> ScaledMap {
        let largest = x.iter().map(|x| x.abs()).fold(0.0, f64::max);
        let scale = if largest > 0.0 { largest } else { 1.0 };
        let chunk = |places: &[usize]| {
            let mut chunk = [0.0; CHUNK];
            for (value, &pixel) in chunk.iter_mut().zip(places) {
                *value = (x[pixel] / scale) as f32;
            }
            chunk
        };
        ScaledMap { chunks: self.ring.chunks(CHUNK).map(chunk).collect(), scale }
    }

    /// Divides pairs into groups of consecutive pairs of one class, and builds the tables of these classes.
    fn row_groups(&self, pairs: &[PairGeometry]) -> Vec<RowGroup> {
        let is_average = self.rows.method() == PixelMethod::Average;
        let mut blocks: Vec<RowGroup> = Vec::new();
        for (k, pair) in pairs.iter().enumerate() {
            let class = self.rows.class_of(pair.baseline_wavelengths()).filter(|_| is_average);
            match blocks.last_mut() {
                Some(last) if last.class == class && last.count < ROWS => last.count += 1,
                _ => blocks.push(RowGroup { first: k, count: 1, class }),
            }
        }
        for class in blocks.iter().filter_map(|block| block.class) {
            self.rows.class(class);
        }
        blocks
    }

    /// Sums over groups of rows, by column, in RING order; `add` adds each group.
    fn sums(
        &self,
        pairs: &[PairGeometry],
        columns: usize,
        add: &(dyn Fn(&RowGroup, &ChunkedRows, &mut [ChunkSums]) + Sync),
    ) -> Vec<Vec<f64>> {
        let groups = self.row_groups(pairs);
        let part = |blocks: &[RowGroup]| -> Vec<ChunkSums> {
            let mut sums = vec![vec![[0.0; CHUNK]; self.chunks.len()]; columns];
            let mut chunked_rows = ChunkedRows::new(self.chunks.len());
            for group in blocks {
                self.compute_rows(pairs, group, &mut chunked_rows);
                add(group, &chunked_rows, &mut sums);
            }
            sums
        };
        let parts: Vec<_> = groups.par_chunks(groups.len().div_ceil(PARTS).max(1)).map(part).collect();
        (0..columns)
            .map(|column| {
                let mut sums = vec![0.0; self.pixels()];
                for part in &parts {
                    let values = part[column].as_flattened();
                    self.ring.iter().zip(values).for_each(|(&pixel, value)| sums[pixel] += value);
                }
                sums
            })
            .collect()
    }

    fn compute_rows(&self, pairs: &[PairGeometry], group: &RowGroup, chunked_rows: &mut ChunkedRows) {
        let pairs = &pairs[group.first..][..group.count];
        let prepared: Vec<KernelGeometry> = pairs.iter().map(KernelGeometry::pair).collect();
        for (cap, views) in self.caps.iter().zip(&mut chunked_rows.views) {
            for (pair, view) in prepared.iter().zip(views) {
                *view = cap.view_of(pair);
            }
        }
        match (self.rows.method(), group.class) {
            (PixelMethod::Centre, _) => {
                let chunks = self.chunks.iter().zip(&chunked_rows.views).zip(&mut chunked_rows.pieces);
                chunks.for_each(|((n, views), pieces)| fringes(&prepared, views, n, pieces));
            }
            (PixelMethod::Average, Some(class)) => {
                averages(&prepared, self.rows.class(class), chunked_rows);
            }
            // Row by row: for verification, and for baselines that no map uses.
            _ => self.fill(pairs, chunked_rows),
        }
    }

    fn fill(&self, pairs: &[PairGeometry], chunked_rows: &mut ChunkedRows) {
        let mut row = [vec![0.0_f32; self.pixels()], vec![0.0_f32; self.pixels()]];
        for (k, pair) in pairs.iter().enumerate() {
            let [re, im] = &mut row;
            self.rows.fill(pair, 1.0, re, im);
            for (part, values) in row.iter().enumerate() {
                for (pieces, values) in chunked_rows.pieces.iter_mut().zip(values.chunks(CHUNK)) {
                    pieces[k][part] = [0.0; CHUNK];
                    pieces[k][part][..values.len()].copy_from_slice(values);
                }
            }
        }
    }
}

impl Cap {
    fn view_of(&self, pair: &KernelGeometry) -> ChunkView {
        let [x, y, z] = self.centre;
        let (depth_i, depth_j) = pair.depths::<false>(x, y, z);
        match depth_i.min(depth_j) {
            depth if depth < -self.radius => ChunkView::Hidden,
            depth if depth > self.radius => ChunkView::Open,
            _ => ChunkView::Cut,
        }
    }
}

impl ChunkedRows {
    fn new(chunks: usize) -> Self {
        Self {
            pieces: vec![[[[0.0; CHUNK]; 2]; ROWS]; chunks],
            views: vec![[ChunkView::Hidden; ROWS]; chunks],
        }
    }

    fn forward(&self, count: usize, x: &[ScaledMap]) -> Vec<[[f64; 2]; ROWS]> {
        let column = |x: &ScaledMap| {
            let mut lanes = [[[0.0_f64; LANES]; 2]; ROWS];
            for ((pieces, views), x) in self.pieces.iter().zip(&self.views).zip(&x.chunks) {
                multiply((&pieces[..count], views), x, &mut lanes);
            }
            lanes.map(|parts| parts.map(|lanes| lanes.iter().sum()))
        };
        x.iter().map(column).collect()
    }

    fn add_to(&self, count: usize, factors: &Factors, sums: &mut [ChunkSums]) {
        for (k, (pieces, views)) in self.pieces.iter().zip(&self.views).enumerate() {
            for (sums, factors) in sums.iter_mut().zip(factors) {
                accumulate((&pieces[..count], views), factors, &mut sums[k]);
            }
        }
    }
}

/// Computes A S_i S_j exp(-2 pi i u . n) at the pixel centres of a chunk, for each pair that sees some of it.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn fringes(
    pairs: &[KernelGeometry],
    views: &[ChunkView; ROWS],
    n: &[[f64; CHUNK]; 3],
    out: &mut [Piece; ROWS],
) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let [x, y, z] = n;
    for ((pair, view), [re, im]) in pairs.iter().zip(views).zip(out) {
        if *view == ChunkView::Hidden {
            continue;
        }
        let mut turns = [0.0_f32; CHUNK];
        for k in 0..CHUNK {
            turns[k] = fraction_of_turn(dot64::<FMA>(pair.u, x[k], y[k], z[k]));
        }
        for k in 0..CHUNK {
            let (cos, sin) = cos_sin_turns::<FMA>(turns[k]);
            (re[k], im[k]) = (cos, -sin);
        }
        if *view == ChunkView::Cut || pair.dipole.is_some() {
            let mut seen = [1.0_f32; CHUNK];
            for k in 0..CHUNK {
                seen[k] = if pair.sees::<FMA>(x[k], y[k], z[k]) { 1.0 } else { 0.0 };
            }
            pair.apply_antenna::<FMA, _>([x, y, z], &mut seen);
            for k in 0..CHUNK {
                (re[k], im[k]) = (re[k] * seen[k], im[k] * seen[k]);
            }
        }
    }
}

/// Averages over the pixels of all chunks, for each pair that sees some of them.
fn averages(pairs: &[KernelGeometry], class: &BlockClass, chunked_rows: &mut ChunkedRows) {
    let mut means = Means::default();
    let per_pixel = class.per_side * class.per_side;
    let pixels = GROUP / per_pixel;
    let chunks = class.whole.groups.chunks(per_pixel).zip(&chunked_rows.views).zip(&mut chunked_rows.pieces);
    for ((groups, views), pieces) in chunks {
        for ((pair, view), [re, im]) in pairs.iter().zip(views).zip(pieces) {
            if *view == ChunkView::Hidden {
                continue;
            }
            let parts = re.chunks_exact_mut(pixels).zip(im.chunks_exact_mut(pixels));
            for (group, (re, im)) in groups.iter().zip(parts) {
                means_of_group(pair, class.whole.children, group, &mut means);
                average(&means.re, per_pixel, re);
                average(&means.im, per_pixel, im);
            }
        }
    }
    for set in &class.finer {
        let share = (set.children * set.children) as f32 / (super::CHILDREN * super::CHILDREN) as f32;
        for (group, places) in set.groups.iter().zip(set.pixels.chunks(GROUP)) {
            for (row, pair) in pairs.iter().enumerate() {
                means_of_group(pair, set.children, group, &mut means);
                for (lane, &place) in places.iter().enumerate() {
                    let (chunk, k) = (place as usize / CHUNK, place as usize % CHUNK);
                    let [re, im] = &mut chunked_rows.pieces[chunk][row];
                    re[k] += share * means.re[lane];
                    im[k] += share * means.im[lane];
                }
            }
        }
    }
}

/// Adds a chunk of rows times a chunk of a vector to lanes of partial sums: in f32 within a chunk, in f64 between chunks.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn multiply(
    (pieces, views): (&[Piece], &[ChunkView; ROWS]),
    x: &[f32; CHUNK],
    lanes: &mut [[[f64; LANES]; 2]; ROWS],
) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    for ((piece, view), lanes) in pieces.iter().zip(views).zip(lanes) {
        if *view == ChunkView::Hidden {
            continue;
        }
        for (values, lanes) in piece.iter().zip(lanes) {
            let mut sums = [0.0_f32; LANES];
            for (values, x) in values.as_chunks::<LANES>().0.iter().zip(x.as_chunks::<LANES>().0) {
                for k in 0..LANES {
                    sums[k] = fused::<FMA>(values[k], x[k], sums[k]);
                }
            }
            for k in 0..LANES {
                lanes[k] += f64::from(sums[k]);
            }
        }
    }
}

/// Adds a chunk of rows times factors to sums: in f32 within a group of rows, in f64 between groups.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn accumulate(
    (pieces, views): (&[Piece], &[ChunkView; ROWS]),
    factors: &[[f32; 2]; ROWS],
    sums: &mut [f64; CHUNK],
) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let mut block = [0.0_f32; CHUNK];
    for (([re, im], view), [a, b]) in pieces.iter().zip(views).zip(factors) {
        if *view == ChunkView::Hidden {
            continue;
        }
        for k in 0..CHUNK {
            block[k] = fused::<FMA>(re[k], *a, fused::<FMA>(im[k], *b, block[k]));
        }
    }
    for k in 0..CHUNK {
        sums[k] += f64::from(block[k]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::AntennaResponse;
    use crate::response::pixel::exact;
    use crate::sky::healpix::pixel_count;
    use crate::units::vector::{cross, unit};

    const MOON_M: f64 = 1.7371e6;

    /// Pairs all around the Moon, with baselines up to `longest` wavelengths.
    fn pairs(count: usize, longest: f64, response: AntennaResponse) -> Vec<PairGeometry> {
        let frequency_hz = 1e7;
        (0..count)
            .map(|k| {
                let k = k as f64;
                let r_hat = unit([(1.3 * k).sin(), (0.7 * k + 1.0).cos(), (2.1 * k + 0.4).sin()]);
                let along = unit(cross(r_hat, [0.3, (0.9 * k).cos(), 0.6]));
                let apart_m = 29.98 * longest * (0.05 + 0.95 * (0.37 * k).fract());
                let r_i_m = scale(2.0371e6, r_hat);
                let r_j_m = add(r_i_m, scale(apart_m, along));
                PairGeometry { r_i_m, r_j_m, frequency_hz, moon_radius_m: MOON_M, response }
            })
            .collect()
    }

    /// Reference rows: in f64, or averages in closed form row by row, whose accuracy the tests of [`RowMaker`] check.
    fn rows(pairs: &[PairGeometry], nside: usize, method: PixelMethod) -> Vec<Vec<Complex64>> {
        let n = pixel_directions(nside);
        let area_sr = pixel_area_sr(nside);
        let maker = RowMaker::new(nside, method).unwrap();
        let row = |pair| match method {
            PixelMethod::Centre => exact::centre_row(pair, &n),
            PixelMethod::Average => {
                let [mut re, mut im] = [0, 1].map(|_| vec![0.0_f64; maker.pixels()]);
                maker.fill(pair, 1.0, &mut re, &mut im);
                re.into_iter().zip(im).map(|(re, im)| Complex64::new(re, im)).collect()
            }
            _ => exact::average_row(pair, nside, super::super::CHILDREN),
        };
        pairs.iter().map(|pair| row(pair).into_iter().map(|value| value * area_sr).collect()).collect()
    }

    fn difference(found: &[f64], expected: &[f64]) -> f64 {
        let rms = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
        rms(&mut found.iter().zip(expected).map(|(a, b)| a - b)) / rms(&mut expected.iter().copied())
    }

    #[test]
    fn products_are_those_of_rows() {
        for (method, nside, longest) in [
            (PixelMethod::Centre, 4, 30.0),
            (PixelMethod::Centre, 1, 2.0),
            // All classes of blocks, and longer baselines.
            (PixelMethod::Average, 4, 1.9 / 0.256),
            (PixelMethod::Average, 8, 9.0 / 0.128),
            (PixelMethod::Average, 1, 2.0),
            (PixelMethod::AverageExact, 2, 4.0),
        ] {
            // Fringes are accurate to 1e-6, sums in f32 to some 1e-7 of their largest terms; a product contains rows twice.
            let tolerance = 3e-6;
            for response in [AntennaResponse::Isotropic, AntennaResponse::DipoleNormal] {
                let pairs = pairs(41, longest, response);
                let pixels = pixel_count(nside);
                let rows = rows(&pairs, nside, method);
                let weights: Vec<f64> = (0..pairs.len()).map(|k| 1e-9 * (1.0 + (k % 5) as f64)).collect();
                let x: [Vec<f64>; 2] = [0.7, 1.9]
                    .map(|f: f64| (0..pixels).map(|p| 3e4 * ((f * p as f64).sin() + 0.3)).collect());
                let products = RowProducts::new(nside, method).unwrap();
                assert_eq!(products.pixels(), pixels);
                let found = products.normal(&pairs, &weights, &[&x[0], &x[1]]);
                let what = format!("{method:?} {nside} {response:?}");
                for (x, found) in x.iter().zip(&found) {
                    let mut expected = vec![0.0; pixels];
                    let mut seen = Vec::new();
                    for (row, weight) in rows.iter().zip(&weights) {
                        let value: Complex64 = row.iter().zip(x).map(|(row, x)| row * x).sum();
                        for (sum, row) in expected.iter_mut().zip(row) {
                            *sum += weight * (row.re * value.re + row.im * value.im);
                        }
                        seen.extend([value.re, value.im]);
                    }
                    let error = difference(found, &expected);
                    assert!(error < tolerance, "{what}: {error:e}");
                    let forward: Vec<f64> =
                        products.forward(&pairs, x).iter().flat_map(|value| [value.re, value.im]).collect();
                    let error = difference(&forward, &seen);
                    assert!(error < tolerance, "{what}, forward: {error:e}");
                }
                let values: Vec<Complex64> =
                    (0..pairs.len()).map(|k| Complex64::cis(0.8 * k as f64) * 1e-7).collect();
                let mut expected = vec![0.0; pixels];
                for (row, value) in rows.iter().zip(&values) {
                    for (sum, row) in expected.iter_mut().zip(row) {
                        *sum += row.re * value.re + row.im * value.im;
                    }
                }
                let error = difference(&products.adjoint(&pairs, &[&values])[0], &expected);
                assert!(error < tolerance, "{what}, adjoint: {error:e}");
                // Columns do not affect each other.
                assert!(products.normal(&pairs, &weights, &[&x[1]])[0] == found[1], "{what}");
            }
        }
    }

    #[test]
    fn bits_do_not_depend_on_threads() {
        let pairs = pairs(531, 20.0, AntennaResponse::Isotropic);
        let weights = vec![1.0; pairs.len()];
        for method in [PixelMethod::Centre, PixelMethod::Average] {
            let products = RowProducts::new(8, method).unwrap();
            let x: Vec<f64> = (0..products.pixels()).map(|p| (0.7 * p as f64).sin()).collect();
            let on = |threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| products.normal(&pairs, &weights, &[&x]))
            };
            assert!(on(1) == on(2) && on(2) == on(5), "{method:?}");
        }
    }

    #[test]
    fn nothing_makes_nothing() {
        let products = RowProducts::new(2, PixelMethod::Centre).unwrap();
        assert_eq!(products.normal(&[], &[], &[&[1.0; 48]]), [vec![0.0; 48]]);
        let one = pairs(1, 2.0, AntennaResponse::Isotropic);
        assert_eq!(products.normal(&one, &[1.0], &[&[0.0; 48]]), [vec![0.0; 48]]);
        assert_eq!(products.adjoint(&one, &[&[Complex64::ZERO]]), [vec![0.0; 48]]);
    }
}
