//! Provenance of the maps: header cards and captions.

use std::path::Path;

use super::config::PostProcessing;
use crate::frames::{AntennaResponse, Instrument};
use crate::imaging::Solution;
use crate::imaging::anywhere::Refinement;
use crate::imaging::{MapConfig, Method, RegulariserChoice};
use crate::sky::fits::Card;
use crate::units::calendar::tai_text;

/// The part of the provenance that is common to all maps. The rest comes with each solution.
#[derive(Clone, Debug, PartialEq)]
pub struct Provenance {
    /// Hash of the ground segment's configuration.
    pub ground_hash: u64,
    /// Configuration of the maps.
    pub map: MapConfig,
}

impl Provenance {
    /// FITS header cards of a map. Equal data give equal cards.
    #[must_use]
    pub fn cards(&self, solution: &Solution, what: &str, processing: Option<PostProcessing>) -> Vec<Card> {
        let Instrument { name, channels, seed, configuration_hash, epoch_tai_s, .. } =
            solution.instrument.as_ref();
        let frequency_hz = channels.get(usize::from(solution.channel.0)).map_or(0.0, |c| c.frequency_hz);
        let mut cards = vec![
            Card::text(
                "PIPELINE",
                &in_ascii(&name.chars().take(60).collect::<String>()),
                "instrument description's name",
            ),
            Card::text("CONTENT", what, "what the map shows"),
            Card::real("FREQ", frequency_hz, "[Hz] centre frequency"),
            Card::integer("NVIS", solution.visibilities.try_into().unwrap_or(i64::MAX), "visibilities used"),
            Card::real("TSTART", solution.span_s[0], "[s] first data, since the mission epoch"),
            Card::real("TSTOP", solution.span_s[1], "[s] last data, since the mission epoch"),
            Card::text("TELESCOP", "lunarray", "array of satellites in lunar orbit"),
            Card::text("INSTRUME", &in_ascii(&name.chars().take(60).collect::<String>()), "as PIPELINE"),
            Card::text("TIMESYS", "TAI", "scale of DATE-BEG and DATE-END"),
            Card::text("DATE-BEG", &tai_text(epoch_tai_s + solution.span_s[0]), "first data"),
            Card::text("DATE-END", &tai_text(epoch_tai_s + solution.span_s[1]), "last data"),
            Card::real("EPOCHTAI", *epoch_tai_s, "[s] mission epoch, TAI since 1958-01-01"),
            Card::text("SEED", &format!("{seed:016x}"), "seed of the space segment, hexadecimal"),
            Card::text("HASHSPAC", &format!("{configuration_hash:016x}"), "configuration, space segment"),
            Card::text("HASHGRND", &format!("{:016x}", self.ground_hash), "configuration, ground segment"),
        ];
        cards.extend(self.regulariser_cards(solution));
        cards.extend(self.method_cards(solution, frequency_hz));
        if let Some(interruption) = solution.interruption() {
            if solution.refinement.is_none() {
                cards.push(Card::logical("CONVERGD", false, "not the map of these data"));
            }
            cards.push(Card::text("WARNING", &interruption, ""));
        }
        if let Some(PostProcessing { split, fwhm_deg }) = processing {
            let split = i64::try_from(split).unwrap_or(i64::MAX);
            cards.push(Card::integer("SPLIT", split, "parts along a side of a pixel of the map as solved"));
            cards.push(Card::real("FWHM", fwhm_deg, "[deg] Gaussian beam to which it was smoothed then"));
        }
        cards
    }

    fn method_cards(&self, solution: &Solution, frequency_hz: f64) -> Vec<Card> {
        let map = &self.map;
        let mut cards = vec![
            Card::text("NOISE", noise_state(&solution.instrument), "thermal noise in the visibilities"),
            Card::text("ANTENNA", antenna_name(solution.instrument.response), "response of every daughter"),
            Card::text("ENGINE", engine_name(map), "unknowns of the solution"),
        ];
        match map.method() {
            Method::Pixel | Method::MatrixFree => {
                let rows = format!("{:?}", map.rows).to_lowercase();
                cards.push(Card::text("ROWS", &rows, "of B: average over pixels, or centre"));
                if let Some(convergence) = solution.diagnostics.convergence {
                    let products = i64::try_from(convergence.iterations).unwrap_or(i64::MAX);
                    let with = if map.is_matrix_free() {
                        "with rows of B made again"
                    } else {
                        "with the normal matrix"
                    };
                    cards.push(Card::integer("PRODUCTS", products, with));
                    cards.push(Card::real("RESIDUAL", convergence.residual, "of the equations, relative"));
                }
            }
            Method::Harmonic | Method::Refined => {
                let l_max = i64::try_from(map.degree()).unwrap_or(i64::MAX);
                cards.push(Card::integer("LMAX", l_max, "greatest degree of the solution"));
                if let Some(refinement) = &solution.refinement {
                    cards.extend(self.refinement_cards(refinement, solution.has_converged()));
                }
            }
        }
        let (limit_m, limit) = (map.baseline_m_max(frequency_hz), map.baseline_bp_max);
        cards.push(Card::real("BASEMAX", limit_m, "[m] longest baseline used"));
        cards.push(Card::real("BPMAX", limit, "the same in units of b_p = wavelength / pixel"));
        let channel = usize::from(solution.channel.0);
        if let Some(path) = map.beyond_files.get(channel) {
            cards.push(Card::text("BEYOND", &file_name(path), "sky's power; above LMAX it counts as noise"));
        }
        cards.push(Card::text("PRIOR", &self.prior(channel), "prior map"));
        cards
    }

