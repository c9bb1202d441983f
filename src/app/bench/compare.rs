//! Comparison of a benchmark with an earlier one.

use serde::Serialize;
use serde_json::Value;

/// Comparison of a stage with its earlier results.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StageComparison {
    /// Name of the stage.
    pub stage: String,
    /// Median time of the earlier benchmark, s.
    pub before_s: f64,
    /// Median time now, s.
    pub now_s: f64,
    /// Speed relative to the earlier benchmark.
    pub times_as_fast: f64,
    /// Whether the ranges between the quartiles do not overlap.
    pub differs: bool,
}

/// Comparison of a benchmark with an earlier one of the same size.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Version, processor and date of the earlier benchmark.
    pub before: [String; 3],
    /// The stages that both benchmarks have.
    pub stages: Vec<StageComparison>,
}

impl Comparison {
    /// Compares the JSON output of a benchmark with that of an earlier one.
    ///
    /// # Errors
    /// `before` is not the output of a benchmark, or has another size.
    #[doc(hidden)]
    pub fn of(now: &Value, before: &Value) -> Result<Self, String> {
        for key in ["channels", "daughters", "bits", "block_samples", "sky_pixels", "mission_s"] {
            match (&now[key], &before[key]) {
                (now, found) if now == found => {}
                (_, Value::Null) => {
                    return Err(format!("no number {key}; expected the output of `lunarray bench --json`"));
                }
                (now, found) => return Err(format!("{key} = {found}; expected {now}, as in this benchmark")),
            }
        }
        let rates = now["rates"].as_array().into_iter().flatten();
        let stages = rates.filter_map(|rate| compare(rate, &before["rates"])).collect();
        let machine = &before["machine"];
        let text = |key: &str| machine[key].as_str().unwrap_or("unknown").to_owned();
        Ok(Self { before: ["version", "processor", "date"].map(text), stages })
    }
}

/// Compares a stage with its earlier results; `None` if the earlier benchmark does not have it.
fn compare(now: &Value, before: &Value) -> Option<StageComparison> {
    let before = before.as_array()?.iter().find(|rate| rate["stage"] == now["stage"])?;
    let times = |rate: &Value| {
        let [low, high] = [0, 1].map(|k| rate["quartiles_s"][k].as_f64());
        Some((rate["median_s"].as_f64()?, low?, high?))
    };
    let ((before_s, low, high), (now_s, now_low, now_high)) = (times(before)?, times(now)?);
    let differs = now_high < low || now_low > high;
    let stage = now["stage"].as_str()?.to_owned();
    Some(StageComparison { stage, before_s, now_s, times_as_fast: before_s / now_s, differs })
}
