//! The ground: every packet once, in order of use, and what is kept from one session to the next.

pub mod archive;
mod collector;
mod hold_buffer;
mod reception;

pub use collector::{Collector, CollectorState, CollectorView, Delivery, Placed};
pub use hold_buffer::{Waiting, WaitingPacket};
pub use reception::Reception;
