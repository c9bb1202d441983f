//! Runs of the whole chain in sample fidelity.

use lunarray::array::ArrayConfig;
use lunarray::sky::fits::{ReadOptions, read_map};
use lunarray::units::vector::unit;

use crate::craft::{Spacecraft, frequencies, point};

#[test]
fn the_same_seed_gives_the_same_samples_whatever_the_threads() {
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

/// A run of the whole chain in one of the fidelities: map, noise-only map.
fn mapped(folder: &std::path::Path, fidelity: &str, more: &[&str]) -> (Vec<f64>, Vec<f64>) {
    const PIPELINE: &str = r#"
        name = "small"
        seed = 3
        sky.nside = 8
        [spacecraft]
        channels_hz = [1.0e6]
        duration_s = 4.1e7
        every_nth_window = 100
        window_s_max = 30.0
        baseline_wavelengths_max = 24.0
        [map]
        nside = 8
        epsilon = 1e-3
        [products]
        pictures = false
    "#;
    let pipeline = folder.join("small.toml");
    std::fs::write(&pipeline, PIPELINE).unwrap();
    let out = folder.join(fidelity);
    let fidelity = format!("spacecraft.fidelity={fidelity}");
    let done = assert_cmd::Command::cargo_bin("lunarray")
        .unwrap()
        .args(["run", pipeline.to_str().unwrap(), "--out", out.to_str().unwrap(), "--set", &fidelity])
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
    let (samples, _) = mapped(folder.path(), "samples", &[]);
    let noise = rms(noise.iter().copied());
    let difference = rms(samples.iter().zip(&visibilities).map(|(a, b)| a - b));
    let sky = rms(visibilities.iter().copied());
    eprintln!("noise {noise:.3e}, difference {difference:.3e}, sky {sky:.3e} K rms");
    // Two independent noises; 768 pixels, of which a regularised map has fewer degrees of freedom.
    let ratio = difference / (2.0_f64.sqrt() * noise);
    assert!((0.7..1.4).contains(&ratio), "{ratio}");
    assert!(sky > 5.0 * noise, "{sky} {noise}");
}
