//! Files that are mapped into the process.
//!
//! Mapped bytes are read like any others, so two things must not happen while a mapping lives, and
//! what is mapped is chosen so that they do not:
//! - the content changes: chunk files are never written to once they have their name (ME-2); the
//!   files of a scene are mapped while they are read for the first time, as every program that maps its
//!   input does, and hashed meanwhile;
//! - the file gets shorter: the system would end the process. Chunk files are only ever removed, which
//!   leaves their content to who has them open.
#![allow(unsafe_code)]

use std::{fmt, fs::File, io, ops::Deref};

use memmap2::{Mmap, UncheckedAdvice};
use sightline_geometry::Holder;

/// A file that is mapped for reading.
pub struct Map(Mmap);

impl Map {
    /// Maps a whole file.
    pub fn of(file: &File) -> io::Result<Self> {
        // Sound as far as the file stays as it is, see the module.
        Ok(Self(unsafe { Mmap::map(file)? }))
    }

    /// Gives back the memory of a range of bytes; who reads them next loads them again.
    pub fn give_back(&self, offset: usize, len: usize) -> io::Result<()> {
        // Sound: the mapping is of a file and was never written to, so that the same bytes come back.
        unsafe { self.0.unchecked_advise_range(UncheckedAdvice::DontNeed, offset, len) }
    }
}

// Sound: a mapping stays where it is until it is dropped, and what is mapped stays as it is.
unsafe impl Holder for Map {
    fn bytes(&self) -> &[u8] {
        &self.0
    }
}

impl Deref for Map {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.0
    }
}

impl fmt::Debug for Map {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Map({} bytes)", self.0.len())
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn what_was_given_back_reads_as_before() {
        let mut file = tempfile::tempfile().unwrap();
        let content: Vec<u8> = (0..100_000u32).map(|i| (i * 7 % 251) as u8).collect();
        file.write_all(&content).unwrap();
        let map = Map::of(&file).unwrap();
        assert_eq!(*map, *content);
        map.give_back(4096, 90_000).unwrap();
        assert_eq!(*map, *content);
    }

    #[test]
    fn an_empty_file_is_an_empty_slice() {
        assert!(Map::of(&tempfile::tempfile().unwrap()).unwrap().is_empty());
    }
}
