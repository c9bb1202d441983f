//! The page and its interface, over plain sockets: what it says is what is on disk, and nobody who looks changes a bit.

use std::collections::BTreeMap;

use lunarray::sky::fits::{ReadOptions, read_map};

use super::common::process::{signal, wait_until};
use super::common::workplace::{files, maps};
use super::*;

/// A pipeline that keeps a map for every snapshot.
pub(super) const SNAPSHOTS: [&str; 4] =
    ["--set", "products.snapshot_maps=true", "--set", "map.snapshot_every_s=20e6"];

/// A command that serves; ends when dropped.
pub(super) struct Served {
    pub(super) child: Child,
    pub(super) address: String,
    /// What it says after that.
    pub(super) said: Arc<Mutex<String>>,
}

impl Served {
    pub(super) fn start(args: &[&str]) -> Self {
        let mut command = Process::new(assert_cmd::cargo::cargo_bin("lunarray"));
        command.args(args).args(["--serve", "0"]).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let address = loop {
            let line = lines.next().expect("it ended before it served").unwrap();
            // Also in a line for programs.
            if let Some((_, url)) = line.split_once("serving on http://") {
                break url.split('/').next().unwrap_or_default().to_owned();
            }
        };
        let said = Arc::new(Mutex::new(String::new()));
        let heard = Arc::clone(&said);
        // It never waits for a reader.
        std::thread::spawn(move || {
            lines.for_each(|line| *heard.lock().unwrap() += &format!("{}\n", line.unwrap_or_default()));
        });
        Self { child, address, said }
    }

    /// Ends it with SIGKILL.
    pub(super) fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Its process.
    pub(super) fn process(&self) -> u32 {
        self.child.id()
    }

    /// Where it listens for packets.
    pub(super) fn listening(&self) -> String {
        let mut found = None;
        wait_until("listening", || {
            let said = self.said.lock().unwrap();
            found = said.lines().find_map(|line| line.strip_prefix("listening on tcp://")).map(str::to_owned);
            found.is_some()
        });
        found.unwrap()
    }

    fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(&self.address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(120))).unwrap();
        stream
    }

    /// Sends these bytes and reads until the server closes.
    fn raw(&self, request: &[u8]) -> Reply {
        let mut stream = self.connect();
        // A refusal may come before all is sent.
        let _ = stream.write_all(request);
        let mut bytes = Vec::new();
        let _ = stream.read_to_end(&mut bytes);
        Reply::of(&bytes)
    }

    fn request(&self, method: &str, path: &str, host: &str) -> Reply {
        self.raw(format!("{method} {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").as_bytes())
    }

    pub(super) fn get(&self, path: &str) -> Reply {
        self.request("GET", path, &self.address)
    }

    pub(super) fn json(&self, path: &str) -> Value {
        let reply = self.get(path);
        assert_eq!((reply.status, reply.header("content-type")), (200, "application/json"), "{path}");
        serde_json::from_slice(&reply.body).unwrap()
    }

    /// The value of a sample.
    pub(super) fn metric(&self, name: &str) -> f64 {
        let text = String::from_utf8(self.get("/metrics").body).unwrap();
        let line = text.lines().find(|line| line.split([' ', '{']).next() == Some(name));
        line.unwrap_or_else(|| panic!("no {name} in {text}")).rsplit(' ').next().unwrap().parse().unwrap()
    }

    pub(super) fn wait_for_phase(&self, phase: &str) {
        wait_until(phase, || self.json("/api/status")["phase"] == phase);
    }

    /// Ends it in order.
    pub(super) fn end(mut self) -> ExitStatus {
        signal(&self.child, "TERM");
        self.child.wait().unwrap()
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[derive(Debug)]
pub(super) struct Reply {
    /// 0 if there was no answer.
    pub(super) status: u16,
    headers: BTreeMap<String, String>,
    pub(super) body: Vec<u8>,
}

impl Reply {
    fn of(bytes: &[u8]) -> Self {
        let end = bytes.windows(4).position(|four| four == b"\r\n\r\n").unwrap_or(bytes.len());
        let head = String::from_utf8_lossy(&bytes[..end]).into_owned();
        let mut lines = head.lines();
        let status =
            lines.next().and_then(|line| line.split(' ').nth(1)).map_or(0, |code| code.parse().unwrap());
        let header = |line: &str| line.split_once(": ").map(|(k, v)| (k.to_ascii_lowercase(), v.to_owned()));
        let body = bytes.get(end + 4..).unwrap_or_default().to_vec();
        Self { status, headers: lines.filter_map(header).collect(), body }
    }

    fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", String::as_str)
    }

    pub(super) fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }
}

