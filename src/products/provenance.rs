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
                &in_ascii(&name.chars().take(60).collect::<String>()),
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

/// A text as a header can hold it: what is not printable ASCII is percent-encoded, byte by byte in UTF-8 (RFC 3986).
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
