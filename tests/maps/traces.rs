//! Traces of the covariances from epsilon 1e-9 to 1, against rows and eigenvalues of other code.

use crate::common;
use crate::engines::{harmonic_sums, observe};

use std::io::Write;
use std::process::{Command, Stdio};
use std::time::Duration;

use faer::{Mat, Side};
use lunarray::imaging::{Accuracy, NormalSums};
use lunarray::imaging::{
    SolveWatch, Traces, UnsupportedEpsilon, W_MAX_EXACT, largest_eigenvalue, probed_traces, traces,
};
use lunarray::runtime::Cancel;
use lunarray::sky::{Frame, SkyMap};
use serde_json::{Value, json};

/// 1e-9 to 1.
fn epsilons() -> Vec<f64> {
    (0..10).map(|power| 10_f64.powi(power - 9)).collect()
}

/// Both traces of a matrix with these eigenvalues, for R = epsilon times the greatest (the paper, Sect. 4).
fn expected(eigenvalues: &[f64], epsilon: f64) -> [f64; 2] {
    let w_max = eigenvalues.iter().copied().fold(0.0, f64::max);
    let eps = epsilon * w_max;
    let sum = |f: &dyn Fn(f64) -> f64| eigenvalues.iter().map(|w| f(w.max(0.0))).sum();
    [sum(&|w| w / (w + eps).powi(2)), sum(&|w| (eps / (w + eps)).powi(2))]
}

/// Whether traces are those of the eigenvalues within their error.
fn check(found: &Traces, eigenvalues: &[f64], epsilon: f64) {
    let expected = expected(eigenvalues, epsilon);
    for (found, expected) in [found.sigma_n_k2, found.sigma_s].into_iter().zip(expected) {
        println!("{epsilon:e}: {:.4e} +- {:.1e}, expected {expected:.4e}", found.value, found.error);
        assert!((found.value - expected).abs() <= found.error, "{epsilon:e}: {found:?} {expected:e}");
    }
}

fn w_max(sums: &dyn NormalSums) -> f64 {
    largest_eigenvalue(sums, W_MAX_EXACT, &mut |_, _| true).value
}

#[test]
#[ignore = "needs LUNARRAY_SHARED"]
fn traces_of_pixels_are_those_of_the_reference_at_every_epsilon() {
    let path = common::shared("reference/tikhonov_nside4.json");
    let reference: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    let eigenvalues: Vec<f64> =
        reference["eigenvalues"].as_array().unwrap().iter().map(|w| w.as_f64().unwrap()).collect();
    let sums = crate::tikhonov::sums(&reference);
    let watch = SolveWatch::default();
    for epsilon in epsilons() {
        let found = traces(&sums, epsilon, w_max(&sums), 1, watch.named("test")).unwrap().unwrap();
        assert_eq!(found.probes, 0);
        check(&found, &eigenvalues, epsilon);
        // Exact: nothing but the accuracy of the sums is open, 1e-11 of W_max, which at 1e-9 is some percent.
        assert!(found.sigma_n_k2.error < 0.1 * found.sigma_n_k2.value, "{found:?}");
        // Bounds of 192 steps at most, the last of which leaves none open; and six standard errors, as six probes know them
        // badly.
        let probed = probed_traces(&sums, epsilon, w_max(&sums), 6, watch.named("test")).unwrap().unwrap();
        for (probed, exact) in [(probed.sigma_n_k2, found.sigma_n_k2), (probed.sigma_s, found.sigma_s)] {
            let apart = (probed.value - exact.value).abs();
            assert!(apart < 6.0 * probed.error, "{epsilon:e}: {probed:?} {exact:?}");
        }
    }
}

/// They are left out, not refused for their accuracy.
#[test]
fn interrupted_traces_are_none() {
    let sky = SkyMap::new(Frame::Ecliptic, vec![1e6; 12 * 8 * 8]).unwrap();
    let sums = harmonic_sums(&observe(&sky, 3e6, 250.0, 100), 20, 250.0);
    let w_max = w_max(&sums);
    let cancel = Cancel::new();
    let watch = SolveWatch::new(cancel.clone()).with_grace(Duration::ZERO);
    assert!(traces(&sums, 0.1, w_max, 2, watch.named("test")).unwrap().is_some());
    cancel.cancel();
    assert_eq!(traces(&sums, 0.1, w_max, 2, watch.named("test")), Ok(None));
    assert_eq!(probed_traces(&sums, 0.1, w_max, 2, watch.named("test")), Ok(None));
}

