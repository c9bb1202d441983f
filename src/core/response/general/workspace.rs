//! Tables and work buffers for products with B.

use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::RowsSetup;
use super::cap::{CapBuffers, CapClass, NodePatterns};
use super::lanes::Value;
use super::phases::{PaddedWeights, PhaseTable};
use super::plan::{RowNode, RowPlan};
use super::skies::{RotatedSkies, RotationBuffers};

/// Tables shared by the rows of a plan.
pub(super) struct Tables {
    /// Tables of the classes that the nodes have.
    classes: Vec<CapClass>,
    /// Index in `classes` of each class of the plan.
    index_of_class: Vec<usize>,
}

impl Tables {
    pub(super) fn new(setup: &RowsSetup, plan: &RowPlan) -> Self {
        let mut numbers: Vec<usize> = plan.nodes.iter().map(|node| node.class as usize).collect();
        numbers.sort_unstable();
        numbers.dedup();
        let mut index_of_class = vec![0; plan.classes.len()];
        numbers.iter().enumerate().for_each(|(index, number)| index_of_class[*number] = index);
        let classes = numbers.par_iter().map(|number| CapClass::new(setup, &plan.classes[*number])).collect();
        Self { classes, index_of_class }
    }

    /// Returns the tables of a batch, which has at least one node.
    pub(super) fn class(&self, nodes: &[RowNode]) -> &CapClass {
        &self.classes[self.index_of_class[nodes[0].class as usize]]
    }
}

/// Nodes of one class, and their patterns.
#[derive(Default)]
pub(super) struct Batch {
    /// Indices among the nodes of the group's tracks.
    pub(super) indices: Vec<usize>,
    pub(super) nodes: Vec<RowNode>,
    pub(super) patterns: Vec<NodePatterns>,
}

/// Work buffers of a task on one group of tracks.
///
/// Later tasks reuse them: allocating tens of MB for each group would take up to two fifths of a product's time in page faults,
/// where antennas multiply the skies.
#[derive(Default)]
pub(super) struct Workspace {
    pub(super) cap: CapBuffers,
    pub(super) batches: Vec<Batch>,
    pub(super) rotation: RotationBuffers,
    /// Skies in the chosen frames, later gradients in these frames.
    pub(super) basis: RotatedSkies,
    /// Skies in the frames of a batch.
    pub(super) rotated: RotatedSkies,
    /// Weights of the chosen frames in the frames of a batch.
    pub(super) weights: Vec<Value>,
    /// `[node][sky][real or imaginary part][order]`.
    pub(super) amplitudes: Vec<f64>,
    pub(super) table: PhaseTable,
    pub(super) node_weights: Vec<f64>,
    pub(super) padded: PaddedWeights,
}

/// Pool of free workspaces.
#[derive(Default)]
pub(super) struct WorkspacePool(Mutex<Vec<Workspace>>);

impl WorkspacePool {
    pub(super) fn with_workspace<T>(&self, task: impl FnOnce(&mut Workspace) -> T) -> T {
        let free = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut workspace = free().pop().unwrap_or_default();
        let out = task(&mut workspace);
        free().push(workspace);
        out
    }
}
