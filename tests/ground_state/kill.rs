//! Ended by force at any moment.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use super::refined::REFINED;
use super::{ENGINES, Ground, checkpoints};

/// Kills for each engine.
fn kills() -> u32 {
    std::env::var("LUNARRAY_KILLS").map_or(10, |text| text.parse().unwrap())
}

fn start(args: &[String]) -> Child {
    let mut command = Command::new(assert_cmd::cargo::cargo_bin("lunarray"));
    command.args(args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// Starts `begin` again and again and kills it, at moments spread evenly over `length` in golden steps; `ended` is
/// told each time whether it had come to its end before. The span follows how long sessions take: one that was
/// measured on a busy machine would mostly see them end by themselves.
fn kill(kills: u32, mut length: Duration, begin: impl Fn() -> Child, mut ended: impl FnMut(bool)) {
    let mut share: f64 = 0.1;
    let mut killed = 0;
    while killed < kills {
        let mut child = begin();
        share = (share + 0.618_034) % 1.0;
        std::thread::sleep(length.mul_f64(share));
        let is_over = child.try_wait().unwrap().is_some();
        child.kill().unwrap();
        child.wait().unwrap();
        killed += u32::from(!is_over);
        length = length.mul_f64(if is_over { 0.9 } else { 1.02 });
        ended(is_over);
    }
}

#[test]
fn killed_at_any_moment_it_goes_on_to_the_same_bits() {
    for (engine, more) in ENGINES {
        let place = Ground::with(more);
        let file = place.simulate("longer.ccsds", &["--set", "spacecraft.every_nth_window=100"]);
        let every = ["--checkpoint-every", "300"];
        let since = Instant::now();
        place.replay("whole", &[&file], &every);
        let session = since.elapsed();
        let whole = place.bytes("whole");
        let args = place.session("killed", &[&file], &every);
        let mut resumed = 0;
        kill(
            kills(),
            session,
            || start(&args),
            |is_over| {
                resumed += u32::from(!checkpoints(Path::new(&place.path("killed"))).is_empty());
                if is_over {
                    // It came to its end: that has to be right too; then from the beginning.
                    assert!(place.bytes("killed") == whole, "{engine}");
                    std::fs::remove_dir_all(place.path("killed")).unwrap();
                }
            },
        );
        place.replay("killed", &[&file], &every);
        assert!(place.bytes("killed") == whole, "{engine}: {resumed} sessions with a checkpoint");
        assert!(place.maps("killed") == place.maps("whole"), "{engine}");
        eprintln!("{engine}: {} kills, none differs; {resumed} sessions left or found a checkpoint", kills());
    }
}

#[test]
fn killed_at_any_moment_it_holds_the_visibilities_of_a_refined_map() {
    let place = Ground::with(REFINED);
    let file = place.simulate("longer.ccsds", &["--set", "spacecraft.every_nth_window=100"]);
    let every = ["--checkpoint-every", "300"];
    let since = Instant::now();
    place.replay("whole", &[&file], &every);
    let session = since.elapsed();
    let args = place.session("killed", &[&file], &every);
    // What the checkpoints name depends on when they were written, so that maps are compared.
    kill(kills(), session, || start(&args), |_| ());
    place.replay("killed", &[&file], &every);
    assert!(place.maps("killed") == place.maps("whole"));
    assert_eq!(checkpoints(Path::new(&place.path("killed"))).len(), 2);
}

#[test]
fn killed_while_taking_out_it_leaves_the_old_state_or_the_new_one() {
    let place = Ground::new();
    let file = place.downlink();
    place.replay("whole", &[&file], &[]);
    let packets = super::packets(&file);
    let part = place.file("part", &packets[packets.len() / 2..].concat());
    let copy = |name: &str| {
        let (from, to) = (place.path("whole"), place.path(name));
        let _ = std::fs::remove_dir_all(&to);
        std::fs::create_dir(&to).unwrap();
        for path in checkpoints(Path::new(&from)) {
            std::fs::copy(&path, Path::new(&to).join(path.file_name().unwrap())).unwrap();
        }
    };
    let args = |state: &str| -> Vec<String> {
        let args = ["retract", &part, "--state", &place.path(state), "--map", &place.pipeline];
        args.map(str::to_owned).to_vec()
    };
    copy("without");
    let since = Instant::now();
    assert!(start(&args("without")).wait().unwrap().success());
    let length = since.elapsed();
    let (old, new) = (place.bytes("whole"), place.bytes("without"));
    assert!(old != new);
    copy("killed");
    let (mut olds, mut news) = (0, 0);
    // Twice as long as it took: with other work on the machine it takes longer.
    kill(
        kills(),
        2 * length,
        || start(&args("killed")),
        |_| {
            let found = place.bytes("killed");
            assert!(found == old || found == new);
            olds += u32::from(found == old);
            news += u32::from(found == new);
            copy("killed");
        },
    );
    eprintln!("{olds} left the old state, {news} the new one");
}

/// Gains of eight daughters that are near one and change between two times; errors of their positions with `position_m`.
fn gains(seed: u32, position_m: f64) -> String {
    let mut state = seed;
    // Any numbers will do: a linear congruence.
    let mut draw = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(state >> 8) / f64::from(1_u32 << 24) - 0.5
    };
    let mut solution = |time_s: f64| {
        let gains: Vec<[f64; 2]> = (0..8).map(|_| [1.0 + 0.2 * draw(), 0.4 * draw()]).collect();
        serde_json::json!({ "time_s": time_s, "gains": gains })
    };
    let mut channel = |frequency_hz: f64| serde_json::json!({ "frequency_hz": frequency_hz, "solutions": [solution(0.0), solution(4e7)] });
    let channels = [channel(3e6), channel(10e6)];
    let offsets: Vec<[f64; 3]> = (0..8).map(|n| [position_m * f64::from(n), 0.0, 0.0]).collect();
    let positions = serde_json::json!([{
        "from_s": 0.0, "until_s": 4e7, "normals_hat": vec![[0.0, 0.0, 1.0]; 8], "offsets_m": offsets
    }]);
    serde_json::json!({ "channels": channels, "positions": positions }).to_string()
}

#[test]
fn killed_while_gains_are_replaced_it_leaves_the_old_state_or_the_new_one() {
    for (engine, more) in ENGINES {
        let place = Ground::with(more);
        let file = place.downlink();
        // Offsets along the track alone keep daughters on their circle.
        let [old_gains, new_gains] = [("old.json", 1, 0.0), ("new.json", 2, 0.5)]
            .map(|(name, seed, position_m)| place.file(name, gains(seed, position_m).as_bytes()));
        place.replay("whole", &[&file], &["--calibration", &old_gains]);
        let copy = |name: &str| {
            let (from, to) = (place.path("whole"), place.path(name));
            let _ = std::fs::remove_dir_all(&to);
            std::fs::create_dir(&to).unwrap();
            for path in checkpoints(Path::new(&from)) {
                std::fs::copy(&path, Path::new(&to).join(path.file_name().unwrap())).unwrap();
            }
        };
        let args = |state: &str| -> Vec<String> {
            let state = place.path(state);
            let args = ["recalibrate", &file, "--state", &state, "--map", &place.pipeline];
            let gains = ["--old-calibration", &old_gains, "--calibration", &new_gains];
            args.into_iter().chain(gains).map(str::to_owned).collect()
        };
        copy("recalibrated");
        let since = Instant::now();
        assert!(start(&args("recalibrated")).wait().unwrap().success());
        let length = since.elapsed();
        let (old, new) = (place.bytes("whole"), place.bytes("recalibrated"));
        assert!(old != new, "{engine}");
        copy("killed");
        let (mut olds, mut news) = (0, 0);
        kill(
            kills(),
            length,
            || start(&args("killed")),
            |_| {
                let found = place.bytes("killed");
                assert!(found == old || found == new, "{engine}");
                let is_old = found == old;
                // The same command again: from the old state to every bit of the new one; the new one is of other gains than
                // the command says, and stays.
                assert_eq!(start(&args("killed")).wait().unwrap().success(), is_old, "{engine}");
                assert!(place.bytes("killed") == new, "{engine}");
                (olds, news) = (olds + u32::from(is_old), news + u32::from(!is_old));
                copy("killed");
            },
        );
        // The sums are those of a new state with the new gains.
        place.replay("fresh", &[&file], &["--calibration", &new_gains]);
        place.replay("killed", &[&file], &["--calibration", &old_gains]);
        assert!(start(&args("killed")).wait().unwrap().success(), "{engine}");
        place.replay("killed", &[&file], &["--calibration", &new_gains]);
        assert!(place.maps("killed") == place.maps("fresh"), "{engine}");
        eprintln!("{engine}: {olds} left the old state, {news} the new one");
    }
}