/// A whole run of the small pipeline that goes on serving.
pub(super) fn finished(place: &Place, out: &str) -> Served {
    let out = place.path(out);
    let fixed = ["run", place.pipeline(), "--out", &out, "--serve-after"];
    let served = Served::start(&[&fixed[..], &SNAPSHOTS].concat());
    served.wait_for_phase("ended");
    served
}

#[test]
fn what_is_served_is_what_is_on_disk() {
    let place = Place::new();
    let served = finished(&place, "out");
    let summary = std::fs::read(place.path("out/summary.json")).unwrap();
    let summary: Value = serde_json::from_slice(&summary).unwrap();
    let status = served.json("/api/status");
    for key in ["name", "segment", "cancelled", "reception", "completeness"] {
        assert_eq!(status[key], summary[key], "{key}");
    }
    for key in ["sampled", "accumulated", "flagged", "lost"] {
        assert_eq!(status["ledger"][key], summary["ledger"][key], "{key}");
    }
    assert_eq!(status["ledger"]["unaccounted"], 0);
    let counts = |stages: &Value| -> Vec<Value> {
        let of = |stage: &Value| {
            serde_json::json!([stage["name"], stage["items_in"], stage["items_out"], stage["units"]])
        };
        stages.as_array().unwrap().iter().map(of).collect()
    };
    assert_eq!(counts(&status["stages"]), counts(&summary["report"]["stages"]));
    let elapsed_s = status["elapsed_s"].as_f64().unwrap();
    for stage in status["stages"].as_array().unwrap() {
        let done = stage["units_per_s"].as_f64().unwrap() * elapsed_s;
        assert!((done - stage["units"].as_f64().unwrap()).abs() < 1e-6 * done.max(1.0), "{stage}");
    }
    assert_eq!(served.json("/api/config")["map"]["nside"], 4);
    for (number, channel) in summary["channels"].as_array().unwrap().iter().enumerate() {
        let seen = &status["channels"][number];
        let snapshots = channel["snapshots"].as_array().unwrap();
        assert!(snapshots.len() > 1, "{snapshots:?}");
        assert_eq!(seen["diagnostics"], channel["diagnostics"]);
        assert_eq!(seen["figures"], snapshots[snapshots.len() - 1]);
        let figures = served.json(&format!("/api/figures/{number}"));
        assert_eq!(&figures["snapshots"], &channel["snapshots"]);
        assert_eq!(&figures["spectra"]["rho"], &channel["rho"]);
        let folder = format!("out/{:.3}MHz", channel["frequency_hz"].as_f64().unwrap() / 1e6);
        for (k, snapshot) in snapshots.iter().enumerate() {
            let n = snapshot["number"].as_u64().unwrap();
            let is_last = k + 1 == snapshots.len();
            let name = if is_last { "map.fits".to_owned() } else { format!("snapshot-{n:03}.fits") };
            let path = place.path(&format!("{folder}/{name}"));
            let fits = served.get(&format!("/api/maps/{number}/{n}.fits"));
            assert!(fits.body == std::fs::read(&path).unwrap(), "{path}");
            let pixels = served.get(&format!("/api/maps/{number}/{n}.f32")).body;
            let map = read_map(path.as_ref(), &ReadOptions::default()).unwrap();
            let expected: Vec<u8> = map.values().iter().flat_map(|&v| (v as f32).to_le_bytes()).collect();
            assert!(pixels == expected, "{path}");
            if is_last {
                assert!(served.get(&format!("/api/maps/{number}/latest.f32")).body == expected);
                let latest = std::fs::read(place.path(&format!("{folder}/latest.fits"))).unwrap();
                assert!(latest == fits.body, "{folder}");
            }
        }
        for (kind, name) in [("noise", "noise.fits"), ("input", "input.fits")] {
            let map =
                read_map(place.path(&format!("{folder}/{name}")).as_ref(), &ReadOptions::default()).unwrap();
            let expected: Vec<u8> = map.values().iter().flat_map(|&v| (v as f32).to_le_bytes()).collect();
            assert!(served.get(&format!("/api/maps/{number}/{kind}.f32")).body == expected, "{kind}");
        }
    }
    let png = served.get("/api/maps/0/latest.png");
    assert_eq!(png.header("content-type"), "image/png");
    assert!(png.body.starts_with(b"\x89PNG\r\n\x1a\n") && png.body.len() > 10_000);
    assert!(served.end().success());
}

