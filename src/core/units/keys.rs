//! Declares each key of a pipeline file once, beside the struct that holds its value.
//!
//! [`keys!`](crate::units::keys) generates the struct, its defaults, its parser, and the table from which reference, help and checks of
//! effect are made.

/// The readers that a key is shown to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// Everyone who makes maps: help and `lunarray config` show the key.
    Everyday,
    /// Those who study one part: the key is shown on request.
    Expert,
    /// The key is a section, whose keys have levels of their own.
    Section,
}

/// A key of a section, or a subsection.
#[derive(Debug)]
pub struct Key {
    /// Name in its section, with the unit.
    pub name: &'static str,
    /// Who needs it.
    pub level: Level,
    /// Its description, line by line.
    pub about: &'static [&'static str],
    /// The condition under which it has an effect: comparisons of keys, joined by ` or ` and ` and `, which binds tighter; empty if it always
    /// has one. A key that begins with a dot is of the same section.
    pub only_with: &'static str,
    /// The default; `None` for a key that is absent by default.
    pub default: fn() -> Option<toml::Value>,
    /// The keys of a section.
    pub keys: &'static [Key],
}

/// Declares a section: the struct, its defaults, and its table `KEYS`.
///
/// Each field has its documentation (which `lunarray explain` shows), `#[only_with("...")]` with its condition if it has one, its serde
/// attributes, its level (`everyday`, `expert` or `section`) and its default.
#[macro_export]
#[doc(hidden)]
macro_rules! keys {
    (
        $(#[$outer:meta])*
        $vis:vis struct $name:ident {
            $(
                $(#[doc = $doc:literal])+
                $(#[only_with($only:literal)])?
                $(#[serde($($serde:tt)*)])?
                $level:ident $field:ident: $type:ty = $default:expr;
            )*
        }
    ) => {
        $(#[$outer])*
        #[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
        #[serde(deny_unknown_fields, default)]
        $vis struct $name {
            $(
                $(#[doc = $doc])+
                $(#[serde($($serde)*)])?
                pub $field: $type,
            )*
        }

        impl Default for $name {
            fn default() -> Self {
                Self { $($field: $default,)* }
            }
        }

        impl $name {
            /// The keys of this section.
            #[doc(hidden)]
            pub const KEYS: &'static [$crate::units::Key] = &[$(
                $crate::units::Key {
                    name: stringify!($field),
                    level: $crate::units::keys!(@level $level),
                    about: &[$($doc),+],
                    only_with: concat!($($only)?),
                    default: || {
                        let default: $type = $default;
                        toml::Value::try_from(default).ok()
                    },
                    keys: $crate::units::keys!(@keys $level $type),
                },
            )*];
        }
    };
    (@level everyday) => { $crate::units::Level::Everyday };
    (@level expert) => { $crate::units::Level::Expert };
    (@level section) => { $crate::units::Level::Section };
    (@keys section $type:ty) => { <$type>::KEYS };
    (@keys $level:ident $type:ty) => { &[] };
}
pub use keys;
