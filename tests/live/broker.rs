//! Packets by way of a message broker, which `tests/python/broker.py` drives.

use std::path::Path;

use super::common::python;
use super::*;

/// The broker's program.
fn server() -> PathBuf {
    let path = std::env::var_os("PATH").unwrap_or_default();
    // Debian puts it where only the path of root looks.
    let folders = std::env::split_paths(&path).chain([PathBuf::from("/usr/sbin")]);
    let found = folders.map(|folder| folder.join("nats-server")).find(|path| path.is_file());
    found.expect("no nats-server here; Debian has it in the package nats-server")
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON and nats-server"]
fn what_a_broker_was_told_to_forget_the_ground_holds() {
    let (python, server) = (python(), server());
    let place = Place::new();
    let file = place.downlink("packets");
    place.replay("whole.out", &file, &["--state", &place.path("whole")]);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/broker.py");
    let output = Process::new(python)
        .arg(script)
        .arg(server)
        .arg(assert_cmd::cargo::cargo_bin("lunarray"))
        .args([place.pipeline(), &file, &place.path("")])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    println!("{said}");
    // Nothing is sent again.
    let (out, state) = (place.path("resumed"), place.path("state"));
    succeed(&["replay", "--map", place.pipeline(), "--out", &out, "--state", &state]);
    assert!(place.checkpoint("state") == place.checkpoint("whole"));
    assert!(place.maps("resumed") == place.maps("whole.out"));
}
