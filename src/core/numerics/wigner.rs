//! Wigner's d-functions, the matrix elements of a rotation about y.
//!
//! `d^l_{m mu}(beta) = <l m| exp(-i beta J_y) |l mu>`, in the convention of Varshalovich et al. (1988),
//! ch. 4, and Edmonds with the active sense: `d^1_{10} = -sin(beta) / sqrt 2`.
//!
//! At fixed `m` and `mu` the three-term recurrence in l (Varshalovich 4.8.2, eq. 12)
//!
//! ```text
//! e_{l+1}(m) e_{l+1}(mu) d^{l+1} = (2l+1)(l+1) (cos beta - m mu / (l (l+1))) d^l
//!                                  - (l+1)/l e_l(m) e_l(mu) d^{l-1},     e_l(m) = sqrt(l^2 - m^2)
//! ```
//!
//! starts at `l = max(|m|, |mu|)` from the closed form
//! `d^l_{l mu} = sqrt(C(2l, l-mu)) cos^{l+mu}(beta/2) (-sin(beta/2))^{l-mu}` and its mirror images. The forward
//! recurrence grows out of the classically forbidden region and then oscillates, so it is stable; its starting
//! values lie below the range of f64 (0.5^1000 at l = 1000 and 30 deg), so every lane carries a power of 2^512.

use super::scaled::{LaneSlices, Scaled, ScaledLanes, advance};

/// Tables that the recurrences at all mu share: `sqrt(l^2 - m^2)`, its inverse, powers of the half angle.
#[derive(Clone, Debug)]
pub struct WignerTable {
    l_max: usize,
    cos_beta: f64,
    cos_powers: Vec<Scaled>,
    sin_powers: Vec<Scaled>,
    /// `e_l(m)` for m = -l ..= l, at `l^2`; zero at |m| = l.
    root: Vec<f64>,
    /// `1 / e_l(m)`; zero at |m| = l, where it is never used.
    inverse_root: Vec<f64>,
}

impl WignerTable {
    /// Builds the tables for `l <= l_max` at the angle `beta_rad` between 0 and pi.
    #[must_use]
    pub fn new(l_max: usize, beta_rad: f64) -> Self {
        let (sin, cos) = (0.5 * beta_rad).sin_cos();
        let len = (l_max + 1) * (l_max + 1);
        let (mut root, mut inverse_root) = (Vec::with_capacity(len), Vec::with_capacity(len));
        for l in 0..=l_max as i64 {
            for m in -l..=l {
                let e = (((l - m) * (l + m)) as f64).sqrt();
                root.push(e);
                inverse_root.push(if e > 0.0 { 1.0 / e } else { 0.0 });
            }
        }
        Self {
            l_max,
            cos_beta: beta_rad.cos(),
            cos_powers: Scaled::powers(cos, 2 * l_max + 1),
            sin_powers: Scaled::powers(sin, 2 * l_max + 1),
            root,
            inverse_root,
        }
    }

    /// Maximum degree.
    #[must_use]
    pub fn l_max(&self) -> usize {
        self.l_max
    }

    /// The rows `d^l_{m mu}`, m = -l ..= l, for l = mu, mu + 1, .. `l_max`; `mu <= l_max`.
    #[must_use]
    pub fn rows(&self, mu: usize) -> WignerRows<'_> {
        WignerRows::new(self, mu)
    }
}

/// An iteration over the rows of d at one `mu >= 0`, by increasing degree.
///
/// Negative mu follow from `d^l_{m,-mu} = (-1)^(m-mu) d^l_{-m,mu}`.
#[derive(Clone, Debug)]
pub struct WignerRows<'a> {
    table: &'a WignerTable,
    mu: usize,
    next_l: usize,
    /// `sqrt(C(2l, l - mu))` of the current l.
    binomial: Scaled,
    /// By order, m = -l_max ..= l_max.
    lanes: ScaledLanes,
}

