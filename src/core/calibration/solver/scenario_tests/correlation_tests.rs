//! Stated errors of maps by gains against the scatter of solutions over seeds.

use super::*;

/// The channel that is looked at.
const C: usize = 1;

/// Squares of a sum of errors, their variance as it is stated, and that without correlations.
#[derive(Clone, Copy, Default)]
struct Squares {
    scatter: f64,
    stated: f64,
    independent: f64,
}

impl Squares {
    fn add(&mut self, coefficients: &[f64], errors: &[f64], sigma: &[f64], correlations: &[f64]) {
        let sum: f64 = coefficients.iter().zip(errors).map(|(a, e)| a * e).sum();
        let scaled: Vec<f64> = coefficients.iter().zip(sigma).map(|(a, sigma)| a * sigma).collect();
        let own: f64 = scaled.iter().map(|x| x * x).sum();
        let pairs = (0..scaled.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
        let shared: f64 = pairs.zip(correlations).map(|((i, j), r)| 2.0 * r * scaled[i] * scaled[j]).sum();
        self.scatter += sum * sum;
        self.stated += own + shared;
        self.independent += own;
    }
}

/// Those of a number of passes, each with gains and noise of its own, that were solved in one part, and their seeds.
fn solved_passes(mode: CalibrationMode, passes: u64) -> Vec<(u64, PassSolution)> {
    let config = SolverConfig { mode, ..SolverConfig::default() };
    let solve = |number: u64| {
        let gains = gains(first_seed() + number);
        let gain = |c: usize, n: usize, _: f64| gains[c][n];
        let parts = plain(first_seed() + number, &gain).solve(number, &config);
        let [solution]: [PassSolution; 1] = parts.try_into().ok()?;
        Some((first_seed() + number, solution))
    };
    (0..passes).into_par_iter().filter_map(solve).collect()
}

/// Of gains from other data than those of the map. What enters this are sums of two ln amplitudes and differences of two phases, and over a pass
/// those of all.
#[test]
fn stated_correlations_are_those_of_the_scatter() {
    let mut squares = [[Squares::default(); 2]; 2];
    for (seed, solution) in solved_passes(CalibrationMode::Beacon, 240) {
        let truth = &gains(seed)[C];
        let found: Vec<&GainEstimate> = solution.daughters.iter().map(|one| &one.gains[C]).collect();
        let reference = truth[solution.reference as usize - 1];
        let error = |(found, truth): (&&GainEstimate, &Complex64)| {
            let turn = Complex64::cis(found.phase_deg.to_radians()) * (reference / truth);
            [(found.amplitude / truth.norm()).ln(), turn.arg()]
        };
        let errors: Vec<[f64; 2]> = found.iter().zip(truth).map(error).collect();
        for (axis, sign) in [(0, 1.0), (1, -1.0)] {
            let of = |values: &[[f64; 2]]| values.iter().map(|value| value[axis]).collect::<Vec<f64>>();
            let sigma = of(&found.iter().map(|one| one.map_sigma).collect::<Vec<_>>());
            let correlations = of(&solution.correlations[C]);
            let mut add = |which: usize, coefficients: &[f64]| {
                squares[axis][which].add(coefficients, &of(&errors), &sigma, &correlations);
            };
            for pair in all_pairs(DAUGHTERS) {
                let mut coefficients = [0.0; DAUGHTERS];
                (coefficients[usize::from(pair.i)], coefficients[usize::from(pair.j)]) = (1.0, sign);
                add(0, &coefficients);
            }
            add(1, &[1.0; DAUGHTERS]);
        }
    }
    for (squares, name) in squares.iter().zip(["amplitudes", "phases"]) {
        for (of, what) in squares.iter().zip(["pairs", "all"]) {
            let [stated, independent] = [of.stated, of.independent].map(|sum| (sum / of.scatter).sqrt());
            eprintln!("{name} of {what}: {stated:.3} of the scatter, without correlations {independent:.3}");
            // The margin of 1.1. 240 sums give their rms to 4.6 %: three times that.
            assert!((stated / 1.1 - 1.0).abs() < 0.14, "{name} of {what}: {stated}");
        }
        // Of all daughters the correlations are what matters.
        let all = (squares[1].independent / squares[1].scatter).sqrt();
        assert!((all / 1.1 - 1.0).abs() > 0.28, "{name}: {all}");
    }
}

/// Visibilities divided by gains that were found from them are nearer to the truth than by the true gains, by one unit of chi-square for each
/// parameter: the noise of these gains is no error beside that of the visibilities.
#[test]
fn noise_of_gains_from_the_same_data_is_none_of_maps() {
    let mut gained = Vec::new();
    let mut stated = 0;
    let solved = solved_passes(CalibrationMode::Sky, 60);
    for (seed, solution) in &solved {
        let truth = gains(*seed);
        let found: Vec<Complex64> = solution
            .daughters
            .iter()
            .map(|one| Complex64::from_polar(one.gains[C].amplitude, one.gains[C].phase_deg.to_radians()))
            .collect();
        stated += solution.daughters.iter().filter(|one| one.gains[C].map_sigma != [0.0; 2]).count();
        let chi_square = |gains: &[Complex64]| -> f64 {
            let blocks = plain(*seed, &|c, n, _| truth[c][n]).blocks();
            let of = |block: &ModelledBlock| {
                let [i, j] = [block.pair.i, block.pair.j].map(|n| gains[usize::from(n)]);
                let terms = block.value_k_sr.iter().zip(&block.model).zip(&block.weight);
                terms.map(|((value, model), w)| w * (value - i * j.conj() * model[0]).norm_sqr()).sum::<f64>()
            };
            blocks.iter().filter(|block| block.channel == C).map(of).sum()
        };
        gained.push(chi_square(&truth[C]) - chi_square(&found));
    }
    let mean = gained.iter().sum::<f64>() / gained.len() as f64;
    eprintln!("chi-square is {mean:.2} lower; {stated} gains of {} state errors", DAUGHTERS * solved.len());
    // Eight amplitudes and seven phases; their chi-square scatters by sqrt(30), of 60 passes by 0.7: four times that.
    assert!((mean - 15.0).abs() < 2.8, "{mean}");
    // One in fifty seems to change by chance, each with its reference.
    assert!(stated * 10 < DAUGHTERS * solved.len(), "{stated}");
}
