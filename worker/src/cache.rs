//! Parts that were read or written lately, by their digest.
//!
//! Neighbouring cells tasks read the same segment parts. Keeping bytes by digest cannot change a
//! result: whoever wrote them, equal digests are equal bytes.

use std::collections::{HashMap, VecDeque};

use bytes::Bytes;

/// Bytes that are kept at most.
const CACHE_BYTES_MAX: usize = 256 << 20;

/// The parts, oldest first out.
#[derive(Default)]
pub(crate) struct PartCache {
    parts: HashMap<String, Bytes>,
    order: VecDeque<String>,
    bytes: usize,
}

impl PartCache {
    pub fn get(&self, digest: &str) -> Option<Bytes> {
        self.parts.get(digest).cloned()
    }

    pub fn put(&mut self, digest: &str, part: Bytes) {
        if part.len() > CACHE_BYTES_MAX || self.parts.contains_key(digest) {
            return;
        }
        self.bytes += part.len();
        self.parts.insert(digest.to_owned(), part);
        self.order.push_back(digest.to_owned());
        while self.bytes > CACHE_BYTES_MAX {
            let Some(oldest) = self.order.pop_front() else { return };
            self.bytes -= self.parts.remove(&oldest).map_or(0, |part| part.len());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_part_makes_room() {
        let mut cache = PartCache::default();
        let part = Bytes::from(vec![0; CACHE_BYTES_MAX / 2]);
        for digest in ["a", "b", "b", "c"] {
            cache.put(digest, part.clone());
        }
        assert!(cache.get("a").is_none() && cache.get("b").is_some() && cache.get("c").is_some());
        cache.put("too large", Bytes::from(vec![0; CACHE_BYTES_MAX + 1]));
        assert!(cache.get("too large").is_none() && cache.get("c").is_some());
    }
}
