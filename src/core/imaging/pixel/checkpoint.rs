//! The setup and the sums of the pixel engine in checkpoints. Sums are the matrix's tiles column by column (i64), then both right-hand
//! sides (i128).

use super::exact::ExactTiles;
use super::{ExactPixels, PixelSetup};
use crate::imaging::AccumulationError;
use crate::imaging::exact::checkpoint::{FrameReader, FrameWriter, RESPONSES, number_of, refused};
use crate::response::pixel::PixelMethod;
use crate::sky::healpix::{is_valid_nside, pixel_count};

/// Maximum nside that is accepted.
const NSIDE_MAX: u32 = 64;

/// The setup of a pixel engine in a checkpoint.
#[derive(bincode::Encode, bincode::Decode)]
pub struct PixelHead {
    nside: u32,
    frequency_hz: f64,
    method: u8,
    moon_radius_m: f64,
    response: u8,
    companion_seed: u64,
    weight_max: f64,
}

/// Methods, numbered in checkpoints by their position; only append.
const METHODS: [PixelMethod; 3] = [PixelMethod::Centre, PixelMethod::Average, PixelMethod::AverageExact];

impl PixelHead {
    pub(in crate::imaging) fn new(setup: &PixelSetup) -> Self {
        Self {
            nside: setup.nside as u32,
            frequency_hz: setup.frequency_hz,
            method: number_of(&METHODS, &setup.method),
            moon_radius_m: setup.moon_radius_m,
            response: number_of(&RESPONSES, &setup.response),
            companion_seed: setup.companion_seed,
            weight_max: setup.weight_max,
        }
    }

    pub(in crate::imaging) fn setup(&self) -> Result<PixelSetup, AccumulationError> {
        let nside = self.nside as usize;
        if !is_valid_nside(nside) || self.nside > NSIDE_MAX {
            return Err(refused(format!("nside {nside}"), "a power of two up to 64"));
        }
        let method = METHODS.get(usize::from(self.method)).copied();
        let response = RESPONSES.get(usize::from(self.response)).copied();
        Ok(PixelSetup {
            nside,
            frequency_hz: self.frequency_hz,
            method: method.ok_or_else(|| refused(format!("method {}", self.method), "a known method"))?,
            moon_radius_m: self.moon_radius_m,
            response: response
                .ok_or_else(|| refused(format!("response {}", self.response), "a known response"))?,
            companion_seed: self.companion_seed,
            weight_max: self.weight_max,
        })
    }
}

impl ExactPixels {
    pub(in crate::imaging) fn write(&self, out: &mut FrameWriter<'_>) -> Result<(), AccumulationError> {
        for column in self.normal.columns() {
            out.integers(column, i64::to_le_bytes)?;
        }
        out.integers(&self.right, i128::to_le_bytes)?;
        Ok(out.integers(&self.noise, i128::to_le_bytes)?)
    }

    /// Reads the sums. Memory is allocated only for data that could be read, not for what a forged head announces.
    pub(in crate::imaging) fn read(
        nside: usize,
        from: &mut FrameReader<'_>,
    ) -> Result<Self, AccumulationError> {
        let pixels = pixel_count(nside);
        let normal = ExactTiles::read(pixels, |column| from.integers(column, i64::from_le_bytes))?;
        let (mut right, mut noise) = (vec![0; pixels], vec![0; pixels]);
        from.integers(&mut right, i128::from_le_bytes)?;
        from.integers(&mut noise, i128::from_le_bytes)?;
        Ok(Self { normal, right, noise })
    }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;
    use crate::array::{Array, ArrayConfig};
    use crate::frames::{AntennaResponse, PlacedVisibilities};
    use crate::imaging::{NormalEngine, NormalSums, PixelEngine};
    use crate::units::Pair;

    fn setup() -> PixelSetup {
        PixelSetup {
            nside: 4,
            frequency_hz: 3e6,
            method: PixelMethod::Average,
            moon_radius_m: crate::units::constants::MOON_RADIUS_M,
            response: AntennaResponse::Isotropic,
            companion_seed: 3,
            weight_max: 10.0,
        }
    }

