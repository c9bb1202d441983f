//! Tests of what the sums resolve.

use super::*;

/// Sums of many equal visibilities neither stop growing nor drift.
#[test]
fn sums_of_many_do_not_lose_weight() {
    let mut one = blocks(0, 1).swap_remove(0);
    one.weight.iter_mut().for_each(|w| *w = 1.0 / 3.0);
    let mut engine = HarmonicEngine::new(setup()).unwrap();
    let repeats = 20_000;
    for _ in 0..repeats {
        let _ = engine.add(&one).unwrap();
    }
    let many = engine.into_sums();
    let mut engine = HarmonicEngine::new(setup()).unwrap();
    let _ = engine.add(&one).unwrap();
    let single = engine.into_sums();
    let (mut a, mut b) = (vec![0.0; many.unknowns()], vec![0.0; many.unknowns()]);
    many.apply(&vector(9), &mut a);
    single.apply(&vector(9), &mut b);
    let ratio = dot(&a, &b) / dot(&b, &b) / f64::from(repeats);
    // Rounding of 20,000 additions in f32, all in one direction: 20,000 / 2^25.
    assert!((ratio - 1.0).abs() < 6e-4, "{ratio}");
}

#[test]
fn blocks_of_orders_are_symmetric_and_solved() {
    let blocks = blocks(0, 40);
    let sums = engine(&blocks).into_sums();
    let factors = sums.order_blocks().factors(1e-3);
    let (x, z) = (vector(11), vector(12));
    let solved = |v: &[f64]| {
        let mut v = v.to_vec();
        factors.solve(&mut v);
        v
    };
    let (px, pz) = (solved(&x), solved(&z));
    assert!((dot(&z, &px) - dot(&x, &pz)).abs() < 1e-9 * (dot(&px, &px) * dot(&z, &z)).sqrt());
    assert!(dot(&x, &px) > 0.0);
    // The factors invert the blocks plus R.
    let mut product = x.clone();
    sums.order_blocks().multiply(&mut product);
    product.iter_mut().zip(&x).for_each(|(product, x)| *product += 1e-3 * x);
    let undone = solved(&product);
    let apart = undone.iter().zip(&x).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(apart < 1e-6, "R is a millionth of the greatest element: {apart:e}");
    // For even coverage the monopole is nearly an eigenvector, for which block and operator agree.
    let mut e = vec![0.0; x.len()];
    e[0] = 1.0;
    let (mut whole, block) = (vec![0.0; x.len()], sums.order_blocks());
    sums.apply(&e, &mut whole);
    let quotient = block.diagonal(0) / whole[0];
    // Blocks neglect dependence on the phase, which the monopole does not have.
    assert!((quotient - 1.0).abs() < 1e-3, "{quotient}");
}