fn only_its_own_names_are_answered(served: &Served) {
    // A name that somebody else's name server points here.
    let port = served.address.rsplit(':').next().unwrap();
    for host in
        ["evil.example", &format!("evil.example:{port}"), "127.0.0.1:1", "localhost.evil.example", "[::2]"]
    {
        assert_eq!(served.request("GET", "/api/status", host).status, 421, "{host}");
    }
    for host in ["localhost", &format!("localhost:{port}"), "127.0.0.1", &format!("[::1]:{port}")] {
        assert_eq!(served.request("GET", "/api/status", host).status, 200, "{host}");
    }
    let own = &served.address;
    for (request, status) in [
        ("GET /api/status HTTP/1.1\r\nConnection: close\r\n\r\n".to_owned(), 400),
        (format!("GET / HTTP/1.1\r\nHost: {own}\r\nHost: evil.example\r\nConnection: close\r\n\r\n"), 400),
        (format!("GET http://evil.example/ HTTP/1.1\r\nHost: {own}\r\nConnection: close\r\n\r\n"), 421),
        ("nonsense\r\n\r\n".to_owned(), 400),
        (format!("GET / HTTP/1.1\r\nHost: {own}\r\nX: {}\r\n\r\n", "x".repeat(1 << 20)), 431),
        (format!("GET /{} HTTP/1.1\r\nHost: {own}\r\n\r\n", "x".repeat(1 << 20)), 0),
        (format!("GET / HTTP/1.1\r\nHost: {own}\r\n{}\r\n", "X: y\r\n".repeat(100)), 431),
    ] {
        let reply = served.raw(request.as_bytes());
        let shown = request.get(..80).unwrap_or(&request);
        if status == 0 {
            assert!((400..500).contains(&reply.status) || reply.status == 0, "{shown}: {}", reply.status);
        } else {
            assert_eq!(reply.status, status, "{shown}");
        }
    }
}

