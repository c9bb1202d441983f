//! Runs of the whole chain in sample fidelity.

use lunarray::array::ArrayConfig;
use lunarray::sky::fits::{ReadOptions, read_map};
use lunarray::units::vector::unit;

use crate::craft::{Spacecraft, frequencies, point};

#[test]
fn the_same_seed_gives_the_same_samples_with_any_number_of_threads() {
    let sky = point(unit([1.0, 2.0, 3.0]));
    let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies(5), sky, 6.0);
    craft.receiver_noise_k_sr = 1.0;
    craft.daughters.bits = 4;
    let with = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| craft.run(seed))
    };
    let first = with(1, 7);
    assert_eq!(first, with(3, 7));
    assert_ne!(first, with(1, 8));
}

/// Runs the whole chain with a name and settings; returns map and noise-only map.
fn mapped(folder: &std::path::Path, name: &str, more: &[&str]) -> (Vec<f64>, Vec<f64>) {
    // With rows at pixel centres and a sky summed over the same centres the map is complete. Structure between the map's
    // pixels would enter the map depending on the (u, v) points, and so differ for reasons other than noise.
    const PIPELINE: &str = r#"
        name = "small"
        seed = 3
        sky.nside = 8
        [spacecraft]
        channels_hz = [1.0e6]
        duration_s = 4.1e7
        every_nth_window = 100
        window_s_max = 30.0
        flag_earth = false # the last daughters see the Earth for 64 s of a window
        baseline_wavelengths_max = 24.0
        [map]
        engine = 'pixel'
        nside = 8
        rows = "centre"
        epsilon = 1e-3
        [products]
        pictures = false
    "#;
    let pipeline = folder.join("small.toml");
    std::fs::write(&pipeline, PIPELINE).unwrap();
    let out = folder.join(name);
    let done = assert_cmd::Command::cargo_bin("lunarray")
        .unwrap()
        .args(["run", pipeline.to_str().unwrap(), "--out", out.to_str().unwrap()])
        .args(more.iter().flat_map(|set| ["--set", set]))
        .output()
        .unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let mut maps = [Vec::new(), Vec::new()];
    for (map, name) in maps.iter_mut().zip(["map.fits", "noise.fits"]) {
        let path = out.join("1.000MHz").join(name);
        *map = read_map(&path, &ReadOptions::default()).unwrap().values().to_vec();
    }
    let [map, noise] = maps;
    (map, noise)
}

fn rms(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    (values.map(|x| x * x).sum::<f64>() / count).sqrt()
}

#[test]
fn a_map_of_samples_is_the_map_of_visibilities_within_its_noise() {
    let folder = tempfile::tempdir().unwrap();
    let (visibilities, noise) = mapped(folder.path(), "visibilities", &[]);
    let sky = rms(visibilities.iter().copied());
    let noise = rms(noise.iter().copied());
    assert!(sky > 5.0 * noise, "{sky} {noise}");
    let samples = "spacecraft.fidelity=samples";
    for (bands, more) in
        [(1, &[samples][..]), (4, &[samples, "spacecraft.sub_bands=4", "calibration.sub_bands=4"][..])]
    {
        let (samples, own) = mapped(folder.path(), &format!("samples-{bands}"), more);
        let own = rms(own.iter().copied());
        let difference = rms(samples.iter().zip(&visibilities).map(|(a, b)| a - b));
        eprintln!(
            "{bands} sub-bands: noise {noise:.3e} and {own:.3e}, difference {difference:.3e}, sky {sky:.3e} K"
        );
        // Noise of both maps, with some 100 degrees of freedom after regularisation: 7 % of an rms. In addition, motion
        // within integrations and the channel's width cost up to 3 % of visibilities of 20 times their noise.
        let ratio = difference / (2.0_f64.sqrt() * noise);
        assert!((0.75..1.35).contains(&ratio), "{bands}: {ratio}");
        // The ground draws independent noise for each sub-band: as large as for whole channels, within 3 times 10 %, from
        // 7 % of each. Common noise would be twice as large where integrations are in step.
        assert!((0.7..1.3).contains(&(own / noise)), "{bands}: {own} {noise}");
    }
}

#[test]
fn the_harmonic_model_is_refused_for_samples_with_a_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let pipeline = folder.path().join("samples.toml");
    std::fs::write(&pipeline, "name = \"refused\"\n[spacecraft]\nfidelity = \"samples\"\n").unwrap();
    for (set, refused) in [
        ("spacecraft.model=harmonic", true),
        ("spacecraft.smear_integrations=true", true),
        ("spacecraft.smear_bandwidth=true", true),
        ("spacecraft.model=direct", false),
        ("spacecraft.model=auto", false),
    ] {
        let mut command = assert_cmd::Command::cargo_bin("lunarray").unwrap();
        let short = ["--set", "spacecraft.duration_s=1e4", "--set", "sky.nside=4", "--set", "map.nside=16"];
        command.args(["check", pipeline.to_str().unwrap(), "--set", set]).args(short);
        let done = command.output().unwrap();
        let said = String::from_utf8_lossy(&done.stderr).replace('\n', " ");
        assert_eq!(done.status.success(), !refused, "{set}: {said}");
        let message = "spacecraft.fidelity = \"samples\": expected spacecraft.model = \"auto\" or \"direct\", and \
                       spacecraft.smear_integrations = false";
        assert_eq!(said.contains(message), refused, "{set}: {said}");
    }
}
