//! Orbits that are written, in the hands of other software.

use crate::common;

use std::path::Path;

use common::workplace::{Workplace, succeed};

/// Three satellites whose spacing breathes: velocities jump where it turns around.
const BREATHING: &str = r#"
name = "breathing"
[array]
satellites = 3
arcs_m = [600.0, 1500.0]
breathing.period_s = 43_200.0
[spacecraft]
channels_hz = [3.0e6]
# 2024-03-01T00:00:00 UTC: 24,166 days and 37 s.
epoch_tai_s = 2_087_942_437.0
"#;

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn the_oem_package_reads_what_is_written_and_its_files_are_read() {
    let python = common::python();
    let place = Workplace::new(BREATHING);
    let folder = place.path("orbits");
    succeed(&["export", "orbits", "--pipeline", &place.pipeline, "--duration", "1d", "--out", &folder]);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/oem_judge.py");
    let judged = std::process::Command::new(python).arg(script).arg(&folder).output().unwrap();
    assert!(judged.status.success(), "{}", String::from_utf8_lossy(&judged.stderr));
    let told = String::from_utf8(judged.stdout).unwrap();
    let (start, segments) = told.trim().split_once(' ').unwrap();
    assert_eq!(start, "2024-03-01T00:00:00.000000");
    assert!(segments.parse::<u32>().unwrap() > 2, "{segments}");
    let truth = std::fs::read(Path::new(&folder).join("truth")).unwrap();
    let truth: Vec<f64> = truth.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
    let rows = truth.as_chunks::<10>().0;
    assert_eq!(rows.len(), 60);
    let files = |ending: &str| {
        let names: Vec<String> = (1..=3).map(|n| format!("'{folder}/sat{n}.{ending}'")).collect();
        format!("array.oem=[{}]", names.join(", "))
    };
    let (kvn, xml) = (files("oem"), files("xml"));
    let of_files = |oem| ["array.arcs_m=[]", "array.breathing={}", oem, "spacecraft.duration_s=86000"];
    for sets in [&[][..], &of_files(&kvn), &of_files(&xml)] {
        let mut arguments = vec!["geometry", "--json", "--pipeline", &place.pipeline];
        sets.iter().for_each(|set| arguments.extend(["--set", set]));
        arguments.push("--at");
        let times: Vec<String> = rows.iter().map(|row| row[0].to_string()).collect();
        arguments.extend(times.iter().map(String::as_str));
        let told = succeed(&arguments);
        assert_eq!(told.lines().count(), rows.len());
        for (line, row) in told.lines().zip(rows) {
            let found: serde_json::Value = serde_json::from_str(line).unwrap();
            for (k, expected) in row[1..].iter().enumerate() {
                let position_m = found["satellites_m"][k / 3][k % 3].as_f64().unwrap();
                // Files have micrometres, and a polynomial of degree 7 over two minutes errs by less.
                assert!(
                    (position_m - expected).abs() < 1e-3,
                    "{sets:?} {} {k}: {position_m} {expected}",
                    row[0]
                );
            }
        }
    }
}
