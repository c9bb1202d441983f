//! Estimates of the memory, operations and time that the normal equations of a channel take.

use crate::imaging::{MapConfig, RegulariserChoice};

/// Iterations of a harmonic solution whose windows cover the planes of the orbit: for W_max, the map and its noise map each (`lunarray run`
/// of the quicklook with `map.epsilon = 1e-4`: 9 to 16, 11 to 13 and 10 to 13).
pub(in crate::imaging) const ITERATIONS: f64 = 11.0;

/// Number of windows below which iterations grow, and the power of the fraction by which they do: 24 with 50 windows, 75 to 183 with 17.
const WINDOWS_COVERED: f64 = 90.0;
const COVERAGE_EXPONENT: f64 = 1.4;

/// Maximum number of iterations of a solution from few windows, which determine few harmonics.
const ITERATIONS_FEW: f64 = 180.0;

/// Columns that are solved together: a map and its noise map, or, with R from the data, the errors of mean and dipole; or those of bodies that
/// move.
pub(in crate::imaging) fn solved_together(map: &MapConfig) -> usize {
    if map.regulariser() == RegulariserChoice::Data || !map.movers.is_empty() { 4 } else { 2 }
}

/// Maximum number of intermediate maps whose products are counted one by one.
const MAPS_COUNTED: u64 = 100;

/// Vectors of unknowns that a solution holds: the Lanczos basis for W_max, and that for a probe.
pub(in crate::imaging) const BASIS_VECTORS: [f64; 2] = [60.0, 120.0];

/// The cost of one channel's engine.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EngineCost {
    /// Memory of the sums, bytes.
    pub sums_bytes: f64,
    /// Memory of a floating-point copy of the sums, from which a map is solved, bytes.
    pub copy_bytes: f64,
    /// Memory of tables and workspace, bytes.
    pub other_bytes: f64,
    /// Estimated time per visibility, s.
    pub visibility_s: f64,
    /// Estimated time of all solutions, with the random probes and beams of the final one, s.
    pub solving_s: f64,
    pub visibility_multiply_adds: f64,
    /// Multiply-adds of all solutions.
    pub solving_multiply_adds: f64,
    /// Number of products with the normal matrix in all solutions; 0 for a factorisation.
    pub products: f64,
}

/// The data of a channel as planned, before its sums exist.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChannelData {
    pub frequency_hz: f64,
    /// Visibilities within the map's longest baseline.
    pub visibilities: f64,
    /// Number of observation windows.
    pub windows: f64,
    /// Turns of the orbit's node.
    pub node_turns: f64,
    /// Length of the mission, s.
    pub duration_s: f64,
    /// Every so many integrations are sent.
    pub every_nth: f64,
    /// Number of maps: intermediate ones and the final one.
    pub solutions: u64,
    /// Range of the angle between nadir and limb over the mission, rad.
    pub limb_range_rad: f64,
    /// Number of draws of the errors of applied gains; 0 if these are not known.
    pub error_draws: usize,
}

impl ChannelData {
    /// Number of windows in planes of their own: at most what the turn of the node has.
    pub(in crate::imaging) fn planes(&self) -> f64 {
        self.windows.min(WINDOWS_COVERED * self.node_turns)
    }
}

/// Usual number of iterations of a map from this many windows.
pub(in crate::imaging) fn iterations(windows: f64) -> f64 {
    let grown = (WINDOWS_COVERED / windows.max(1.0)).max(1.0).powf(COVERAGE_EXPONENT);
    (ITERATIONS * grown).min(ITERATIONS_FEW)
}