    fn visibilities(from_s: f64, count: usize) -> PlacedVisibilities {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let mut placed = PlacedVisibilities {
            frequency_hz: 3e6,
            pair: Pair { i: 0, j: 1 },
            ..PlacedVisibilities::default()
        };
        for k in 0..count {
            let time_s = from_s + 13.0 * k as f64;
            placed.time_s.push(time_s);
            placed.r_i_m.push(array.position_m(0, time_s));
            placed.r_j_m.push(array.position_m(1, time_s));
            placed.value_k_sr.push(Complex64::new((0.1 * k as f64).sin(), 0.3));
            placed.weight.push(1.0 + 0.01 * k as f64);
        }
        placed
    }

    fn checkpoint(engine: &mut PixelEngine) -> Vec<u8> {
        let mut bytes = Vec::new();
        engine.checkpoint(&mut bytes).unwrap();
        bytes
    }

    #[test]
    fn a_resumed_engine_has_the_same_bits() {
        let (first, second) = (visibilities(0.0, 200), visibilities(5e6, 171));
        let mut whole = PixelEngine::new(setup()).unwrap();
        let mut stopped = PixelEngine::new(setup()).unwrap();
        let _ = whole.add(&first).unwrap();
        let _ = whole.add(&second).unwrap();
        let _ = stopped.add(&first).unwrap();
        let mut resumed = PixelEngine::restore(&mut checkpoint(&mut stopped).as_slice()).unwrap();
        let _ = resumed.add(&second).unwrap();
        assert!(whole.into_sums() == resumed.into_sums());
    }

    #[test]
    fn blocks_and_snapshots_do_not_change_a_bit() {
        let all = visibilities(0.0, 300);
        let mut whole = PixelEngine::new(setup()).unwrap();
        let _ = whole.add(&all).unwrap();
        let mut parts = PixelEngine::new(setup()).unwrap();
        for k in 0..300 {
            let one = PlacedVisibilities {
                time_s: vec![all.time_s[k]],
                r_i_m: vec![all.r_i_m[k]],
                r_j_m: vec![all.r_j_m[k]],
                value_k_sr: vec![all.value_k_sr[k]],
                weight: vec![all.weight[k]],
                ..all.clone()
            };
            let _ = parts.add(&one).unwrap();
            if k % 100 == 50 {
                assert_eq!(parts.sums().counts().visibilities, k as u64 + 1);
            }
        }
        assert!(whole.into_sums() == parts.into_sums());
    }

    #[test]
    fn merging_is_adding() {
        let (first, second) = (visibilities(0.0, 100), visibilities(5e6, 150));
        let engine = |blocks: &[&PlacedVisibilities]| {
            let mut engine = PixelEngine::new(setup()).unwrap();
            for block in blocks {
                let _ = engine.add(block).unwrap();
            }
            engine
        };
        let mut merged = engine(&[&first]);
        merged.merge(engine(&[&second])).unwrap();
        let (merged, whole) = (merged.into_sums(), engine(&[&first, &second]).into_sums());
        assert_eq!(merged.counts.visibilities, whole.counts.visibilities);
        let scale = whole.normal.get(0, 0);
        for k in [0, 17, 191] {
            // The sums have the same terms in another order.
            assert!((merged.normal.get(k, 3) - whole.normal.get(k, 3)).abs() < 1e-13 * scale);
        }
    }

    #[test]
    fn any_damage_is_found() {
        let mut engine = PixelEngine::new(setup()).unwrap();
        let _ = engine.add(&visibilities(0.0, 140)).unwrap();
        let good = checkpoint(&mut engine);
        assert!(PixelEngine::restore(&mut good.as_slice()).is_ok());
        for index in [0, 7, 8, 11, 12, 16, 24, 40, 60, 80, good.len() / 2, good.len() - 5, good.len() - 1] {
            let mut bad = good.clone();
            bad[index] ^= 0x10;
            assert!(PixelEngine::restore(&mut bad.as_slice()).is_err(), "byte {index}");
        }
        for length in [0, 5, 11, 50, good.len() / 3, good.len() - 1] {
            assert!(PixelEngine::restore(&mut &good[..length]).is_err(), "{length} bytes");
        }
    }
}
