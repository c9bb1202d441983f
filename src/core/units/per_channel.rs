//! Configuration values that may differ between channels.

use serde::{Deserialize, Serialize};

/// One value for all channels, or one for each.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "expected one value, or a list with one for each channel")]
pub enum PerChannel<T> {
    /// One value for all channels.
    All(T),
    /// One value for each channel, in order.
    Each(Vec<T>),
}

impl<T: Clone> PerChannel<T> {
    /// The value for `channel`; `None` if the list is too short.
    #[must_use]
    pub fn get(&self, channel: usize) -> Option<T> {
        match self {
            Self::All(value) => Some(value.clone()),
            Self::Each(values) => values.get(channel).cloned(),
        }
    }

    /// Applies `change` to every value.
    #[must_use]
    pub fn map<U>(&self, change: impl Fn(&T) -> U) -> PerChannel<U> {
        match self {
            Self::All(value) => PerChannel::All(change(value)),
            Self::Each(values) => PerChannel::Each(values.iter().map(change).collect()),
        }
    }

    /// Whether there is a value for each of `channels` channels, and no more.
    #[must_use]
    pub fn fits(&self, channels: usize) -> bool {
        match self {
            Self::All(_) => true,
            Self::Each(values) => values.len() == channels,
        }
    }

    /// All values that were given.
    pub fn values(&self) -> &[T] {
        match self {
            Self::All(value) => std::slice::from_ref(value),
            Self::Each(values) => values,
        }
    }
}
