//! Harmonic coefficients of a real field.

use num_complex::Complex64;

/// Coefficients `a_lm`, m >= 0, of a real field, for which `a_{l,-m} = (-1)^m conj(a_lm)`.
///
/// They are stored in healpy's order: all l of m = 0, then all l of m = 1, ...
#[derive(Clone, Debug, PartialEq)]
pub struct Alm {
    l_max: usize,
    values: Vec<Complex64>,
}

impl Alm {
    /// Creates zero coefficients for `l <= l_max`.
    #[must_use]
    pub fn zeros(l_max: usize) -> Self {
        Self { l_max, values: vec![Complex64::ZERO; Self::len_for(l_max)] }
    }

    /// Creates coefficients from values in healpy's order; `None` if their number does not match `l_max`.
    #[must_use]
    pub fn from_values(l_max: usize, values: Vec<Complex64>) -> Option<Self> {
        (values.len() == Self::len_for(l_max)).then_some(Self { l_max, values })
    }

    /// Number of coefficients for `l_max`.
    #[must_use]
    #[doc(hidden)]
    pub fn len_for(l_max: usize) -> usize {
        (l_max + 1) * (l_max + 2) / 2
    }

    /// Maximum degree.
    #[must_use]
    pub fn l_max(&self) -> usize {
        self.l_max
    }

    /// Index of `(l, m)`, `m <= l <= l_max`, among the values.
    #[inline]
    #[must_use]
    #[doc(hidden)]
    pub fn index(&self, l: usize, m: usize) -> usize {
        debug_assert!(m <= l && l <= self.l_max);
        m * (2 * self.l_max + 1 - m) / 2 + l
    }

    /// `a_lm` for `m >= 0`.
    #[inline]
    #[must_use]
    pub fn get(&self, l: usize, m: usize) -> Complex64 {
        self.values[self.index(l, m)]
    }

    /// Mutable `a_lm` for `m >= 0`.
    #[inline]
    #[doc(hidden)]
    pub fn get_mut(&mut self, l: usize, m: usize) -> &mut Complex64 {
        let index = self.index(l, m);
        &mut self.values[index]
    }

    /// The coefficients l = m .. l_max of order `m`.
    #[must_use]
    #[doc(hidden)]
    pub fn order(&self, m: usize) -> &[Complex64] {
        let first = self.index(m, m);
        &self.values[first..=first + self.l_max - m]
    }

    /// Mutable coefficients l = m .. l_max of order `m`.
    #[doc(hidden)]
    pub fn order_mut(&mut self, m: usize) -> &mut [Complex64] {
        let first = self.index(m, m);
        let last = first + self.l_max - m;
        &mut self.values[first..=last]
    }

    /// All values in healpy's order.
    #[must_use]
    pub fn values(&self) -> &[Complex64] {
        &self.values
    }

    /// Mutable values in healpy's order.
    #[doc(hidden)]
    pub fn values_mut(&mut self) -> &mut [Complex64] {
        &mut self.values
    }
}