    fn regulariser_cards(&self, solution: &Solution) -> Vec<Card> {
        let mut cards = Vec::new();
        if let Some(epsilon) = solution.diagnostics.epsilon {
            cards.push(Card::real("EPSILON", epsilon, "regularisation, of W_max"));
        }
        if let Some(w_max) = solution.diagnostics.w_max {
            cards.push(Card::real("WMAX", w_max, "[K-2] greatest eigenvalue of BtN^-1B"));
        }
        let channel = usize::from(solution.channel.0);
        match self.map.regulariser() {
            RegulariserChoice::Data => {
                cards.push(Card::text("REGULAR", "data", "R_l = 1 / C_l of the sky from the data"));
            }
            RegulariserChoice::Degree(exponent) => {
                cards.push(Card::real("REXPON", exponent, "R_l = EPSILON WMAX (l + 1)^REXPON"));
            }
            RegulariserChoice::File(files) => {
                if let Some(path) = files.get(channel) {
                    cards.push(Card::text("RPOWER", &file_name(path), "R_l = EPSILON / C_l of this table"));
                }
            }
            _ => {}
        }
        cards
    }

    fn refinement_cards(&self, refinement: &Refinement, has_converged: bool) -> Vec<Card> {
        let iterations = i64::try_from(refinement.convergence.iterations).unwrap_or(i64::MAX);
        let antennas = match self.map.antennas.keys_set() {
            keys if keys.is_empty() => "ideal".to_owned(),
            keys => keys.join(", "),
        };
        vec![
            Card::integer("PASSES", iterations, "over visibilities, rows of true positions"),
            Card::real("RESIDUAL", refinement.convergence.residual, "of the equations, relative"),
            Card::logical("CONVERGD", has_converged, "no more passes are needed"),
            Card::logical("SMEARED", self.map.refine.smear_integrations, "rows averaged over integrations"),
            Card::text("ANTROWS", &antennas, ""),
        ]
    }

    fn prior(&self, channel: usize) -> String {
        let map = &self.map;
        match map.prior_files.get(channel) {
            Some(path) => format!("{}, FWHM {} deg", file_name(path), map.prior_fwhm_deg),
            None => match map.prior_k.get(channel) {
                Some(level_k) if level_k != 0.0 => format!("uniform, {level_k:e} K"),
                _ => "none".to_owned(),
            },
        }
    }

    /// Line on the method below the picture of a map.
    pub(super) fn caption(&self, solution: &Solution) -> String {
        let map = &self.map;
        let prior = self.prior(usize::from(solution.channel.0));
        let epsilon = solution.diagnostics.epsilon.unwrap_or(1.0);
        let regulariser = match map.regulariser() {
            RegulariserChoice::Data => "R from the data".to_owned(),
            RegulariserChoice::Degree(exponent) => format!("epsilon {epsilon:e} (l + 1)^{exponent}"),
            RegulariserChoice::File(_) => format!("epsilon {epsilon:e} / C_{{l}}"),
            _ => format!("epsilon {epsilon:e}"),
        };
        let warning = if solution.has_converged() { "" } else { "NOT CONVERGED, " };
        format!(
            "{warning}{regulariser}, b < {} b_p, prior: {prior}, thermal noise {}",
            map.baseline_bp_max,
            noise_state(&solution.instrument)
        )
    }
}

/// The last 30 characters of a file name, as a header card holds 68.
fn file_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy();
    let name: String = name.chars().filter(char::is_ascii_graphic).collect();
    name[name.len().saturating_sub(30)..].to_owned()
}

fn noise_state(instrument: &Instrument) -> &'static str {
    if instrument.noiseless { "off" } else { "on" }
}

fn antenna_name(response: AntennaResponse) -> &'static str {
    match response {
        AntennaResponse::Isotropic => "isotropic",
        AntennaResponse::DipoleNormal => "dipole-normal",
        AntennaResponse::ThreeDipoles => "three-dipoles",
    }
}

fn engine_name(map: &MapConfig) -> &'static str {
    if map.is_harmonic() { "harmonic" } else { "pixel" }
}

/// Encodes a text for a header: UTF-8 bytes that are not printable ASCII are percent-encoded (RFC 3986).
fn in_ascii(text: &str) -> String {
    text.bytes()
        .map(|byte| match byte {
            0x20..=0x7e => char::from(byte).to_string(),
            _ => format!("%{byte:02X}"),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_in_any_script_fit_a_header() {
        assert_eq!(in_ascii("it's 100 % ASCII"), "it's 100 % ASCII");
        // U+00E4 and U+6708 in UTF-8 (RFC 3629).
        assert_eq!(in_ascii("m\u{e4}rz \u{6708}"), "m%C3%A4rz %E6%9C%88");
        assert_eq!(in_ascii("a\x1b[31m\n\x7f"), "a%1B[31m%0A%7F");
    }
}
