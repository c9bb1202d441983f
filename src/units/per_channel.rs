//! Configuration values that may differ between channels.

use std::fmt;
use std::marker::PhantomData;

use serde::de::value::SeqAccessDeserializer;
use serde::de::{Error, IntoDeserializer, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

/// One value for all channels, or one for each.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum PerChannel<T> {
    /// The same for all channels.
    All(T),
    /// One for each channel, in their order.
    Each(Vec<T>),
}

/// Not derived: that would not say what is wrong with a value.
impl<'de, T: Deserialize<'de>> Deserialize<'de> for PerChannel<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(PerChannelVisitor(PhantomData))
    }
}

struct PerChannelVisitor<T>(PhantomData<T>);

impl<T> PerChannelVisitor<T> {
    fn all<'de, E: Error>(value: impl IntoDeserializer<'de, E>) -> Result<PerChannel<T>, E>
    where
        T: Deserialize<'de>,
    {
        T::deserialize(value.into_deserializer()).map(PerChannel::All)
    }
}

impl<'de, T: Deserialize<'de>> Visitor<'de> for PerChannelVisitor<T> {
    type Value = PerChannel<T>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("one value for all channels, or a list with one for each")
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<Self::Value, E> {
        Self::all(value)
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Self::Value, E> {
        Self::all(value)
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Self::Value, E> {
        Self::all(value)
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Self::Value, E> {
        Self::all(value)
    }

    fn visit_str<E: Error>(self, value: &str) -> Result<Self::Value, E> {
        Self::all(value)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, values: A) -> Result<Self::Value, A::Error> {
        Vec::deserialize(SeqAccessDeserializer::new(values)).map(PerChannel::Each)
    }
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

    /// Whether the list, if it is one, has `channels` values.
    #[must_use]
    pub fn fits(&self, channels: usize) -> bool {
        match self {
            Self::All(_) => true,
            Self::Each(values) => values.len() == channels,
        }
    }

    /// All values, one or one for each channel.
    pub fn values(&self) -> &[T] {
        match self {
            Self::All(value) => std::slice::from_ref(value),
            Self::Each(values) => values,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::PathBuf;

    use super::*;

    fn parsed<T: for<'de> Deserialize<'de>>(text: &str) -> Result<PerChannel<T>, String> {
        let table = toml::from_str::<BTreeMap<String, PerChannel<T>>>(text);
        table.map(|mut table| table.remove("x").unwrap()).map_err(|error| error.to_string())
    }

    #[test]
    fn one_value_or_a_list_is_read() {
        assert_eq!(parsed("x = 3"), Ok(PerChannel::All(3_u64)));
        assert_eq!(parsed("x = 3"), Ok(PerChannel::All(3.0)));
        assert_eq!(parsed("x = [3, 0.5]"), Ok(PerChannel::Each(vec![3.0, 0.5])));
        assert_eq!(parsed("x = \"a.fits\""), Ok(PerChannel::All(PathBuf::from("a.fits"))));
        assert_eq!(parsed("x = [\"a\", \"b\"]"), Ok(PerChannel::Each(vec!["a".to_owned(), "b".to_owned()])));
    }

    #[test]
    fn errors_say_what_was_found_and_where() {
        for (text, found) in [
            ("x = \"three\"", "string \"three\""),
            ("x = [1, true]", "boolean `true`"),
            ("x = { a = 1 }", "map"),
        ] {
            let said = parsed::<f64>(text).unwrap_err();
            assert!(said.contains("line 1") && said.contains(found) && !said.contains("untagged"), "{said}");
        }
        let said = parsed::<u64>("x = -1").unwrap_err();
        assert!(said.contains("`-1`") && said.contains("u64"), "{said}");
    }
}
