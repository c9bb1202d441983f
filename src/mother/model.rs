//! What the array would measure without noise.

use num_complex::Complex64;

use crate::units::ChannelId;
use crate::units::vector::Vec3;

/// Where the two daughters of a pair are.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PairPosition {
    /// Position of daughter i, m.
    pub r_i_m: Vec3,
    /// Position of daughter j, m.
    pub r_j_m: Vec3,
}

/// A visibility without noise.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Prediction {
    /// V_ij, K sr.
    pub visibility_k_sr: Complex64,
    /// `Int T S_i S_j A dn`, K sr: the sky's part of the system temperature.
    pub zero_spacing_k_sr: f64,
}

/// A sky seen by the array: visibilities of any pair, channel by channel.
///
/// Equal arguments give equal results, whatever the threads.
pub trait VisibilityModel: Send + Sync {
    /// Predicts one visibility for each position; `out` has the length of `positions`.
    fn predict(&self, channel: ChannelId, positions: &[PairPosition], out: &mut [Prediction]);
}
