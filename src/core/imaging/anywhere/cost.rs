//! Estimates of what a refined map takes.

use std::f64::consts::TAU;

use super::REFINED_VISIBILITY_BYTES;
use super::solve::{COLUMNS_AT_ONCE, can_be_formed};
use crate::imaging::circle::harmonic_cost;
use crate::imaging::cost::{ChannelData, EngineCost};
use crate::imaging::rates::{
    AVERAGE_INSTANTS, INNER_SOLUTION_FRACTION, INTERPOLATION_S, REFINED_ITERATIONS, ROW_FIXED_S, ROW_S,
    VISIBILITIES_PER_ROW, cores,
};
use crate::imaging::{MapConfig, RegulariserChoice};
use crate::response::general::row_tables_bytes;
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Memory of a visibility while the circle's sums for a refinement are made, bytes: position, data, noise.
const SUMMED_VISIBILITY_BYTES: f64 = 120.0;

/// Number of planes below which a refinement converges slowly: with 17 and with those of a month it does, with 121 not (eccentricity 0.01).
const PLANES_SLOW: f64 = 45.0;

/// The circle's sums, solved once per iteration; visibilities in memory; and tables of the true rows.
pub(in crate::imaging) fn refined_cost(map: &MapConfig, data: ChannelData) -> EngineCost {
    let ChannelData { frequency_hz, visibilities, limb_range_rad, .. } = data;
    let data = ChannelData { error_draws: 0, ..data };
    let planes = data.planes();
    // The circle's matrix is no use to it as a whole.
    let data = ChannelData { node_turns: 1.0, ..data };
    let circle = harmonic_cost(map, data);
    // Intermediate maps are solved on the nearest circle.
    let circle_final = harmonic_cost(map, ChannelData { solutions: 1, ..data });
    let u_max = map.baseline_m_max(frequency_hz) * frequency_hz / SPEED_OF_LIGHT_M_S;
    let stored = visibilities.min(map.refine.visibilities_max as f64);
    let held = stored * REFINED_VISIBILITY_BYTES as f64;
    // While the circle's sums are made, integers and floats are both in memory, but each visibility takes less than later.
    let while_summed = circle.sums_bytes - (held - stored * SUMMED_VISIBILITY_BYTES);
    let iterations = (map.refine.passes_max as f64).min(REFINED_ITERATIONS);
    let l_max = map.degree() as f64;
    let row_s = ROW_FIXED_S + ROW_S * l_max * (l_max + TAU * u_max);
    let [every, thinned] = VISIBILITIES_PER_ROW;
    let per_row = if data.every_nth > 1.0 { (thinned / data.every_nth).max(1.0) } else { every };
    // The sky times each monomial of the antennas' responses, at each instant of an average.
    let degree = map.antennas.degree();
    let skies = ((degree + 1) * (degree + 2) / 2) as f64;
    let instants = if map.refine.smear_integrations { AVERAGE_INSTANTS } else { 1.0 };
    let interpolation_s = INTERPOLATION_S * skies * instants;
    let product_s = |skies: f64| visibilities * (row_s / per_row + 0.5 * skies * interpolation_s) / cores();
    let iteration_s = product_s(2.0);
    // From few planes it converges slowly: with R from the data in twice as many solutions, each of which ends with the true matrix formed.
    let unknowns = (map.degree() + 1).pow(2);
    let is_slow = planes < PLANES_SLOW;
    let rounds = if is_slow && map.regulariser() == RegulariserChoice::Data { 2.0 } else { 1.0 };
    let is_formed = is_slow && can_be_formed(unknowns, (visibilities / per_row) as usize);
    let together = COLUMNS_AT_ONCE as f64;
    let forming_s = if is_formed { unknowns as f64 / together * product_s(together) } else { 0.0 };
    let coefficients = if degree > 0 { 4.0 * skies } else { 0.0 };
    let held = held + visibilities * coefficients;
    let rows =
        row_tables_bytes(map.degree(), u_max, limb_range_rad, rayon::current_num_threads(), degree) as f64;
    // Intermediate maps are solved from circle sums and a copy of them.
    let has_snapshots = map.snapshot_every_s > 0.0;
    let snapshot_bytes = if has_snapshots { circle.sums_bytes + circle.copy_bytes } else { 0.0 };
    EngineCost {
        sums_bytes: held,
        copy_bytes: 0.0,
        other_bytes: circle.other_bytes + circle.sums_bytes + while_summed.max(0.0) + rows + snapshot_bytes,
        // Each iteration takes a product and an inner solution, for the map and its noise map.
        solving_s: circle.solving_s - circle_final.solving_s
            + rounds * (iterations + 1.0) * (INNER_SOLUTION_FRACTION * circle_final.solving_s + iteration_s)
            + rounds * forming_s
            + visibilities * circle.visibility_s,
        visibility_s: if has_snapshots { circle.visibility_s } else { 0.0 },
        ..circle
    }
}
