//! Keeps a process within its memory by giving chunks of mapped files back.
//!
//! The measure is what the system itself counts: the resident set of the process (`/proc/self/statm`),
//! mapped pages and all else. Walks call [`Keeper::look`](Residency::look) every so many steps. A look
//! costs an atomic subtraction until so many looks were made that the room that was left at the last
//! measurement could be used up; then the process is measured again. Above the *high mark* (a sixteenth below
//! the limit, which is for what happens between two looks) chunks are given back until the process is an
//! eighth of the limit below it.
//!
//! Chunks go in a circle over the mapped files. That is not the order of their last use, which nobody
//! knows without paying for it at every step; but a chunk that is in use comes back from the page cache of the
//! system in some tens of microseconds, and the page cache, which sees the use, is the cache here.
//!
//! A thread looks every few milliseconds besides, for what reads arrays and does not walk.
//!
//! How many chunks are loaded is read from `/proc/self/pagemap` before they are given back, and at the
//! end. Linux only.

use std::{
    fs::File,
    io,
    os::unix::fs::FileExt,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError, Weak,
        atomic::{AtomicI64, AtomicU64, Ordering},
    },
    time::Duration,
};

use sightline_geometry::{Residency, STEPS};

use super::{Map, MemoryLimit};
use crate::{Cause, SceneError};

/// Bytes of a chunk: what is given back at once.
pub const CHUNK: usize = 2 << 20;

/// Bytes that [`STEPS`] steps of one thread are taken to load at most, on average over the threads.
const A_LOOK: u64 = STEPS * 16 * 1024;

/// Room for chunks that a strict limit must leave, as a part of it.
const LEAST_ROOM: u64 = 8;

/// What was held of the chunk file, so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Held {
    /// The limit, bytes.
    pub limit: u64,
    /// Bytes of the chunk file.
    pub bytes: u64,
    /// Chunks of the file.
    pub chunks: u64,
    /// Chunks of which something was loaded at some time.
    pub touched: u64,
    /// Times that a chunk was loaded: once each that was touched, and again after it was given back.
    pub loaded: u64,
    /// Times that a chunk was given back.
    pub given_back: u64,
    /// Times that the process was above its limit and nothing was left to give back.
    pub overruns: u64,
}

/// A mapped file, and what is known of its chunks.
#[derive(Debug)]
struct Kept {
    map: Weak<Map>,
    bytes: u64,
    /// Whether it is a chunk file: others are not counted.
    counts: bool,
    touched: Vec<bool>,
    given_back: u64,
}

#[derive(Debug, Default)]
struct Circle {
    kept: Vec<Kept>,
    /// The next chunk: of which file, and its number.
    hand: (usize, usize),
}

/// Keeps a process within a limit. One a scene.
#[derive(Debug)]
pub struct Keeper {
    limit: u64,
    strict: bool,
    page: u64,
    statm: File,
    pagemap: Option<File>,
    /// Looks until the next measurement.
    credit: AtomicI64,
    circle: Mutex<Circle>,
    overruns: AtomicU64,
}

impl Keeper {
    /// A keeper for a limit.
    ///
    /// # Errors
    /// Where the system does not say how large the process is.
    pub fn new(limit: &MemoryLimit) -> io::Result<Self> {
        let keeper = Self {
            limit: limit.bytes,
            strict: limit.strict,
            page: rustix::param::page_size() as u64,
            statm: File::open("/proc/self/statm")?,
            pagemap: File::open("/proc/self/pagemap").ok(),
            credit: AtomicI64::new(0),
            circle: Mutex::default(),
            overruns: AtomicU64::new(0),
        };
        keeper.resident()?;
        Ok(keeper)
    }

    /// Looks every few milliseconds on a thread of its own, until the keeper is dropped: what reads
    /// mapped arrays without knowing of it, such as the writer of the numbering, is kept within the limit too.
    pub(crate) fn watch(self: &Arc<Self>) -> io::Result<()> {
        /// Far less than it takes to load an eighth of any limit from a disk.
        const PAUSE: Duration = Duration::from_millis(5);
        let keeper = Arc::downgrade(self);
        let look = move || {
            while let Some(keeper) = keeper.upgrade() {
                keeper.look_now();
                drop(keeper);
                std::thread::park_timeout(PAUSE);
            }
        };
        std::thread::Builder::new().name("memory".into()).spawn(look).map(drop)
    }

    /// The limit, bytes.
    #[must_use]
    pub const fn limit(&self) -> u64 {
        self.limit
    }

    /// Takes a mapped file into the circle; it leaves it when it is dropped elsewhere. A chunk file
    /// `counts` in what is reported.
    pub(crate) fn keep(&self, map: &Arc<Map>, counts: bool) {
        let touched = vec![false; map.len().div_ceil(CHUNK)];
        let (map, bytes) = (Arc::downgrade(map), map.len() as u64);
        let kept = Kept { map, bytes, counts, touched, given_back: 0 };
        let mut circle = self.circle();
        circle.kept.retain(|kept| kept.counts || kept.map.strong_count() > 0);
        circle.kept.push(kept);
        circle.hand = (0, 0);
    }