impl<'a> WignerRows<'a> {
    fn new(table: &'a WignerTable, mu: usize) -> Self {
        let lanes = ScaledLanes::zeros(2 * table.l_max + 1);
        Self { table, mu, next_l: mu, binomial: Scaled::ONE, lanes }
    }

    /// The next degree and its values for m = -l ..= l; `None` after `l_max`.
    ///
    /// Values below 2^-256 are given as zero.
    pub fn next_row(&mut self) -> Option<(usize, &[f64])> {
        let l = self.next_l;
        if l > self.table.l_max {
            return None;
        }
        if l == self.mu {
            self.start();
        } else {
            self.step(l);
            self.start_outer_orders(l);
        }
        self.next_l += 1;
        let centre = self.table.l_max;
        Some((l, &self.lanes.value[centre - l..=centre + l]))
    }

    /// All orders of degree mu: `d^mu_{m mu} = sqrt(C(2mu, mu-m)) cos^{mu+m} sin^{mu-m}`.
    fn start(&mut self) {
        let (mu, centre) = (self.mu, self.table.l_max);
        let mut binomial = Scaled::ONE;
        for k in 0..=2 * mu {
            // k = mu - m
            if k > 0 {
                binomial = binomial.times((((2 * mu + 1 - k) as f64) / k as f64).sqrt());
            }
            let start = binomial.product(self.table.cos_powers[2 * mu - k]).product(self.table.sin_powers[k]);
            self.lanes.set(centre + mu - k, start);
        }
    }

    /// Starts the two orders m = -l and m = l, whose recurrences begin at degree l > mu.
    fn start_outer_orders(&mut self, l: usize) {
        let (mu, centre) = (self.mu, self.table.l_max);
        let ratio = (2 * l * (2 * l - 1)) as f64 / ((l - mu) * (l + mu)) as f64;
        self.binomial = self.binomial.times(ratio.sqrt());
        let (cos, sin) = (&self.table.cos_powers, &self.table.sin_powers);
        let last = self.binomial.product(cos[l + mu]).product(sin[l - mu]);
        let sign = if (l - mu).is_multiple_of(2) { 1.0 } else { -1.0 };
        self.lanes.set(centre + l, last.times(sign));
        self.lanes.set(centre - l, self.binomial.product(cos[l - mu]).product(sin[l + mu]));
    }

    /// Advances the orders |m| < l from l - 1 to l.
    fn step(&mut self, l: usize) {
        let (table, mu, centre) = (self.table, self.mu, self.table.l_max);
        let from = l - 1;
        let index = |l: usize, m: usize| l * l + l + m;
        let by_mu = table.inverse_root[index(l, mu)];
        let first = (2 * from + 1) as f64 * l as f64 * by_mu;
        let (slope, behind) = if from == 0 {
            (0.0, 0.0)
        } else {
            let inverse = 1.0 / from as f64;
            (mu as f64 * inverse / l as f64, l as f64 * inverse * table.root[index(from, mu)] * by_mu)
        };
        step_lanes(
            [first * table.cos_beta, first * slope, behind, -(from as f64)],
            [&table.inverse_root[l * l + 1..(l + 1) * (l + 1) - 1], &table.root[from * from..l * l]],
            self.lanes.slices(centre - from..centre + from + 1),
        );
    }
}

/// One step of the recurrence on all lanes. `factors` are those of `d^{l-1}` at m = 0 and per order, that of `d^{l-2}`, and the first order;
/// `roots` are `1 / e_l(m)` and `e_{l-1}(m)`.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn step_lanes(factors: [f64; 4], roots: [&[f64]; 2], lanes: LaneSlices<'_>) {
    let [at_zero, by_order, behind, first_order] = factors;
    let LaneSlices { current, previous, power, value } = lanes;
    let n = current.len();
    let (inverse, root) = (&roots[0][..n], &roots[1][..n]);
    let (previous, power, value) = (&mut previous[..n], &mut power[..n], &mut value[..n]);
    for k in 0..n {
        let m = first_order + k as f64;
        let next = inverse[k] * ((at_zero - by_order * m) * current[k] - behind * root[k] * previous[k]);
        advance(next, [&mut current[k], &mut previous[k], &mut power[k], &mut value[k]]);
    }
}

