//! A benchmark beside an earlier one.

use serde::Serialize;
use serde_json::Value;

use super::{Bench, Rate};

/// A stage beside its earlier figures.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StageComparison {
    /// Name of the stage.
    pub stage: &'static str,
    /// Median time of the earlier benchmark, s.
    pub before_s: f64,
    /// Median time now, s.
    pub now_s: f64,
    /// How many times as fast it is now.
    pub times_as_fast: f64,
    /// Whether the quartiles of both lie apart.
    pub differs: bool,
}

/// A benchmark beside an earlier one of the same size.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Version, processor and date of the earlier one.
    pub before: [String; 3],
    /// Stages that are in both.
    pub stages: Vec<StageComparison>,
}

impl Comparison {
    /// Compares with the JSON output of an earlier benchmark.
    ///
    /// # Errors
    /// It is none, or of another size.
    pub fn of(now: &Bench, before: &Value) -> Result<Self, String> {
        let sizes = [
            ("channels", now.channels as f64),
            ("daughters", now.daughters as f64),
            ("bits", f64::from(now.bits)),
            ("block_samples", now.block_samples as f64),
            ("sky_pixels", now.sky_pixels as f64),
            ("mission_s", now.mission_s),
        ];
        for (key, size) in sizes {
            match before[key].as_f64() {
                Some(found) if found == size => {}
                Some(found) => return Err(format!("{key} = {found}; expected {size}, as of this benchmark")),
                None => {
                    return Err(format!("no number {key}; expected what `lunarray bench --json` prints"));
                }
            }
        }
        let stages = now.rates.iter().filter_map(|rate| compare(rate, &before["rates"])).collect();
        let machine = &before["machine"];
        let text = |key: &str| machine[key].as_str().unwrap_or("unknown").to_owned();
        Ok(Self { before: ["version", "processor", "date"].map(text), stages })
    }
}

fn compare(now: &Rate, before: &Value) -> Option<StageComparison> {
    let before = before.as_array()?.iter().find(|rate| rate["stage"] == now.stage)?;
    let before_s = before["median_s"].as_f64()?;
    let [low, high] = [0, 1].map(|k| before["quartiles_s"][k].as_f64());
    let differs = now.quartiles_s[1] < low? || now.quartiles_s[0] > high?;
    let (stage, now_s) = (now.stage, now.median_s);
    Some(StageComparison { stage, before_s, now_s, times_as_fast: before_s / now_s, differs })
}