    /// As a look, but measures at once.
    pub(crate) fn look_now(&self) {
        self.credit.store(0, Ordering::Relaxed);
        self.look();
    }

    /// What was held so far. Counts what is loaded now.
    #[must_use]
    pub fn held(&self) -> Held {
        let mut circle = self.circle();
        let mut held = Held {
            limit: self.limit,
            overruns: self.overruns.load(Ordering::Relaxed),
            ..Held::default()
        };
        for kept in circle.kept.iter_mut().filter(|kept| kept.counts) {
            if let Some(map) = kept.map.upgrade() {
                for chunk in 0..kept.touched.len() {
                    if self.loaded_pages(&map, chunk).is_some_and(|pages| pages > 0) {
                        kept.touched[chunk] = true;
                        held.loaded += 1;
                    }
                }
            }
            held.bytes += kept.bytes;
            held.chunks += kept.touched.len() as u64;
            held.touched += kept.touched.iter().filter(|&&t| t).count() as u64;
            held.given_back += kept.given_back;
        }
        held.loaded += held.given_back;
        held
    }

    /// Refuses a scene whose resting part leaves no room for chunks, with `more` bytes to come.
    pub(crate) fn expect_room(&self, more: u64) -> Result<(), SceneError> {
        if !self.strict {
            return Ok(());
        }
        let unknown = |source| SceneError::from(Cause::MemoryUnknown { source });
        let rests = self.anonymous().map_err(unknown)? + more;
        let needed = rests + rests / (LEAST_ROOM - 1);
        let limit = self.limit;
        if needed > limit { Err(Cause::OutOfMemory { needed, limit }.into()) } else { Ok(()) }
    }

    fn circle(&self) -> MutexGuard<'_, Circle> {
        // Nothing of the circle is half done when someone panics.
        self.circle.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Bytes of the process that are in memory.
    fn resident(&self) -> io::Result<u64> {
        Ok(self.counted(1)? * self.page)
    }

    /// Bytes of the process in memory that are of no file.
    fn anonymous(&self) -> io::Result<u64> {
        Ok(self.counted(1)?.saturating_sub(self.counted(2)?) * self.page)
    }

    /// A number of `/proc/self/statm`, pages.
    fn counted(&self, place: usize) -> io::Result<u64> {
        let mut text = [0; 128];
        let len = self.statm.read_at(&mut text, 0)?;
        let mut words = text[..len].split(|b| b.is_ascii_whitespace());
        let word = words.nth(place).and_then(|word| std::str::from_utf8(word).ok());
        word.and_then(|word| word.parse().ok())
            .ok_or_else(|| io::Error::other("/proc/self/statm has another form"))
    }

    /// Pages of a chunk that this process has loaded, where the system says.
    fn loaded_pages(&self, map: &Map, chunk: usize) -> Option<u64> {
        /// Of an entry of the page map: the page is in memory.
        const PRESENT: u64 = 1 << 63;
        let (start, end) = (chunk * CHUNK, map.len().min((chunk + 1) * CHUNK));
        let first = (map.as_ptr() as u64 + start as u64) / self.page;
        let pages = (end - start).div_ceil(self.page as usize);
        let mut entries = vec![0u8; 8 * pages];
        self.pagemap.as_ref()?.read_exact_at(&mut entries, 8 * first).ok()?;
        let entries = entries.as_chunks::<8>().0;
        Some(entries.iter().filter(|e| u64::from_le_bytes(**e) & PRESENT != 0).count() as u64)
    }

    fn measure(&self) {
        let high = self.limit - self.limit / 16;
        let Ok(resident) = self.resident() else { return };
        let resident = if resident > high { self.give_back(high) } else { resident };
        let looks = high.saturating_sub(resident) / A_LOOK;
        // Far below the limit too, someone looks now and then.
        self.credit.store(looks.clamp(1, 256) as i64, Ordering::Relaxed);
    }

