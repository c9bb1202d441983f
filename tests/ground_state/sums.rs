//! How far sums of the same terms in another order, or after a detour, may differ.

use std::io::Cursor;

use lunarray::sky::fits::{ReadOptions, read_map_from};

use super::Ground;

/// Greatest difference of two maps of the same data, over the greatest value of one of them.
///
/// Pixel sums are in f64: some 10^4 terms, of which half may have been added and taken out again, err by 10^4 times
/// 1.1e-16 at most, and the solution makes of it at most 1 / epsilon = 10^4 times as much: 1e-8. Harmonic sums are in
/// f32, as far as they are: 6e-8 a term, but of errors that do not add up (the square root of 10^4), and the same 10^4
/// in directions that the regularisation damps to a part in a hundred of the map: 6e-8 x 100 x 10^4 x 0.01 = 6e-4.
fn tolerance(engine: &str) -> f64 {
    if engine == "pixel" { 1e-8 } else { 1e-3 }
}

/// Holds the maps of two sessions against each other.
pub fn assert_same_maps(place: &Ground, engine: &str, one: &str, other: &str) {
    let maps = [one, other].map(|state| place.maps(state));
    assert_eq!(maps[0].len(), maps[1].len());
    for (one, other) in maps[0].iter().zip(&maps[1]) {
        let values = [one, other].map(|bytes| values(bytes));
        let scale = values[0].iter().fold(0.0_f64, |most, value| most.max(value.abs()));
        let worst = values[0].iter().zip(&values[1]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(worst <= tolerance(engine) * scale, "{engine}: {} of {}", worst / scale, tolerance(engine));
    }
}

fn values(fits: &[u8]) -> Vec<f64> {
    let read = read_map_from(&mut Cursor::new(fits), fits.len() as u64, &ReadOptions::default());
    read.unwrap().map.values().to_vec()
}
