//! What arrives in another order, and what is not all there yet.

use rand::seq::SliceRandom;

use super::*;
use crate::units::Pair;

/// A block in parts of some visibilities, as packets have them.
fn parts(block: &PlacedVisibilities, visibilities: usize) -> Vec<PlacedVisibilities> {
    let part = |from: usize| {
        let mut part = block.without_visibilities();
        (from..block.len().min(from + visibilities)).for_each(|k| part.push_from(block, k));
        part
    };
    (0..block.len()).step_by(visibilities).map(part).collect()
}

#[test]
fn a_burst_does_not_depend_on_the_order_of_arrival() {
    let array = array();
    let n_hat = direction(123.0, 31.0);
    let from_s = seen_from_s(&array, n_hat);
    let mut stream = ChaCha8Rng::seed_from_u64(17);
    let blocks = pass_of_burst(&array, &mut stream, from_s, (n_hat, 60.0 * STEADY_K_SR), true);
    let of_five = blocks.iter().filter(|block| block.pair.j < 5);
    let mut packets: Vec<PlacedVisibilities> = of_five.flat_map(|block| parts(block, 7)).collect();
    let in_order = found(&packets);
    assert!(in_order.len() == 1 && in_order[0].light_curve.is_some(), "{in_order:?}");
    for _ in 0..2 {
        packets.shuffle(&mut stream);
        assert_eq!(found(&packets), in_order);
    }
}

/// Blocks without what comes after some visibilities of each pair.
fn so_far(blocks: &[PlacedVisibilities], visibilities: impl Fn(Pair) -> usize) -> Vec<PlacedVisibilities> {
    let cut = |block: &PlacedVisibilities| parts(block, visibilities(block.pair)).swap_remove(0);
    blocks.iter().map(cut).collect()
}

fn alerts(blocks: &[PlacedVisibilities]) -> Vec<BurstAlert> {
    find_alerts(&blocks.iter().collect::<Vec<_>>())
}

#[test]
fn alerts_wait_for_most_pairs() {
    let array = array();
    let n_hat = direction(10.0, 50.0);
    let from_s = seen_from_s(&array, n_hat);
    let k_sr = |t_s: f64| if (1000.0..1060.0).contains(&(t_s - from_s)) { 6.0 * STEADY_K_SR } else { 0.0 };
    let blocks = pass(&array, 300, from_s, n_hat, k_sr);
    // Integrations 100 to 105 have the burst. Of 28 pairs, 7 have the first daughter, 13 one of the first two, 18 of the first three, 22 of the
    // first four: more than three quarters.
    for (daughters, expected) in [(1, 0), (2, 0), (3, 0), (4, 1)] {
        let sent = so_far(&blocks, |pair| if pair.i < daughters { 106 } else { 98 });
        assert_eq!(alerts(&sent).len(), expected, "{daughters}");
    }
    // Two of five daughters have died, with 7 of 10 pairs, and three pairs are too few for visibilities; one, with 4, leaves 6 of 10.
    for (alive, sent, expected) in [(3, 300, 0), (4, 110, 0), (4, 150, 0), (4, 180, 1)] {
        let mut blocks = so_far(&blocks, |pair| if pair.j < alive { sent } else { 90 });
        blocks.retain(|block| block.pair.j < 5);
        assert_eq!(alerts(&blocks).len(), expected, "{alive} {sent}");
    }
}

#[test]
fn what_always_looks_like_bursts_has_few_alerts_and_directions() {
    let array = array();
    let n_hat = direction(10.0, 50.0);
    let from_s = seen_from_s(&array, n_hat);
    // 30 bursts of 10 s, the last 16 of which are twice as bright; a bin has two visibilities.
    let k_sr = |t_s: f64| match t_s - from_s {
        after_s if after_s % 100.0 != 50.0 => 0.0,
        after_s if after_s < 1400.0 => 10.0 * STEADY_K_SR,
        _ => 20.0 * STEADY_K_SR,
    };
    let mut blocks = pass(&array, 400, from_s, n_hat, k_sr);
    blocks.retain(|block| block.pair.j < 5);
    let search = BurstSearch { choice: BurstChoice::Flag, ..SEARCH };
    let found = find_bursts(search, &blocks.iter().collect::<Vec<_>>()).bursts;
    assert_eq!(found.len(), 30);
    for (index, burst) in found.iter().enumerate() {
        assert_eq!(!burst.positions_deg.is_empty(), index >= 14, "{burst}");
        // What is not known is not 0.
        let json = serde_json::to_value(burst).unwrap();
        for key in ["flux_jy", "flux_sigma_jy", "significance"] {
            assert_eq!(json[key].is_null(), index < 14, "{key} {json}");
        }
        assert_eq!(burst.to_string().contains("of unknown flux"), index < 14, "{burst}");
    }
    let bursts = FoundBursts::new(BurstChoice::Flag);
    found.into_iter().for_each(|burst| assert!(bursts.add(burst)));
    let summary = BurstSummary::new(BurstChoice::Flag, bursts.list(), Vec::new()).unwrap();
    assert_eq!((summary.found, summary.channels[0].without_direction), (30, 14));
    assert!(summary.to_string().contains("14 without direction"), "{summary}");
    // Looks at the open pass.
    let (bursts, mut of_pass) = (FoundBursts::new(BurstChoice::Flag), PassAlerts::default());
    for sent in [40, 80, 160, 300, 300] {
        bursts.alert(&mut of_pass, alerts(&so_far(&blocks, |_| sent)));
    }
    assert_eq!((bursts.alerts(), bursts.untold_alerts()), (8, 22));
    let are_last: Vec<bool> = bursts.alerts_since(0).iter().map(|alert| alert.is_last).collect();
    assert_eq!(are_last, [false, false, false, false, false, false, false, true]);
    assert!(bursts.alerts_since(7)[0].to_string().ends_with("only counted until it ends"));
}

#[test]
fn a_flux_that_no_visibility_sees_is_not_determined() {
    let block = |z_m: f64| PlacedVisibilities {
        frequency_hz: FREQUENCY_HZ,
        time_s: vec![5.0],
        duration_s: vec![2.0],
        r_i_m: vec![[0.0, 0.0, z_m]],
        r_j_m: vec![[0.0, 10.0, z_m]],
        value_k_sr: vec![Complex64::new(1e5, 0.0)],
        weight: vec![1e-6],
        ..PlacedVisibilities::default()
    };
    let place = place([0.0, 0.0, 1.0], 1_737_100.0);
    for (z_m, is_seen) in [(2e6, true), (-2e6, false)] {
        let block = block(z_m);
        let row = BurstRow { block: &block, k: 0, steady_k2_sr2: 1e6 };
        assert_eq!(Flux::fit(&[row], place, [0.0, 10.0]).is_some(), is_seen);
    }
}
