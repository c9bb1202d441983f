//! The engine of one channel, whichever the configuration asks for.

use std::io::{Read, Write};
use std::path::Path;

use super::snapshot::SnapshotData;
use crate::frames::{Channel, Instrument, PlacedVisibilities, VisibilityReason};
use crate::imaging::anywhere::{RefinedSetup, SegmentFolder, VisibilityArchive};
use crate::imaging::circle::{HarmonicEngine, HarmonicSetup, nominal_orbit};
use crate::imaging::{
    AccumulationError, Added, EngineKind, MapConfig, MatrixFreeVisibilities, NormalEngine, PixelEngine,
    PixelSetup, automatic_weight_max,
};
use crate::ranks::{RankShare, Ranks};

/// The engine of one channel: pixel sums, harmonic sums, or stored visibilities.
pub(super) enum Engine {
    Pixel(Box<PixelEngine>),
    Harmonic(Box<HarmonicEngine>),
    Archive(Box<VisibilityArchive>),
}

impl Engine {
    /// Restricts the engine to this rank's share. Only the harmonic engine divides its sums; the others hold everything on every rank.
    pub(super) fn with_ranks(self, ranks: &Ranks) -> Self {
        match self {
            Self::Harmonic(engine) => Self::Harmonic(Box::new(engine.with_ranks(ranks))),
            other => other,
        }
    }

    pub(super) fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        match self {
            Self::Pixel(engine) => engine.add(placed),
            Self::Harmonic(engine) => engine.add(placed),
            Self::Archive(archive) => archive.add(placed),
        }
    }

    pub(super) fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        match self {
            Self::Pixel(engine) => engine.remove(placed),
            Self::Harmonic(engine) => engine.remove(placed),
            Self::Archive(archive) => archive.remove(placed),
        }
    }

    /// Adds the sums of another engine of the same kind.
    pub(super) fn merge(&mut self, other: Self) -> Result<(), AccumulationError> {
        match (self, other) {
            (Self::Pixel(ours), Self::Pixel(theirs)) => ours.merge(*theirs),
            (Self::Harmonic(ours), Self::Harmonic(theirs)) => ours.merge(*theirs),
            (Self::Archive(ours), Self::Archive(theirs)) => ours.merge(*theirs),
            _ => Err(AccumulationError::Mismatch { what: "kinds" }),
        }
    }

    /// Writes it; an archive's visibilities go into files of their own in `segments`.
    pub(super) fn checkpoint(
        &mut self,
        out: &mut dyn Write,
        segments: SegmentFolder<'_>,
    ) -> Result<(), AccumulationError> {
        match self {
            Self::Pixel(engine) => engine.checkpoint(out),
            Self::Harmonic(engine) => engine.checkpoint(out),
            Self::Archive(archive) => archive.checkpoint(out, segments),
        }
    }

    /// Reads what [`Self::checkpoint`] wrote on the rank with share `part`, with archive files in `folder`. Only the share of `ranks` is kept.
    pub(super) fn restore(
        config: &MapConfig,
        from: &mut dyn Read,
        folder: Option<&Path>,
        (part, ranks): (RankShare, &Ranks),
    ) -> Result<Self, AccumulationError> {
        Ok(match config.engine {
            _ if config.holds_visibilities() => {
                let visibilities_max = config.refine.visibilities_max;
                Self::Archive(Box::new(VisibilityArchive::restore(from, folder, visibilities_max)?))
            }
            EngineKind::Pixel | EngineKind::Auto => Self::Pixel(Box::new(PixelEngine::restore(from)?)),
            EngineKind::Harmonic => {
                Self::Harmonic(Box::new(HarmonicEngine::restore_part(from, part, ranks)?))
            }
        })
    }

    /// Whether it holds no visibility.
    pub(super) fn is_empty(&self) -> bool {
        let counts = match self {
            Self::Pixel(engine) => engine.counts(),
            Self::Harmonic(engine) => engine.counts(),
            Self::Archive(archive) => archive.counts(),
        };
        counts.visibilities == 0
    }

    /// Copies the data for a snapshot. For refinement these are the harmonic sums on the nearest circular orbit.
    pub(super) fn snapshot_data(&mut self, config: &MapConfig) -> Result<SnapshotData, AccumulationError> {
        Ok(match self {
            Self::Archive(archive) if config.is_matrix_free() => matrix_free(config, archive.copy()),
            Self::Pixel(engine) => SnapshotData::Pixel(engine.sums()),
            Self::Harmonic(engine) => SnapshotData::Harmonic(Box::new(engine.sums())),
            Self::Archive(archive) => SnapshotData::Harmonic(Box::new(archive.circle_sums()?)),
        })
    }

    pub(super) fn into_final_data(self, config: &MapConfig) -> SnapshotData {
        match self {
            Self::Archive(archive) if config.is_matrix_free() => matrix_free(config, *archive),
            Self::Pixel(engine) => SnapshotData::Pixel(engine.into_sums()),
            Self::Harmonic(engine) => SnapshotData::Harmonic(Box::new(engine.into_sums())),
            Self::Archive(archive) => SnapshotData::Refined(archive),
        }
    }
}

