//! Lagrange interpolation.

/// The weights with which values at distinct `nodes` are interpolated at `x`.
pub(crate) fn lagrange_weights(nodes: &[f64], x: f64) -> Vec<f64> {
    let weight = |k: usize| {
        let others = nodes.iter().enumerate().filter(|(m, _)| *m != k);
        others.map(|(_, node)| (x - node) / (nodes[k] - node)).product()
    };
    (0..nodes.len()).map(weight).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parabola_is_interpolated_exactly() {
        let nodes = [1.0, 2.0, 4.0];
        let value: f64 = lagrange_weights(&nodes, 3.0).iter().zip(nodes).map(|(w, x)| w * (x * x - x)).sum();
        // 9 - 3; rounding of three products.
        assert!((value - 6.0).abs() < 1e-14, "{value}");
    }
}
