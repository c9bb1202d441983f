//! The shipped alerts, in a real Prometheus, which `tests/python/alerts.py` drives.

use std::path::Path;

use super::common::python;
use super::*;

#[test]
#[ignore = "needs LUNARRAY_PYTHON and LUNARRAY_PROMETHEUS"]
fn every_alert_that_can_be_caused_fires_and_clears() {
    let prometheus = std::env::var_os("LUNARRAY_PROMETHEUS")
        .expect("LUNARRAY_PROMETHEUS names no program; Debian has it in the package prometheus");
    let place = Place::new();
    let file = place.downlink("packets");
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Process::new(python())
        .arg(root.join("tests/python/alerts.py"))
        .arg(prometheus)
        .arg(assert_cmd::cargo::cargo_bin("lunarray"))
        .args([place.pipeline(), &file])
        .arg(root.join("docs/deploy/alerts.yml"))
        .arg(place.path("alerts"))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    println!("{said}");
}
