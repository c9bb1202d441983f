//! Cramer-Rao bounds of gains, clocks and positions from the data of a pass.
//!
//! A bound is a diagonal element of the inverse of the Fisher information without errors, with the configured priors.
//! Values of visibilities do not enter, so that bounds can be computed before a pass is observed.

use serde::Serialize;

use super::config::SolverConfig;
use super::layout::ParameterLayout;
use super::model::{KnownSignal, Offsets};
use super::positions::modelled;
use super::robust_fit::sums_of;
use crate::calibration::CalibrationError;
use crate::frames::{Instrument, PlacedVisibilities};
use crate::numerics::DenseFactor;
use crate::sky::SkyMap;
use crate::units::vector::Vec3;

/// Smallest possible standard deviations of the gain of a daughter in a channel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct GainBound {
    /// Centre of the channel, Hz.
    pub frequency_hz: f64,
    /// Standard deviation of the natural logarithm of the amplitude.
    pub amplitude_sigma: f64,
    /// Standard deviation of the phase relative to the reference daughter, clock included, deg.
    pub phase_sigma_deg: f64,
    /// Number of visibilities of the daughter.
    pub visibilities: u64,
}

/// Smallest possible standard deviations of a daughter's gains, clock and position after a pass.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DaughterBound {
    /// Number of the daughter, from 1.
    pub daughter: u32,
    /// Standard deviation of the clock, ns; 0 where it is not solved for.
    pub clock_sigma_ns: f64,
    /// Standard deviations of the position along the track, across it and away from the Moon, m; 0 where it is not
    /// solved for.
    pub position_sigma_m: [f64; 3],
    /// Bounds of gains, by channel.
    pub gains: Vec<GainBound>,
}

/// Computes the bounds of all daughters for visibilities of one pass, whose values do not matter, with one map (K) of
/// the sky per channel and the normal of each daughter's orbit.
///
/// # Errors
/// The solver does not accept the maps.
pub fn bounds(
    config: &SolverConfig,
    instrument: &Instrument,
    maps: &[SkyMap],
    placed: &[PlacedVisibilities],
    normal_hat: Vec<Vec3>,
) -> Result<Vec<DaughterBound>, CalibrationError> {
    config.can_model(maps)?;
    let mut signal = KnownSignal::new(config, instrument, maps)?;
    let satellites = normal_hat.len();
    let offsets = Offsets { offset_m: vec![[0.0; 3]; satellites], normal_hat };
    let placed: Vec<(&PlacedVisibilities, bool)> = placed.iter().map(|placed| (placed, false)).collect();
    let blocks = modelled(&placed, &mut signal, &offsets)?;
    let layout = ParameterLayout::new(config, satellites, &instrument.frequencies_hz());
    let sums = sums_of(&blocks, [f64::NEG_INFINITY, f64::INFINITY], &layout, &vec![1.0; blocks.len()]);
    let order = layout.order();
    let (information, _) = layout.normal(&layout.ideal(), &sums, None);
    // The priors keep the matrix positive definite.
    let covariance = DenseFactor::new(&information, order).map_or_else(Vec::new, |factor| factor.inverse());
    let covariance_of = |a: Option<usize>, b: Option<usize>| match (a, b) {
        (Some(a), Some(b)) => covariance.get(a * order + b).copied().unwrap_or(f64::NAN),
        _ => 0.0,
    };
    let gain = |c: usize, n: usize| {
        let (amplitude, phase, clock) = (layout.amplitude(c, n), layout.phase(c, n), layout.clock(n));
        let rad_per_ns = layout.rad_per_ns(c);
        let variance = covariance_of(phase, phase)
            + 2.0 * rad_per_ns * covariance_of(phase, clock)
            + rad_per_ns * rad_per_ns * covariance_of(clock, clock);
        let of_daughter = blocks.iter().filter(|block| block.channel == c);
        let of_daughter =
            of_daughter.filter(|block| [block.pair.i, block.pair.j].map(usize::from).contains(&n));
        GainBound {
            frequency_hz: layout.frequencies_hz[c],
            amplitude_sigma: covariance_of(amplitude, amplitude).sqrt(),
            phase_sigma_deg: variance.max(0.0).sqrt().to_degrees(),
            visibilities: of_daughter.map(|block| block.time_s.len() as u64).sum(),
        }
    };
    let daughter = |n: usize| DaughterBound {
        daughter: n as u32 + 1,
        clock_sigma_ns: covariance_of(layout.clock(n), layout.clock(n)).sqrt(),
        position_sigma_m: [0, 1, 2].map(|axis| {
            let index = layout.position(n, axis);
            covariance_of(index, index).sqrt()
        }),
        gains: (0..layout.channels()).map(|c| gain(c, n)).collect(),
    };
    Ok((0..satellites).map(daughter).collect())
}
