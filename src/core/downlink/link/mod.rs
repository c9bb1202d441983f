//! A simulated link with seeded faults: bit errors, bursts, losses, duplicates, reordering, truncation.
//!
//! [`LinkSimulator`] damages a downlink of either format and records the truth: which frames and packets no receiver can
//! recover. Tests compare the ground's counts with it. [`LinkStage`] is the link in a pipeline, [`corrupt`] the link
//! between two files.
//!
//! Uses `wire`, and `receive` to detect a file's format. The same seed gives the same faults for any chunk size.

mod bit_errors;
mod bit_writer;
mod file;
mod simulator;
mod splitter;
mod truth;

pub use super::config::LinkConfig;
pub use file::corrupt;
#[doc(hidden)]
pub use file::{LinkStage, truth_path};
#[doc(hidden)]
pub use simulator::LinkSimulator;
pub use truth::LinkTruth;
#[doc(hidden)]
pub use truth::{FrameFate, LostFrames, PacketRange};
