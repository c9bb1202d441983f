//! Cramer-Rao bounds of the gains in one pass of a planned array.

use std::fmt;

use num_complex::Complex64;
use serde::Serialize;

use crate::calibration::solver::{CalibrationMode, DaughterBound, bounds};
use crate::frames::{ObservingWindow, PlacedVisibilities};
use crate::mother::Schedule;
use crate::pipeline::config::{PipelineError, Plan};
use crate::response::model::{DaughterPosition, DirectSum, ModelError, VisibilityModel};
use crate::sky::SkyMap;
use crate::units::{ChannelId, InvalidValue, Pair, TICKS_PER_SECOND, all_pairs};

/// Cramer-Rao bounds of one pass.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BoundSummary {
    /// Number of the observing window, from 0.
    pub pass: u64,
    /// Start and end of the window, s since the epoch.
    pub span_s: [f64; 2],
    /// Bounds by daughter.
    pub daughters: Vec<DaughterBound>,
}

impl fmt::Display for BoundSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [from_s, until_s] = self.span_s;
        write!(
            f,
            "Pass {}, {:.1} min: least standard deviations, with the priors of [calibrate]\n\
             daughter    MHz  visibilities  ln amplitude  phase, deg   clock, ns   along, m  across, m  radial, m",
            self.pass,
            (until_s - from_s) / 60.0
        )?;
        for daughter in &self.daughters {
            let [along, across, radial] = daughter.position_sigma_m;
            for gain in &daughter.gains {
                write!(
                    f,
                    "\n{:>8} {:>6.3} {:>13} {:>13.5} {:>11.4} {:>11.4} {along:>10.4} {across:>10.4} {radial:>10.4}",
                    daughter.daughter,
                    gain.frequency_hz / 1e6,
                    gain.visibilities,
                    gain.amplitude_sigma,
                    gain.phase_sigma_deg,
                    daughter.clock_sigma_ns,
                )?;
            }
        }
        Ok(())
    }
}

/// Computes the bounds of observing window `pass` with maps (K) of the sky, one per channel. The noise follows from the power
/// of the maps.
///
/// # Errors
/// A pass that does not exist; maps that do not fit the channels; a known signal other than the sky.
pub fn bound(plan: &Plan, maps: &[SkyMap], pass: usize) -> Result<BoundSummary, PipelineError> {
    let solver = &plan.config.calibrate;
    let invalid = |key: &str, value: String, expected: String| InvalidValue {
        key: key.to_owned(),
        value,
        expected: expected.into(),
    };
    if solver.mode != CalibrationMode::Sky {
        let found = format!("{:?}", solver.mode).to_lowercase();
        let expected = "\"sky\": bounds are of what the sky tells; --set calibrate.mode=sky".to_owned();
        return Err(invalid("calibrate.mode", found, expected).into());
    }
    if maps.is_empty() {
        let expected = "a HEALPix map of the sky for each channel, here or in calibrate.model_files";
        return Err(invalid("--model", "(none)".to_owned(), expected.to_owned()).into());
    }
    solver.check_instrument(&plan.instrument, maps.len(), "--model")?;
    let Some(&window) = plan.windows.get(pass) else {
        let expected = format!("0 to {}, the passes of the mission", plan.windows.len().saturating_sub(1));
        return Err(invalid("--pass", pass.to_string(), expected).into());
    };
    let pairs = all_pairs(plan.array.satellites());
    let mut placed = Vec::new();
    for (channel, map) in maps.iter().enumerate() {
        let mut sky = DirectSum::new(
            map,
            plan.instrument.channels[channel].frequency_hz,
            plan.array.moon_radius_m(),
            plan.instrument.response,
        );
        for pair in &pairs {
            let width_hz = plan.instrument.channels[channel].width_hz;
            // Standard deviation of the real or imaginary part.
            let sigma =
                |[p_i, p_j]: [f64; 2], duration_s: f64| (p_i * p_j / (2.0 * width_hz * duration_s)).sqrt();
            let schedule = &plan.schedules[channel];
            let block = observation(plan, &mut sky, (channel, *pair), (schedule, window), &sigma)?;
            if !block.is_empty() {
                placed.push(block);
            }
        }
    }
    let span_s = [window.start.seconds(), window.end.seconds()];
    let middle_s = 0.5 * (span_s[0] + span_s[1]);
    let normals = (0..plan.array.satellites()).map(|n| plan.array.normal_hat(n, middle_s)).collect();
    let daughters = bounds(solver, &plan.instrument, maps, &placed, normals)?;
    Ok(BoundSummary { pass: pass as u64, span_s, daughters })
}

