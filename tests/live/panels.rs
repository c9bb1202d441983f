//! Passes, orbit and baselines as the page has them, against the packets, the array and the exported visibilities.

use lunarray::units::constants::SPEED_OF_LIGHT_M_S;

use super::serving::{Served, finished};
use super::*;

/// A replay of a file, which goes on serving.
fn replayed(place: &Place, file: &str) -> Served {
    let out = place.path("replayed");
    let served = Served::start(&["replay", file, "--map", place.pipeline(), "--out", &out, "--serve-after"]);
    served.wait_for_phase("ended");
    served
}

fn numbers(list: &Value) -> Vec<u64> {
    list.as_array().unwrap().iter().map(|number| number.as_u64().unwrap()).collect()
}

fn vector(list: &Value) -> [f64; 3] {
    std::array::from_fn(|k| list[k].as_f64().unwrap())
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| a[k] * b[k]).sum()
}

#[test]
fn the_time_line_adds_up_to_the_status_and_names_the_missing_packets() {
    let place = Place::new();
    let all = std::fs::read(place.downlink("packets")).unwrap();
    let header = |packet: &Vec<u8>| PacketHeader::parse(packet).unwrap();
    let mut packets = packets_of(&all);
    let of_kind =
        |packets: &[Vec<u8>], kind| packets.iter().filter(|p| header(p).kind == kind).count() as u64;
    let whole = of_kind(&packets, PacketKind::Visibilities);
    // Within a pass, over a long time, and one by itself; and two packets of positions: what waits for those comes at the end.
    let lost = [whole / 10..whole / 10 + 3, whole / 3..whole / 2, whole - 4..whole - 3];
    packets.retain(|packet| match header(packet) {
        PacketHeader { kind: PacketKind::Visibilities, count, .. } => {
            !lost.iter().any(|range| range.contains(&count))
        }
        PacketHeader { kind: PacketKind::Ephemeris, count, .. } => !(4..6).contains(&count),
        _ => true,
    });
    let file = place.workplace.file("cut.packets", &packets.concat());
    let served = replayed(&place, &file);
    let (line, status) = (served.json("/api/passes"), served.json("/api/status"));

    let epoch_s = line["epoch_tai_s"].as_f64().unwrap();
    let [start_s, bin_s] = ["start_s", "bin_s"].map(|key| line[key].as_f64().unwrap());
    let made_s = |packet: &Vec<u8>| header(packet).time.tai_s() - epoch_s;
    for kind in line["kinds"].as_array().unwrap() {
        let name = kind["kind"].as_str().unwrap();
        let [received, missing] = ["received", "missing"].map(|key| numbers(&kind[key]));
        let reception = &status["reception"][name];
        assert_eq!(reception["packets"], received.iter().sum::<u64>(), "{name}");
        assert_eq!(reception["missing"], missing.iter().sum::<u64>(), "{name}");
        let mut expected = vec![0; received.len()];
        for packet in packets.iter().filter(|packet| header(packet).kind.to_string() == name) {
            expected[((made_s(packet) - start_s) / bin_s) as usize] += 1;
        }
        assert_eq!(received, expected, "{name}");
    }
    let kinds: Vec<&str> =
        line["kinds"].as_array().unwrap().iter().map(|k| k["kind"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["instrument", "ephemeris", "visibilities", "housekeeping"]);

    // The ranges, and when the packets on either side were made.
    let mut expected: Vec<(u64, u64, u64, [f64; 2])> = lost
        .iter()
        .map(|range| (PacketKind::Visibilities, range.clone()))
        .chain([(PacketKind::Ephemeris, 4..6)])
        .map(|(kind, range)| {
            let side = |count| {
                packets.iter().find(|p| header(p).kind == kind && header(p).count == count).map(made_s)
            };
            let between_s = [side(range.start - 1).unwrap(), side(range.end).unwrap()];
            (u64::from(kind.apid()), range.start, range.end - 1, between_s)
        })
        .collect();
    let mut found: Vec<(u64, u64, u64, [f64; 2])> = line["ranges"]
        .as_array()
        .unwrap()
        .iter()
        .map(|range| {
            let [apid, from, to] = ["apid", "from", "to"].map(|key| range[key].as_u64().unwrap());
            (apid, from, to, std::array::from_fn(|k| range["between_s"][k].as_f64().unwrap()))
        })
        .collect();
    assert!(found.windows(2).all(|two| two[0].3[1] >= two[1].3[1]), "the latest first: {found:?}");
    found.sort_by_key(|range| (range.0, range.1));
    expected.sort_by_key(|range| (range.0, range.1));
    assert_eq!(found, expected);
    assert_eq!(line["ranges_left_out"], 0);
    assert!(served.end().success());
}

#[test]
fn a_second_session_shows_the_packets_of_the_first() {
    let place = Place::new();
    let packets = packets_of(&std::fs::read(place.downlink("packets")).unwrap());
    // The second session does not bring what is missing in the middle.
    let [first, rest] = [packets.len() / 3, packets.len() / 2];
    let parts = [&packets[..first], &packets[rest..]].map(<[Vec<u8>]>::concat);
    let files = ["first", "second"].map(|name| place.path(name));
    files.iter().zip(&parts).for_each(|(file, bytes)| std::fs::write(file, bytes).unwrap());
    let (state, out) = (place.path("state"), place.path("out"));
    let fixed = ["--map", place.pipeline(), "--out", &out, "--state", &state];
    succeed(&[&["replay", &files[0]], &fixed[..]].concat());
    let served = Served::start(&[&["replay", &files[1], "--serve-after"], &fixed[..]].concat());
    served.wait_for_phase("ended");
    let (line, status) = (served.json("/api/passes"), served.json("/api/status"));
    let mut received = 0;
    for kind in line["kinds"].as_array().unwrap() {
        let reception = &status["reception"][kind["kind"].as_str().unwrap()];
        assert_eq!(reception["packets"], numbers(&kind["received"]).iter().sum::<u64>(), "{kind}");
        assert_eq!(reception["missing"], numbers(&kind["missing"]).iter().sum::<u64>(), "{kind}");
        received += numbers(&kind["received"]).iter().sum::<u64>();
    }
    assert_eq!(received, (first + packets.len() - rest) as u64);
    // The same ranges as the list of gaps, which the state knows.
    let ranges = |list: &Value| -> Vec<[u64; 3]> {
        let of = |range: &Value| ["apid", "from", "to"].map(|key| range[key].as_u64().unwrap());
        let mut ranges: Vec<_> = list.as_array().unwrap().iter().map(of).collect();
        ranges.sort_unstable();
        ranges
    };
    assert_eq!(ranges(&line["ranges"]), ranges(&served.json("/api/gaps")["gaps"]));
    assert!(served.end().success());
}

#[test]
fn the_geometry_is_that_of_the_array_at_the_time_of_the_latest_data() {
    let place = Place::new();
    let file = place.downlink("packets");
    let served = replayed(&place, &file);
    let geometry = served.json("/api/geometry");
    let csv = place.path("visibilities.csv");
    let latest_s = (0..2)
        .flat_map(|channel: u32| {
            succeed(&["export", "visibilities", &file, "--channel", &channel.to_string(), "--out", &csv]);
            let text = std::fs::read_to_string(&csv).unwrap();
            let times =
                text.lines().skip(1).map(|line| line.split(',').next().unwrap().parse::<f64>().unwrap());
            times.collect::<Vec<_>>()
        })
        .fold(f64::NEG_INFINITY, f64::max);
    let time_s = geometry["time_s"].as_f64().unwrap();
    // Half ticks in the text.
    assert!((time_s - latest_s).abs() < 1e-6, "{time_s} {latest_s}");

    let at = format!("{time_s}");
    let text = succeed(&["geometry", "--at", &at, "--pipeline", place.pipeline(), "--json"]);
    let array: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(array["observing"], true);
    let earth = vector(&geometry["earth_hat"]);
    let expected = vector(&array["earth_hat"]);
    assert!((0..3).all(|k| (earth[k] - expected[k]).abs() < 1e-12), "{earth:?} {expected:?}");
    let radius_m = geometry["moon_radius_m"].as_f64().unwrap();
    let satellites = geometry["satellites"].as_array().unwrap();
    assert_eq!(satellites.len(), array["satellites_m"].as_array().unwrap().len());
    for (found, expected) in satellites.iter().zip(array["satellites_m"].as_array().unwrap()) {
        let (r, expected) = (vector(&found["position_m"]), vector(expected));
        // Interpolated at the end of a segment, a year after the epoch: micrometres, magnified.
        assert!((0..3).all(|k| (r[k] - expected[k]).abs() < 1e-3), "{r:?} {expected:?}");
        // Behind the plane through the Moon's centre, and within its shadow, a cylinder.
        let depth_m = -dot(earth, expected);
        let is_hidden = depth_m > 0.0 && dot(expected, expected) - depth_m * depth_m < radius_m * radius_m;
        assert_eq!(found["earth_is_hidden"], is_hidden);
    }
    // The first satellite is on the orbit that is drawn, whose plane is its own.
    let first = vector(&satellites[0]["position_m"]);
    let normal = vector(&geometry["normal_hat"]);
    let orbit: Vec<[f64; 3]> = geometry["orbit_m"].as_array().unwrap().iter().map(vector).collect();
    // The node turns by a few degrees a year about the pole: within a degree of the plane.
    assert!(dot(normal, first).abs() < 0.02 * dot(first, first).sqrt());
    let far_m = |place: &[f64; 3]| (0..3).map(|k| (place[k] - first[k]).powi(2)).sum::<f64>().sqrt();
    let nearest_m = orbit.iter().map(far_m).fold(f64::INFINITY, f64::min);
    let step_m = std::f64::consts::TAU / orbit.len() as f64 * dot(first, first).sqrt();
    assert!(nearest_m < step_m && orbit.iter().all(|place| dot(normal, *place).abs() < 1.0), "{nearest_m}");
    // The track is that of the window.
    let [from_s, to_s] = [0, 1].map(|k| geometry["known_s"][k].as_f64().unwrap());
    assert!(from_s < time_s && time_s < to_s);
    let at = format!("{from_s}");
    let text = succeed(&["geometry", "--at", &at, "--pipeline", place.pipeline(), "--json"]);
    let begun = vector(&serde_json::from_str::<Value>(&text).unwrap()["satellites_m"][0]);
    let track = vector(&geometry["track_m"][0]);
    assert!((0..3).all(|k| (track[k] - begun[k]).abs() < 1e-3), "{track:?} {begun:?}");
    assert!(served.end().success());
}

#[test]
fn the_earth_is_not_shown_where_the_configuration_and_the_data_contradict() {
    let place = Place::new();
    let file = place.downlink("packets");
    // The Earth on the other side of the Moon: it would have been in sight.
    let other = place.path("other.toml");
    let pipeline = std::fs::read_to_string(place.pipeline()).unwrap();
    std::fs::write(&other, format!("{pipeline}\n[array]\nearth_longitude_deg = 180.0\n")).unwrap();
    let out = place.path("out");
    let served = Served::start(&["replay", &file, "--map", &other, "--out", &out, "--serve-after"]);
    served.wait_for_phase("ended");
    let geometry = served.json("/api/geometry");
    assert!(geometry["earth_hat"].is_null(), "{geometry}");
    assert!(geometry["satellites"].as_array().unwrap().iter().all(|s| s["earth_is_hidden"].is_null()));
    assert!(served.end().success());
}

#[test]
fn the_planes_of_u_v_w_hold_every_eighth_baseline() {
    let place = Place::new();
    let file = place.downlink("packets");
    let served = replayed(&place, &file);
    let csv = place.path("visibilities.csv");
    for (channel, frequency_hz) in [(0, 3e6), (1, 1e7)] {
        let density = served.json(&format!("/api/uvw/{channel}"));
        succeed(&["export", "visibilities", &file, "--channel", &channel.to_string(), "--out", &csv]);
        let text = std::fs::read_to_string(&csv).unwrap();
        let rows = text.lines().skip(1).map(|line| line.split(',').collect::<Vec<_>>());
        let good: Vec<[f64; 3]> = rows
            .filter(|row| row[row.len() - 1] == "0")
            .map(|row| {
                std::array::from_fn(|k| {
                    row[5 + k].parse::<f64>().unwrap() * (frequency_hz / SPEED_OF_LIGHT_M_S)
                })
            })
            .collect();
        assert_eq!(density["visibilities"], good.len());
        assert_eq!(
            (&density["every"], &density["beyond"], &density["cells"]),
            (&8.into(), &0.into(), &64.into())
        );
        assert_eq!(density["frequency_hz"], frequency_hz);
        let hits = served.json(&format!("/api/hits/{channel}"));
        assert_eq!((&hits["visibilities"], &hits["nside"]), (&good.len().into(), &16.into()));
        // The poles of the ecliptic are hidden at most by the blur, what lies in the orbit's plane for a third of the time.
        let by_direction = numbers(&hits["hits"]);
        let [least, most] = [by_direction.iter().min().unwrap(), by_direction.iter().max().unwrap()];
        let counted = 8 * good.len().div_ceil(8) as u64;
        assert!(by_direction.len() == 3072 && (counted - counted / 50..=counted).contains(most), "{most}");
        assert!(counted / 3 < *least && *least < counted * 9 / 10, "{least} of {counted}");
        let counted: Vec<&[f64; 3]> = good.iter().step_by(8).collect();
        let longest = counted.iter().flat_map(|b| b.iter()).fold(0.0, |m: f64, x| m.max(x.abs()));
        let extent = density["extent_wavelengths"].as_f64().unwrap();
        assert!(longest < extent && extent <= 2.0 * longest, "{longest} {extent}");
        let cell = |x: f64| ((x + extent) * 32.0 / extent).floor() as usize;
        for (plane, (x, y)) in [(0, 1), (0, 2), (1, 2)].into_iter().enumerate() {
            let mut expected = vec![0_u64; 64 * 64];
            for b in &counted {
                expected[64 * cell(b[y]) + cell(b[x])] += 1;
            }
            let found = numbers(&density["planes"][plane]);
            let apart: u64 = found.iter().zip(&expected).map(|(a, b)| a.abs_diff(*b)).sum();
            // One that lies on an edge may be on either side of it.
            assert!(
                apart <= 2 && found.iter().sum::<u64>() == counted.len() as u64,
                "{channel} {plane}: {apart}"
            );
        }
    }
    assert!(served.end().success());
}

#[test]
fn nothing_is_told_of_what_is_not_known() {
    let place = Place::new();
    let out = place.path("small.ccsds");
    // A space segment alone has no ground.
    let served = Served::start(&["simulate", place.pipeline(), "--out", &out, "--serve-after"]);
    served.wait_for_phase("ended");
    for path in ["/api/passes", "/api/geometry", "/api/uvw/0", "/api/hits/0"] {
        assert!(served.json(path).is_null(), "{path}");
    }
    assert!(served.end().success());
    // A channel that is not there.
    let served = finished(&place, "out");
    for of in ["uvw", "hits", "powers"] {
        assert_eq!(served.get(&format!("/api/{of}/2")).status, 404, "{of}");
    }
    assert!(!served.json("/api/uvw/1").is_null());
}

#[test]
fn the_waterfall_has_the_means_of_the_powers_that_are_written() {
    let place = Place::new();
    let out = place.path("out");
    // More than a packet holds for each window.
    let autos = ["--set", "spacecraft.auto_powers=true", "--set", "spacecraft.auto_integration_s=20"];
    let served =
        Served::start(&[&["run", place.pipeline(), "--out", &out, "--serve-after"], &autos[..]].concat());
    served.wait_for_phase("ended");
    let text = std::fs::read_to_string(place.path("out/autos.csv")).unwrap();
    let rows: Vec<Vec<f64>> = text
        .lines()
        .skip(1)
        .map(|line| line.split(',').map(|cell| cell.parse().unwrap()).collect())
        .collect();
    for (channel, frequency_hz) in [(0, 3e6), (1, 1e7)] {
        let waterfall = served.json(&format!("/api/powers/{channel}"));
        let wide_s = waterfall["time_s"].as_f64().unwrap();
        let mut sums: std::collections::BTreeMap<i64, Vec<(f64, f64)>> = std::collections::BTreeMap::new();
        for row in rows.iter().filter(|row| row[0] == frequency_hz) {
            let daughters =
                sums.entry((row[3] / wide_s).floor() as i64).or_insert_with(|| vec![(0.0, 0.0); 8]);
            let sum = &mut daughters[row[2] as usize - 1];
            *sum = (sum.0 + row[4], sum.1 + 1.0);
        }
        assert!(sums.len() > 30 && sums.len() <= 256, "{}", sums.len());
        let times = waterfall["times_s"].as_array().unwrap();
        let powers = waterfall["powers_k_sr"].as_array().unwrap();
        assert_eq!((times.len(), powers.len()), (sums.len(), sums.len()));
        for ((number, daughters), (time, powers)) in sums.iter().zip(times.iter().zip(powers)) {
            assert_eq!(*time, *number as f64 * wide_s);
            for (k, (sum, count)) in daughters.iter().enumerate() {
                match powers[k].as_f64() {
                    // Eight digits are written.
                    Some(mean) => assert!((mean * count / sum - 1.0).abs() < 1e-6, "{mean} {sum} {count}"),
                    None => assert_eq!(*count, 0.0),
                }
            }
        }
    }
    assert!(served.end().success());
}