/// Compares every sum with one in f64 of the same kernels, at weights a thousand times below the maximum. The error of a term is at most half a
/// quantum and the rounding of its f32 product, and errors do not accumulate.
#[test]
fn sums_are_within_their_resolution_of_plain_ones() {
    let blocks = blocks(0, 20);
    let mut engine = engine(&blocks);
    let (tori, quanta) = (engine.sums().tori, engine.basis.quanta);
    let grids = Arc::clone(&engine.basis.grids);
    let mut sums = [vec![Cell::default(); tori.nodes.len() * grids.weights_len()], Vec::new()];
    sums[1] = vec![Cell::default(); tori.nodes.len() * grids.right_len()];
    for visibility in
        blocks.iter().flat_map(|block| (0..block.len()).map(|k| engine.accept(block, k).unwrap()))
    {
        let (first_node, u) = grids.u.spread((visibility.place.u - grids.nodes.first) / grids.nodes.step);
        let circles = [
            (&grids.weight_alpha, &grids.weight_gamma, grids.points, grids.weight_stride(), quanta.weight),
            (&grids.data, &grids.data, grids.data_points(), grids.data_stride(), quanta.right),
        ];
        for (which, (by_alpha, by_gamma, points, stride, quantum)) in circles.into_iter().enumerate() {
            let (alpha, alphas) = Grids::kernel_at(by_alpha, points, visibility.place.alpha_rad);
            let (gamma, gammas) = Grids::kernel_at(by_gamma, points, visibility.place.gamma_rad);
            for at in 0..grid::NODES {
                let values: Vec<f64> = if which == 0 {
                    (at..grid::NODES).map(|above| visibility.weight * f64::from(u[at] * u[above])).collect()
                } else {
                    visibility.right_hand_sides().iter().map(|side| side * f64::from(u[at])).collect()
                };
                let parts = [grid::NODES, 4][which];
                let node = (first_node as usize + at) * points * parts * stride;
                for (i, part, j) in (0..by_alpha.width())
                    .flat_map(|i| (0..values.len()).flat_map(move |part| (0..16).map(move |j| (i, part, j))))
                {
                    let row = (alpha as usize + i) % points * parts + part;
                    let cell = &mut sums[which][node + row * stride + (gamma as usize + j) % points];
                    let term = values[part] * f64::from(alphas[i]) * f64::from(gammas[j]);
                    cell.sum += term;
                    // Four roundings of factors and products, and the sum read in f32.
                    cell.error_max += 0.5 * quantum + 5.0 * 6e-8 * term.abs();
                }
            }
        }
    }
    for (which, sums) in sums.iter().enumerate() {
        let (mut error, mut total, mut count) = (0.0, 0.0, 0);
        for (node, sums) in tori.nodes.iter().zip(sums.chunks_exact(sums.len() / tori.nodes.len())) {
            let Some(node) = node else {
                assert!(sums.iter().all(|cell| cell.error_max == 0.0));
                continue;
            };
            let found = if which == 0 { &node.weights } else { &node.right };
            for (found, cell) in found.iter().zip(sums) {
                let off = f64::from(*found) - cell.sum;
                assert!(off.abs() <= cell.error_max, "{found} {} {:e}", cell.sum, cell.error_max);
                error += off * off;
                total += cell.sum * cell.sum;
                count += usize::from(cell.sum != 0.0);
            }
        }
        // Rounding by 0.3 quanta is 2^-20 of a weight and 2^-14 of a standard deviation. Terms of three-dimensional kernels have
        // rms values of some 1e-2 and 1e-1, so rounding is far below the kernels' errors of 1e-4 and the noise.
        let relative = (error / total).sqrt();
        assert!(count > 50_000 && relative < [5e-5, 4e-4][which], "{count} {relative:e}");
    }
}

/// A sum in f64, and the tolerance of the exact one.
#[derive(Clone, Copy, Default)]
struct Cell {
    sum: f64,
    error_max: f64,
}

#[test]
fn additional_realisations_have_the_bits_of_their_own_engines() {
    let blocks = blocks(0, 12);
    let of_seed = |seed: u64| {
        let mut engine = HarmonicEngine::new(HarmonicSetup { companion_seed: seed, ..setup() }).unwrap();
        blocks.iter().for_each(|block| drop(engine.add(block).unwrap()));
        engine.into_sums().noise_right_hand_side().to_vec()
    };
    // Two realisations share a row; the last one has its own.
    let seeds = [7, 8, 1 << 40];
    let mut engine = HarmonicEngine::new(setup()).unwrap();
    let mut noises = NoiseSums::new(&engine, &seeds);
    for block in &blocks {
        noises.add(&engine, block);
        assert_eq!(engine.add(block).unwrap().visibilities, block.len() as u64);
    }
    let sums = engine.into_sums().with_noise_realisations(noises);
    assert_eq!(sums.noise_realisations().len(), seeds.len());
    for (seed, found) in seeds.into_iter().zip(sums.noise_realisations()) {
        let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        assert!(bits(found) == bits(&of_seed(seed)), "seed {seed}");
    }
    assert!(sums.noise_realisations()[0] == sums.noise_right_hand_side());
}