/// Fringes end at l = 2 pi 2.5 = 16 or so: the harmonics beyond are hardly measured, and eigenvalues fall to nothing.
#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn traces_of_harmonics_hardly_measured_are_right_or_refused_at_every_epsilon() {
    compare_with_rows(3e6, 250.0, 20, 3_000);
}

/// At 10 MHz up to b_p of nside 8. Up to 470 m, which takes minutes, eigenvalues are apart by less.
#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn traces_of_harmonics_at_10_mhz_are_right_or_refused_at_every_epsilon() {
    compare_with_rows(10e6, 234.0, 20, 3_458);
}

/// Traces over harmonics against those of rows in f64, one by one, with nothing in common.
fn compare_with_rows(frequency_hz: f64, baseline_m_max: f64, l_max: usize, count: usize) {
    let python = common::python();
    let sky = SkyMap::new(Frame::Ecliptic, vec![1e6; 12 * 8 * 8]).unwrap();
    let blocks = observe(&sky, frequency_hz, baseline_m_max, count);
    let visibilities: Vec<Value> = blocks
        .iter()
        .map(|block| json!([block.pair.i, block.pair.j, block.time_s[0], block.weight[0]]))
        .collect();
    let asked = json!({ "l_max": l_max, "frequency_hz": frequency_hz, "visibilities": visibilities });
    let script = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/harmonic_traces.py");
    let (input, output) = (Stdio::piped(), Stdio::piped());
    let mut child = Command::new(python).arg(script).stdin(input).stdout(output).spawn().unwrap();
    child.stdin.take().unwrap().write_all(asked.to_string().as_bytes()).unwrap();
    let answer: Value = serde_json::from_slice(&child.wait_with_output().unwrap().stdout).unwrap();
    let exact: Vec<f64> = answer.as_array().unwrap().iter().map(|w| w.as_f64().unwrap()).collect();

    let sums = harmonic_sums(&blocks, l_max, baseline_m_max);
    let (order, w_max) = (sums.unknowns(), w_max(&sums));
    assert_eq!(exact.len(), order);
    // The accuracy that the engine claims is that of its eigenvalues.
    let mut matrix = Mat::<f64>::zeros(order, order);
    let (mut unit, mut column) = (vec![0.0; order], vec![0.0; order]);
    for k in 0..order {
        unit[k] = 1.0;
        sums.apply(&unit, &mut column);
        unit[k] = 0.0;
        for (row, x) in column.iter().enumerate() {
            matrix[(row, k)] += 0.5 * x / w_max;
            matrix[(k, row)] += 0.5 * x / w_max;
        }
    }
    let own = matrix.self_adjoint_eigenvalues(Side::Lower).unwrap();
    let greatest = exact[order - 1];
    // Of each eigenvalue, what the relative accuracy does not account for.
    let Accuracy { relative, absolute } = sums.accuracy();
    let apart = own.iter().zip(&exact).map(|(own, exact)| {
        let exact = exact / greatest;
        (((own - exact).abs() - relative * exact).max(0.0), exact)
    });
    let (apart, at) = apart.fold((0.0, 0.0), |most, one| if one.0 > most.0 { one } else { most });
    println!(
        "{} visibilities, apart by {apart:e} at {at:e}; least eigenvalue {:e}",
        blocks.len(),
        exact[0] / greatest
    );
    assert!(apart <= absolute, "{apart:e}");

    let watch = SolveWatch::default();
    for epsilon in epsilons() {
        let all = [
            traces(&sums, epsilon, w_max, 1, watch.named("test")),
            probed_traces(&sums, epsilon, w_max, 6, watch.named("test")),
        ];
        for found in all {
            match found.map(Option::unwrap) {
                Ok(found) if found.probes == 0 => check(&found, &exact, epsilon),
                Ok(found) => {
                    let expected = expected(&exact, epsilon);
                    for (found, expected) in [found.sigma_n_k2, found.sigma_s].into_iter().zip(expected) {
                        // Six standard errors, as six probes know them badly.
                        assert!(
                            (found.value - expected).abs() < 6.0 * found.error,
                            "{epsilon:e}: {found:?} {expected}"
                        );
                    }
                }
                Err(refused) => {
                    println!("{refused}");
                    assert_eq!(refused, UnsupportedEpsilon { epsilon, accuracy: absolute });
                    // No more than the smallest eigenvalues ask for.
                    assert!(epsilon < 1e3 * absolute, "{refused}");
                }
            }
        }
    }
}
