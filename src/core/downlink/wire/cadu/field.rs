//! The Galois field of the code, GF(2^8) with x^8 + x^7 + x^2 + x + 1, and the dual basis (CCSDS 131.0-B, 4.3 and annex F).

/// The field's polynomial without its leading term.
const POLYNOMIAL: u8 = 0x87;

/// Rows of the matrix that transforms a symbol from the conventional to the dual basis, the highest power first
/// (131.0-B, annex F).
const TO_DUAL: [u8; 8] = [0x8D, 0xEF, 0xEC, 0x86, 0xFA, 0x99, 0xAF, 0x7B];

pub(super) const ORDER: usize = 255;

/// Placeholder for the logarithm of 0, larger than any sum of two others.
const LOG_OF_ZERO: u16 = 511;

/// Tables of the field.
#[derive(Debug)]
pub(super) struct GaloisField {
    /// Powers of the primitive element, repeated once, so that sums of two logarithms need no reduction; then zeros.
    exp: [u8; 1024],
    /// Logarithms. The sum of [`LOG_OF_ZERO`] and any other indexes a zero of `exp`.
    log: [u16; 256],
    /// Symbols in the dual basis, indexed by symbols in the conventional basis.
    pub(super) to_dual: [u8; 256],
    /// Symbols in the conventional basis, indexed by symbols in the dual basis.
    pub(super) to_conventional: [u8; 256],
}

/// The tables, computed at compile time.
pub(super) static FIELD: GaloisField = tables();

const fn tables() -> GaloisField {
    let (mut exp, mut log) = ([0; 1024], [LOG_OF_ZERO; 256]);
    let (mut power, mut element) = (0, 1_u8);
    while power < ORDER {
        exp[power] = element;
        exp[power + ORDER] = element;
        log[element as usize] = power as u16;
        element = times_primitive(element);
        power += 1;
    }
    let (mut to_dual, mut to_conventional) = ([0; 256], [0; 256]);
    let mut symbol = 0;
    while symbol < 256 {
        let (mut dual, mut row) = (0, 0);
        while row < 8 {
            if symbol >> (7 - row) & 1 == 1 {
                dual ^= TO_DUAL[row];
            }
            row += 1;
        }
        to_dual[symbol] = dual;
        to_conventional[dual as usize] = symbol as u8;
        symbol += 1;
    }
    GaloisField { exp, log, to_dual, to_conventional }
}

/// `element` times the primitive element.
pub(super) const fn times_primitive(element: u8) -> u8 {
    (element << 1) ^ (POLYNOMIAL & (element >> 7).wrapping_neg())
}

impl GaloisField {
    pub(super) fn multiply(&self, a: u8, b: u8) -> u8 {
        self.exp[self.log(a) + self.log(b)]
    }

    pub(super) fn log(&self, a: u8) -> usize {
        usize::from(self.log[usize::from(a)])
    }

    /// `a` divided by a non-zero `b`.
    pub(super) fn divide(&self, a: u8, b: u8) -> u8 {
        self.exp[self.log(a) + ORDER - self.log(b)]
    }

    /// The primitive element to the power of `exponent`.
    pub(super) fn power(&self, exponent: usize) -> u8 {
        self.exp[exponent % ORDER]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_follow_the_standard() {
        // 131.0-B, annex F, and the tables of libfec (Karn): powers 0, 1, 2, 7, 8, 31, 254 and transformed symbols.
        let powers = [(0, 0x01), (1, 0x02), (2, 0x04), (7, 0x80), (8, 0x87), (31, 0xCD), (254, 0xC3)];
        assert!(powers.iter().all(|&(power, element)| FIELD.power(power) == element));
        assert_eq!(FIELD.to_dual[..8], [0x00, 0x7B, 0xAF, 0xD4, 0x99, 0xE2, 0x36, 0x4D]);
        assert_eq!(FIELD.to_conventional[..8], [0x00, 0xCC, 0xAC, 0x60, 0x79, 0xB5, 0xD5, 0x19]);
        assert_eq!((FIELD.to_dual[0xFF], FIELD.to_conventional[0xFF]), (0xBF, 0xBD));
    }

    #[test]
    fn multiplication_has_inverses_and_is_distributive() {
        for a in 1..=255 {
            assert_eq!(FIELD.multiply(a, 2), times_primitive(a));
            assert_eq!(FIELD.multiply(FIELD.divide(1, a), a), 1);
            for b in 0..=255 {
                assert_eq!(FIELD.multiply(a, b ^ 0x5C), FIELD.multiply(a, b) ^ FIELD.multiply(a, 0x5C));
            }
        }
    }
}
