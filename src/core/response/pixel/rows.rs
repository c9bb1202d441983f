//! Rows of B by the fast path, at pixel centres or averaged over blocks in closed form.

use std::sync::OnceLock;

use multiversion::multiversion;

use super::average::{Means, block_means};
use super::blocks::{BlockClass, BlockGroup, BlockSet, GROUP};
use super::exact::child_directions;
use super::kernel::{CHUNK, KernelGeometry, dot64};
use super::limb_blocks::limb_block_mean;
use super::order::PixelOrder;
use super::{CHILDREN, Directions, PairGeometry, PixelMethod, ResponseError, exact};
use crate::sky::healpix;
use crate::units::arithmetic::{cos_sin_turns, fraction_of_turn};
use crate::units::vector::{Vec3, norm};

/// Maximum nside of rows: blocks of nside 512 take some GB.
const NSIDE_MAX: usize = 512;

/// Classes of blocks: the longest baseline (wavelengths) times the pixel width, and the minimum number of blocks along a
/// pixel's side. Maps use baselines up to 2 in this unit.
const CLASSES: [(f64, usize); 5] = [(0.5, 1), (1.0, 1), (2.01, 1), (4.02, 2), (8.04, 4)];

/// Element type of a row.
pub trait RowValue: Copy + Send + Sync + 'static {
    /// Converts a value of the fast path.
    fn of_f32(value: f32) -> Self;
    /// Converts a value of the exact path.
    fn of_f64(value: f64) -> Self;
}

impl RowValue for f32 {
    #[inline(always)]
    fn of_f32(value: f32) -> Self {
        value
    }

    #[inline(always)]
    fn of_f64(value: f64) -> Self {
        value as f32
    }
}

impl RowValue for f64 {
    #[inline(always)]
    fn of_f32(value: f32) -> Self {
        f64::from(value)
    }

    #[inline(always)]
    fn of_f64(value: f64) -> Self {
        value
    }
}

/// Computes rows of B for one pixelisation and method.
///
/// [`PixelMethod::Average`] agrees with the mean over all children to 1e-3 rms. It builds the blocks of a class of
/// baselines on first use (0.1 s at nside 64). Baselines beyond 8 wavelengths a pixel are of no use in a map of that
/// pixelisation; they are averaged child by child, slowly.
#[derive(Debug)]
pub struct RowMaker {
    nside: usize,
    method: PixelMethod,
    pixel_width_rad: f64,
    order: PixelOrder,
    centres: Vec<Vec3>,
    directions: Directions,
    classes: [OnceLock<BlockClass>; CLASSES.len()],
}

impl RowMaker {
    /// Prepares rows for maps of `nside` in RING order.
    ///
    /// # Errors
    /// [`ResponseError::Nside`] unless `nside` is a power of two up to 512.
    pub fn new(nside: usize, method: PixelMethod) -> Result<Self, ResponseError> {
        Self::with_order(nside, method, PixelOrder::Ring)
    }

    /// Prepares rows with pixels in this order.
    pub(super) fn with_order(
        nside: usize,
        method: PixelMethod,
        order: PixelOrder,
    ) -> Result<Self, ResponseError> {
        if !healpix::is_valid_nside(nside) || nside > NSIDE_MAX {
            return Err(ResponseError::Nside(nside));
        }
        let ring = healpix::pixel_directions(nside);
        let centres: Vec<Vec3> = (0..ring.len()).map(|place| ring[order.ring(nside, place)]).collect();
        Ok(Self {
            nside,
            method,
            order,
            pixel_width_rad: healpix::pixel_area_sr(nside).sqrt(),
            directions: Directions::from(centres.as_slice()),
            centres,
            classes: Default::default(),
        })
    }

    /// Resolution of the maps.
    #[must_use]
    pub fn nside(&self) -> usize {
        self.nside
    }

    /// Method by which rows represent pixels.
    #[must_use]
    pub fn method(&self) -> PixelMethod {
        self.method
    }

