//! Coefficients of the product of a field and a component n_x, n_y or n_z of the direction.
//!
//! They follow exactly from the recurrences of spherical harmonics (Varshalovich et al. 1988, Quantum Theory of Angular Momentum, 5.7).
//! A product has one degree more than the field.

use num_complex::Complex64;

use super::Alm;

/// A component of a direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Component {
    /// Component n_x.
    X,
    /// Component n_y.
    Y,
    /// Component n_z.
    Z,
}

impl Component {
    /// All components, in order.
    pub const ALL: [Self; 3] = [Self::X, Self::Y, Self::Z];
}

/// Recurrence coefficient `sqrt(a b / ((2 l + 1) (2 l + 3)))` between degrees l and l + 1.
fn root(l: usize, a: usize, b: usize) -> f64 {
    ((a * b) as f64 / ((2 * l + 1) * (2 * l + 3)) as f64).sqrt()
}

/// Term of coefficient `to` of a product, proportional to coefficient `from` of the field or to its conjugate.
struct Term {
    to: [usize; 2],
    from: [usize; 2],
    factor: Complex64,
    is_conjugate: bool,
}

/// Passes all terms of the product of a field of degree `l_max` to `take`.
fn terms(l_max: usize, component: Component, take: &mut dyn FnMut(Term)) {
    for m in 0..=l_max + 1 {
        for l in m..=l_max + 1 {
            let mut put = |l_from: usize, m_from: usize, factor: Complex64, is_conjugate: bool| {
                if m_from <= l_from && l_from <= l_max {
                    take(Term { to: [l, m], from: [l_from, m_from], factor, is_conjugate });
                }
            };
            let below = l.checked_sub(1);
            if component == Component::Z {
                if let Some(below) = below {
                    put(below, m, root(below, l - m, l + m).into(), false);
                }
                put(l + 1, m, root(l, l + 1 - m, l + 1 + m).into(), false);
                continue;
            }
            // n_x +- i n_y raise and lower the order.
            let [raised, lowered] = match component {
                Component::Y => [Complex64::new(0.0, -0.5), Complex64::new(0.0, 0.5)],
                _ => [Complex64::new(0.5, 0.0); 2],
            };
            if let Some(below) = below {
                match m.checked_sub(1) {
                    Some(m_from) => put(below, m_from, -root(below, l + m - 1, l + m) * raised, false),
                    // a_{l,-1} = -conj(a_{l 1}).
                    None => put(below, 1, root(below, below, l) * raised, true),
                }
                if l > m {
                    put(below, m + 1, root(below, l - m - 1, l - m) * lowered, false);
                }
            }
            match m.checked_sub(1) {
                Some(m_from) => put(l + 1, m_from, root(l, l + 1 - m, l + 2 - m) * raised, false),
                None => put(l + 1, 1, -root(l, l + 1, l + 2) * raised, true),
            }
            put(l + 1, m + 1, -root(l, l + m + 1, l + m + 2) * lowered, false);
        }
    }
}

/// Multiplies a field by a component of the direction; the result has one degree more.
#[must_use]
pub fn times_direction(field: &Alm, component: Component) -> Alm {
    let mut out = Alm::zeros(field.l_max() + 1);
    terms(field.l_max(), component, &mut |Term { to, from, factor, is_conjugate }| {
        let value = field.get(from[0], from[1]);
        *out.get_mut(to[0], to[1]) += factor * if is_conjugate { value.conj() } else { value };
    });
    out
}

/// Computes the gradient with respect to a field from the gradient with respect to its product ([`times_direction`]).
///
/// It is the transpose with respect to real and imaginary parts, and has one degree less; for a gradient of degree 0 it is zero.
#[must_use]
pub fn times_direction_transposed(gradient: &Alm, component: Component) -> Alm {
    let l_max = gradient.l_max().saturating_sub(1);
    let mut out = Alm::zeros(l_max);
    if gradient.l_max() == 0 {
        return out;
    }
    terms(l_max, component, &mut |Term { to, from, factor, is_conjugate }| {
        let value = factor.conj() * gradient.get(to[0], to[1]);
        *out.get_mut(from[0], from[1]) += if is_conjugate { value.conj() } else { value };
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::harmonics::synthesis;
    use crate::sky::healpix::pixel_directions;

    fn field(l_max: usize, seed: f64) -> Alm {
        let mut alm = Alm::zeros(l_max);
        for m in 0..=l_max {
            for (k, z) in alm.order_mut(m).iter_mut().enumerate() {
                let phase = if m == 0 { 0.0 } else { seed * (m + k) as f64 + 0.3 * m as f64 };
                *z = Complex64::from_polar(1.0 / (1.0 + k as f64 + seed), phase);
            }
        }
        alm
    }

    #[test]
    fn products_are_those_of_pixels() {
        for l_max in [0, 1, 2, 7] {
            let field = field(l_max, 1.7);
            let map = synthesis(&field, 8).unwrap();
            let scale = map.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
            for (axis, component) in Component::ALL.into_iter().enumerate() {
                let product = synthesis(&times_direction(&field, component), 8).unwrap();
                for ((n, value), product) in pixel_directions(8).iter().zip(&map).zip(product) {
                    // The sums over some ten degrees are rounded.
                    assert!((n[axis] * value - product).abs() < 1e-13 * scale, "{component:?} {l_max}");
                }
            }
        }
    }

    #[test]
    fn transposes_agree() {
        for component in Component::ALL {
            let (x, y) = (field(6, 0.9), field(7, 2.3));
            let inner = |a: &Alm, b: &Alm| -> f64 {
                a.values().iter().zip(b.values()).map(|(a, b)| a.re * b.re + a.im * b.im).sum()
            };
            let (forward, back) = (times_direction(&x, component), times_direction_transposed(&y, component));
            let (a, b) = (inner(&forward, &y), inner(&x, &back));
            assert!((a - b).abs() < 1e-14 * (1.0 + a.abs()), "{component:?}: {a} {b}");
        }
    }
}
