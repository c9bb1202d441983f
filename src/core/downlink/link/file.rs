//! The simulated link as a stage and between files. It writes the truth beside the damaged file.

use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use super::simulator::LinkSimulator;
use super::truth::LinkTruth;
use crate::downlink::config::DownlinkConfig;
use crate::downlink::config::LinkConfig;
use crate::downlink::error::{DownlinkError, io_error};
use crate::downlink::receive::{DownlinkFile, EventReader};
use crate::downlink::wire::cadu::ReedSolomon;
use crate::files::{AtomicFile, IfUnfinished, ProtectedInputs, write_atomically};
use crate::runtime::{Outlet, Stage, Units};

const READ_BYTES: usize = 1 << 18;

/// Path of the truth about a damaged downlink: the downlink's path plus `.truth.json`.
#[must_use]
pub fn truth_path(downlink: &Path) -> PathBuf {
    let mut name = downlink.as_os_str().to_owned();
    name.push(".truth.json");
    PathBuf::from(name)
}

fn write_truth(downlink: &Path, truth: &LinkTruth) -> Result<(), DownlinkError> {
    let path = truth_path(downlink);
    let text = serde_json::to_vec(truth).map_err(std::io::Error::from);
    text.and_then(|text| write_atomically(&path, &text)).map_err(io_error(&path, "write the truth"))
}

/// The simulated link between spacecraft and ground, as a stage.
#[derive(Debug)]
pub struct LinkStage {
    simulator: LinkSimulator,
    downlink: PathBuf,
    bytes: u64,
}

impl LinkStage {
    /// A link that writes its truth beside the file `downlink`; `None` for a link without faults and without a limit of its
    /// rate.
    ///
    /// # Errors
    /// The configuration is invalid.
    pub fn new(config: &DownlinkConfig, seed: u64, downlink: &Path) -> Result<Option<Self>, DownlinkError> {
        // With a limited rate the spacecraft drops data, which the truth reports too.
        if !config.link.is_on() && config.rate_bits_per_s_max == 0.0 {
            return Ok(None);
        }
        let simulator = LinkSimulator::new(&config.link, seed, config.code())?;
        Ok(Some(Self { simulator, downlink: downlink.to_owned(), bytes: 0 }))
    }

    fn forward(&mut self, bytes: Vec<u8>, out: &mut Outlet<Vec<u8>>) {
        self.bytes += bytes.len() as u64;
        if !bytes.is_empty() {
            out.push(bytes);
        }
    }
}

impl Stage for LinkStage {
    type In = Vec<u8>;
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn step(&mut self, bytes: Vec<u8>, out: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        let mut arrived = Vec::new();
        self.simulator.push(&bytes, &mut arrived)?;
        self.forward(arrived, out);
        Ok(())
    }

    fn finish(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        let mut arrived = Vec::new();
        let truth = self.simulator.finish(&mut arrived)?;
        write_truth(&self.downlink, truth)?;
        self.forward(arrived, out);
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}

/// Sends an undamaged file over a simulated link to another file, and writes the truth beside it.
///
/// # Errors
/// A file cannot be read or written; the input is not an undamaged downlink; the configuration is invalid.
pub fn corrupt(from: &Path, to: &Path, config: &LinkConfig, seed: u64) -> Result<LinkTruth, DownlinkError> {
    let _input = ProtectedInputs::of([from]);
    let mut simulator = LinkSimulator::new(config, seed, code_of(from)?)?;
    let mut source = DownlinkFile::open(from)?;
    let mut file = AtomicFile::create(to, IfUnfinished::Remove).map_err(io_error(to, "create the file"))?;
    let (mut bytes, mut arrived) = (Vec::new(), Vec::new());
    let in_input = |error: DownlinkError| error.at(from);
    loop {
        bytes.clear();
        arrived.clear();
        let read = Read::by_ref(&mut source).take(READ_BYTES as u64).read_to_end(&mut bytes);
        if read.map_err(io_error(from, "read"))? == 0 {
            break;
        }
        simulator.push(&bytes, &mut arrived).map_err(in_input)?;
        file.write_all(&arrived).map_err(io_error(to, "write"))?;
    }
    let truth = simulator.finish(&mut arrived).map_err(in_input)?.clone();
    file.write_all(&arrived).map_err(io_error(to, "write"))?;
    file.finish().map_err(io_error(to, "finish the file"))?;
    write_truth(to, &truth)?;
    Ok(truth)
}

/// The code of a file's frames; `None` for plain packets.
fn code_of(path: &Path) -> Result<Option<ReedSolomon>, DownlinkError> {
    let mut events = EventReader::open(path)?;
    // The receiver knows the format before it returns an event.
    events.find(|_| Some(()))?;
    if events.receiver().format().is_none() {
        events.require_packets()?;
    }
    Ok(events.receiver().frames().and_then(|frames| ReedSolomon::new(frames.interleave)))
}
