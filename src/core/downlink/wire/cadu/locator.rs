//! Finds errors from syndromes: Berlekamp-Massey algorithm, Chien search, Forney formula.

use std::sync::LazyLock;

use multiversion::multiversion;

use super::code::{ERRORS_MAX, PARITY_BYTES, ROOT_FIRST, ROOT_STEP};
use super::field::{FIELD, ORDER, times_primitive};

/// Wrong octets of a codeword.
#[derive(Clone, Copy, Debug)]
pub(super) struct Errors {
    /// Number of errors; only this many elements of the arrays are valid.
    pub(super) count: usize,
    /// Positions in the codeword, from 0 for the first octet sent.
    pub(super) places: [u8; ERRORS_MAX],
    /// Error values at these positions, in the conventional basis; adding them corrects the codeword.
    pub(super) values: [u8; ERRORS_MAX],
}

/// Coefficients of a polynomial by rising powers.
type Polynomial = [u8; PARITY_BYTES + 1];

/// Inverses of the locators X = a^(11 (254 - place)) by place, padded with zeros, which are never roots.
static INVERSE_LOCATORS: LazyLock<[u8; 256]> =
    LazyLock::new(|| std::array::from_fn(|place| if place < ORDER { inverse_locator(place) } else { 0 }));

fn inverse_locator(place: usize) -> u8 {
    FIELD.power(ROOT_STEP * (ORDER - (ORDER - 1 - place)))
}

/// The errors that explain the syndromes; `None` if there are too many.
pub(super) fn locate(syndromes: &[u8; PARITY_BYTES]) -> Option<Errors> {
    let (locator, count) = shortest_register(syndromes)?;
    let mut values = *INVERSE_LOCATORS;
    evaluate(&locator[..=count], &mut values);
    let mut errors = Errors { count: 0, places: [0; ERRORS_MAX], values: [0; ERRORS_MAX] };
    for (place, _) in values.iter().enumerate().take(ORDER).filter(|(_, value)| **value == 0) {
        *errors.places.get_mut(errors.count)? = place as u8;
        errors.count += 1;
    }
    if errors.count != count {
        return None;
    }
    let evaluator = evaluator(syndromes, &locator, count);
    for (place, value) in errors.places.iter().zip(&mut errors.values).take(count) {
        *value = forney(&evaluator[..count], &locator[..=count], usize::from(*place))?;
    }
    Some(errors)
}

/// The shortest linear recurrence of the syndromes (Massey 1969) and its length.
fn shortest_register(syndromes: &[u8; PARITY_BYTES]) -> Option<(Polynomial, usize)> {
    let (mut locator, mut previous) = ([0; PARITY_BYTES + 1], [0; PARITY_BYTES + 1]);
    (locator[0], previous[0]) = (1, 1);
    let (mut length, mut shift, mut last, mut previous_length) = (0, 1, 1, 0);
    for n in 0..PARITY_BYTES {
        let products = (1..=length).map(|k| FIELD.multiply(locator[k], syndromes[n - k]));
        let discrepancy = products.fold(syndromes[n], |sum, product| sum ^ product);
        if discrepancy == 0 {
            shift += 1;
            continue;
        }
        let factor = FIELD.divide(discrepancy, last);
        let before = locator;
        for (new, old) in locator[shift..].iter_mut().zip(&previous[..=previous_length]) {
            *new ^= FIELD.multiply(factor, *old);
        }
        if 2 * length <= n {
            (previous, last, shift, previous_length) = (before, discrepancy, 1, length);
            length = n + 1 - length;
            if length > ERRORS_MAX {
                return None;
            }
        } else {
            shift += 1;
        }
    }
    (locator[length] != 0).then_some((locator, length))
}

/// S(x) times the locator, modulo x^count, for Forney's formula.
fn evaluator(syndromes: &[u8; PARITY_BYTES], locator: &Polynomial, count: usize) -> [u8; ERRORS_MAX] {
    let mut product = [0; ERRORS_MAX];
    for (n, coefficient) in product.iter_mut().enumerate().take(count) {
        *coefficient = (0..=n).fold(0, |sum, k| sum ^ FIELD.multiply(locator[k], syndromes[n - k]));
    }
    product
}

/// The error value at a place: X^(1 - 112) evaluator(1/X) / locator'(1/X).
fn forney(evaluator: &[u8], locator: &[u8], place: usize) -> Option<u8> {
    let inverse = inverse_locator(place);
    let value_at = |coefficients: &mut dyn DoubleEndedIterator<Item = u8>, x: u8| {
        coefficients.rev().fold(0, |sum, coefficient| FIELD.multiply(sum, x) ^ coefficient)
    };
    let numerator = value_at(&mut evaluator.iter().copied(), inverse);
    // In characteristic 2 the derivative has only the odd terms, each one power lower.
    let square = FIELD.multiply(inverse, inverse);
    let denominator = value_at(&mut locator.iter().skip(1).step_by(2).copied(), square);
    if denominator == 0 || numerator == 0 {
        return None;
    }
    let log = FIELD.log(inverse) * (ROOT_FIRST - 1);
    Some(FIELD.multiply(FIELD.divide(numerator, denominator), FIELD.power(log)))
}

/// Replaces each x by the value of a polynomial at x: Horner's rule for all x at once, which the compiler vectorises.
#[multiversion(targets("x86_64+avx512f+avx512bw", "x86_64+avx2"))]
fn evaluate(coefficients: &[u8], x: &mut [u8; 256]) {
    let mut sum = [0_u8; 256];
    for coefficient in coefficients.iter().rev() {
        for (sum, x) in sum.iter_mut().zip(x.iter()) {
            let (mut product, mut shifted) = (0, *sum);
            for bit in 0..8 {
                product ^= shifted & (x >> bit & 1).wrapping_neg();
                shifted = times_primitive(shifted);
            }
            *sum = product ^ coefficient;
        }
    }
    *x = sum;
}