    /// Number of pixels: the length of a row.
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.centres.len()
    }

    /// Pixel width theta_p = sqrt(4 pi / N_pix), rad.
    #[must_use]
    pub fn pixel_width_rad(&self) -> f64 {
        self.pixel_width_rad
    }

    /// Builds the tables that rows of this pair need. Call it before parallel tasks fill rows: tables are built in
    /// parallel too, and tasks that wait for them would block the workers.
    pub fn prepare(&self, pair: &PairGeometry) {
        if self.method == PixelMethod::Average {
            let pixels_long = norm(pair.baseline_wavelengths()) * self.pixel_width_rad;
            // With a margin, so that rounding cannot select a class that was not built.
            for reach in [pixels_long * (1.0 - 1e-12), pixels_long * (1.0 + 1e-12)] {
                if let Some(class) = CLASSES.iter().position(|&(longest, _)| reach <= longest) {
                    self.class(class);
                }
            }
        }
    }

    /// Index of the class of blocks for a baseline, in wavelengths; `None` beyond the longest.
    pub(super) fn class_of(&self, u: Vec3) -> Option<usize> {
        let pixels_long = norm(u) * self.pixel_width_rad;
        CLASSES.iter().position(|&(longest, _)| pixels_long <= longest)
    }

    /// Returns the blocks of a class, which are built on first use.
    pub(super) fn class(&self, class: usize) -> &BlockClass {
        self.classes[class].get_or_init(|| {
            let (longest, per_side) = CLASSES[class];
            BlockClass::new((self.nside, self.order), per_side, longest / self.pixel_width_rad)
        })
    }

    /// Writes the real and imaginary parts of the pair's row, times `factor` (pixel area and root of weight).
    ///
    /// Both slices should have [`Self::pixels`] elements; elements beyond the shorter slice are not changed.
    pub fn fill<R: RowValue>(&self, pair: &PairGeometry, factor: f64, re: &mut [R], im: &mut [R]) {
        let pixels = self.pixels().min(re.len()).min(im.len());
        let (re, im) = (&mut re[..pixels], &mut im[..pixels]);
        match self.method {
            PixelMethod::Centre => self.fill_centre(&KernelGeometry::pair(pair), factor, re, im),
            PixelMethod::AverageExact => {
                let row = exact::average_row(pair, self.nside, CHILDREN);
                for (place, (re, im)) in re.iter_mut().zip(im).enumerate() {
                    let value = row[self.order.ring(self.nside, place)];
                    (*re, *im) = (R::of_f64(value.re * factor), R::of_f64(value.im * factor));
                }
            }
            PixelMethod::Average => self.fill_average(pair, factor, re, im),
        }
    }

    fn fill_centre<R: RowValue>(&self, pair: &KernelGeometry, factor: f64, re: &mut [R], im: &mut [R]) {
        let mut values = [[0.0_f32; CHUNK]; 2];
        let mut n = [[0.0_f64; CHUNK]; 3];
        let chunks = re.chunks_mut(CHUNK).zip(im.chunks_mut(CHUNK));
        for (k, (re, im)) in chunks.enumerate() {
            let range = k * CHUNK..k * CHUNK + re.len();
            for (to, from) in n.iter_mut().zip([&self.directions.x, &self.directions.y, &self.directions.z]) {
                to[..re.len()].copy_from_slice(&from[range.clone()]);
            }
            fringes(pair, &n, &mut values);
            scale(&values[0], factor, re);
            scale(&values[1], factor, im);
        }
    }

    fn fill_average<R: RowValue>(&self, pair: &PairGeometry, factor: f64, re: &mut [R], im: &mut [R]) {
        let prepared = KernelGeometry::pair(pair);
        let Some(class) = self.class_of(prepared.u) else {
            return self.fill_children(&prepared, factor, re, im);
        };
        let blocks = self.class(class);
        // Sums start from zeros, but the output may hold any values.
        let mut row = vec![[0.0_f32; GROUP]; 2 * re.len().div_ceil(GROUP)];
        let (row_re, row_im) = row.as_flattened_mut().split_at_mut(re.len().next_multiple_of(GROUP));
        sum_whole(&prepared, blocks, row_re, row_im);
        for set in &blocks.finer {
            add_finer(&prepared, set, row_re, row_im);
        }
        scale(row_re, factor, re);
        scale(row_im, factor, im);
    }

    /// Averages child by child, in the precision of the fast path.
    fn fill_children<R: RowValue>(&self, pair: &KernelGeometry, factor: f64, re: &mut [R], im: &mut [R]) {
        const { assert!(CHUNK == CHILDREN * CHILDREN, "a chunk holds the children of one pixel") };
        let mut values = [[0.0_f32; CHUNK]; 2];
        let mut n = [[0.0_f64; CHUNK]; 3];
        for (place, (re, im)) in re.iter_mut().zip(im).enumerate() {
            let pixel = self.order.ring(self.nside, place);
            for (k, child) in child_directions(self.nside, CHILDREN, pixel).enumerate() {
                for axis in 0..3 {
                    n[axis][k] = child[axis];
                }
            }
            fringes(pair, &n, &mut values);
            let mean = |values: &[f32; CHUNK]| {
                values.iter().map(|&value| f64::from(value)).sum::<f64>() / CHUNK as f64
            };
            *re = R::of_f64(mean(&values[0]) * factor);
            *im = R::of_f64(mean(&values[1]) * factor);
        }
    }
}

