//! Arrays of which only few pairs see signal: what a dead daughter and what a jump that goes back look like there.

use super::*;

/// Passes in which only these pairs of a channel see the sky; those of a dead daughter 2 would see it five times as strong.
fn solved_with_few_pairs(seed: u64, pairs: [&[(u8, u8)]; 3]) -> PassSolution {
    let gains = gains(seed);
    let gain = |c: usize, n: usize, _: f64| if n == 1 { Complex64::ZERO } else { gains[c][n] };
    let pass = plain(seed, &gain);
    let mut blocks = pass.blocks();
    blocks.retain(|block| pairs[block.channel].contains(&(block.pair.i, block.pair.j)));
    for block in blocks.iter_mut().filter(|block| [block.pair.i, block.pair.j].contains(&1)) {
        block.model.iter_mut().for_each(|terms| terms[0] *= 5.0);
    }
    let mut solutions = pass.solve_blocks(seed, &SolverConfig::default(), &mut blocks);
    assert_eq!(solutions.len(), 1);
    solutions.remove(0)
}

#[test]
fn a_dead_daughter_of_few_pairs_is_told_and_costs_the_others_nothing() {
    let low: [&[(u8, u8)]; 2] = [&[(0, 1), (0, 2), (1, 2)], &[(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]];
    let middle: [&[(u8, u8)]; 2] = [&[(0, 1)], &[(0, 1), (1, 2)]];
    for seed in first_seed()..first_seed() + PASSES {
        let k = (seed % 4) as usize;
        let solution = solved_with_few_pairs(seed, [low[k % 2], middle[k / 2], &[]]);
        assert!(solution.converged && solution.chi_square.is_finite(), "{seed}: {solution:?}");
        for (n, daughter) in solution.daughters.iter().enumerate() {
            let states: Vec<GainState> = daughter.gains.iter().map(|gain| gain.state).collect();
            if n == 1 {
                assert_eq!(states[..2], [GainState::Dead; 2], "{seed}");
            } else {
                // Pairs with a dead daughter say nothing of the other; one pair or two hardly tell amplitudes.
                let allowed = [GainState::Good, GainState::Uncertain, GainState::Unstable, GainState::NoData];
                assert!(states.iter().all(|state| allowed.contains(state)), "{seed} {n}: {states:?}");
                assert!(states[1] != GainState::Good, "{seed} {n}: {states:?}");
            }
        }
        let events = instrument_events(&[solution]);
        let dead = InstrumentEvent::Dead { pass: seed, daughter: 2, channels: vec![0, 1] };
        assert!(events.contains(&dead), "{seed}: {events:?}");
        let others = events.iter().filter(|event| !matches!(event, InstrumentEvent::Dead { .. }));
        let is_of_gains = |event: &InstrumentEvent| {
            matches!(event, InstrumentEvent::Drift { .. } | InstrumentEvent::GainDrift { .. })
        };
        assert!(others.clone().all(is_of_gains) && others.count() <= 1, "{seed}: {events:?}");
    }
}

#[test]
fn a_jump_that_goes_back_at_the_next_pass_is_told() {
    // Four passes; the phase of daughter 3 is turned by 60 deg from the middle of the second to its end.
    for seed in 0..PASSES / 6 {
        let gains = gains(seed);
        let solutions: Vec<PassSolution> = (0..4)
            .flat_map(|number| {
                let gain = |c: usize, n: usize, t_s: f64| {
                    let is_turned = number == 1 && n == 2 && t_s > 1400.0;
                    gains[c][n] * Complex64::cis(if is_turned { 60_f64.to_radians() } else { 0.0 })
                };
                plain(first_seed() + 10 * seed + number, &gain).solve(number, &SolverConfig::default())
            })
            .collect();
        assert_eq!(solutions.len(), 5, "{seed}");
        let events = instrument_events(&solutions);
        let told = events.iter().find_map(|event| match event {
            InstrumentEvent::PhaseStep { pass: 1, between_s, daughter: 3, channels } => {
                Some((between_s, channels))
            }
            _ => None,
        });
        let Some((between_s, channels)) = told else { panic!("{seed}: {events:?}") };
        // Integrations are 45 s apart.
        assert!((between_s[0] - 1400.0).abs() < 45.0 && between_s[1] == between_s[0], "{seed}: {events:?}");
        assert_eq!(channels.iter().map(|(channel, ..)| *channel).collect::<Vec<_>>(), [0, 1, 2], "{seed}");
        for (_, deg, sigma_deg) in channels {
            // Of 30 to 90 numbers one in 15,000 is off by four deviations; both parts have a tenth of the sky's phase error at most.
            assert!((deg - 60.0).abs() < 4.0 * sigma_deg && *sigma_deg < 6.0, "{seed}: {events:?}");
        }
    }
}
