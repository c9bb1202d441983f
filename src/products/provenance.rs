//! Provenance of the maps.

use crate::frames::Instrument;
use crate::sky::fits::Card;
use crate::solve::Solution;

/// The ground segment's share of the provenance; the rest comes with each solution.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Provenance {
    /// Hash of the ground segment's configuration.
    pub ground_hash: u64,
}

impl Provenance {
    /// FITS header cards of a map. Runs on the same data give the same cards.
    #[must_use]
    pub fn cards(&self, solution: &Solution, what: &str) -> Vec<Card> {
        let Instrument { name, channels, seed, configuration_hash, epoch_tai_s, .. } =
            solution.instrument.as_ref();
        let frequency_hz = channels.get(usize::from(solution.channel.0)).map_or(0.0, |c| c.frequency_hz);
        vec![
            Card::text("CREATOR", concat!("lunarray ", env!("CARGO_PKG_VERSION")), "program"),
            Card::text(
                "PIPELINE",
                &name.chars().take(60).collect::<String>(),
                "instrument description's name",
            ),
            Card::text("CONTENT", what, "what the map shows"),
            Card::real("FREQ", frequency_hz, "[Hz] centre frequency"),
            Card::integer("NVIS", solution.visibilities.try_into().unwrap_or(i64::MAX), "visibilities used"),
            Card::real("TSTART", solution.span_s[0], "[s] first data, since the mission epoch"),
            Card::real("TSTOP", solution.span_s[1], "[s] last data, since the mission epoch"),
            Card::real("EPOCHTAI", *epoch_tai_s, "[s] mission epoch, TAI since 1958-01-01"),
            Card::real("EPSILON", solution.diagnostics.epsilon, "regularisation, of W_max"),
            Card::real("WMAX", solution.diagnostics.w_max, "[K-2] greatest eigenvalue of BtN^-1B"),
            Card::text("SEED", &format!("{seed:016x}"), "seed of the space segment, hexadecimal"),
            Card::text("HASHSPAC", &format!("{configuration_hash:016x}"), "configuration, space segment"),
            Card::text("HASHGRND", &format!("{:016x}", self.ground_hash), "configuration, ground segment"),
        ]
    }
}
