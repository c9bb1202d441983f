//! The best solution of a symmetric system in the span of conjugate directions.

use crate::imaging::solver::{dot, subtract};

/// Number of directions to which each new one is made conjugate; older ones affect only rounding.
const DIRECTIONS_MAX: usize = 64;

/// Minimum fraction of its curvature that a direction keeps when it is made conjugate to the others; below it the direction is taken to be a
/// combination of them. Products are accurate to 1e-6.
const NEW_FRACTION_MIN: f64 = 1e-10;

/// Conjugate directions of unit curvature, and their products with the matrix.
#[derive(Default)]
pub(super) struct Subspace {
    directions: Vec<Vec<f64>>,
    products: Vec<Vec<f64>>,
}

/// The best solution for a right-hand side in the subspace, and its residual.
pub(super) struct Column {
    pub(super) x: Vec<f64>,
    pub(super) residual: Vec<f64>,
}

impl Subspace {
    /// Adds directions with their products, and moves each column to the solution nearest to the true one in the norm of the matrix, so that
    /// no column moves away from it. Returns how many of the directions were new.
    pub(super) fn extend(
        &mut self,
        directions: impl IntoIterator<Item = (Vec<f64>, Vec<f64>)>,
        columns: &mut [Column],
    ) -> usize {
        let mut added = 0;
        for (mut direction, mut product) in directions {
            let curvature = dot(&direction, &product);
            // The second round removes rounding errors of the first.
            for _ in 0..2 {
                for (known, known_product) in self.directions.iter().zip(&self.products) {
                    let share = dot(known_product, &direction);
                    subtract(&mut direction, share, known);
                    subtract(&mut product, share, known_product);
                }
            }
            let new_curvature = dot(&direction, &product);
            // Also false for NaN.
            let is_new = new_curvature > NEW_FRACTION_MIN * curvature && new_curvature.is_finite();
            if !is_new {
                continue;
            }
            let scale = new_curvature.sqrt().recip();
            direction.iter_mut().chain(&mut product).for_each(|x| *x *= scale);
            for Column { x, residual } in columns.iter_mut() {
                let step = dot(&direction, residual);
                subtract(x, -step, &direction);
                subtract(residual, step, &product);
            }
            self.directions.push(direction);
            self.products.push(product);
            added += 1;
        }
        let old = self.directions.len().saturating_sub(DIRECTIONS_MAX);
        self.directions.drain(..old);
        self.products.drain(..old);
        added
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The matrix is `D + v v'`, whose inverse is the Sherman-Morrison formula.
    #[test]
    fn directions_that_span_all_give_the_solution() {
        const ORDER: usize = 6;
        let diagonal: Vec<f64> = (0..ORDER).map(|k| 10.0_f64.powi(-(k as i32))).collect();
        let v: Vec<f64> = (0..ORDER).map(|k| (0.7 * k as f64 + 0.2).cos()).collect();
        let b: Vec<f64> = (0..ORDER).map(|k| (1.3 * k as f64).sin() + 0.1).collect();
        let multiply = |x: &[f64]| -> Vec<f64> {
            let along = dot(&v, x);
            (0..ORDER).map(|k| diagonal[k] * x[k] + v[k] * along).collect()
        };
        let over: Vec<f64> = b.iter().zip(&diagonal).map(|(b, d)| b / d).collect();
        let of_v: Vec<f64> = v.iter().zip(&diagonal).map(|(v, d)| v / d).collect();
        let share = dot(&v, &over) / (1.0 + dot(&v, &of_v));
        let exact: Vec<f64> = over.iter().zip(&of_v).map(|(a, b)| a - share * b).collect();
        let distance = |x: &[f64]| {
            let off: Vec<f64> = x.iter().zip(&exact).map(|(a, b)| a - b).collect();
            dot(&off, &multiply(&off)).sqrt()
        };
        let mut columns = [Column { x: vec![0.0; ORDER], residual: b.clone() }];
        let mut subspace = Subspace::default();
        let mut last = distance(&columns[0].x);
        for k in 0..ORDER {
            // Directions that are neither conjugate nor normalised; and a known one, zero and NaN.
            let direction: Vec<f64> = (0..ORDER).map(|m| ((m + 1) as f64).powi(k as i32)).collect();
            let bad = [direction.clone(), vec![0.0; ORDER], vec![f64::NAN; ORDER]];
            let product = multiply(&direction);
            assert_eq!(subspace.extend([(direction, product)], &mut columns), 1, "{k}");
            let again = bad.map(|x| (x.clone(), multiply(&x)));
            assert_eq!(subspace.extend(again, &mut columns), 0, "{k}");
            let now = distance(&columns[0].x);
            assert!(now < last, "{k}: {now} {last}");
            last = now;
        }
        // Rounding times the condition number of the matrix.
        for (found, exact) in columns[0].x.iter().zip(&exact) {
            assert!((found / exact - 1.0).abs() < 1e-8, "{found} {exact}");
        }
    }
}
