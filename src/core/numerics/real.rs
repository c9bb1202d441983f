//! The floating-point types that kernels are generic over.

/// f32 or f64.
pub trait Real: faer::traits::RealField + rustfft::FftNum + Default {
    /// The nearest value.
    fn nearest(value: f64) -> Self;
    /// The nearest value, or zero where products would be subnormal, which are a hundred times as slow; for tables with values of order one.
    fn table_entry(value: f64) -> Self;
}

impl Real for f32 {
    fn nearest(value: f64) -> Self {
        value as Self
    }
    #[inline]
    fn table_entry(value: f64) -> Self {
        if value.abs() < 1e-14 { 0.0 } else { value as Self }
    }
}

impl Real for f64 {
    fn nearest(value: f64) -> Self {
        value
    }
    fn table_entry(value: f64) -> Self {
        value
    }
}