/// Sum over all intermediate maps, and the value of the final one, of a cost by the fraction of the data that a map has.
pub(in crate::imaging) fn over_maps(data: ChannelData, cost: impl Fn(f64) -> f64) -> [f64; 2] {
    let intermediate = data.solutions.saturating_sub(1);
    let counted = intermediate.min(MAPS_COUNTED);
    let at = |k: u64| cost(k as f64 / (counted + 1) as f64);
    let mean = (1..=counted).map(at).sum::<f64>() / counted.max(1) as f64;
    [intermediate as f64 * mean, cost(1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::{EngineKind, MatrixKind};
    use crate::response::pixel::PixelMethod;

    /// Data that cover the orbit's planes, without intermediate maps.
    const DATA: ChannelData = ChannelData {
        frequency_hz: 1e7,
        visibilities: 25_000.0,
        windows: 200.0,
        node_turns: 1.0,
        duration_s: 4.1e7,
        every_nth: 1.0,
        solutions: 1,
        limb_range_rad: 0.05,
        error_draws: 0,
    };

    fn harmonic(regulariser: RegulariserChoice) -> MapConfig {
        MapConfig { engine: EngineKind::Harmonic, regulariser: Some(regulariser), ..MapConfig::default() }
    }

    #[test]
    fn auto_costs_what_pixels_do_and_r_from_the_data_takes_more_of_all() {
        let free = |engine: EngineKind| {
            let map = MapConfig { engine, matrix: MatrixKind::Free, ..MapConfig::default() };
            map.cost(DATA)
        };
        assert_eq!(free(EngineKind::Auto), free(EngineKind::Pixel));
        let dense = |regulariser| MapConfig { engine: EngineKind::Pixel, ..harmonic(regulariser) };
        for map in [harmonic, dense] {
            let [given, from_data] = [RegulariserChoice::Identity, RegulariserChoice::Data]
                .map(|regulariser| map(regulariser).cost(DATA));
            assert!(from_data.other_bytes > given.other_bytes, "{from_data:?} {given:?}");
            assert!(from_data.solving_s > given.solving_s, "{from_data:?} {given:?}");
        }
    }

    #[test]
    fn matrix_free_cost_is_products_times_rows_times_pixels() {
        let cost = |nside, iterations_max, rows| {
            let map =
                MapConfig { nside, rows, matrix: MatrixKind::Free, iterations_max, ..MapConfig::default() };
            MapConfig { regulariser: Some(RegulariserChoice::Identity), ..map }.cost(DATA)
        };
        let (few, many) = (cost(64, 1, PixelMethod::Centre), cost(64, 22, PixelMethod::Centre));
        // With the 20 for W_max, twice as many products take twice the time.
        assert!((many.solving_s / few.solving_s - 2.0).abs() < 1e-9);
        assert!((few.solving_s / cost(32, 1, PixelMethod::Centre).solving_s - 4.0).abs() < 1e-9);
        assert!(cost(64, 1, PixelMethod::Average).solving_s > few.solving_s);
        // 9.7 GB of matrix (`PIXEL_ENGINE_NSIDE_MAX`) against 400 bytes per visibility.
        let stored = MapConfig { nside: 64, ..MapConfig::default() }.cost(DATA);
        assert!(stored.sums_bytes > 9e9 && few.sums_bytes < 2e7 && few.other_bytes < 1e9);
    }

    #[test]
    fn snapshots_cost_as_much_as_their_data_need() {
        let of = |map: &MapConfig, windows, solutions| map.cost(ChannelData { windows, solutions, ..DATA });
        let map = harmonic(RegulariserChoice::Identity);
        let [one, six] = [1, 6].map(|solutions| of(&map, 200.0, solutions).solving_s);
        // The first two have fewer windows than cover the planes, and take more iterations; none of them is free.
        assert!(six > 6.0 * one, "{six} {one}");
        assert!(of(&map, 17.0, 1).solving_s > of(&map, 200.0, 1).solving_s);
        // Without a matrix, a map of half the data takes half the time of a product.
        let regulariser = Some(RegulariserChoice::Identity);
        let free =
            MapConfig { matrix: MatrixKind::Free, iterations_max: 1, regulariser, ..MapConfig::default() };
        let [one, two] = [1, 2].map(|solutions| of(&free, 1e6, solutions).solving_s);
        assert!((two / one - 1.5).abs() < 1e-9);
    }

    #[test]
    fn draws_of_the_errors_of_gains_take_memory_and_time() {
        let of = |error_draws| harmonic(RegulariserChoice::Data).cost(ChannelData { error_draws, ..DATA });
        let [none, eight] = [0, 8].map(of);
        // Weights are five diagonals on a grid, right-hand sides four on a quarter of its points: a pair is a sixth of all.
        assert!((eight.sums_bytes / none.sums_bytes - (1.0 + 4.0 / 6.0)).abs() < 0.1, "{eight:?} {none:?}");
        assert!(eight.visibility_s > none.visibility_s && eight.solving_s > none.solving_s);
    }

    #[test]
    fn only_the_final_map_is_refined() {
        let mut map = harmonic(RegulariserChoice::Identity);
        let of = |map: &MapConfig, solutions| map.cost(ChannelData { solutions, ..DATA }).solving_s;
        let on_circle = of(&map, 6) - of(&map, 1);
        map.refine.passes_max = 3;
        let [one, six] = [1, 6].map(|solutions| of(&map, solutions));
        assert!(((six - one) / on_circle - 1.0).abs() < 1e-9, "{six} {one} {on_circle}");
        assert!(one > of(&harmonic(RegulariserChoice::Identity), 1));
    }

    #[test]
    fn memory_follows_windows_and_limbs() {
        let mut map = harmonic(RegulariserChoice::Identity);
        let of = |map: &MapConfig, data| map.cost(data);
        let [few, many, all] =
            [10.0, 100.0, f64::INFINITY].map(|windows| of(&map, ChannelData { windows, ..DATA }).sums_bytes);
        assert!(few < 0.5 * many && many < all, "{few} {many} {all}");
        // A circular orbit has limbs at one angle, an ellipse needs tables for many.
        map.refine.passes_max = 3;
        let [circle, ellipse] =
            [0.0, 0.5].map(|limb_range_rad| of(&map, ChannelData { limb_range_rad, ..DATA }).other_bytes);
        assert!(circle < ellipse, "{circle} {ellipse}");
    }
}
