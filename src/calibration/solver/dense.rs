//! Small dense symmetric systems.

/// Lower triangle of a Cholesky factor.
pub(super) struct DenseFactor {
    order: usize,
    rows: Vec<f64>,
}

impl DenseFactor {
    /// Factors a symmetric matrix, row after row; `None` if it is not positive definite.
    pub(super) fn new(matrix: &[f64], order: usize) -> Option<Self> {
        let mut rows = matrix.to_vec();
        for j in 0..order {
            for i in j..order {
                let done: f64 = (0..j).map(|k| rows[i * order + k] * rows[j * order + k]).sum();
                let left = rows[i * order + j] - done;
                if i == j {
                    if left <= 0.0 || !left.is_finite() {
                        return None;
                    }
                    rows[i * order + j] = left.sqrt();
                } else {
                    rows[i * order + j] = left / rows[j * order + j];
                }
            }
        }
        Some(Self { order, rows })
    }

    /// Solves for one right side.
    pub(super) fn solve(&self, x: &mut [f64]) {
        let Self { order, rows } = self;
        for i in 0..*order {
            let done: f64 = (0..i).map(|k| rows[i * order + k] * x[k]).sum();
            x[i] = (x[i] - done) / rows[i * order + i];
        }
        for i in (0..*order).rev() {
            let done: f64 = (i + 1..*order).map(|k| rows[k * order + i] * x[k]).sum();
            x[i] = (x[i] - done) / rows[i * order + i];
        }
    }

    /// The inverse, row after row.
    pub(super) fn inverse(&self) -> Vec<f64> {
        let order = self.order;
        let mut inverse = vec![0.0; order * order];
        for column in inverse.chunks_exact_mut(order).enumerate() {
            let (place, column) = column;
            column[place] = 1.0;
            self.solve(column);
        }
        inverse
    }
}
