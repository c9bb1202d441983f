//! Light curves of events, and their errors.

use super::*;

/// Errors of the values of light curves in standard errors, and the true flux of each in units of the peak.
fn errors_of_curves(arcs_m: &[f64], seeds: std::ops::Range<u64>) -> Vec<[f64; 2]> {
    let arcs_m = arcs_m.to_vec();
    let array = Array::new(&crate::array::ArrayConfig { arcs_m, ..Default::default() }).unwrap();
    let search = BurstSearch { choice: BurstChoice::Keep, ..SEARCH };
    let mut errors = Vec::new();
    for seed in seeds {
        let mut stream = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
        let n_hat = unit([normal(), normal(), normal()]);
        // From 5 to 800 times the steady sky.
        let peak_k_sr = 60.0 * STEADY_K_SR * (0.8 * normal().clamp(-3.0, 3.0)).exp();
        let from_s = seen_from_s(&array, n_hat);
        let blocks = pass_of_burst(&array, &mut stream, from_s, (n_hat, peak_k_sr), seed % 2 == 0);
        let [event] = &find_events(search, &[blocks], &mut PassCounts::default())[..] else {
            panic!("{seed}")
        };
        let [curve] = &event.curves[..] else { panic!("{seed}") };
        assert!(curve.is_found && event.bursts.len() == 1);
        // The margins on both sides, but less than a value at the end.
        let ends = curve.points.first().zip(curve.points.last()).unwrap();
        assert!(ends.0.from_s == event.from_s && ends.0.from_s <= event.bursts[0].from_s - 30.0);
        assert!(ends.1.until_s > event.until_s - 30.0 && ends.1.until_s <= event.until_s);
        errors.extend(curve.points.iter().map(|point| {
            let truth = mean_of_burst([point.from_s, point.until_s].map(|t_s| t_s - from_s - 400.0));
            let off_jy = point.flux_jy - truth * peak_k_sr / k_sr_per_jy(FREQUENCY_HZ);
            [off_jy.abs() / point.sigma_jy, truth]
        }));
    }
    errors
}

fn share(errors: &[[f64; 2]], sigma: f64) -> f64 {
    errors.iter().filter(|[error, _]| *error < sigma).count() as f64 / errors.len() as f64
}

#[test]
fn errors_of_light_curves_hold() {
    let errors = errors_of_curves(&[30.0, 100.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0], 0..6);
    // Neighbours share integrations, and the values of a burst its direction: as if 200 in all were independent, standard deviations of 0.033
    // and 0.015, of which three. Errors of half or twice the scatter would have 0.38 and 0.67, or 0.95 and 1.
    let [one, two] = [1.0, 1.96].map(|sigma| share(&errors, sigma));
    assert!(
        errors.len() > 300 && (one - 0.683).abs() < 0.1 && two > 0.905,
        "{one} {two} of {}",
        errors.len()
    );
}

#[test]
fn bursts_that_overlap_in_any_channel_are_one_event() {
    let array = array();
    let n_hat = direction(123.0, 31.0);
    let from_s = seen_from_s(&array, n_hat);
    let lit = |from: f64, until: f64| {
        move |t_s: f64| if (from..until).contains(&(t_s - from_s)) { 1e6 } else { 0.0 }
    };
    // The third channel is quiet; the second burst of the first is apart.
    let spans = [[(1000.0, 1060.0), (2000.0, 2060.0)], [(1050.0, 1110.0); 2], [(0.0, 0.0); 2]];
    let channels = (0..3_u16).zip(spans).map(|(channel, [first, second])| {
        let k_sr = |t_s| f64::max(lit(first.0, first.1)(t_s), lit(second.0, second.1)(t_s));
        let mut blocks = pass(&array, u64::from(channel), from_s, n_hat, k_sr);
        for block in &mut blocks {
            (block.channel, block.frequency_hz) = (ChannelId(channel), FREQUENCY_HZ);
        }
        blocks
    });
    let events = find_events(SEARCH, &channels.collect::<Vec<_>>(), &mut PassCounts::default());
    let bursts: Vec<Vec<u16>> =
        events.iter().map(|event| event.bursts.iter().map(|burst| burst.channel).collect()).collect();
    assert_eq!(bursts, [vec![0, 1], vec![0]]);
    for (event, found) in events.iter().zip([[true, true, false], [true, false, false]]) {
        assert_eq!(event.curves.iter().map(|curve| curve.is_found).collect::<Vec<_>>(), found);
        let quiet = &event.curves[2].points;
        let beyond = quiet.iter().filter(|point| point.flux_jy.abs() > 4.0 * point.sigma_jy).count();
        assert!(!quiet.is_empty() && beyond == 0, "{quiet:?}");
    }
    assert!(find_events(SEARCH, &[], &mut PassCounts::default()).is_empty());
}

#[test]
#[ignore = "a table"]
#[allow(clippy::print_stdout)] // It prints what it measured.
fn long_the_table_of_errors_of_light_curves() {
    let errors = errors_of_curves(&[30.0, 100.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0], 1000..1060);
    let kinds = [("bright", [0.1, 1.1]), ("faint", [1e-3, 0.1]), ("quiet", [-1.0, 1e-3])];
    for (kind, [least, most]) in kinds {
        let of_kind = |[_, truth]: &[f64; 2]| (least..most).contains(truth);
        let of_kind: Vec<[f64; 2]> = errors.iter().copied().filter(of_kind).collect();
        let [one, two] = [1.0, 1.96].map(|sigma| share(&of_kind, sigma));
        println!("{kind}: {one:.3} of {} within 1, {two:.3} within 1.96", of_kind.len());
        assert!(one > 0.6 && two > 0.9, "{kind} {one} {two}");
    }
}
