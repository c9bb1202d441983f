//! Directions in the layout of the kernels.

use crate::units::vector::{Vec3, dot};

/// List of unit vectors as a structure of arrays, on the axes of any frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Directions {
    pub(super) x: Vec<f64>,
    pub(super) y: Vec<f64>,
    pub(super) z: Vec<f64>,
}

impl Directions {
    /// Number of directions.
    #[must_use]
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// Whether there are none.
    #[must_use]
    #[doc(hidden)]
    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }

    /// Direction `k`.
    #[must_use]
    #[doc(hidden)]
    pub fn get(&self, k: usize) -> Vec3 {
        [self.x[k], self.y[k], self.z[k]]
    }

    /// Rotates the directions by a matrix, given by rows.
    #[must_use]
    #[doc(hidden)]
    pub fn rotated(&self, rotation: &[Vec3; 3]) -> Self {
        (0..self.len()).map(|k| rotation.map(|row| dot(row, self.get(k)))).collect()
    }
}

impl FromIterator<Vec3> for Directions {
    fn from_iter<I: IntoIterator<Item = Vec3>>(vectors: I) -> Self {
        let mut directions = Self::default();
        for [x, y, z] in vectors {
            directions.x.push(x);
            directions.y.push(y);
            directions.z.push(z);
        }
        directions
    }
}

impl From<&[Vec3]> for Directions {
    fn from(vectors: &[Vec3]) -> Self {
        vectors.iter().copied().collect()
    }
}
