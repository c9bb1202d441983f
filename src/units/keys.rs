//! One declaration of each key of a pipeline file, beside the struct that holds its value.
//!
//! [`keys!`](crate::units::keys) makes the struct, its defaults, how it is read, and the table from which reference, help and checks
//! of effect are made.

/// Who needs a key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// Whoever makes maps: shown by help and by `lunarray config`.
    Everyday,
    /// Who studies one part: shown on request.
    Expert,
    /// It is a section, and its keys have levels of their own.
    Section,
}

/// A key of a section, or a section in it.
#[derive(Debug)]
pub struct Key {
    /// Name in its section, with the unit.
    pub name: &'static str,
    /// Who needs it.
    pub level: Level,
    /// What it means, line by line.
    pub about: &'static [&'static str],
    /// When it has an effect: comparisons of keys, joined by ` or `; always if empty. A strength of zero is a value like others, which a
    /// study may go through: what belongs to it has its effect.
    pub only_with: &'static str,
    /// The default; `None` for a key that is absent by default.
    pub default: fn() -> Option<toml::Value>,
    /// Keys of a section.
    pub keys: &'static [Key],
}

/// Declares a section: the struct, its defaults, and its table `KEYS`.
///
/// Each field has its documentation (which `lunarray explain` shows), `#[only_with("...")]` if it has an effect only then, what serde needs,
/// its level (`everyday`, `expert` or `section`) and its default.
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
            /// Its keys.
            #[doc(hidden)]
            pub const KEYS: &'static [$crate::units::Key] = &[$(
                $crate::units::Key {
                    name: stringify!($field),
                    level: $crate::units::keys!(@level $level),
                    about: &[$($doc),+],
                    only_with: concat!($($only)?),
                    default: || {
                        let usual: $type = $default;
                        toml::Value::try_from(usual).ok()
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
pub(crate) use keys;
