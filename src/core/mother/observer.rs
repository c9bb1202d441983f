//! Source of observing windows, for the space segment in visibility fidelity.

use super::thinning::WindowThinning;
use crate::array::{Array, ObservingWindows};
use crate::frames::ObservingWindow;
use crate::runtime::{Flow, Outlet, Source};

/// Emits the observing windows of a mission in the order of time.
#[derive(Debug)]
pub struct Observer {
    windows: std::vec::IntoIter<ObservingWindow>,
}

impl Observer {
    /// Creates a source of `windows`.
    #[must_use]
    pub fn new(windows: Vec<ObservingWindow>) -> Self {
        Self { windows: windows.into_iter() }
    }

    /// Windows of `array` from the epoch to `duration_s` that `thinning` keeps, in the order of time.
    #[must_use]
    pub fn windows(array: &Array, duration_s: f64, thinning: WindowThinning) -> Vec<ObservingWindow> {
        ObservingWindows::new(array, 0.0, duration_s).filter(|window| thinning.keeps(window.index)).collect()
    }
}

impl Source for Observer {
    type Out = ObservingWindow;
    type Error = std::convert::Infallible;

    fn next(&mut self, out: &mut Outlet<ObservingWindow>) -> Result<Flow, Self::Error> {
        match self.windows.next() {
            Some(window) => {
                out.push(window);
                Ok(Flow::Continue)
            }
            None => Ok(Flow::Done),
        }
    }
}
