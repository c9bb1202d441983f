//! What is missing, and a state that is refused.

use super::common::workplace::{json, succeed};
use super::{Ground, leave_out};
use serde_json::Value;

fn total(gaps: &Value, key: &str) -> f64 {
    gaps["channels"].as_array().unwrap().iter().map(|channel| channel[key].as_f64().unwrap()).sum()
}

#[test]
fn gaps_are_told_in_packets_and_in_integration_time() {
    let place = Ground::new();
    let file = place.downlink();
    assert_eq!(json(&["gaps", &file])["gaps"].as_array().unwrap().len(), 0);
    let bad = place.path("bad.ccsds");
    std::fs::write(&bad, leave_out(&file, 21..40)).unwrap();
    let found = json(&["gaps", &bad]);
    assert_eq!(found["gaps"].as_array().unwrap().len(), 1);
    let gap = &found["gaps"][0];
    assert_eq!([&gap["apid"], &gap["from"], &gap["to"]], [0x103, 21, 39]);
    // What is received and what is missing are together what was sent, as well as passes resemble each other: the
    // formation breathes, and with it the number of integrations short enough for a baseline.
    let sent = total(&json(&["gaps", &file]), "integration_s");
    let (received, missing) = (total(&found, "integration_s"), total(&found, "missing_integration_s"));
    let lost = sent - received;
    assert!(lost > 0.1 * sent && (missing / lost - 1.0).abs() < 0.3, "{missing} s told, {lost} s lost");

    // A state tells the same, and nothing once the packets have come.
    place.replay("state", &[&bad], &[]);
    assert_eq!(place.gaps("state"), found);
    let picture = place.path("coverage.png");
    let table = succeed(&["gaps", &place.path("state"), "--picture", &picture]);
    assert!(table.contains("0x103"), "{table}");
    assert!(std::fs::read(&picture).unwrap().starts_with(b"\x89PNG"));
    let whole = place.replay("state", &[&file], &[]);
    assert_eq!(place.gaps("state")["gaps"].as_array().unwrap().len(), 0);
    let once = place.replay("once", &[&file], &[]);
    assert_eq!(whole["ledger"], once["ledger"]);
}

#[test]
fn a_state_of_other_settings_is_refused() {
    let place = Ground::new();
    let file = place.downlink();
    place.replay("state", &[&file], &[]);
    // What is made of the sums may change: no file is needed.
    place.replay("state", &[], &["--set", "map.epsilon=1e-3"]);
    let output = place.output("state", &[&file], &["--set", "map.nside=8"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success());
    assert!(said.contains("map.nside = 4") && said.contains("expected 8"), "{said}");
}