/// Times, positions and weights of a pair's visibilities in a window; the values are zero. `sigma_k_sr` gives their noise from the powers
/// of both daughters, K sr, and the duration, s.
pub(super) fn observation(
    plan: &Plan,
    sky: &mut DirectSum,
    (channel, pair): (usize, Pair),
    (schedule, window): (&Schedule, ObservingWindow),
    sigma_k_sr: &dyn Fn([f64; 2], f64) -> f64,
) -> Result<PlacedVisibilities, ModelError> {
    let integrations = schedule.integrations(&plan.array, window, pair);
    let mut times = Vec::with_capacity(integrations.len());
    let mut durations_s = Vec::with_capacity(integrations.len());
    let mut daughters = Vec::with_capacity(2 * integrations.len());
    for integration in &integrations {
        let middle = i64::from(integration.offset_ticks) + i64::from(integration.duration_ticks / 2);
        let t_s = window.start.plus_ticks(middle).seconds();
        times.push(t_s);
        durations_s.push(f64::from(integration.duration_ticks) / TICKS_PER_SECOND as f64);
        for n in [pair.i, pair.j].map(usize::from) {
            let (r_m, normal_hat) = (plan.array.position_m(n, t_s), plan.array.normal_hat(n, t_s));
            daughters.push(DaughterPosition { r_m, normal_hat, daughter_time: None });
        }
    }
    let mut powers = vec![0.0; daughters.len()];
    sky.predict_powers(&daughters, &mut powers)?;
    let positions_m =
        |side: usize| daughters.iter().skip(side).step_by(2).map(|daughter| daughter.r_m).collect();
    // Without power the sky is hidden.
    let weight = powers.chunks(2).zip(&durations_s).map(|(pair_powers, duration_s)| {
        let variance = sigma_k_sr([pair_powers[0], pair_powers[1]], *duration_s).powi(2);
        if variance > 0.0 { variance.recip() } else { 0.0 }
    });
    Ok(PlacedVisibilities {
        channel: ChannelId(channel as u16),
        band: 0,
        frequency_hz: schedule.frequency_hz,
        pair,
        value_k_sr: vec![Complex64::ZERO; times.len()],
        time_s: times,
        r_i_m: positions_m(0),
        r_j_m: positions_m(1),
        weight: weight.collect(),
        duration_s: Vec::new(),
        gain_errors: Vec::new(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::ConfigSource;
    use crate::sky::Frame;
    use crate::units::vector::dot;

    #[test]
    fn one_source_gives_the_bound_of_a_complete_network() {
        let overrides = [
            "spacecraft.channels_hz=[3e6]",
            "spacecraft.every_nth_window=1",
            "spacecraft.every_nth_integration=1",
            "spacecraft.baseline_wavelengths_max=0",
            "spacecraft.duration_s=2e4",
            "calibrate.sky_model=\"direct\"",
            "calibrate.phase_sigma_deg=1e4",
        ];
        let source =
            ConfigSource { file: None, overrides: overrides.map(str::to_owned).to_vec(), seed: None };
        let plan = Plan::new(source.load().unwrap()).unwrap();
        // One pixel in the direction of the orbit's normal, which the Moon never occults.
        let normal = plan.array.normal_hat(0, 0.0);
        let mut map = SkyMap::new(Frame::Ecliptic, vec![0.0; 12 * 16]).unwrap();
        let towards = map.directions_ecliptic();
        let near = |a: &usize, b: &usize| dot(towards[*a], normal).total_cmp(&dot(towards[*b], normal));
        let brightest = (0..towards.len()).max_by(near).unwrap();
        let mut values = vec![0.0; towards.len()];
        values[brightest] = 1e7;
        map = SkyMap::new(Frame::Ecliptic, values).unwrap();
        let found = bound(&plan, &[map], 0).unwrap();
        // The signal of every pair equals its noise, so its Fisher information is 2 bandwidth duration. In a complete network of N nodes
        // with such conductances, the resistance between two nodes is 2 / (N conductance).
        let [from_s, until_s] = found.span_s;
        let information = 2.0 * plan.instrument.channels[0].width_hz * (until_s - from_s);
        let expected_deg = (2.0 / (8.0 * information)).sqrt().to_degrees();
        for daughter in &found.daughters[1..] {
            let sigma_deg = daughter.gains[0].phase_sigma_deg;
            assert!((sigma_deg / expected_deg - 1.0).abs() < 1e-3, "{sigma_deg} {expected_deg}");
        }
        assert_eq!(found.daughters[0].gains[0].phase_sigma_deg, 0.0);
        assert!(matches!(bound(&plan, &[], 0), Err(PipelineError::Invalid(_))));
    }
}
