//! Atomic files: complete under their name or absent, and written by one process at a time. All code that writes files
//! uses this module, and all that reads tables its [`Columns`].

mod access;
mod atomic;
mod folder_lock;
mod form;
mod protected;
mod table;
#[cfg(test)]
mod tests;

pub use access::{
    disk_space, is_at, is_same_name, open_file, read_at, read_file, read_folder, read_text, write_at,
};
pub use atomic::{
    AtomicFile, IfUnfinished, growing_file, nameless_file, remove_unfinished, write_atomically,
};
pub use folder_lock::FolderLock;
pub use form::{form_of, form_with_remedy, text_of};
pub use protected::{ProtectedInputs, require_replaceable};
pub use table::{
    Columns, Row, Separator, TableFault, is_comment, numbered_lines, without_cells, without_mark,
};
