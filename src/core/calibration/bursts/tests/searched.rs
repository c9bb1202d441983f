//! Passes that are searched, and those that are not.

use super::*;
use crate::units::Pair;

/// Passes of two channels, with a bright burst in both; the second has some pairs only.
fn channels(seed: u64, pairs: &[Pair]) -> [Vec<PlacedVisibilities>; 2] {
    let array = array();
    let n_hat = direction(123.0, 31.0);
    let from_s = seen_from_s(&array, n_hat);
    let k_sr = |t_s: f64| if (1000.0..1060.0).contains(&(t_s - from_s)) { 1e7 } else { 0.0 };
    let mut few = pass(&array, seed, from_s, n_hat, k_sr);
    few.retain(|block| pairs.contains(&block.pair));
    few.iter_mut().for_each(|block| block.channel = ChannelId(1));
    [pass(&array, seed + 1, from_s, n_hat, k_sr), few]
}

/// Counts passes: of each channel its number, those not searched, and those of them beside a burst.
fn counts(channels: &[Vec<PlacedVisibilities>]) -> (usize, Vec<[u64; 3]>) {
    let mut counts = PassCounts::default();
    let search = BurstSearch { choice: BurstChoice::Keep, ..SEARCH };
    let bursts = find_events(search, channels, &mut counts).iter().map(|event| event.bursts.len()).sum();
    let numbers = |of: &SearchedPasses| [of.passes, of.not_searched, of.not_searched_beside_burst];
    (bursts, counts.list().iter().map(numbers).collect())
}

#[test]
fn passes_of_few_pairs_are_counted_as_not_searched() {
    // The weights are constant, so that they tell no powers: a search takes six pairs.
    for (pairs, bursts, expected) in [(6, 2, [1, 0, 0]), (5, 1, [1, 1, 1]), (1, 1, [1, 1, 1])] {
        let channels = channels(1, &all_pairs(8)[..pairs]);
        assert_eq!(counts(&channels), (bursts, vec![[1, 0, 0], expected]), "{pairs}");
    }
    // Alone it is not beside a burst, and a channel without visibilities has no pass.
    let [_, few] = channels(1, &all_pairs(8)[..5]);
    assert_eq!(counts(&[few, Vec::new()]), (0, vec![[1, 1, 0]]));
}

#[test]
fn a_pass_of_few_pairs_for_most_of_its_time_is_not_searched() {
    // A sixth pair for a third and for two thirds of the pass: of 6 x 300 visibilities less a part, those at times of all six.
    for (kept, not_searched) in [(100, 1), (200, 0)] {
        let [_, mut few] = channels(1, &all_pairs(8)[..6]);
        let last = few.last_mut().unwrap();
        let mut shorter = last.without_visibilities();
        (0..kept).for_each(|k| shorter.push_from(last, k));
        *last = shorter;
        assert_eq!(counts(&[few]).1, [[1, not_searched, 0]], "{kept}");
    }
}

#[test]
fn a_summary_tells_what_was_not_searched() {
    let counted = |frequency_hz, not_searched, not_searched_beside_burst| SearchedPasses {
        channel: 0,
        frequency_hz,
        passes: 30,
        not_searched,
        not_searched_beside_burst,
    };
    let text = |passes| BurstSummary::new(BurstChoice::Flag, Vec::new(), vec![passes]).unwrap().to_string();
    let told = text(counted(1e7, 16, 3));
    assert!(told.contains("16 of 30 passes were not searched for bursts"), "{told}");
    assert!(told.contains("in 3 of them another channel has one"), "{told}");
    assert!(
        told.contains("fewer than 6 pairs") && told.contains("spacecraft.baseline_wavelengths_max"),
        "{told}"
    );
    assert_eq!(text(counted(1e7, 0, 0)), "none found");
}

#[test]
fn a_table_goes_on_with_the_passes_of_earlier_sessions() {
    let [_, few] = channels(1, &all_pairs(8)[..5]);
    let pass = [find_bursts(SEARCH, &few.iter().collect::<Vec<_>>())];
    let [first, second] = [FoundBursts::new(BurstChoice::Flag), FoundBursts::new(BurstChoice::Flag)];
    first.add_pass(&pass);
    second.resume(first.list(), first.searched());
    second.add_pass(&pass);
    let [of_both] = &second.searched()[..] else { panic!() };
    assert_eq!((of_both.passes, of_both.not_searched), (2, 2));
}
