//! Little-endian arrays of numbers. The loops compile to plain copies on little-endian machines.

use num_complex::Complex32;

use crate::units::vector::Vec3;

/// Appends `N * count` zero bytes and returns them.
fn append_zeros<const N: usize>(out: &mut Vec<u8>, count: usize) -> &mut [[u8; N]] {
    let start = out.len();
    out.resize(start + N * count, 0);
    out[start..].as_chunks_mut().0
}

pub(super) fn put_u32(values: &[u32], out: &mut Vec<u8>) {
    for (bytes, value) in append_zeros::<4>(out, values.len()).iter_mut().zip(values) {
        *bytes = value.to_le_bytes();
    }
}

pub(super) fn put_f32(values: &[f32], out: &mut Vec<u8>) {
    for (bytes, value) in append_zeros::<4>(out, values.len()).iter_mut().zip(values) {
        *bytes = value.to_le_bytes();
    }
}

pub(super) fn put_complex32(values: &[Complex32], out: &mut Vec<u8>) {
    for (bytes, value) in append_zeros::<8>(out, values.len()).iter_mut().zip(values) {
        bytes[..4].copy_from_slice(&value.re.to_le_bytes());
        bytes[4..].copy_from_slice(&value.im.to_le_bytes());
    }
}

pub(super) fn put_f64<'a>(values: impl ExactSizeIterator<Item = &'a f64>, out: &mut Vec<u8>) {
    for (bytes, value) in append_zeros::<8>(out, values.len()).iter_mut().zip(values) {
        *bytes = value.to_le_bytes();
    }
}

pub(super) fn put_vec3(values: &[Vec3], out: &mut Vec<u8>) {
    for (bytes, value) in append_zeros::<24>(out, values.len()).iter_mut().zip(values) {
        for (bytes, x) in bytes.as_chunks_mut().0.iter_mut().zip(value) {
            *bytes = x.to_le_bytes();
        }
    }
}

/// Reader of the arrays of a payload, one after the other.
///
/// The caller must have checked the total length: from a shorter payload it returns a shorter array.
pub(super) struct Arrays<'a>(pub(super) &'a [u8]);

impl<'a> Arrays<'a> {
    fn take<const N: usize>(&mut self, count: usize) -> &'a [[u8; N]] {
        let (front, rest) = self.0.split_at_checked(N * count).unwrap_or((self.0, &[]));
        self.0 = rest;
        front.as_chunks().0
    }

    pub(super) fn u8(&mut self, count: usize) -> &'a [u8] {
        self.take::<1>(count).as_flattened()
    }

    pub(super) fn u32(&mut self, count: usize) -> Vec<u32> {
        self.take(count).iter().map(|bytes| u32::from_le_bytes(*bytes)).collect()
    }

    pub(super) fn f32(&mut self, count: usize) -> Vec<f32> {
        self.take(count).iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
    }

    pub(super) fn f64(&mut self, count: usize) -> impl Iterator<Item = f64> {
        self.take(count).iter().map(|bytes| f64::from_le_bytes(*bytes))
    }

    pub(super) fn complex32(&mut self, count: usize) -> Vec<Complex32> {
        let complex = |bytes: &[u8; 8]| {
            let [a, b, c, d, e, f, g, h] = *bytes;
            Complex32::new(f32::from_le_bytes([a, b, c, d]), f32::from_le_bytes([e, f, g, h]))
        };
        self.take(count).iter().map(complex).collect()
    }

    pub(super) fn vec3(&mut self, count: usize) -> Vec<Vec3> {
        let vector = |bytes: &[u8; 24]| {
            let (numbers, _) = bytes.as_chunks::<8>();
            std::array::from_fn(|k| f64::from_le_bytes(numbers[k]))
        };
        self.take(count).iter().map(vector).collect()
    }
}