#[test]
fn every_route_answers_and_nothing_else_does() {
    let place = Place::new();
    let served = finished(&place, "out");
    for (path, status, kind, words) in [
        ("/", 200, "text/html; charset=utf-8", "<title>lunarray"),
        ("/page.js", 200, "text/javascript; charset=utf-8", "EventSource"),
        ("/sky.js", 200, "text/javascript; charset=utf-8", "webgl2"),
        ("/array.js", 200, "text/javascript; charset=utf-8", "drawOrbit"),
        ("/passes.js", 200, "text/javascript; charset=utf-8", "class Passes"),
        ("/tools.js", 200, "text/javascript; charset=utf-8", "copyText"),
        ("/page.css", 200, "text/css; charset=utf-8", "--panel"),
        ("/page.json", 200, "application/json", "cividis"),
        ("/favicon.svg", 200, "image/svg+xml", "<svg"),
        ("/metrics", 200, "application/openmetrics-text; version=1.0.0; charset=utf-8", "# EOF"),
        ("/healthz", 200, "text/plain; charset=utf-8", "ended"),
        ("/readyz", 503, "text/plain; charset=utf-8", "ended"),
        ("/api/passes", 200, "application/json", "\"kind\":\"visibilities\""),
        ("/api/geometry", 200, "application/json", "\"earth_hat\":["),
        ("/api/uvw/0", 200, "application/json", "\"extent_wavelengths\""),
        ("/api/uvw/00", 404, "text/plain; charset=utf-8", "no such channel"),
        // No auto-correlations are sent.
        ("/api/powers/0", 200, "application/json", "null"),
        ("/api/powers/+1", 404, "text/plain; charset=utf-8", "no such channel"),
        ("/api/uvw/../../etc/passwd", 404, "text/plain; charset=utf-8", "no such"),
        ("/api/gaps", 404, "text/plain; charset=utf-8", "--state"),
        ("/nothing", 404, "text/plain; charset=utf-8", "no such page"),
        ("/api/maps/0/9999.f32", 404, "text/plain; charset=utf-8", "no such map"),
        ("/api/maps/0/latest", 404, "text/plain; charset=utf-8", "no such map"),
        ("/api/maps/0/latest.exe", 404, "text/plain; charset=utf-8", "no such map"),
        ("/api/maps/7/latest.f32", 404, "text/plain; charset=utf-8", "no such map"),
        ("/api/maps/00/latest.f32", 404, "text/plain; charset=utf-8", "no such map"),
        ("/api/maps/-1/latest.f32", 404, "text/plain; charset=utf-8", "no such map"),
        ("/api/maps/0/noise.fits", 404, "text/plain; charset=utf-8", ".f32"),
        ("/api/figures/99999", 404, "text/plain; charset=utf-8", "no such channel"),
        ("/api/maps/../../etc/passwd", 404, "text/plain; charset=utf-8", "no such"),
        ("/api/maps/0/..%2f..%2fetc%2fpasswd", 404, "text/plain; charset=utf-8", "no such"),
        ("/../../../../etc/passwd", 404, "text/plain; charset=utf-8", "no such"),
        ("/page.css%00.f32", 404, "text/plain; charset=utf-8", "no such"),
    ] {
        let reply = served.get(path);
        assert_eq!((reply.status, reply.header("content-type")), (status, kind), "{path}");
        assert!(reply.text().contains(words), "{path}: {}", reply.text());
        let policy = reply.header("content-security-policy");
        assert!(policy.contains("default-src 'none'") && policy.contains("frame-ancestors 'none'"), "{path}");
        assert!(!policy.contains("unsafe") && !policy.contains('*') && !policy.contains("http"), "{policy}");
        assert_eq!(reply.header("x-content-type-options"), "nosniff", "{path}");
    }
    // The page asks nobody else for anything.
    for path in ["/", "/page.js", "/sky.js", "/array.js", "/passes.js", "/tools.js", "/page.css"] {
        let text = served.get(path).text();
        assert!(
            !text.contains("http://") && !text.contains("https://") && !text.contains("src=\"//"),
            "{path}"
        );
    }
    assert!(served.request("HEAD", "/", &served.address).body.is_empty());
    for method in ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "BREW"] {
        let reply = served.request(method, "/api/status", &served.address);
        assert_eq!((reply.status, reply.header("allow")), (405, "GET, HEAD"), "{method}");
        assert!(reply.text().contains("expected GET or HEAD"), "{}", reply.text());
    }
    only_its_own_names_are_answered(&served);
    assert_eq!(served.get("/healthz").status, 200);
    wait_until("what was cut to be counted", || served.metric("lunarray_http_cut_total") >= 1.0);
}

