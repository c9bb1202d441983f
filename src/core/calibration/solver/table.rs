//! Solutions as a table, and as a gains file that a replay applies.

use std::fmt::Write;

use super::estimates::{DaughterEstimate, GainEstimate, GainState};
use super::smooth::goes_on;
use super::solution::PassSolution;
use crate::calibration::gains_file::SIGMA_MAX;
use crate::calibration::{
    ChannelGains, GainErrors, GainSolution, GainsFile, Interpolation, PositionSolution,
};
use crate::frames::Channel;

/// Duration of a jump in a gains file, s.
const JUMP_S: f64 = 1e-6;

/// Comma-separated values, one line for each solution, daughter and channel.
#[must_use]
pub fn solutions_csv(solutions: &[PassSolution]) -> String {
    let mut text = String::from(
        "pass,from_s,until_s,daughter,frequency_hz,amplitude,ln_amplitude_sigma,phase_deg,phase_sigma_deg,clock_ns,\
         clock_sigma_ns,along_m,along_sigma_m,across_m,across_sigma_m,radial_m,radial_sigma_m,visibilities,outliers,\
         chi_square,converged,held_out,state,phase_scatter_deg,unexplained,reference,data_from_s,data_until_s,ln_amplitude_scatter\n",
    );
    for solution in solutions {
        for daughter in &solution.daughters {
            for gain in &daughter.gains {
                let ([x, y, z], [sx, sy, sz]) = (daughter.position_m, daughter.position_sigma_m);
                // Writing to a String cannot fail.
                let _ = writeln!(
                    text,
                    "{},{:.6},{:.6},{},{},{:.7},{:.3e},{:.6},{:.3e},{:.6},{:.3e},{x:.5},{sx:.3e},{y:.5},{sy:.3e},{z:.5},\
                     {sz:.3e},{},{},{:.5},{},{},{},{:.4},{:.5},{},{:.6},{:.6},{:.5}",
                    solution.pass,
                    solution.from_s,
                    solution.until_s,
                    daughter.daughter,
                    gain.frequency_hz,
                    gain.amplitude,
                    gain.amplitude_sigma,
                    gain.phase_deg,
                    gain.phase_sigma_deg,
                    daughter.clock_ns,
                    daughter.clock_sigma_ns,
                    gain.visibilities,
                    gain.outliers,
                    solution.chi_square,
                    u8::from(solution.converged),
                    u8::from(solution.is_held_out),
                    gain.state.word(),
                    gain.phase_scatter_deg,
                    gain.unexplained,
                    solution.reference,
                    gain.data_s[0],
                    gain.data_s[1],
                    gain.amplitude_scatter,
                );
            }
        }
    }
    text
}

/// Errors of maps by the gains of a solution in a channel, rounded to 1e-6; `None` if there are none, or their correlations are not known.
/// `solution_s` names all solutions that were smoothed together: each tells of all.
fn errors_of(
    solution: &PassSolution,
    (solution_s, c): (f64, usize),
    is_used: impl Fn(&GainEstimate) -> bool,
) -> Option<GainErrors> {
    let rounded = |values: [f64; 2]| values.map(|value| (value * 1e6).round() / 1e6);
    let correlations = solution.correlations.get(c).filter(|found| !found.is_empty())?;
    let sigma = |daughter: &DaughterEstimate| {
        let gain = &daughter.gains[c];
        // `min` takes the bound for what is not a number.
        if is_used(gain) { rounded(gain.map_sigma.map(|sigma| sigma.min(SIGMA_MAX))) } else { [0.0; 2] }
    };
    let sigma: Vec<[f64; 2]> = solution.daughters.iter().map(sigma).collect();
    sigma.as_flattened().iter().any(|sigma| *sigma > 0.0).then(|| GainErrors {
        solution_s,
        sigma,
        correlations: correlations.iter().map(|pair| rounded(*pair)).collect(),
    })
}

/// Gains file for `antenna-gains`: gains that are not good are zero, which removes their visibilities. With
/// `without_held_out`, held-out passes have no gains either.
///
/// A single solution of a pass, or of a part between jumps, applies to all of it; several are interpolated between
/// their middles.
#[must_use]
pub fn gains_file(solutions: &[PassSolution], channels: &[Channel], without_held_out: bool) -> GainsFile {
    let is_used = |solution: &PassSolution, gain: &GainEstimate| {
        gain.state == GainState::Good && !(without_held_out && solution.is_held_out)
    };
    let gains = |c: usize, solution: &PassSolution| -> Vec<[f64; 2]> {
        let gain_of = |daughter: &DaughterEstimate| {
            let gain = &daughter.gains[c];
            if !is_used(solution, gain) {
                return [0.0, 0.0];
            }
            let (sin, cos) = gain.phase_deg.to_radians().sin_cos();
            [gain.amplitude * cos, gain.amplitude * sin]
        };
        solution.daughters.iter().map(gain_of).collect()
    };
    let channel = |(c, channel): (usize, &Channel)| {
        let mut found: Vec<GainSolution> = Vec::new();
        let mut push = |time_s: f64, (run_s, solution): (f64, &PassSolution)| {
            // Times must increase: of two equal ones the first is used.
            if found.last().is_none_or(|last| last.time_s < time_s) {
                let errors = errors_of(solution, (run_s, c), |gain| is_used(solution, gain));
                found.push(GainSolution { time_s, gains: gains(c, solution), errors });
            }
        };
        let mut run_s = 0.0;
        for (k, solution) in solutions.iter().enumerate() {
            if k == 0 || !goes_on(&solutions[k - 1], solution) {
                run_s = 0.5 * (solution.from_s + solution.until_s);
            }
            let of_run = (run_s, solution);
            let is_first = k == 0 || solutions[k - 1].pass != solution.pass || solution.begins_with_jump;
            let is_last =
                solutions.get(k + 1).is_none_or(|next| next.pass != solution.pass || next.begins_with_jump);
            if is_first {
                // Times must increase: the part before ends where this one begins.
                push(solution.from_s + if solution.begins_with_jump { JUMP_S } else { 0.0 }, of_run);
            }
            if !(is_first && is_last) {
                push(0.5 * (solution.from_s + solution.until_s), of_run);
            }
            if is_last {
                push(solution.until_s, of_run);
            }
        }
        ChannelGains { frequency_hz: channel.frequency_hz, solutions: found }
    };
    let has_offsets =
        |solution: &&PassSolution| solution.daughters.iter().any(|daughter| daughter.position_m != [0.0; 3]);
    let position = |solution: &PassSolution| PositionSolution {
        from_s: solution.from_s,
        until_s: solution.until_s,
        normals_hat: solution.normal_hat.clone(),
        offsets_m: solution.daughters.iter().map(|daughter| daughter.position_m).collect(),
    };
    let half_hz = |channel: &Channel| 0.5 * channel.width_hz;
    GainsFile {
        interpolation: Interpolation::LogLinear,
        frequency_tolerance_hz: channels.iter().map(half_hz).fold(f64::INFINITY, f64::min),
        channels: channels.iter().enumerate().map(channel).collect(),
        positions: solutions.iter().filter(has_offsets).map(position).collect(),
    }
}