/// Computes the means over a group of blocks, including those that the limb crosses.
pub(super) fn means_of_group(pair: &KernelGeometry, children: usize, group: &BlockGroup, means: &mut Means) {
    if block_means(pair, children, group, means) {
        for lane in 0..GROUP {
            if means.cut[lane] != 0.0 {
                (means.re[lane], means.im[lane]) = limb_block_mean(pair, children, group, lane);
            }
        }
    }
}

fn sum_whole(pair: &KernelGeometry, class: &BlockClass, re: &mut [f32], im: &mut [f32]) {
    let mut means = Means::default();
    let per_pixel = class.per_side * class.per_side;
    let pixels = GROUP / per_pixel;
    let outputs = re.chunks_exact_mut(pixels).zip(im.chunks_exact_mut(pixels));
    for (group, (re, im)) in class.whole.groups.iter().zip(outputs) {
        means_of_group(pair, class.whole.children, group, &mut means);
        average(&means.re, per_pixel, re);
        average(&means.im, per_pixel, im);
    }
}

/// Averages `per_pixel` consecutive blocks for each pixel.
pub(super) fn average(blocks: &[f32; GROUP], per_pixel: usize, pixels: &mut [f32]) {
    if per_pixel == 1 {
        return pixels.copy_from_slice(blocks);
    }
    let fraction = 1.0 / per_pixel as f32;
    for (pixel, blocks) in pixels.iter_mut().zip(blocks.chunks_exact(per_pixel)) {
        *pixel = fraction * blocks.iter().sum::<f32>();
    }
}

fn add_finer(pair: &KernelGeometry, set: &BlockSet, re: &mut [f32], im: &mut [f32]) {
    let mut means = Means::default();
    let fraction = (set.children * set.children) as f32 / (CHILDREN * CHILDREN) as f32;
    for (group, pixels) in set.groups.iter().zip(set.pixels.chunks(GROUP)) {
        means_of_group(pair, set.children, group, &mut means);
        for (lane, &pixel) in pixels.iter().enumerate() {
            re[pixel as usize] += fraction * means.re[lane];
            im[pixel as usize] += fraction * means.im[lane];
        }
    }
}

fn scale<R: RowValue>(values: &[f32], factor: f64, out: &mut [R]) {
    let factor = factor as f32;
    for (out, &value) in out.iter_mut().zip(values) {
        *out = R::of_f32(value * factor);
    }
}

/// Computes the real and imaginary parts of A S_i S_j exp(-2 pi i u . n), to 1e-6.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn fringes(pair: &KernelGeometry, n: &[[f64; CHUNK]; 3], out: &mut [[f32; CHUNK]; 2]) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let [x, y, z] = n;
    let mut turns = [0.0_f32; CHUNK];
    let mut seen = [0.0_f32; CHUNK];
    for k in 0..CHUNK {
        turns[k] = fraction_of_turn(dot64::<FMA>(pair.u, x[k], y[k], z[k]));
        let (depth_i, depth_j) = pair.depths::<FMA>(x[k], y[k], z[k]);
        seen[k] = if depth_i.min(depth_j) >= 0.0 { 1.0 } else { 0.0 };
    }
    pair.apply_antenna::<FMA, _>([x, y, z], &mut seen);
    let [re, im] = out;
    for k in 0..CHUNK {
        let (cos, sin) = cos_sin_turns::<FMA>(turns[k]);
        re[k] = seen[k] * cos;
        im[k] = -seen[k] * sin;
    }
}
