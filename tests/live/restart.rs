//! A ground that was started again, and one that fails, tell the truth at once.

use super::common::process::{end, wait_until};
use super::serving::Served;
use super::*;

impl Place {
    /// A ground that listens, keeps a state and serves.
    fn served(&self, more: &[&str]) -> Served {
        let (out, state) = (self.path("out"), self.path("state"));
        let fixed = ["replay", "--listen", "tcp://127.0.0.1:0", "--map", self.pipeline(), "--out", &out];
        Served::start(&[&fixed[..], &["--state", &state], more].concat())
    }
}

#[test]
fn a_ground_that_is_started_again_shows_what_its_state_holds() {
    let place = Place::new();
    let bytes = std::fs::read(place.downlink("packets")).unwrap();
    let served = place.served(&[]);
    // Before anything came, what is not known is null, and no number is below nothing.
    assert!(served.json("/api/status")["ledger"]["sampled"].is_null());
    finish(TcpStream::connect(served.listening()).unwrap(), &bytes);
    wait_until("the sums", || served.json("/api/status")["saving"]["written"] == 1);
    let before = served.json("/api/status");
    let passes = served.json("/api/passes");
    assert!(before["ledger"]["unaccounted"].is_null() && before["saving"]["unsaved_bytes"] == 0);
    assert!(before["listening"]["silence_s"].as_f64().is_some());
    assert!(before["listening"]["archive"]["bytes"].as_u64() == Some(bytes.len() as u64));
    served.kill();
    let served = place.served(&["--snapshot-every", "365d"]);
    served.listening();
    let after = served.json("/api/status");
    for kind in ["instrument", "ephemeris", "visibilities", "housekeeping"] {
        for count in ["packets", "missing"] {
            assert_eq!(after["reception"][kind][count], before["reception"][kind][count], "{kind} {count}");
        }
    }
    assert_eq!(after["ledger"]["accumulated"], before["ledger"]["accumulated"]);
    assert!(after["ledger"]["accumulated"].as_u64() > Some(0) && after["ledger"]["sampled"].is_null());
    assert!(served.json("/api/passes") == passes && !passes.is_null());
    assert!(!served.json("/api/geometry").is_null());
    // Of what it holds it makes maps, before anything comes.
    wait_until("maps", || served.json("/api/status")["channels"].as_array().map_or(0, Vec::len) == 2);
    assert!(served.json("/api/status")["channels"][0]["age_s"].as_f64().is_some());
    // Nobody has been heard in this session; for the alarm silence counts from its beginning.
    assert!(after["listening"]["silence_s"].is_null());
    assert!(served.metric("lunarray_senders_silence_seconds") > 0.0);
    for name in ["lunarray_disk_free_bytes", "lunarray_disk_size_bytes", "lunarray_memory_resident_bytes"] {
        assert!(served.metric(name) > 0.0, "{name}");
    }
    served.kill();
}

#[test]
fn readers_of_events_leave_room_for_health_and_metrics() {
    let place = Place::new();
    let served = place.served(&[]);
    let request = format!("GET /events HTTP/1.1\r\nHost: {}\r\n\r\n", served.address);
    let mut visitors = Vec::new();
    // More than there are places; each is answered before the next comes.
    for _ in 0..140 {
        let mut stream = TcpStream::connect(&served.address).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        stream.read_exact(&mut [0; 12]).unwrap();
        visitors.push(stream);
    }
    // Those that say nothing have the places that readers may not have.
    visitors.extend((0..32).map(|_| TcpStream::connect(&served.address).unwrap()));
    for path in ["/healthz", "/metrics", "/api/status", "/readyz"].repeat(3) {
        assert_eq!(served.get(path).status, 200, "{path}");
    }
    assert_eq!(served.get("/").status, 503);
    drop(visitors);
    served.kill();
}

#[test]
fn a_failure_is_served_until_it_is_seen() {
    let place = Place::new();
    let bytes = std::fs::read(place.downlink("packets")).unwrap();
    let mut served = place.served(&["--connections", "1"]);
    let address = served.listening();
    // The last checkpoint will not find its folder, so that the run fails.
    std::fs::rename(place.path("state"), place.path("gone")).unwrap();
    finish(TcpStream::connect(address).unwrap(), &bytes);
    wait_until("the failure", || served.json("/api/status")["phase"] == "failed");
    let text = String::from_utf8(served.get("/metrics").body).unwrap();
    assert!(text.contains("lunarray_run_phase{phase=\"failed\"} 1"), "{text}");
    let (status, _) = end(&mut served.child);
    assert_eq!(status.code(), Some(3));
}

#[test]
fn trouble_with_disks_is_in_the_log_for_programs() {
    let place = Place::new();
    let bytes = std::fs::read(place.downlink("packets")).unwrap();
    let served = place.served(&["--log", "json"]);
    // `--log json` has no plain line with the address: it is a field.
    let mut address = None;
    wait_until("listening", || {
        let said = served.said.lock().unwrap();
        let lines = said.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
        address = lines
            .filter(|line| line["event"] == "listening")
            .find_map(|line| line["url"].as_str()?.strip_prefix("tcp://").map(str::to_owned));
        address.is_some()
    });
    let (folder, gone) = (PathBuf::from(place.path("state")).join("archive"), place.path("gone"));
    std::fs::rename(&folder, &gone).unwrap();
    let send = || finish(TcpStream::connect(address.as_ref().unwrap()).unwrap(), &bytes);
    assert!(send().starts_with("busy: "));
    let has = |event: &str, level: &str| {
        let said = served.said.lock().unwrap();
        let lines: Vec<Value> = said.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
        lines.iter().any(|line| line["event"] == event && line["level"] == level)
    };
    wait_until("the trouble", || has("archive", "warn"));
    assert_eq!(served.get("/readyz").status, 503);
    std::fs::rename(&gone, &folder).unwrap();
    assert!(send().starts_with("taken "));
    wait_until("its end", || has("archive", "info") && has("checkpoint", "info"));
    assert_eq!(served.get("/readyz").status, 200);
    served.kill();
}
