//! Earth and Sun, against astropy.

use crate::common;

use std::path::Path;
use std::process::Command;

use lunarray::array::{EarthModel, sun_hat_by_date};
use lunarray::units::vector::{norm, sub};

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn earth_and_sun_are_where_astropy_has_them() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("places");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/bodies.py");
    let output = Command::new(common::python()).arg(script).arg(&file).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let bytes = std::fs::read(&file).unwrap();
    let numbers: Vec<f64> = bytes.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
    let (rows, rest) = numbers.as_chunks::<7>();
    assert!(rows.len() > 1000 && rest.is_empty());
    for &[tai_s, ex, ey, ez, sx, sy, sz] in rows {
        // The mission begins a month before.
        let (epoch_s, t_s) = (tai_s - 2.6e6, 2.6e6);
        for (found, expected) in [
            (EarthModel::Dated.hat(epoch_s, t_s), [ex, ey, ez]),
            (sun_hat_by_date(epoch_s, t_s), [sx, sy, sz]),
        ] {
            // A hundredth of a degree is what is promised.
            let off_deg = norm(sub(found, expected)).to_degrees();
            assert!(off_deg < 0.01, "{tai_s}: {off_deg} degrees");
        }
    }
}
