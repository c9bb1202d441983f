//! Arithmetic of vectors of unknowns.

pub(in crate::imaging) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

pub(in crate::imaging) fn norm(a: &[f64]) -> f64 {
    dot(a, a).sqrt()
}

/// Computes `a -= factor b`.
pub(in crate::imaging) fn subtract(a: &mut [f64], factor: f64, b: &[f64]) {
    a.iter_mut().zip(b).for_each(|(a, b)| *a -= factor * b);
}

/// Takes off what a vector has along each of an orthonormal basis; the second round removes rounding errors of the first.
pub(in crate::imaging) fn orthogonalise(a: &mut [f64], basis: &[Vec<f64>]) {
    for vector in [basis, basis].into_iter().flatten() {
        let part = dot(vector, a);
        subtract(a, part, vector);
    }
}

/// Computes `a += b`.
pub(in crate::imaging) fn add(a: &mut [f64], b: &[f64]) {
    a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
}