#[test]
fn metrics_keep_to_their_format() {
    let place = Place::new();
    let served = finished(&place, "out");
    let text = served.get("/metrics").text();
    let mut families: BTreeMap<&str, &str> = BTreeMap::new();
    let mut buckets: BTreeMap<String, f64> = BTreeMap::new();
    assert!(text.ends_with("# EOF\n"));
    for line in text.lines().filter(|line| *line != "# EOF") {
        if let Some(about) = line.strip_prefix("# ") {
            let mut words = about.splitn(3, ' ');
            let (what, name, rest) = (words.next().unwrap(), words.next().unwrap(), words.next().unwrap());
            match what {
                "HELP" => assert!(families.insert(name, "").is_none(), "{name} stands twice"),
                "TYPE" => drop(families.insert(name, rest)),
                // The unit ends the name.
                "UNIT" => assert!(name.ends_with(&format!("_{rest}")), "{line}"),
                _ => panic!("{line}"),
            }
            continue;
        }
        let (sample, value) = line.rsplit_once(' ').unwrap();
        let value: f64 = value.parse().unwrap();
        let (name, labels) = sample.split_once('{').unwrap_or((sample, "}"));
        assert!(labels.ends_with('}') && name.starts_with("lunarray_"), "{line}");
        let endings = ["_total", "_bucket", "_sum", "_count", ""];
        let family = endings.iter().find_map(|ending| families.get(name.strip_suffix(ending)?).copied());
        assert!(matches!(family, Some("gauge" | "counter" | "histogram")), "{line}");
        if name.ends_with("_bucket") {
            let stage = labels.split(',').find(|label| label.contains("stage=")).unwrap();
            let series = format!("{name} {}", stage.trim_end_matches('}'));
            let before = buckets.insert(series, value).unwrap_or(0.0);
            assert!(value >= before, "buckets fall: {line}");
        }
    }
    let summary = std::fs::read(place.path("out/summary.json")).unwrap();
    let summary: Value = serde_json::from_slice(&summary).unwrap();
    let has = |line: String| assert!(text.contains(&line), "no {line} in {text}");
    let accumulated = summary["ledger"]["accumulated"].as_u64().unwrap();
    has(format!("lunarray_ledger_visibilities{{entry=\"accumulated\"}} {accumulated}.0\n"));
    has("lunarray_ledger_unaccounted_visibilities 0.0\n".into());
    has("lunarray_stage_queue_items{stage=\"ground\"} 0.0\n".into());
    has("lunarray_run_phase{phase=\"ended\"} 1.0\n".into());
    let ground = summary["report"]["stages"]
        .as_array()
        .unwrap()
        .iter()
        .find(|stage| stage["name"] == "ground")
        .unwrap();
    has(format!(
        "lunarray_stage_latency_seconds_count{{stage=\"ground\"}} {}\n",
        ground["since_source"]["count"]
    ));
    // Without this class Prometheus finds no quantile.
    has(format!(
        "lunarray_stage_latency_seconds_bucket{{le=\"+Inf\",stage=\"ground\"}} {}\n",
        ground["since_source"]["count"]
    ));
    has(format!("lunarray_stage_step_seconds_count{{stage=\"ground\"}} {}\n", ground["working"]["count"]));
}

/// Reads events until `is_enough`.
fn read_events(served: &Served, mut is_enough: impl FnMut(&str, &Value) -> bool) {
    let mut stream = served.connect();
    write!(stream, "GET /events HTTP/1.1\r\nHost: {}\r\n\r\n", served.address).unwrap();
    let mut name = String::new();
    for line in BufReader::new(stream).lines() {
        let line = line.expect("the events end");
        if let Some(event) = line.strip_prefix("event: ") {
            name = event.to_owned();
        }
        if let Some(data) = line.strip_prefix("data: ")
            && is_enough(&name, &serde_json::from_str(data).unwrap())
        {
            return;
        }
    }
    panic!("the events end");
}

