//! Late blocks, through the whole chain.

use lunarray::downlink::Transmitter;
use lunarray::frames::{GroundFrame, SampleBlock, Samples, SpaceFrame};
use lunarray::ground::Reception;
use lunarray::mother::Store;
use lunarray::pipeline::{ConfigSource, Plan, SampleCounts, sample_stages};
use lunarray::runtime::{Flow, Outlet, Source, Stage};
use lunarray::units::all_pairs;

use crate::craft::constant;

const PIPELINE: &str = r#"
    name = "late"
    seed = 5
    sky.nside = 4
    map.nside = 4
    [spacecraft]
    fidelity = "samples"
    channels_hz = [1.0e6]
    duration_s = 26e3
    window_s_max = 4.0
    flag_earth = false # the last daughters see the Earth for 64 s of a window
    auto_integration_s = 0.0
    wait_blocks = 4
"#;

/// Blocks of a window of 32,000 samples: 31 of 1024 and one of 256.
const BLOCKS: u64 = 32;

/// A link that holds back some blocks of daughter 4 until blocks a given number ahead have passed, or the window ends. It
/// sets all samples to one, so that powers are one and weights are twice the number of samples.
#[derive(Default)]
struct Slow {
    held: Vec<(u64, SampleBlock)>,
}

/// Number of blocks by which a block is held back.
fn held_back(daughter: u8, number: u64) -> u64 {
    match (daughter, number % 11, number % 5) {
        (3, 3, _) => 7,
        (3, _, 0) => 2,
        _ => 0,
    }
}

/// Whether a block arrives after the mother, which waits for 4 blocks, has given it up.
fn is_late(daughter: u8, number: u64) -> bool {
    held_back(daughter, number) > 4 && number + 4 < BLOCKS
}

impl Stage for Slow {
    type In = SpaceFrame;
    type Out = SpaceFrame;
    type Error = std::convert::Infallible;

    fn step(&mut self, frame: SpaceFrame, out: &mut Outlet<SpaceFrame>) -> Result<(), Self::Error> {
        let SpaceFrame::Samples(blocks) = frame else {
            if matches!(frame, SpaceFrame::WindowEnd(_)) {
                out.push(SpaceFrame::Samples(self.held.drain(..).map(|(_, block)| block).collect()));
            }
            out.push(frame);
            return Ok(());
        };
        let mut sent = Vec::new();
        for block in blocks {
            let length = block.samples.len();
            let samples = Samples::Float { re: vec![1.0; length], im: vec![0.0; length] };
            let (number, last) = (block.number, block.daughter == 7);
            let block = SampleBlock { samples, ..block };
            match held_back(block.daughter, number) {
                0 => sent.push(block),
                numbers => self.held.push((number + numbers, block)),
            }
            if last {
                // All daughters have sent this number.
                sent.extend(self.held.extract_if(.., |(until, _)| *until <= number).map(|(_, block)| block));
            }
        }
        out.push(SpaceFrame::Samples(sent));
        Ok(())
    }
}

fn through<S: Stage>(mut stage: S, input: Vec<S::In>) -> Vec<S::Out> {
    let mut out = Outlet::collect();
    input.into_iter().for_each(|item| stage.step(item, &mut out).unwrap());
    stage.finish(&mut out).unwrap();
    out.into_vec()
}

#[test]
fn late_blocks_are_in_the_accounts_and_in_no_weight() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("late.toml");
    std::fs::write(&path, PIPELINE).unwrap();
    let source = ConfigSource { file: Some(path), ..ConfigSource::default() };
    let plan = Plan::new(source.load().unwrap()).unwrap();
    let counts = SampleCounts::default();
    let (mut sampler, link, correlator) = sample_stages(&plan, vec![constant(0.0)(1e6)], &counts);
    let mut sampled = Outlet::collect();
    while sampler.next(&mut sampled).unwrap() == Flow::Continue {}
    let frames = through(Slow::default(), through(link, sampled.into_vec()));
    let visibilities = through(correlator, frames);
    let passes = through(Store::new(&plan.config.spacecraft, None), visibilities);
    let packets = through(Transmitter::new(&plan.config.downlink).unwrap(), passes);
    let received = through(Reception::new(0, 1024, std::sync::Arc::default()), packets);

    let windows = plan.windows.len() as u64;
    let late: u64 = (0..BLOCKS).map(|number| u64::from(is_late(3, number))).sum();
    let in_time = (0..BLOCKS).filter(|&number| held_back(3, number) > 0 && !is_late(3, number)).count();
    assert!(late == 3 && in_time > 4 && windows > 1);
    let (sampler, blocks) = (*counts.sampler.lock().unwrap(), counts.correlator.lock().unwrap().blocks);
    assert_eq!(sampler.samples, windows * 8 * 32_000);
    assert_eq!((blocks.late, blocks.missing), (windows * late, windows * late));
    assert_eq!((blocks.used, blocks.duplicate, blocks.malformed), (windows * (8 * BLOCKS - late), 0, 0));
    assert_eq!(blocks.late_samples, windows * late * 1024);
    assert_eq!(sampler.samples, blocks.used_samples + blocks.late_samples);
    for pair in all_pairs(8) {
        let whole = (0..BLOCKS).filter(|&number| !is_late(pair.i, number) && !is_late(pair.j, number));
        let expected: u64 = whole.map(|number| if number == BLOCKS - 1 { 256 } else { 1024 }).sum();
        let mut found = 0.0;
        for frame in &received {
            if let GroundFrame::Visibilities(block) = frame
                && block.pair == pair
            {
                found += block.weight.iter().map(|&weight| f64::from(weight) / 2.0).sum::<f64>();
            }
        }
        // Powers of one and numbers below 2^24: every weight is exact; one without samples is 1e-38.
        assert_eq!(found, (windows * expected) as f64, "{pair}");
    }
}
