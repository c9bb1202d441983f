//! The FITS files that commands write, judged by NASA's fitsverify.

use crate::common;

use std::path::{Path, PathBuf};
use std::process::Command;

use common::workplace::{Workplace, files, succeed};

/// A map with its errors, beams and smoothed maps.
const MISSION: &str = r#"
name = "verified"
seed = 7
[sky]
nside = 4
[spacecraft]
channels_hz = [3.0e6]
every_nth_window = 300
every_nth_integration = 2
baseline_wavelengths_max = 16.0
[map]
engine = 'pixel'
nside = 4
beams_deg = [[0.0, 90.0]]
[products]
pictures = false
smooth_fwhm_deg = 30.0
"#;

/// A minute of some windows, of long baselines.
const PATCH: [&str; 5] = [
    "spacecraft.channels_hz=[10.0e6]",
    "spacecraft.duration_s=8.0e6",
    "spacecraft.every_nth_window=121",
    "spacecraft.window_s_max=60.0",
    "spacecraft.baseline_wavelengths_max=4000.0",
];

#[test]
#[ignore = "needs fitsverify"]
fn fitsverify_finds_nothing_wrong() {
    let place = Workplace::new(MISSION);
    let path = |name: &str| place.path(&format!("out/{name}"));
    succeed(&["run", &place.pipeline, "--out", &path("run")]);
    let map = path("run/3.000MHz/map.fits");
    succeed(&["export", "alm", &map, "--out", &path("alm.fits")]);
    succeed(&["export", "hips", &map, "--out", &path("hips")]);
    succeed(&["sky", &place.pipeline, "--freq-hz", "3e6", "--out", &path("sky.fits")]);
    let table = place.file("sources.csv", b"name,ra,dec,flux_10mhz_jy\nA,270.0,66.5,60000\n");
    let mut sets: Vec<String> = PATCH.map(str::to_owned).to_vec();
    sets.push(format!("sky.points={table:?}"));
    let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", set]).collect();
    let downlink = place.simulate("pass.ccsds", &sets);
    succeed(&["zoom", &downlink, "--centre", "270,66.5", "--radius-deg", "1", "--out", &path("patch")]);

    let written: Vec<PathBuf> = files(Path::new(&place.path("out"))).into_keys().collect();
    let written: Vec<PathBuf> =
        written.into_iter().filter(|path| path.extension().is_some_and(|ending| ending == "fits")).collect();
    for name in [
        "map",
        "noise",
        "input",
        "sigma",
        "mask",
        "resolution",
        "beam-1",
        "map-smooth",
        "alm",
        "sky",
        "image",
        "residual",
    ] {
        assert!(
            written.iter().any(|path| path.file_stem() == Some(name.as_ref())),
            "no {name} in {written:?}"
        );
    }
    let judged = Command::new("fitsverify").arg("-q").args(&written).current_dir(place.path("out")).output();
    let judged = judged.expect("fitsverify is Debian's package of that name");
    let told = String::from_utf8(judged.stdout).unwrap();
    // Of warnings and errors it tells in the same line.
    let sound = told.lines().filter(|line| line.starts_with("verification OK")).count();
    assert!(judged.status.success() && sound == written.len(), "{sound} of {}: {told}", written.len());
}