/// Wraps stored visibilities for the matrix-free pixel solver.
fn matrix_free(config: &MapConfig, archive: VisibilityArchive) -> SnapshotData {
    SnapshotData::MatrixFree(Box::new(MatrixFreeVisibilities {
        nside: config.nside,
        method: config.rows,
        archive,
    }))
}

/// A value, or why it could not be created from the first data of its channel.
pub(super) type NewOrRefused<T> = Result<T, VisibilityReason>;

/// Creates an engine for the channel of `placed`, its first data; refuses positions that determine no usable orbit.
pub(super) fn new_engine(
    config: &MapConfig,
    instrument: &Instrument,
    placed: &PlacedVisibilities,
) -> Result<NewOrRefused<Engine>, AccumulationError> {
    let Some(&Channel { frequency_hz, width_hz }) = instrument.channels.get(usize::from(placed.channel.0))
    else {
        return Err(AccumulationError::UnknownChannel(placed.channel));
    };
    let (moon_radius_m, response) = (instrument.moon_radius_m, instrument.response);
    let weight_max = match config.weight_max {
        0.0 => automatic_weight_max(frequency_hz, width_hz),
        weight_max => weight_max,
    };
    Ok(match config.engine {
        _ if config.holds_visibilities() => {
            Ok(Engine::Archive(Box::new(VisibilityArchive::new(RefinedSetup {
                channel: placed.channel,
                // A pixel map has no l_max.
                l_max: if config.is_matrix_free() { 0 } else { config.degree() },
                frequency_hz,
                baseline_m_max: config.baseline_m_max(frequency_hz),
                moon_radius_m,
                response,
                companion_seed: config.companion_seed,
                weight_max,
                limits: config.limits,
                visibilities_max: config.refine.visibilities_max,
            })?)))
        }
        EngineKind::Pixel | EngineKind::Auto => Ok(Engine::Pixel(Box::new(PixelEngine::new(PixelSetup {
            nside: config.nside,
            frequency_hz,
            method: config.rows,
            moon_radius_m,
            response,
            companion_seed: config.companion_seed,
            weight_max,
        })?))),
        EngineKind::Harmonic => match nominal_orbit(placed, config.limits) {
            // Positions are untrusted: an orbit inside the Moon, or smaller than the longest baseline, is refused. Later data may still
            // create the engine.
            Some(orbit) if orbit.radius_m <= moon_radius_m.max(config.baseline_m_max(frequency_hz)) => {
                Err(VisibilityReason::OffAltitude)
            }
            Some(orbit) => Ok(Engine::Harmonic(Box::new(HarmonicEngine::new(HarmonicSetup {
                l_max: config.degree(),
                frequency_hz,
                baseline_m_max: config.baseline_m_max(frequency_hz),
                moon_radius_m,
                response,
                orbit,
                companion_seed: config.companion_seed,
                weight_max,
            })?))),
            None => Err(VisibilityReason::NoDirection),
        },
    })
}
