//! Measured visibilities agree with the model, averaged over integrations and channels.

use lunarray::array::{Array, ArrayConfig};
use lunarray::frames::{AntennaResponse, VisibilityBlock};
use lunarray::response::model::{DirectSum, PairPosition, VisibilityModel};
use lunarray::sky::SkyMap;
use lunarray::sky::fits::{ReadOptions, read_map};
use lunarray::units::all_pairs;
use lunarray::units::vector::unit;
use num_complex::Complex64;

use crate::common;
use crate::craft::{Sky, Spacecraft, WIDTH_HZ, fringe, point, smeared};

#[test]
fn a_point_source_has_the_visibilities_of_the_model() {
    let frequencies_hz = vec![1e6, 10e6, 30e6];
    let n_hat = unit([0.3, -0.8, 0.4]);
    let sky = point(n_hat);
    let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies_hz, sky, 30.0);
    craft.receiver_noise_k_sr = 1.0;
    let (mut squares, mut count) = (0.0, 0.0);
    let runs = [3, 4, 5].map(|seed| craft.run(seed));
    for (blocks, channel) in runs.iter().flat_map(|blocks| [0, 1, 2].map(|channel| (blocks, channel))) {
        for pair in all_pairs(8) {
            let (mut product, mut power, mut weight) = (Complex64::ZERO, 0.0, 0.0);
            for block in blocks.iter().filter(|b| b.pair == pair && usize::from(b.channel.0) == channel) {
                for k in 0..block.len() {
                    let from_s = block.start.seconds() + f64::from(block.offset_ticks[k]) * 1e-6;
                    let dt_s = f64::from(block.duration_ticks[k]) * 1e-6;
                    let ends = (usize::from(pair.i), usize::from(pair.j));
                    let at = craft.frequencies_hz[channel];
                    let expected =
                        smeared(&craft.array, ends, (from_s, dt_s), at, |frequency_hz, r_i_m, r_j_m| {
                            fringe(n_hat, frequency_hz, r_i_m, r_j_m)
                        });
                    let found = Complex64::new(block.value_k_sr[k].re.into(), block.value_k_sr[k].im.into());
                    let w = f64::from(block.weight[k]);
                    product += found * expected.conj() * w;
                    power += expected.norm_sqr() * w;
                    weight += expected.norm_sqr() * w;
                    squares += (found - expected).norm_sqr() * w;
                    count += 2.0;
                }
            }
            let ratio = product / power;
            // Weights are those of the noise; 2e-3 is the documented error of interpolation.
            let error = (1.0 / weight).sqrt();
            assert!((ratio - 1.0).norm() < 4.0 * 1.5 * error + 2e-3, "{channel} {pair}: {ratio} +- {error}");
        }
    }
    // Self-noise of the source: half of the power is common to all daughters, so the two parts differ; their mean variance
    // is P_i P_j / (2 n). A quarter of a square is due to the source alone, the same for all pairs, and half of it to the
    // source and one receiver, the same for seven: with 30 s and three channels, and the overlap of integrations, that
    // leaves 1.3 % of the mean, and 0.75 % for three runs.
    let mean = squares / count;
    eprintln!("{count} parts, mean square {mean:.4}");
    assert!((mean - 1.0).abs() < 4.0 * 0.0075, "{mean}");
}

/// The model's visibilities: means over four instants of each integration and 16 frequencies of the channel.
fn expectations(
    array: &Array,
    blocks: &[VisibilityBlock],
    frequency_hz: f64,
    model: impl Fn(f64) -> DirectSum,
) -> Vec<Complex64> {
    let mut positions = Vec::new();
    for block in blocks {
        for k in 0..block.len() {
            let from_s = block.start.seconds() + f64::from(block.offset_ticks[k]) * 1e-6;
            let dt_s = f64::from(block.duration_ticks[k]) * 1e-6;
            positions.extend((0..4).map(|m| {
                let t_s = from_s + dt_s * (f64::from(m) + 0.5) / 4.0;
                PairPosition {
                    r_i_m: array.position_m(block.pair.i.into(), t_s),
                    r_j_m: array.position_m(block.pair.j.into(), t_s),
                    span_rad: 0.0,
                    pair_time: None,
                }
            }));
        }
    }
    let mut expected = vec![Complex64::ZERO; positions.len() / 4];
    let mut predicted = vec![Complex64::ZERO; positions.len()];
    // Frequencies within the channel, as separate channels.
    for k in 0..16 {
        let at_hz = frequency_hz + WIDTH_HZ * ((f64::from(k) + 0.5) / 16.0 - 0.5);
        model(at_hz).predict(&positions, &mut predicted).unwrap();
        for (sum, four) in expected.iter_mut().zip(predicted.chunks_exact(4)) {
            *sum += four.iter().sum::<Complex64>() / 64.0;
        }
    }
    expected
}

/// Observes the published sky at `mhz` for `seconds`; the signal must be at least `signal` standard errors.
fn check_real_sky(mhz: u32, seconds: f64, signal: f64) {
    let path = common::shared(&format!("sky/ulsa_{mhz}mhz_galactic_nside64.fits"));
    let sky: SkyMap = read_map(&path, &ReadOptions::default()).unwrap();
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let moon_radius_m = array.moon_radius_m();
    let model =
        move |frequency_hz| DirectSum::new(&sky, frequency_hz, moon_radius_m, AntennaResponse::Isotropic);
    let frequency_hz = 1e6 * f64::from(mhz);
    let centre = model(frequency_hz);
    let sky: Sky = Box::new(move |_| Box::new(centre.clone()));
    let craft = Spacecraft::new(ArrayConfig::default(), vec![frequency_hz], sky, seconds);
    let (frames, counts) = craft.sample(4);
    assert!(f64::from(counts.repairs.change_max) < 1e-3, "{:?}", counts.repairs);
    let (blocks, _) = craft.correlate(frames);
    let expected = expectations(&array, &blocks, frequency_hz, model);
    let (mut squares, mut count, mut product, mut power) = (0.0, 0.0, Complex64::ZERO, 0.0);
    let mut expected = expected.into_iter();
    for block in &blocks {
        for k in 0..block.len() {
            let (expected, weight) = (expected.next().unwrap(), f64::from(block.weight[k]));
            let found = Complex64::new(block.value_k_sr[k].re.into(), block.value_k_sr[k].im.into());
            let square = (found - expected).norm_sqr() * weight;
            // Four standard errors of each part and more: once in ten million.
            assert!(square < 32.0, "{} {k}: {square}", block.pair);
            product += found * expected.conj() * weight;
            power += expected.norm_sqr() * weight;
            squares += square;
            count += 2.0;
        }
    }
    let (ratio, error) = (product / power, power.sqrt().recip());
    eprintln!("{mhz} MHz: {count} parts, mean square {:.3}, {ratio:.4} +- {error:.4}", squares / count);
    // The whole signal has the right amplitude and no phase error.
    assert!((ratio - 1.0).norm() < 4.0 * error + 2e-3, "{mhz} MHz: {ratio} +- {error}");
    assert!(error < 1.0 / signal, "{mhz} MHz: {error}");
    // Parts are correlated between pairs; a quarter of them as independent is cautious.
    assert!((squares / count - 1.0).abs() < 4.0 * (2.0 / (count / 4.0)).sqrt(), "{}", squares / count);
}

#[test]
#[ignore = "needs LUNARRAY_SHARED"]
fn the_real_sky_has_the_visibilities_of_the_model() {
    check_real_sky(1, 16.0, 15.0);
    check_real_sky(3, 16.0, 5.0);
    check_real_sky(10, 8.0, 4.0);
}
