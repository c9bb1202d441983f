//! lunarray in a browser tab: the chain of `lunarray run` for one channel, thinned, a step at a time.
//!
//! The page calls `start`, then `step` until it returns [`DONE`] or [`FAILED`], and reads text, picture and map from the module's memory
//! after each call.

// Names for JavaScript count as unsafe, as two libraries could use the same ones; there are no unsafe blocks.
#![allow(unsafe_code)]

mod session;
mod settings;

use std::cell::RefCell;

pub use session::Session;
pub use settings::Sliders;

/// Nothing new to show but the progress.
pub const RUNNING: u32 = 0;
/// There is a new map.
pub const MAP: u32 = 1;
/// The last map is there.
pub const DONE: u32 = 2;
/// The text is an error.
pub const FAILED: u32 = 3;

#[derive(Default)]
struct Page {
    session: Option<Session>,
    text: String,
}

thread_local! {
    static PAGE: RefCell<Page> = RefCell::default();
}

fn with<T>(work: impl FnOnce(&mut Page) -> T) -> T {
    PAGE.with(|page| work(&mut page.borrow_mut()))
}

/// Begins a mission; [`RUNNING`] or [`FAILED`].
#[unsafe(no_mangle)]
pub extern "C" fn start(altitude_km: f64, inclination_deg: f64, daughters: u32, frequency_mhz: f64) -> u32 {
    with(|page| {
        page.session = None;
        match Session::new(&Sliders { altitude_km, inclination_deg, daughters, frequency_mhz }) {
            Ok(session) => {
                page.text = session.describe();
                page.session = Some(session);
                RUNNING
            }
            Err(error) => {
                page.text = error.to_string();
                FAILED
            }
        }
    })
}

/// Observes one more window: [`RUNNING`], [`MAP`], [`DONE`] or [`FAILED`].
#[unsafe(no_mangle)]
pub extern "C" fn step() -> u32 {
    with(|page| {
        let Some(session) = &mut page.session else { return FAILED };
        match session.step() {
            Ok(has_map) => {
                page.text = session.describe();
                if session.is_done() { DONE } else { u32::from(has_map) }
            }
            Err(error) => {
                page.text = error.to_string();
                page.session = None;
                FAILED
            }
        }
    })
}

/// Address of the text: JSON, or an error.
#[unsafe(no_mangle)]
pub extern "C" fn text() -> *const u8 {
    with(|page| page.text.as_ptr())
}

/// Bytes of the text.
#[unsafe(no_mangle)]
pub extern "C" fn text_bytes() -> usize {
    with(|page| page.text.len())
}

/// Address of the picture of map and sky: PNG.
#[unsafe(no_mangle)]
pub extern "C" fn picture() -> *const u8 {
    with(|page| page.session.as_ref().map_or(std::ptr::null(), |session| session.picture().as_ptr()))
}

/// Bytes of the picture.
#[unsafe(no_mangle)]
pub extern "C" fn picture_bytes() -> usize {
    with(|page| page.session.as_ref().map_or(0, |session| session.picture().len()))
}

/// Address of the map: f64, K, HEALPix RING, ecliptic.
#[unsafe(no_mangle)]
pub extern "C" fn map() -> *const f64 {
    with(|page| page.session.as_ref().map_or(std::ptr::null(), |session| session.map_k().as_ptr()))
}

/// Pixels of the map.
#[unsafe(no_mangle)]
pub extern "C" fn map_pixels() -> usize {
    with(|page| page.session.as_ref().map_or(0, |session| session.map_k().len()))
}
