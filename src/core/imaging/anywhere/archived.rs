//! A stored visibility, and the setup of an archive of visibilities.

use num_complex::Complex64;

use crate::frames::{AntennaResponse, PlacedVisibilities};
use crate::imaging::exact::checkpoint::{RESPONSES, number_of, refused};
use crate::imaging::{AccumulationError, Refusal};
use crate::response::general::{TimedPair, check_positions};
use crate::response::harmonic::GeometryLimits;
use crate::units::ChannelId;
use crate::units::vector::Vec3;

/// Setup of an archive of visibilities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RefinedSetup {
    /// Channel.
    pub channel: ChannelId,
    /// Maximum degree of the map.
    pub l_max: usize,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Longest baseline that is accepted, m.
    pub baseline_m_max: f64,
    /// Radius of the body that hides the sky, m.
    pub moon_radius_m: f64,
    /// Antenna response.
    pub response: AntennaResponse,
    /// Seed of the noise-only companion.
    pub companion_seed: u64,
    /// Maximum weight that is accepted, (K sr)^-2.
    pub weight_max: f64,
    /// Departures from the circle within which the circle's sums need no refinement.
    pub limits: GeometryLimits,
    /// Maximum number of visibilities.
    pub visibilities_max: u64,
}

/// The setup of an archive in a checkpoint, without the maximum number of visibilities, which may differ between sessions.
#[derive(bincode::Encode, bincode::Decode)]
pub(in crate::imaging) struct VisibilitiesHead {
    channel: u16,
    l_max: u32,
    frequency_hz: f64,
    baseline_m_max: f64,
    moon_radius_m: f64,
    response: u8,
    companion_seed: u64,
    weight_max: f64,
    limits: [f64; 4],
}

impl VisibilitiesHead {
    pub(in crate::imaging) fn new(setup: &RefinedSetup) -> Self {
        let limits = setup.limits;
        Self {
            channel: setup.channel.0,
            l_max: setup.l_max as u32,
            frequency_hz: setup.frequency_hz,
            baseline_m_max: setup.baseline_m_max,
            moon_radius_m: setup.moon_radius_m,
            response: number_of(&RESPONSES, &setup.response),
            companion_seed: setup.companion_seed,
            weight_max: setup.weight_max,
            limits: [
                limits.out_of_track_deg_max,
                limits.inclination_deg_max,
                limits.altitude_m_max,
                limits.radial_deg_max,
            ],
        }
    }

    pub(in crate::imaging) fn setup(&self, visibilities_max: u64) -> Result<RefinedSetup, AccumulationError> {
        let response = RESPONSES.get(usize::from(self.response)).copied();
        let [out_of_track_deg_max, inclination_deg_max, altitude_m_max, radial_deg_max] = self.limits;
        Ok(RefinedSetup {
            channel: ChannelId(self.channel),
            l_max: self.l_max as usize,
            frequency_hz: self.frequency_hz,
            baseline_m_max: self.baseline_m_max,
            moon_radius_m: self.moon_radius_m,
            response: response
                .ok_or_else(|| refused(format!("response {}", self.response), "a known response"))?,
            companion_seed: self.companion_seed,
            weight_max: self.weight_max,
            limits: GeometryLimits {
                out_of_track_deg_max,
                inclination_deg_max,
                altitude_m_max,
                radial_deg_max,
            },
            visibilities_max,
        })
    }
}

/// A stored visibility.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::imaging) struct ArchivedVisibility {
    pub(in crate::imaging) at: TimedPair,
    pub(in crate::imaging) band: u16,
    pub(in crate::imaging) value_k_sr: Complex64,
    pub(in crate::imaging) weight: f64,
    /// Integration time, s; 0 for an instant.
    pub(in crate::imaging) duration_s: f32,
}

/// The key by which visibilities are sorted.
type SortKey = (u8, u8, f64, u16, f64, f64, f64, Vec3, Vec3, f32);

impl ArchivedVisibility {
    /// Visibility `k` of a block; refused if it has no row of B.
    pub(in crate::imaging) fn new(
        placed: &PlacedVisibilities,
        k: usize,
        moon_radius_m: f64,
    ) -> Result<Self, Refusal> {
        let (r_i_m, r_j_m) = (placed.r_i_m[k], placed.r_j_m[k]);
        check_positions(r_i_m, r_j_m, moon_radius_m)?;
        let at = TimedPair { pair: placed.pair, time_s: placed.time_s[k], r_i_m, r_j_m };
        let (value_k_sr, weight) = (placed.value_k_sr[k], placed.weight[k]);
        // An invalid integration time counts as an instant.
        let duration_s = placed.duration_s.get(k).copied().filter(|duration_s| *duration_s > 0.0);
        Ok(Self { at, band: placed.band, value_k_sr, weight, duration_s: duration_s.unwrap_or(0.0) })
    }

    /// The sort key: all of the visibility's content, and nothing of how it arrived.
    pub(in crate::imaging) fn sort_key(&self) -> SortKey {
        let Self { at, band, value_k_sr: value, weight, duration_s } = self;
        let TimedPair { pair, time_s, r_i_m, r_j_m } = *at;
        (pair.i, pair.j, time_s, *band, value.re, value.im, *weight, r_i_m, r_j_m, *duration_s)
    }
}
