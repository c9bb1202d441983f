//! Interpolation through some of the states around a time.

use super::message::{OemSegment, TableMethod};
use crate::array::state::SatelliteState;
use crate::units::vector::{scale, sub};

/// Most values that a polynomial goes through: those of the greatest degree of kernels, 27, and of another state, with which it is compared.
const VALUES_MAX: usize = 30;

/// Newton's polynomial through some of a segment's states about a time, and its derivative.
pub(super) fn interpolated(
    segment: &OemSegment,
    method: TableMethod,
    points: usize,
    at_s: f64,
) -> SatelliteState {
    let repeats = if method == TableMethod::Hermite { 2 } else { 1 };
    let after = segment.time_s.partition_point(|t_s| *t_s <= at_s);
    let first = after.saturating_sub(points.div_ceil(2)).min(segment.time_s.len() - points);
    // Times count from the middle, so that differences keep their digits.
    let zero_s = segment.time_s[first];
    let count = points * repeats;
    let mut times = [0.0; VALUES_MAX];
    let mut divided = [[0.0; 3]; VALUES_MAX];
    for k in 0..count {
        times[k] = segment.time_s[first + k / repeats] - zero_s;
        divided[k] = segment.position_m[first + k / repeats];
    }
    for order in 1..count {
        for k in (order..count).rev() {
            let step = times[k] - times[k - order];
            divided[k] = if step == 0.0 {
                segment.velocity_m_s[first + k / repeats]
            } else {
                scale(1.0 / step, sub(divided[k], divided[k - 1]))
            };
        }
    }
    let tau = at_s - zero_s;
    let (mut position_m, mut velocity_m_s) = (divided[count - 1], [0.0; 3]);
    for k in (0..count - 1).rev() {
        for axis in 0..3 {
            velocity_m_s[axis] = velocity_m_s[axis] * (tau - times[k]) + position_m[axis];
            position_m[axis] = position_m[axis] * (tau - times[k]) + divided[k][axis];
        }
    }
    SatelliteState { position_m, velocity_m_s }
}
