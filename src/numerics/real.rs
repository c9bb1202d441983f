//! The two floating-point types of the kernels.

/// f32 or f64.
pub trait Real: faer::traits::RealField + rustfft::FftNum + Default {
    /// The nearest value.
    fn of(value: f64) -> Self;
    /// An entry of a table with values of order one: the nearest value, or zero if it is so small that products would
    /// be subnormal, which are a hundred times as slow.
    fn entry(value: f64) -> Self;
    /// As f64.
    fn wide(self) -> f64;
}

impl Real for f32 {
    fn of(value: f64) -> Self {
        value as Self
    }
    #[inline]
    fn entry(value: f64) -> Self {
        if value.abs() < 1e-14 { 0.0 } else { value as Self }
    }
    fn wide(self) -> f64 {
        f64::from(self)
    }
}

impl Real for f64 {
    fn of(value: f64) -> Self {
        value
    }
    fn entry(value: f64) -> Self {
        value
    }
    fn wide(self) -> f64 {
        self
    }
}