#[test]
fn events_tell_of_the_run_step_by_step() {
    let place = Place::new();
    let file = place.downlink("packets");
    let (out, state) = (place.path("out"), place.path("state"));
    let fixed = ["replay", &file, "--map", place.pipeline(), "--out", &out, "--state", &state];
    let step = ["--step", "pass", "--checkpoint-every", "1"];
    let mut command = Process::new(assert_cmd::cargo::cargo_bin("lunarray"));
    command.args(fixed).args(step).args(["--serve", "127.0.0.1:0"]);
    let mut child =
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut input = child.stdin.take().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let address = loop {
        let line = lines.next().unwrap().unwrap();
        if let Some(url) = line.strip_prefix("serving on http://") {
            break url.trim_end_matches('/').to_owned();
        }
    };
    let reader = std::thread::spawn(move || lines.for_each(drop));
    let served = Served { child, address, said: Arc::default() };
    served.wait_for_phase("running");
    assert_eq!(served.get("/readyz").status, 200);
    let received = |status: &Value| status["reception"]["visibilities"]["packets"].as_u64().unwrap_or(0);
    let before = received(&served.json("/api/status"));
    writeln!(input).unwrap();
    read_events(&served, |name, data| name == "status" && received(data) > before);
    read_events(&served, |name, data| name == "log" && data["text"].as_str().unwrap().contains("checkpoint"));
    let gaps = served.json("/api/gaps");
    assert_eq!(gaps["gaps"].as_array().unwrap().len(), 0, "{gaps}");
    // The end of the input ends the steps, then the run, then the server: the last status says so.
    let last = std::thread::scope(|scope| {
        let watcher = scope.spawn(|| {
            let mut complete = false;
            read_events(&served, |name, data| {
                complete |= name == "log" && data["text"] == "the run is complete";
                complete && name == "status" && data["phase"] == "ended"
            });
        });
        drop(input);
        watcher.join()
    });
    assert!(last.is_ok());
    wait_until("the port to close", || TcpStream::connect(&served.address).is_err());
    drop(served);
    reader.join().unwrap();
}

#[test]
fn maps_are_the_same_however_many_look_on() {
    let place = Place::new();
    let alone = place.path("alone");
    let run = ["run", place.pipeline(), "--set", "products.pictures=false"];
    succeed(&[&run[..], &SNAPSHOTS, &["--out", &alone]].concat());
    let watched = place.path("watched");
    let served = Served::start(&[&run[..], &SNAPSHOTS, &["--out", &watched, "--serve-after"]].concat());
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for visitor in 0..20 {
            let (served, over) = (&served, &over);
            scope.spawn(move || {
                let wanted = [
                    "/events",
                    "/api/maps/0/latest.f32",
                    "/api/status",
                    "/metrics",
                    "/api/maps/1/latest.png",
                    "/api/passes",
                    "/api/geometry",
                    "/api/uvw/0",
                ];
                if visitor % 2 == 0 {
                    // Asks for all it can and reads nothing.
                    let mut stream = served.connect();
                    stream.set_write_timeout(Some(Duration::from_millis(100))).unwrap();
                    let request = format!(
                        "GET {} HTTP/1.1\r\nHost: {}\r\n\r\n",
                        wanted[visitor / 2 % 8],
                        served.address
                    );
                    while !over.load(Ordering::Relaxed) {
                        let _ = stream.write_all(request.as_bytes());
                        std::thread::sleep(Duration::from_millis(5));
                    }
                } else {
                    while !over.load(Ordering::Relaxed) {
                        let path = wanted[1 + visitor / 2 % 7];
                        let reply = served.get(path);
                        assert!([200, 404].contains(&reply.status), "{path}: {}", reply.status);
                    }
                }
            });
        }
        served.wait_for_phase("ended");
        over.store(true, Ordering::Relaxed);
    });
    assert!(maps(&watched) == maps(&alone));
    assert!(files(watched.as_ref()) == files(alone.as_ref()));
    let ledger = |out: &str| -> Value {
        let summary = std::fs::read(format!("{out}/summary.json")).unwrap();
        serde_json::from_slice::<Value>(&summary).unwrap()["ledger"].clone()
    };
    assert_eq!(ledger(&watched), ledger(&alone));
    assert!(served.end().success());
}

