//! Pipeline files, overrides on the command line, and files of gains: parsed, checked, and what they would cost.
#![no_main]

use std::fmt::Write;

use libfuzzer_sys::fuzz_target;
use lunarray::calibration::GainsFile;
use lunarray::pipeline::{ConfigSource, PipelineError, Plan};

/// Windows times pairs of satellites up to which a plan is made: more take longer than a fuzzer has.
const PLAN_MAX: f64 = 2_000.0;

fn pipeline(source: &ConfigSource, text: &str, said: &mut String) {
    let config = match source.parse_text(text) {
        Ok(config) => config,
        Err(error) => return write!(said, "{error}").expect("memory"),
    };
    let problems = config.problems();
    for problem in &problems {
        write!(said, "{problem}").expect("memory");
    }
    // What was read can be written, and means the same.
    let written = toml::to_string(&config).expect("every configuration has a form");
    let again = ConfigSource::default().parse_text(&written).expect("its own form");
    assert_eq!(config.space_hash(), again.space_hash());
    let orbits = config.spacecraft.duration_s / config.array.orbital_period_s;
    let pairs = (config.array.satellites as f64).powi(2) * config.spacecraft.channels_hz.len() as f64;
    if problems.is_empty() && orbits * pairs < PLAN_MAX {
        let plan = match Plan::new(config) {
            Ok(plan) => plan,
            Err(PipelineError::NoWindow { .. }) => return,
            Err(error) => panic!("a configuration without problems: {error}"),
        };
        let nsides = vec![plan.config.sky.nside; plan.schedules.len()];
        for (expected, model) in plan.visibilities().into_iter().zip(plan.model_plans(&nsides)) {
            assert!(expected.sent >= 0.0 && expected.mapped <= expected.sent);
            assert!(model.bytes >= 0.0 && model.direct_fringes >= 0.0);
        }
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((&how, data)) = data.split_first() else { return };
    let Ok(text) = std::str::from_utf8(data) else { return };
    let mut said = String::new();
    match how % 4 {
        2 => {
            let overrides = text.lines().map(str::to_owned).collect();
            pipeline(&ConfigSource { overrides, ..ConfigSource::default() }, "", &mut said);
        }
        3 => {
            if let Ok(gains) = toml::from_str::<GainsFile>(text) {
                for problem in gains.problems() {
                    write!(said, "{problem}").expect("memory");
                }
            }
        }
        _ => pipeline(&ConfigSource::default(), text, &mut said),
    }
});
