//! Tests of files in a temporary folder.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use super::atomic::WRITE_BYTES;
use super::*;

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<String> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_file_has_its_name_once_it_is_finished() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("new/folder/file");
    let mut file = AtomicFile::create(&path, IfUnfinished::Remove).unwrap();
    file.write_all(b"some").unwrap();
    assert!(!path.exists());
    assert_eq!(file.finish().unwrap(), 4);
    assert_eq!(fs::read(&path).unwrap(), b"some");
    write_atomically(&path, b"other").unwrap();
    assert_eq!(fs::read(&path).unwrap(), b"other");
    assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
}

#[test]
fn an_unfinished_file_is_removed_or_kept() {
    let folder = tempfile::tempdir().unwrap();
    for (unfinished, remains) in [(IfUnfinished::Remove, false), (IfUnfinished::Keep, true)] {
        let path = folder.path().join(format!("{unfinished:?}"));
        let mut file = AtomicFile::create(&path, unfinished).unwrap();
        file.write_all(&vec![7; WRITE_BYTES + 5]).unwrap();
        file.write_all(&[8; 3]).unwrap();
        drop(file);
        assert!(!path.exists());
        let left = fs::read(path.with_extension("partial")).ok();
        assert_eq!(left.map(|bytes| bytes.len()), remains.then_some(WRITE_BYTES + 8));
    }
    // An empty file is not kept.
    drop(AtomicFile::create(&folder.path().join("empty"), IfUnfinished::Keep).unwrap());
    assert_eq!(names(folder.path()), ["Keep.partial"]);
}

#[test]
fn a_second_writer_is_refused_and_leaves_the_first_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("file");
    let mut first = AtomicFile::create(&path, IfUnfinished::Keep).unwrap();
    first.write_all(b"first").unwrap();
    for _ in 0..3 {
        let refused = AtomicFile::create(&path, IfUnfinished::Keep).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::ResourceBusy);
        assert!(refused.to_string().contains("another process is writing it"), "{refused}");
    }
    assert_eq!(names(folder.path()).len(), 1);
    // Another name in the same folder is free.
    write_atomically(&folder.path().join("file2"), b"second").unwrap();
    first.finish().unwrap();
    assert_eq!(fs::read(&path).unwrap(), b"first");
    write_atomically(&path, b"then").unwrap();
    assert_eq!(names(folder.path()), ["file", "file2"]);
}

#[test]
fn of_several_simultaneous_writers_one_writes() {
    let folder = tempfile::tempdir().unwrap();
    for round in 0..10 {
        let path = folder.path().join(format!("file-{round}"));
        let barrier = std::sync::Barrier::new(6);
        let written: Vec<bool> = std::thread::scope(|scope| {
            let writers: Vec<_> = (0..6)
                .map(|writer: u8| {
                    let (path, barrier) = (&path, &barrier);
                    scope.spawn(move || {
                        barrier.wait();
                        let file = AtomicFile::create(path, IfUnfinished::Remove);
                        // Each writer keeps its file until all have tried.
                        barrier.wait();
                        let written = file.and_then(|mut file| {
                            file.write_all(&[writer; 9])?;
                            file.finish()
                        });
                        written.is_ok()
                    })
                })
                .collect();
            writers.into_iter().map(|writer| writer.join().unwrap()).collect()
        });
        assert_eq!(written.iter().filter(|written| **written).count(), 1, "{written:?}");
    }
    assert_eq!(names(folder.path()).len(), 10);
}

#[test]
fn unfinished_files_without_a_writer_are_removed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("file");
    let leftovers = [".file.77-0123456789abcdef.partial", "file.partial"];
    let others =
        [".other.77-0123456789abcdef.partial", ".file.partial", "other.partial", ".file.x-1.partial"];
    for name in leftovers.iter().chain(&others) {
        fs::write(folder.path().join(name), "left").unwrap();
    }
    write_atomically(&path, b"new").unwrap();
    let mut expected: Vec<&str> = others.iter().copied().chain(["file"]).collect();
    expected.sort_unstable();
    assert_eq!(names(folder.path()), expected);
    // A lock of the folder removes all its unfinished files.
    drop(FolderLock::acquire(folder.path(), ".lock", true).unwrap());
    expected.retain(|name| *name != others[0]);
    assert_eq!(names(folder.path()), expected);
}

