//! tmp
use super::harmonics::{AnalysisOptions, analysis};
use super::{MapError, SkyMap};
/// tmp
#[derive(Clone, Debug, serde::Serialize)]
pub struct Comparison {
    /// l
    pub l: Vec<usize>,
    /// cl
    pub cl_map: Vec<f64>,
    /// cl
    pub cl_truth: Vec<f64>,
    /// cl
    pub cl_cross: Vec<f64>,
    /// rho
    pub rho: Vec<f64>,
    /// snr
    pub snr: Option<Vec<f64>>,
}
/// tmp
pub fn compare(map: &SkyMap, truth: &SkyMap, noise: Option<&SkyMap>) -> Result<Comparison, MapError> {
    let l_max = 3 * map.nside() - 1;
    let alm = |m: &SkyMap| analysis(m.values(), l_max, &AnalysisOptions::default()).unwrap().alm;
    let (a, b) = (alm(map), alm(truth));
    let n = noise.map(alm);
    let cross = |x: &super::harmonics::Alm, y: &super::harmonics::Alm| -> Vec<f64> {
        (0..=l_max).map(|l| {
            let mut s = (x.get(l, 0) * y.get(l, 0).conj()).re;
            for m in 1..=l { s += 2.0 * (x.get(l, m) * y.get(l, m).conj()).re; }
            s / (2 * l + 1) as f64
        }).collect()
    };
    let (cl_map, cl_truth, cl_cross) = (cross(&a, &a), cross(&b, &b), cross(&a, &b));
    let rho = (0..=l_max).map(|l| cl_cross[l] / (cl_map[l] * cl_truth[l]).sqrt()).collect();
    let snr = n.map(|n| { let cn = cross(&n, &n); (0..=l_max).map(|l| cl_cross[l] / (cl_truth[l] * cn[l]).sqrt()).collect() });
    Ok(Comparison { l: (0..=l_max).collect(), cl_map, cl_truth, cl_cross, rho, snr })
}
impl SkyMap {
    /// tmp
    pub fn to_ecliptic(&self) -> Result<Self, MapError> { Ok(self.clone()) }
    /// tmp
    pub fn smoothed(&self, _f: f64) -> Result<Self, MapError> { Ok(self.clone()) }
}
