//! What all solvers begin with, and what they say of their map.

use serde::Serialize;

use super::conjugate_gradients::Convergence;
use super::fit::Fit;
use super::traces::{Traces, UnsupportedEpsilon};
use super::vectors::subtract;
use crate::imaging::NormalSums;
use crate::imaging::SolveError;

/// Diagnostics of a solution. Eigenvalues and traces are in pixel units, for harmonic maps too.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct Diagnostics {
    /// epsilon of `R = epsilon W_max I`; absent if R is from the data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epsilon: Option<f64>,
    /// W_max, the largest eigenvalue of `BtN^-1B`, K^-2; absent if R is from the data, or, of pixel maps, a table.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub w_max: Option<f64>,
    /// Number of Lanczos iterations for W_max.
    pub w_max_iterations: usize,
    /// Maximum degree solved for; absent for a pixel map whose R is the identity, or from the data up to nside 32.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub l_max: Option<usize>,
    /// Whether pixels are solved for by their harmonics, so that errors include the sky's degrees beyond these.
    #[serde(skip)]
    pub is_of_pixels: bool,
    /// Whether C_l and errors rest on blocks that are not near the matrix, as the node of the orbit has not turned evenly: these may be far from true.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub errors_may_mislead: bool,
    /// Convergence of the map; absent after a factorisation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub convergence: Option<Convergence>,
    /// Convergence of the noise-only map.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise_convergence: Option<Convergence>,
    /// Traces of the covariances, if requested and not interrupted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub traces: Option<Traces>,
    /// Why requested traces could not be computed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub traces_refused: Option<UnsupportedEpsilon>,
    /// The fit of the map to the data, if traces were requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fit: Option<Fit>,
}

impl Diagnostics {
    /// That of a pixel map which was iterated; a direct solution has none.
    pub(crate) fn convergence_of_pixels(&self) -> Option<Convergence> {
        self.convergence.filter(|_| self.l_max.is_none() || self.is_of_pixels)
    }

    /// Diagnostics of a map up to `l_max` with R from the data.
    pub(in crate::imaging) fn of_power(l_max: usize, convergence: &[Convergence]) -> Self {
        Self { l_max: Some(l_max), ..Self::default() }.with_convergence(convergence)
    }

    /// Adds the convergence of the map and of its noise map.
    pub(in crate::imaging) fn with_convergence(self, found: &[Convergence]) -> Self {
        Self { convergence: found.first().copied(), noise_convergence: found.get(1).copied(), ..self }
    }

    /// Adds traces in pixel units; `per_area_sr` is a pixel's area for harmonic sums, 1 for pixel sums.
    pub(in crate::imaging) fn with_traces(
        mut self,
        found: Result<Option<Traces>, UnsupportedEpsilon>,
        per_area_sr: f64,
    ) -> Self {
        match found {
            Ok(traces) => {
                self.traces =
                    traces.map(|traces| Traces { sigma_n_k2: traces.sigma_n_k2 / per_area_sr, ..traces });
            }
            Err(refused) => self.traces_refused = Some(refused),
        }
        self
    }
}

/// The map of a sky that is 1 K in one pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct PointBeam {
    /// Index of the pixel.
    pub pixel: usize,
    /// Map, K, HEALPix RING; for harmonic maps the sky is that pixel up to the map's maximum degree.
    pub map_k: Vec<f64>,
}

/// Requires that there is data and a positive regularisation.
pub(in crate::imaging) fn check_request(sums: &dyn NormalSums, epsilon: f64) -> Result<(), SolveError> {
    if sums.counts().visibilities == 0 {
        return Err(SolveError::NoData);
    }
    if epsilon.is_nan() || epsilon <= 0.0 {
        return Err(SolveError::Epsilon(epsilon));
    }
    Ok(())
}

/// The right-hand side of the map less its prior, `BtN^-1V - BtN^-1B prior`.
pub(in crate::imaging) fn right_hand_side(
    sums: &dyn NormalSums,
    prior: Option<&[f64]>,
) -> Result<Vec<f64>, SolveError> {
    let mut right = sums.right_hand_side().to_vec();
    if let Some(prior) = prior {
        if prior.len() != right.len() {
            return Err(SolveError::PriorLength { found: prior.len(), expected: right.len() });
        }
        let mut predicted = vec![0.0; prior.len()];
        sums.apply(prior, &mut predicted);
        subtract(&mut right, 1.0, &predicted);
    }
    Ok(right)
}
