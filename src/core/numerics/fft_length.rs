//! Lengths for which fast Fourier transforms are fast.

/// The smallest even length >= `n` with prime factors 2, 3 (at most four times) and 5 (at most once), which the FFT transforms fastest.
pub(crate) fn fft_length(n: usize) -> usize {
    let n = n.max(2);
    let mut best = n.next_power_of_two();
    for odd in [1, 3, 5, 9, 15, 27, 45, 81, 135] {
        let mut length = 2 * odd;
        while length < n {
            length *= 2;
        }
        best = best.min(length);
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_are_enough_and_not_wasteful() {
        for n in 2..3000 {
            let length = fft_length(n);
            assert!(length >= n && length.is_multiple_of(2));
            assert!(n < 16 || (length as f64) < 1.2 * n as f64 + 1.0, "{n} {length}");
        }
    }
}
