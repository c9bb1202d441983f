//! The report on a refined map: its convergence, and the residuals of the data.

use std::collections::BTreeMap;
use std::fmt;

use num_complex::Complex64;
use serde::Serialize;

use crate::imaging::anywhere::{Departures, RefinedSums, orbit_phase_deg};
use crate::imaging::solver::Convergence;
use crate::units::constants::DAY_S;

/// Convergence of a refined map, and residuals of the data.
#[derive(Clone, Debug, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct Refinement {
    /// Convergence of the map; each iteration uses all visibilities.
    pub convergence: Convergence,
    /// Residual of the true equations after each iteration.
    pub residuals: Vec<f64>,
    /// Whether iterations converged too slowly, so that the matrix was formed and the equations solved directly.
    pub direct: bool,
    /// Departures of the positions from the preconditioner's circle.
    pub departures: Departures,
    /// Number of rows of B that were computed; the others were interpolated.
    pub rows_computed: u64,
    /// Number of averages over integrations that were treated as instants in their middle, because too few neighbours of the pair are near.
    pub taken_as_instants: u64,
    /// Reduced chi-squares of the data.
    pub chi_square: ChiSquares,
}

/// Reduced chi-squares: means of `|V - B x|^2 w / 2` over visibilities, 1 for residuals of noise only.
#[derive(Clone, Debug, Default, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct ChiSquares {
    /// All visibilities.
    pub all: f64,
    /// By pair, named `1-2` with daughters from 1.
    pub by_pair: BTreeMap<String, f64>,
    /// By daughter, from 1: all pairs that contain it.
    pub by_daughter: BTreeMap<u16, f64>,
    /// By day of mission time, from 0.
    pub by_day: BTreeMap<i64, f64>,
    /// By orbital phase from the ascending node, in bins of 15 degrees named by their lower edge. Visibilities whose phase is not known are
    /// left out.
    pub by_phase_deg: BTreeMap<u16, f64>,
}

/// Width of a phase bin, degrees.
const PHASE_BIN_DEG: u16 = 15;

impl ChiSquares {
    /// Formats a table with a line for all visibilities, and for each pair, daughter, phase and day.
    #[must_use]
    pub fn csv(&self) -> String {
        let mut table = String::from(
            "# Mean of |V - B x|^2 w / 2: what the map leaves of the data, in units of their noise; 1 for noise alone.\n\
             # by: all; pair; daughter, from 1; phase: beginning of 15 deg from the ascending node; day of the mission, from 0.\n\
             by,which,chi_square\n",
        );
        let mut line = |by: &str, which: &dyn fmt::Display, value: f64| {
            table.push_str(&format!("{by},{which},{value:.6e}\n"));
        };
        line("all", &"all", self.all);
        self.by_pair.iter().for_each(|(pair, value)| line("pair", pair, *value));
        self.by_daughter.iter().for_each(|(daughter, value)| line("daughter", daughter, *value));
        self.by_phase_deg.iter().for_each(|(phase_deg, value)| line("phase", phase_deg, *value));
        self.by_day.iter().for_each(|(day, value)| line("day", day, *value));
        table
    }
}

impl fmt::Display for Refinement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { convergence, departures, chi_square, .. } = self;
        match (self.direct, convergence.iterations) {
            (true, _) => write!(f, "solved directly with rows of the true positions to a residual of")?,
            (_, 1) => write!(f, "refined in 1 pass to a residual of")?,
            (_, passes) => write!(f, "refined in {passes} passes to a residual of")?,
        }
        write!(
            f,
            " {:.1e}{}; {} visibilities on the circle of {:.1} km and {:.2} deg, {} up to \
             {:.2} km, {:.2} deg off its plane and {:.2} deg off the horizontal; chi-square {:.4}",
            convergence.residual,
            if convergence.converged {
                ""
            } else {
                ": not converged, more passes (map.refine.passes_max) change the map"
            },
            departures.on_the_circle,
            departures.circle_radius_m / 1e3,
            departures.circle_inclination_deg,
            departures.by_refinement,
            departures.altitude_m_max / 1e3,
            departures.tilt_deg_max,
            departures.radial_deg_max,
            chi_square.all,
        )?;
        match self.taken_as_instants {
            0 => Ok(()),
            count => {
                write!(f, "; {count} averages over integrations taken for instants: too few others near them")
            }
        }
    }
}

/// Computes the reduced chi-squares of residuals.
pub(super) fn chi_squares(sums: &RefinedSums, residuals: &[Complex64]) -> ChiSquares {
    #[derive(Clone, Copy, Default)]
    struct Mean(f64, f64);
    impl Mean {
        fn add(&mut self, value: f64) {
            self.0 += value;
            self.1 += 1.0;
        }
        fn value(self) -> f64 {
            self.0 / self.1.max(1.0)
        }
    }
    let mut all = Mean::default();
    let (mut pairs, mut daughters, mut days, mut phases) = (
        BTreeMap::<_, Mean>::new(),
        BTreeMap::<_, Mean>::new(),
        BTreeMap::<_, Mean>::new(),
        BTreeMap::<_, Mean>::new(),
    );
    for (k, ((at, residual), weight)) in sums.at.iter().zip(residuals).zip(&sums.data.weight).enumerate() {
        let value = 0.5 * residual.norm_sqr() * weight;
        all.add(value);
        pairs.entry((at.pair.i, at.pair.j)).or_default().add(value);
        for daughter in [at.pair.i, at.pair.j] {
            daughters.entry(u16::from(daughter) + 1).or_default().add(value);
        }
        days.entry((at.time_s / DAY_S).floor() as i64).or_default().add(value);
        if let Some(phase_deg) = orbit_phase_deg(&sums.at, k) {
            phases.entry(phase_deg as u16 / PHASE_BIN_DEG * PHASE_BIN_DEG).or_default().add(value);
        }
    }
    ChiSquares {
        all: all.value(),
        by_pair: pairs
            .into_iter()
            .map(|((i, j), mean)| (format!("{}-{}", u16::from(i) + 1, u16::from(j) + 1), mean.value()))
            .collect(),
        by_daughter: daughters.into_iter().map(|(daughter, mean)| (daughter, mean.value())).collect(),
        by_day: days.into_iter().map(|(day, mean)| (day, mean.value())).collect(),
        by_phase_deg: phases.into_iter().map(|(phase_deg, mean)| (phase_deg, mean.value())).collect(),
    }
}
