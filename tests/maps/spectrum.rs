//! What follows from all eigenvalues and eigenvectors of a small normal matrix.

use faer::{Mat, Side};
use lunarray::imaging::NormalSums;

/// Eigenvalues and eigenvectors of `A = BtN^-1B = Q W Qt`.
pub struct Spectrum {
    /// Eigenvalues W, in increasing order.
    pub eigenvalues: Vec<f64>,
    /// Eigenvectors Q, one per column.
    vectors: Mat<f64>,
}

impl Spectrum {
    /// Forms the matrix column by column, and decomposes it.
    pub fn new(sums: &dyn NormalSums) -> Self {
        let order = sums.unknowns();
        let mut matrix = Mat::zeros(order, order);
        let (mut unit, mut column) = (vec![0.0; order], vec![0.0; order]);
        for k in 0..order {
            unit[k] = 1.0;
            sums.apply(&unit, &mut column);
            unit[k] = 0.0;
            (0..order).for_each(|row| matrix[(row, k)] = column[row]);
        }
        // Products in f32 leave it symmetric to 1e-7 only.
        let scale = matrix[(0, 0)];
        let symmetric = Mat::from_fn(order, order, |i, j| 0.5 * (matrix[(i, j)] + matrix[(j, i)]) / scale);
        let decomposed = symmetric.self_adjoint_eigen(Side::Lower).unwrap();
        let eigenvalues = decomposed.S().column_vector().iter().map(|w| w * scale).collect();
        Self { eigenvalues, vectors: decomposed.U().to_owned() }
    }

    /// The largest eigenvalue.
    pub fn w_max(&self) -> f64 {
        self.eigenvalues.iter().copied().fold(0.0, f64::max)
    }

    /// The sum of a function of the eigenvalues: the trace of the function of the matrix.
    pub fn trace(&self, f: impl Fn(f64) -> f64) -> f64 {
        self.eigenvalues.iter().copied().map(f).sum()
    }

    /// A function of the matrix times a vector.
    pub fn apply(&self, f: impl Fn(f64) -> f64, v: &[f64]) -> Vec<f64> {
        let mut out = vec![0.0; v.len()];
        for (k, &w) in self.eigenvalues.iter().enumerate() {
            let part: f64 = self.vectors.col(k).iter().zip(v).map(|(a, b)| a * b).sum();
            out.iter_mut().zip(self.vectors.col(k).iter()).for_each(|(out, x)| *out += f(w) * part * x);
        }
        out
    }
}