#[test]
fn those_who_do_not_read_or_write_are_cut() {
    let place = Place::new();
    let served = finished(&place, "out");
    // More than there are places, and none says anything.
    let silent: Vec<TcpStream> = (0..300).map(|_| served.connect()).collect();
    wait_until("places again", || served.get("/healthz").status == 200);
    // Not at once: a connection beyond the system's queue arrives when its handshake is repeated, seconds later.
    wait_until("the excess to be refused", || served.metric("lunarray_http_refused_total") > 0.0);
    drop(silent);
    // All but the one that asks.
    wait_until("the silent to be gone", || served.metric("lunarray_http_connections") <= 1.0);
    let cut = served.metric("lunarray_http_cut_total");
    assert!(cut > 0.0, "silent ones were cut");
    // Asks for much more than the system's buffers hold, and reads nothing.
    let mut deaf = served.connect();
    deaf.set_write_timeout(Some(Duration::from_secs(1))).unwrap();
    let request = format!("GET /page.js HTTP/1.1\r\nHost: {}\r\n\r\n", served.address).repeat(2000);
    let _ = deaf.write_all(request.as_bytes());
    wait_until("the deaf to be cut", || served.metric("lunarray_http_cut_total") > cut);
    drop(deaf);
}

#[test]
fn a_browser_on_the_packet_port_is_answered_and_counted() {
    let place = Place::new();
    let file = place.downlink("packets");
    let set = ["--set", "downlink.listen.first_packet_s_max=1", "--connections", "1"];
    let ground = place.ground("heard", &set);
    let mut browser = ground.connect();
    browser.write_all(b"GET / HTTP/1.1\r\nHost: localhost\r\nUser-Agent: Mozilla/5.0\r\n\r\n").unwrap();
    let mut answer = String::new();
    browser.read_to_string(&mut answer).unwrap();
    assert!(answer.contains("first_packet_s_max"), "{answer}");
    assert!(ground.send(&std::fs::read(file).unwrap()).starts_with("taken "));
    let summary = ground.succeed();
    assert_eq!(summary["listening"]["ended"]["first-packet"], 1, "{}", summary["listening"]);
    assert_closed(&summary["reception"]);
}

#[test]
fn a_place_that_cannot_be_had_is_refused_before_anything_runs() {
    let place = Place::new();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let out = place.path("out");
    let run = ["run", place.pipeline(), "--out", &out];
    let refused = |more: &[&str]| complaint(&[&run[..], more].concat());
    assert!(refused(&["--serve", &port]).contains("in use"));
    assert!(refused(&["--serve", "0.0.0.0:0"]).contains("--serve-remote"));
    assert!(refused(&["--serve", "http://localhost"]).contains("expected PORT or HOST:PORT"));
    assert!(refused(&["--serve-after"]).contains("--serve"));
    assert!(!std::path::Path::new(&out).exists());
}

#[test]
fn a_simulation_shows_its_stages_and_no_ground() {
    let place = Place::new();
    let out = place.path("small.ccsds");
    let served = Served::start(&["simulate", place.pipeline(), "--out", &out, "--serve-after"]);
    served.wait_for_phase("ended");
    let status = served.json("/api/status");
    assert_eq!(status["segment"], "space");
    assert!(status["ledger"].is_null() && status["reception"].is_null(), "{status}");
    let stages = status["stages"].as_array().unwrap();
    let record = stages.iter().find(|stage| stage["name"] == "record").unwrap();
    assert_eq!(record["units"], std::fs::metadata(&out).unwrap().len());
    assert_eq!(served.get("/api/maps/0/latest.f32").status, 404);
    assert!(served.end().success());
}
