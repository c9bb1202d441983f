//! A stage of one's own: a source, a stage and a sink, each on its thread, joined by bounded queues.
//!
//! The stage here averages the power of every visibility block. A stage never spawns threads and never reads clocks;
//! the runner does. Alone, it is tested with `Outlet::collect()`.

mod common;

use std::convert::Infallible;
use std::error::Error;
use std::time::Duration;

use lunarray::downlink::{DownlinkError, DownlinkReader};
use lunarray::frames::{GroundFrame, VisibilityBlock};
use lunarray::runtime::{Cancel, Flow, Graph, Outlet, Sink, Source, Stage, Units};
use num_complex::Complex32;

/// Gives the visibility blocks of a downlink file.
struct Blocks(DownlinkReader);

impl Source for Blocks {
    type Out = VisibilityBlock;
    type Error = DownlinkError;

    fn next(&mut self, out: &mut Outlet<VisibilityBlock>) -> Result<Flow, DownlinkError> {
        match self.0.next_frame()? {
            Some(GroundFrame::Visibilities(block)) => out.push(block),
            Some(_) => {}
            None => return Ok(Flow::Done),
        }
        Ok(Flow::Continue)
    }
}

/// Averages |V|^2 over each block.
#[derive(Default)]
struct MeanPower {
    visibilities: u64,
}

impl Stage for MeanPower {
    type In = VisibilityBlock;
    type Out = f64;
    type Error = Infallible;

    fn step(&mut self, block: VisibilityBlock, out: &mut Outlet<f64>) -> Result<(), Infallible> {
        self.visibilities += block.len() as u64;
        if !block.is_empty() {
            let power: f64 = block.value_k_sr.iter().map(|value| f64::from(value.norm_sqr())).sum();
            out.push(power / block.len() as f64);
        }
        Ok(())
    }

    // What the run's report counts for this stage.
    fn units(&self) -> Units {
        Units::of(self.visibilities, "visibilities")
    }
}

/// Prints the strongest block at the end.
#[derive(Default)]
struct Strongest(f64);

impl Sink for Strongest {
    type In = f64;
    type Error = std::io::Error;

    fn take(&mut self, power: f64) -> Result<(), std::io::Error> {
        self.0 = self.0.max(power);
        Ok(())
    }

    fn finish(&mut self) -> Result<(), std::io::Error> {
        println!("strongest block: {:.3e} (K sr)^2", self.0);
        // An error ends the run, and `Graph::run` returns it with the stage's name.
        if self.0 > 0.0 { Ok(()) } else { Err(std::io::Error::other("a sky without power")) }
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    // The stage alone.
    let mut collected = Outlet::collect();
    let block = VisibilityBlock { value_k_sr: vec![Complex32::new(3.0, 4.0)], ..VisibilityBlock::default() };
    MeanPower::default().step(block, &mut collected)?;
    assert_eq!(collected.into_vec(), [25.0]);

    // The stage in a graph.
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("small.ccsds");
    common::small_downlink(&file)?;
    let mut graph = Graph::new();
    let blocks = graph.source("read", 4, Blocks(DownlinkReader::open(&file)?));
    let powers = graph.stage("power", 4, blocks, MeanPower::default());
    graph.sink("strongest", powers, Strongest::default());
    let report = graph.run(&Cancel::new(), Duration::from_secs(10))?;
    for stage in &report.stages {
        println!("{}: {} items in, {} out", stage.name, stage.items_in, stage.items_out);
    }
    Ok(())
}