/// The values `d^l_{m mu}(beta)` for l = 0 ..= `l_max` and orders of any sign; zero for l below `max(|m|, |mu|)`.
#[must_use]
pub fn wigner_d(l_max: usize, m: i64, mu: i64, beta_rad: f64) -> Vec<f64> {
    let mut values = vec![0.0; l_max + 1];
    let (m, order, sign) = match mu {
        0.. => (m, mu as usize, 1.0),
        _ => (-m, mu.unsigned_abs() as usize, if (m - mu) % 2 == 0 { 1.0 } else { -1.0 }),
    };
    if order > l_max {
        return values;
    }
    let table = WignerTable::new(l_max, beta_rad);
    let mut rows = table.rows(order);
    while let Some((l, row)) = rows.next_row() {
        if let Some(&value) = usize::try_from(l as i64 + m).ok().and_then(|k| row.get(k)) {
            values[l] = sign * value;
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The full matrix d^l[m + l][mu + l] from the rows.
    fn matrix(l: usize, beta_rad: f64) -> Vec<Vec<f64>> {
        let orders = -(l as i64)..=l as i64;
        let columns: Vec<Vec<f64>> = orders
            .clone()
            .map(|mu| orders.clone().map(|m| wigner_d(l, m, mu, beta_rad)[l]).collect())
            .collect();
        (0..=2 * l).map(|m| columns.iter().map(|column| column[m]).collect()).collect()
    }

    #[test]
    fn first_degree_is_the_closed_form() {
        for beta in [0.0, 0.3, 1.7, std::f64::consts::PI] {
            let (s, c) = f64::sin_cos(beta);
            let r = std::f64::consts::SQRT_2;
            let (p, q) = (0.5 * (1.0 + c), 0.5 * (1.0 - c));
            let expected = [[p, s / r, q], [-s / r, c, s / r], [q, -s / r, p]];
            let found = matrix(1, beta);
            for (row, expected) in found.iter().zip(expected) {
                for (x, y) in row.iter().zip(expected) {
                    assert!((x - y).abs() < 1e-15, "{beta} {found:?}");
                }
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]
        #[test]
        fn matrices_are_unitary(l in 0_usize..24, beta in 0.0..std::f64::consts::PI) {
            let d = matrix(l, beta);
            for a in 0..=2 * l {
                for b in 0..=2 * l {
                    let product: f64 = (0..=2 * l).map(|k| d[a][k] * d[b][k]).sum();
                    let expected = if a == b { 1.0 } else { 0.0 };
                    // A few hundred roundings.
                    prop_assert!((product - expected).abs() < 1e-12);
                }
            }
        }
    }

    #[test]
    fn columns_stay_orthonormal_to_degree_1024() {
        // The acceptance figure; near the poles 1 - cos(beta) keeps fewer digits of cos(beta).
        for (beta_deg, tolerance) in [(2.0_f64, 1e-11), (30.0, 1e-12), (90.0, 1e-12), (150.0, 1e-12)] {
            let table = WignerTable::new(1024, beta_deg.to_radians());
            let mut kept: Vec<Vec<f64>> = Vec::new();
            for mu in [0, 1, 37, 511, 900, 1023, 1024] {
                let mut rows = table.rows(mu);
                while let Some((l, row)) = rows.next_row() {
                    let norm: f64 = row.iter().map(|d| d * d).sum();
                    assert!((norm - 1.0).abs() < tolerance, "{beta_deg} {l} {mu}: {norm}");
                    if l == 1024 {
                        for other in &kept {
                            let product: f64 = row.iter().zip(other).map(|(a, b)| a * b).sum();
                            assert!(product.abs() < tolerance, "{beta_deg} {mu}: {product}");
                        }
                        kept.push(row.to_vec());
                    }
                }
            }
        }
    }
}
