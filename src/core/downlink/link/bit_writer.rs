//! A writer of bits, for streams that lose or gain single bits.

/// Appends bytes to a bit stream, which need not be aligned to bytes.
#[derive(Debug, Default)]
pub(super) struct BitWriter {
    bytes: Vec<u8>,
    /// Number of used bits of the last byte; 0 if all are used.
    used_bits: u32,
}

impl BitWriter {
    pub(super) fn push(&mut self, bytes: &[u8]) {
        if self.used_bits == 0 {
            self.bytes.extend_from_slice(bytes);
            return;
        }
        for octet in bytes {
            self.push_bits(*octet, 8);
        }
    }

    /// Appends bytes without their bit number `bit`, or with `added` inserted before it.
    pub(super) fn slip(&mut self, bytes: &[u8], bit: usize, added: Option<bool>) {
        let (before, rest) = bytes.split_at(bit / 8);
        self.push(before);
        let Some((octet, after)) = rest.split_first() else { return };
        let upper = (bit % 8) as u32;
        if upper > 0 {
            self.push_bits(*octet, upper);
        }
        let lower = match added {
            Some(added) => {
                self.push_bits(u8::from(added) << 7, 1);
                upper
            }
            None => upper + 1,
        };
        if lower < 8 {
            self.push_bits(octet << lower, 8 - lower);
        }
        self.push(after);
    }

    pub(super) fn bits(&self) -> i64 {
        8 * self.bytes.len() as i64 - i64::from((8 - self.used_bits) % 8)
    }

    /// The bytes, with the last one padded with zeros.
    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    /// Appends the `count` upper bits of a byte.
    fn push_bits(&mut self, octet: u8, count: u32) {
        let octet = octet & (0xFF00_u16 >> count) as u8;
        match self.bytes.last_mut().filter(|_| self.used_bits > 0) {
            Some(last) => {
                *last |= octet >> self.used_bits;
                if self.used_bits + count > 8 {
                    self.bytes.push(octet << (8 - self.used_bits));
                }
            }
            None => self.bytes.push(octet),
        }
        self.used_bits = (self.used_bits + count) % 8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_are_removed_and_inserted_at_the_given_place() {
        let bits = |bytes: &[u8]| bytes.iter().map(|octet| format!("{octet:08b}")).collect::<String>();
        let sent = [0b1011_0010, 0b0100_1101, 0b1110_0001];
        for bit in 0..24 {
            for slip in [None, Some(false), Some(true)] {
                let mut writer = BitWriter::default();
                writer.slip(&sent, bit, slip);
                writer.push(&sent);
                let mut expected = bits(&sent);
                match slip {
                    None => drop(expected.remove(bit)),
                    Some(added) => expected.insert(bit, if added { '1' } else { '0' }),
                }
                expected += &bits(&sent);
                assert_eq!(writer.bits(), expected.len() as i64);
                let found = bits(&writer.into_bytes());
                assert_eq!(found[..expected.len()], expected, "{bit}, {slip:?}");
                assert!(
                    found[expected.len()..].chars().all(|bit| bit == '0') && found.len() < expected.len() + 8
                );
            }
        }
    }
}