    /// Gives chunks back until the process is an eighth of the limit below `high`, or nothing is left.
    /// Returns its size.
    fn give_back(&self, high: u64) -> u64 {
        let low = high - self.limit / 8;
        let mut circle = self.circle();
        // Whoever had the circle before may have done it.
        let Ok(mut resident) = self.resident() else { return high };
        if resident <= high {
            return resident;
        }
        let chunks: usize = circle.kept.iter().map(|kept| kept.touched.len()).sum();
        let Circle { kept, hand } = &mut *circle;
        for _ in 0..chunks + kept.len() {
            let (number, chunk) = *hand;
            let Some(of) = kept.get_mut(number) else {
                *hand = (0, 0);
                continue;
            };
            let map = of.map.upgrade().filter(|_| chunk < of.touched.len());
            let Some(map) = map else {
                *hand = (number + 1, 0);
                continue;
            };
            *hand = (number, chunk + 1);
            let loaded = self.loaded_pages(&map, chunk);
            if loaded == Some(0) {
                continue;
            }
            let len = CHUNK.min(map.len() - chunk * CHUNK);
            if map.give_back(chunk * CHUNK, len).is_err() {
                continue;
            }
            of.touched[chunk] = true;
            of.given_back += 1;
            resident = match loaded {
                Some(pages) => resident.saturating_sub(pages * self.page),
                None => self.resident().unwrap_or(resident),
            };
            if resident <= low {
                return resident;
            }
        }
        if resident > self.limit {
            self.overruns.fetch_add(1, Ordering::Relaxed);
        }
        resident
    }
}

impl Residency for Keeper {
    #[inline]
    fn look(&self) {
        if self.credit.fetch_sub(1, Ordering::Relaxed) <= 1 {
            self.measure();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn mapped(chunks: usize) -> Arc<Map> {
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(&vec![7; chunks * CHUNK - 100]).unwrap();
        Arc::new(Map::of(&file).unwrap())
    }

    fn limit(bytes: u64) -> MemoryLimit {
        MemoryLimit { strict: false, ..MemoryLimit::new(bytes, "unused".into()) }
    }

    fn sum(map: &Map) -> u64 {
        map.iter().map(|&b| u64::from(b)).sum()
    }

    #[test]
    fn chunks_that_nobody_touched_are_never_loaded() {
        let map = mapped(8);
        let keeper = Keeper::new(&limit(1 << 40)).unwrap();
        keeper.keep(&map, true);
        assert_eq!(keeper.held().touched, 0);
        // Away from the ends of chunks: pages around are loaded too.
        assert_eq!((map[CHUNK / 2], map[5 * CHUNK + CHUNK / 2]), (7, 7));
        keeper.look_now();
        let held = keeper.held();
        assert_eq!((held.chunks, held.touched, held.loaded, held.given_back), (8, 2, 2, 0));
        assert_eq!(held.bytes, map.len() as u64);
    }

    #[test]
    fn above_the_limit_all_goes_and_comes_back_the_same() {
        let (map, other) = (mapped(5), mapped(3));
        // The process has more than this of its own.
        let keeper = Keeper::new(&limit(1 << 20)).unwrap();
        keeper.keep(&map, true);
        keeper.keep(&other, false);
        for turn in 1..=3 {
            assert_eq!(sum(&map), 7 * map.len() as u64);
            assert_eq!(sum(&other), 7 * other.len() as u64);
            keeper.look_now();
            let held = keeper.held();
            assert_eq!((held.chunks, held.touched), (5, 5), "only chunk files count");
            assert_eq!((held.loaded, held.given_back), (5 * turn, 5 * turn));
            assert!(held.overruns >= turn);
        }
    }

    #[test]
    fn what_is_given_back_is_no_longer_of_the_process() {
        let map = mapped(64);
        let keeper = Keeper::new(&limit(1 << 40)).unwrap();
        keeper.keep(&map, true);
        assert!(sum(&map) > 0);
        let loaded = |keeper: &Keeper| -> u64 {
            (0..64).filter_map(|chunk| keeper.loaded_pages(&map, chunk)).sum::<u64>() * keeper.page
        };
        assert!(loaded(&keeper) >= 127 << 20);
        let tight = Keeper::new(&limit(1 << 20)).unwrap();
        tight.keep(&map, true);
        tight.look();
        assert_eq!(loaded(&keeper), 0);
    }

    #[test]
    fn a_file_that_is_gone_leaves_the_circle() {
        let keeper = Keeper::new(&limit(1 << 20)).unwrap();
        keeper.keep(&mapped(2), false);
        let map = mapped(1);
        keeper.keep(&map, true);
        assert_eq!(map[9], 7);
        keeper.look_now();
        assert_eq!(keeper.held().given_back, 1);
        drop(map);
        keeper.look_now();
        let held = keeper.held();
        assert_eq!(
            (held.chunks, held.bytes),
            (1, CHUNK as u64 - 100),
            "what was held is still told"
        );
    }

    #[test]
    fn a_strict_limit_needs_room_for_chunks() {
        let strict = |bytes| Keeper::new(&MemoryLimit::new(bytes, "unused".into())).unwrap();
        assert!(strict(1 << 40).expect_room(0).is_ok());
        assert!(strict(1 << 40).expect_room(1 << 40).is_err());
        let error = strict(1 << 20).expect_room(0).unwrap_err();
        assert!(matches!(*error.cause, Cause::OutOfMemory { limit: 1_048_576, .. }), "{error}");
        assert!(Keeper::new(&limit(1 << 20)).unwrap().expect_room(0).is_ok());
    }
}