#[cfg(unix)]
#[test]
fn planted_links_are_not_followed() {
    let folder = tempfile::tempdir().unwrap();
    let (path, victim) = (folder.path().join("file"), folder.path().join("victim"));
    fs::write(&victim, "precious").unwrap();
    for name in ["file.partial", ".file.1-0123456789abcdef.partial"] {
        std::os::unix::fs::symlink(&victim, folder.path().join(name)).unwrap();
    }
    let mut file = AtomicFile::create(&path, IfUnfinished::Keep).unwrap();
    file.write_all(b"mine").unwrap();
    drop(file);
    // The file has replaced the link.
    assert_eq!(fs::read(folder.path().join("file.partial")).unwrap(), b"mine");
    write_atomically(&path, b"whole").unwrap();
    assert_eq!(fs::read(&victim).unwrap(), b"precious");
    assert_eq!(fs::read(&path).unwrap(), b"whole");
}

#[cfg(unix)]
#[test]
fn inputs_and_links_are_not_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let place = |name: &str| folder.path().join(name);
    for name in ["input", "other"] {
        fs::write(place(name), name).unwrap();
    }
    fs::hard_link(place("input"), place("second-name")).unwrap();
    std::os::unix::fs::symlink(place("other"), place("link")).unwrap();
    std::os::unix::fs::symlink(place("nowhere"), place("dangling")).unwrap();
    let said = |name: &str| write_atomically(&place(name), b"new").unwrap_err().to_string();
    {
        let _inputs = ProtectedInputs::of([place("input"), place("missing")]);
        let _twice = ProtectedInputs::of([place("input")]);
        drop(ProtectedInputs::of([place("input")]));
        for name in ["input", "second-name"] {
            assert!(said(name).contains("read as an input"), "{}", said(name));
            assert!(growing_file(&place(name)).is_err());
        }
        write_atomically(&place("missing"), b"new").unwrap();
    }
    assert!(said("link").contains("is a link to") && said("dangling").contains("is a link to"));
    assert!(growing_file(&place("link")).is_err());
    assert_eq!(fs::read(place("input")).unwrap(), b"input");
    assert_eq!(fs::read(place("other")).unwrap(), b"other");
    // Without protection it can be replaced.
    write_atomically(&place("second-name"), b"new").unwrap();
    assert_eq!(fs::read(place("input")).unwrap(), b"input");
}

#[cfg(unix)]
#[test]
fn what_never_ends_is_not_read() {
    assert_eq!(read_text(Path::new("/dev/zero"), 1000).unwrap_err().kind(), io::ErrorKind::FileTooLarge);
    for none in ["/dev/zero", "/dev", "/nowhere"] {
        let kind = read_file(Path::new(none), 1000).unwrap_err().kind();
        assert_eq!(kind == io::ErrorKind::InvalidInput, none.starts_with("/dev"), "{none}");
    }
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(file.path(), "text").unwrap();
    assert_eq!(read_file(file.path(), 4).unwrap(), b"text");
    assert_eq!(read_text(file.path(), 4).unwrap(), "text");
    assert!(read_text(file.path(), 3).is_err());
}

#[test]
fn a_growing_file_takes_the_place_of_the_older_one() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("events");
    fs::write(&path, "older").unwrap();
    let older = File::open(&path).unwrap();
    let mut file = growing_file(&path).unwrap();
    file.write_all(b"first\n").unwrap();
    assert_eq!(fs::read(&path).unwrap(), b"first\n");
    // Whoever has the older one open keeps it.
    assert_eq!(io::read_to_string(older).unwrap(), "older");
    assert_eq!(names(folder.path()), ["events"]);
}

#[test]
fn a_folder_has_one_user_who_notices_its_loss() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path().join("folder");
    let lock = FolderLock::acquire(&folder, ".lock", true).unwrap();
    let refused = FolderLock::acquire(&folder, ".lock", true).unwrap_err();
    assert_eq!(refused.kind(), io::ErrorKind::ResourceBusy);
    assert_eq!(lock.loss(), None);
    fs::remove_file(folder.join(".lock")).unwrap();
    assert!(lock.loss().unwrap().contains("lost its lock"));
    // The next one is not disturbed when the first lets go.
    let next = FolderLock::acquire(&folder, ".lock", true).unwrap();
    drop(lock);
    assert_eq!(next.loss(), None);
    fs::rename(&folder, place.path().join("elsewhere")).unwrap();
    assert!(next.loss().unwrap().contains("moved or removed"));
    fs::create_dir(&folder).unwrap();
    assert!(next.loss().unwrap().contains("replaced"));
    drop(next);
    let last = FolderLock::acquire(&folder, ".lock", true).unwrap();
    drop(last);
    assert!(names(&folder).is_empty());
}
