//! Cholesky factors of small dense symmetric matrices.

/// Lower triangle of a Cholesky factor.
pub(crate) struct DenseFactor {
    order: usize,
    rows: Vec<f64>,
}

impl DenseFactor {
    /// Factorises a symmetric matrix, given row by row; `None` if it is not positive definite.
    pub(crate) fn new(matrix: &[f64], order: usize) -> Option<Self> {
        let mut rows = matrix.to_vec();
        for j in 0..order {
            for i in j..order {
                let sum: f64 = (0..j).map(|k| rows[i * order + k] * rows[j * order + k]).sum();
                let remainder = rows[i * order + j] - sum;
                if i == j {
                    if remainder <= 0.0 || !remainder.is_finite() {
                        return None;
                    }
                    rows[i * order + j] = remainder.sqrt();
                } else {
                    rows[i * order + j] = remainder / rows[j * order + j];
                }
            }
        }
        Some(Self { order, rows })
    }

    /// Solves in place for one right-hand side.
    pub(crate) fn solve(&self, x: &mut [f64]) {
        let Self { order, rows } = self;
        for i in 0..*order {
            let sum: f64 = (0..i).map(|k| rows[i * order + k] * x[k]).sum();
            x[i] = (x[i] - sum) / rows[i * order + i];
        }
        for i in (0..*order).rev() {
            let sum: f64 = (i + 1..*order).map(|k| rows[k * order + i] * x[k]).sum();
            x[i] = (x[i] - sum) / rows[i * order + i];
        }
    }

    /// The inverse matrix, row by row.
    pub(crate) fn inverse(&self) -> Vec<f64> {
        let order = self.order;
        let mut inverse = vec![0.0; order * order];
        for (index, column) in inverse.chunks_exact_mut(order).enumerate() {
            column[index] = 1.0;
            self.solve(column);
        }
        inverse
    }
}
