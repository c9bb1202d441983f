//! Classes of nodes that share quadrature points, by limb and by baseline length.

use std::f64::consts::{FRAC_PI_2, TAU};

use super::view::PairView;
use crate::numerics::quadrature::GaussLegendre;

/// Width of a class of limbs, in units of the wavelength of a harmonic over 2 pi: the zone between the limbs of a class and of a pair
/// takes that many more terms of a series.
const CLASS_WIDTH: f64 = 1.5;

/// Memory of the tables of all classes, bytes; classes are wider where they would exceed it.
const CLASSES_BYTES: f64 = 8e8;

/// Maximum number of classes of limbs.
const CLASSES_MAX: f64 = 64.0;

/// Nodes that share quadrature points.
#[derive(Clone, Copy, Debug)]
pub(super) struct NodeClass {
    /// Angle between nadir and limb in the middle of the class, rad.
    pub(super) limb_rad: f64,
    /// Maximum distance of a pair's limb from the middle, rad.
    pub(super) half_width_rad: f64,
    /// Longest baseline, wavelengths.
    pub(super) u_max: f64,
}

/// Number of quadrature rings for a cap of this radius.
pub(super) fn rings_for(l_max: usize, limb_rad: f64, u_max: f64) -> usize {
    GaussLegendre::points_for(0.5 * limb_rad * (l_max as f64 + TAU * u_max))
}

/// Longest baselines of classes as fractions of the longest of all: shorter ones need fewer points.
const LENGTH_FRACTIONS: [f64; 5] = [1.0, 0.75, 0.5, 0.3, 0.15];

/// Memory of the tables of one limb, bytes: Legendre functions at the quadrature points, of which some three quarters are not
/// negligible.
fn limb_bytes(l_max: usize, u_max: f64, cap_rad: f64) -> f64 {
    let rings = |length: &f64| rings_for(l_max, cap_rad, u_max * length) as f64;
    let rings: f64 = LENGTH_FRACTIONS.iter().map(rings).sum();
    4.0 * 0.75 * rings * 0.5 * ((l_max + 2) as f64).powi(2)
}

/// Maximum memory of the tables of limbs in a range of angles, bytes: at most [`CLASSES_BYTES`], or two limbs if that is more.
pub(super) fn tables_bytes(l_max: usize, u_max: f64, limb_range_rad: f64) -> f64 {
    let limb = limb_bytes(l_max, u_max, FRAC_PI_2);
    let classes = (limb_range_rad * (l_max + 1) as f64 / CLASS_WIDTH).ceil().clamp(1.0, CLASSES_MAX);
    (classes * limb).min(CLASSES_BYTES.max(2.0 * limb))
}

/// Classes by limb and baseline length.
pub(super) struct Classes {
    first_rad: f64,
    step_rad: f64,
    count: usize,
    half_width_rad: f64,
    u_max: f64,
}

impl Classes {
    /// Forms classes for these views, with baselines up to `u_max` wavelengths.
    pub(super) fn new(l_max: usize, views: &[PairView], u_max: f64) -> Self {
        let caps = views.iter().map(PairView::cap_rad);
        let (low, high) = caps.fold((f64::INFINITY, 0.0_f64), |(a, b), cap| (a.min(cap), b.max(cap)));
        let range_rad = (high - low).max(0.0);
        let classes_max = (CLASSES_BYTES / limb_bytes(l_max, u_max, high)).floor().clamp(1.0, CLASSES_MAX);
        let step_rad = (range_rad / classes_max).max(CLASS_WIDTH / (l_max + 1) as f64);
        let count = (range_rad / step_rad).ceil().max(1.0) as usize;
        let spread_rad = views.iter().map(PairView::limb_spread_rad).fold(0.0, f64::max);
        Self {
            first_rad: low + 0.5 * (range_rad - step_rad * (count - 1) as f64),
            step_rad,
            count,
            // Nodes lie between visibilities.
            half_width_rad: 0.5 * step_rad + 1.05 * spread_rad,
            u_max,
        }
    }

    /// Returns the index of a pair's class.
    pub(super) fn class_of(&self, cap_rad: f64, u: f64) -> u32 {
        let limb = ((cap_rad - self.first_rad) / self.step_rad).round();
        let limb = limb.clamp(0.0, (self.count - 1) as f64) as usize;
        let length = LENGTH_FRACTIONS.iter().rposition(|length| u <= length * self.u_max).unwrap_or(0);
        (length * self.count + limb) as u32
    }

    /// Lists the classes in the order of their indices.
    pub(super) fn node_classes(&self) -> Vec<NodeClass> {
        let class = |length: f64| {
            (0..self.count).map(move |k| NodeClass {
                limb_rad: self.first_rad + self.step_rad * k as f64,
                half_width_rad: self.half_width_rad,
                u_max: length * self.u_max,
            })
        };
        LENGTH_FRACTIONS.into_iter().flat_map(class).collect()
    }
}
