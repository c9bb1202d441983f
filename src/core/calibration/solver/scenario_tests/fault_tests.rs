//! Models that are wrong: what is wrong is told, or that it is not known.

use super::*;
use crate::calibration::solver::ModelFault;
use crate::calibration::solver::diagnosis::{Datum, diagnose};
use crate::frames::AntennaResponse;
use crate::response::model::PairPosition;
use crate::response::pixel::PairGeometry;
use crate::sky::{ecliptic_deg, k_sr_per_jy};
use crate::units::vector::sub;

/// Faults of all passes by channel, of models that `change` makes wrong.
fn faults(change: impl Fn(u64, &mut Pass<'_>) + Sync) -> Vec<[Option<ModelFault>; 3]> {
    faults_of(PASSES, change)
}

fn faults_of(passes: u64, change: impl Fn(u64, &mut Pass<'_>) + Sync) -> Vec<[Option<ModelFault>; 3]> {
    let of_pass = |seed: u64| {
        let gains = gains(seed);
        let gain = |c: usize, n: usize, _: f64| gains[c][n];
        let mut pass = plain(seed, &gain);
        change(seed, &mut pass);
        std::array::from_fn(|channel| fault(&pass, channel))
    };
    (first_seed()..first_seed() + passes).into_par_iter().map(of_pass).collect()
}

fn fault(pass: &Pass<'_>, channel: usize) -> Option<ModelFault> {
    let hz = FREQUENCIES_HZ[channel];
    let pairs = pass.blocks().into_iter().filter(|block| block.channel == channel).map(|block| {
        let datum = |k: usize| {
            let (sin, cos) = (TAU * block.time_s[k] / 8258.0).sin_cos();
            let position = |n: u8| [-ALONG_M[usize::from(n)] * cos, -ALONG_M[usize::from(n)] * sin, 0.0];
            let geometry = PairGeometry {
                r_i_m: position(block.pair.i),
                r_j_m: position(block.pair.j),
                frequency_hz: hz,
                moon_radius_m: 0.0,
                response: AntennaResponse::Isotropic,
            };
            let (value_k_sr, weight) = (block.value_k_sr[k], block.weight[k]);
            Datum { geometry, value_k_sr, weight, model: block.model[k][0] }
        };
        (0..block.time_s.len()).map(datum).collect()
    });
    let at_ratio = |ratio: f64, positions: &[PairPosition]| {
        let wave = |position: &PairPosition, [x, y]: [f64; 2]| {
            let [a, b, _] = sub(position.r_i_m, position.r_j_m);
            Complex64::cis(-TAU * ratio * pass.model_frequency * hz / SPEED_OF_LIGHT_M_S * (a * x + b * y))
        };
        let sum = |position: &PairPosition| {
            pass.model.iter().map(|(at, flux)| pass.strength * flux * wave(position, *at)).sum()
        };
        Some(positions.iter().map(sum).collect())
    };
    diagnose(&pairs.collect::<Vec<_>>(), &at_ratio)
}

#[test]
fn another_frequency_is_told() {
    let passes = PASSES / 4;
    for ratio in [0.6, 0.9, 1.05, 1.5] {
        let is_right = |fault: &Option<ModelFault>| match fault {
            // A tenth of a fringe of 12 wavelengths is 0.8 %.
            Some(ModelFault::Frequency { ratio: told }) => (told / ratio - 1.0).abs() < 0.008,
            _ => false,
        };
        for faults in faults_of(passes, |_, pass| pass.model_frequency = 1.0 / ratio) {
            assert!(faults.iter().all(is_right), "{ratio}: {faults:?}");
        }
    }
}

#[test]
fn a_missing_source_is_told_with_its_place_and_flux() {
    let place = [0.5_f64, -0.4];
    let z = (1.0 - place[0].powi(2) - place[1].powi(2)).sqrt();
    let found = faults(|_, pass| pass.sky.push((place, 25.0)));
    for faults in found {
        for (fault, hz) in faults.into_iter().zip(FREQUENCIES_HZ) {
            let Some(ModelFault::Source { position_deg: [longitude, latitude], flux_jy }) = fault else {
                panic!("{faults:?}")
            };
            // The array lies in a plane, which a mirror image shares. 60 wavelengths have a fringe of 1 deg, known to a fifth.
            let [right, north] = ecliptic_deg([place[0], place[1], z]);
            assert!((longitude - right).abs() < 0.2 && (latitude.abs() - north).abs() < 0.2, "{faults:?}");
            // Of 500 numbers with noise of 4 the flux has 0.25; other sources, which gains follow, add some 1.
            assert!((flux_jy * k_sr_per_jy(hz) - 25.0).abs() < 3.0, "{faults:?}");
        }
    }
}

#[test]
fn a_bright_source_at_another_place_is_not_missing() {
    // Half a degree is half a fringe of 60 wavelengths.
    for flux in [40.0, 100.0] {
        let found = faults_of(PASSES / 4, |_, pass| {
            pass.sky.push(([0.5, -0.4], flux));
            pass.model.push(([0.51, -0.4], flux));
        });
        let told = found.iter().flatten().flatten();
        let missing: Vec<_> = told.filter(|fault| matches!(fault, ModelFault::Source { .. })).collect();
        assert!(missing.is_empty(), "{flux}: {missing:?}");
    }
}

#[test]
fn another_sky_has_no_other_fault() {
    let told = |name: &str, change: &(dyn Fn(u64, &mut Pass<'_>) + Sync)| {
        let found = faults(change);
        let told: Vec<_> = found.into_iter().flatten().flatten().collect();
        assert!(told.is_empty(), "{name}: {told:?}");
    };
    told("far", &|seed, pass| pass.model = sky(100 + seed));
    told("right", &|_, _| ());
}

#[test]
fn what_one_source_has_more_than_its_model_is_told_of_it() {
    // Fluxes that are off by a factor of 1.3 either way: where one source is brighter than the others, it is named.
    let changed = |seed: u64| {
        let mut random = random_stream(seed, StreamKind::Probe, [25, 0]);
        let factors: Vec<f64> = (0..60).map(|_| (0.26 * normal(&mut random)).exp()).collect();
        factors
    };
    let found = faults(|seed, pass| {
        pass.model.iter_mut().zip(changed(seed)).for_each(|(source, factor)| source.1 *= factor);
    });
    for (number, faults) in found.iter().enumerate() {
        let seed = first_seed() + number as u64;
        let no_gain = |_: usize, _: usize, _: f64| Complex64::ONE;
        let (sky, factors) = (plain(seed, &no_gain).sky, changed(seed));
        // Gains take the model's strength as a whole.
        let squares = || sky.iter().map(|(_, flux)| flux * flux);
        let common = squares().zip(&factors).map(|(a, b)| a * b).sum::<f64>() / squares().sum::<f64>();
        for fault in faults.iter().flatten() {
            let ModelFault::Source { position_deg: [longitude, latitude], .. } = fault else {
                panic!("{fault:?}")
            };
            let is_at = |([x, y], _): &([f64; 2], f64)| {
                let [right, north] = ecliptic_deg([*x, *y, (1.0 - x * x - y * y).max(0.0).sqrt()]);
                let apart = (longitude - right).abs() * latitude.to_radians().cos();
                apart < 1.0 && (latitude.abs() - north).abs() < 1.0
            };
            let is_fainter =
                sky.iter().zip(&factors).any(|(source, factor)| is_at(source) && *factor < common);
            assert!(is_fainter, "{seed}: {fault:?}");
        }
    }
}
