//! The start-up probe: does this store create if absent, and once only?
//!
//! Two ways in which stores fail: some ignore the condition, and then everyone wins; some look first
//! and write later, and then those win who look before the first has written. The second kind is found
//! by racing: all racers start at once, with bodies large enough that none is whole before all have
//! been looked at, and again and again, since a race can go well by chance.

use std::hash::{BuildHasher, RandomState};

use super::{BakeStore, Created};
use crate::{Result, StoreError, keys};

/// Writers that race for an object.
const RACERS: usize = 12;
/// Races. A server that looks first and writes later lets several win in nearly every one.
const RACES: usize = 4;
/// Size of a racer's object, bytes: several packets, so that writing takes longer than looking.
const BODY_BYTES: usize = 64 << 10;

impl BakeStore {
    /// Verifies that creating if absent has exactly one winner, and that the winner's bytes can be
    /// read and listed. Leaves nothing behind.
    ///
    /// # Errors
    /// [`StoreError::UnsafeStore`] when the store breaks a promise, or what the store reports.
    pub async fn probe(&self) -> Result<()> {
        // Ids come through seams; this one names scratch that is deleted below and decides nothing.
        let scratch = RandomState::new().hash_one(std::process::id());
        for race in 0..RACES {
            let key = format!("{}/{scratch:016x}-{race}", keys::PROBE_FOLDER);
            let outcome = self.race(&key).await;
            let cleaned = self.delete(&key).await;
            outcome.and(cleaned)?;
        }
        Ok(())
    }

    async fn race(&self, key: &str) -> Result<()> {
        let racers = (0..RACERS).map(|racer| {
            let (store, key) = (self.clone(), key.to_owned());
            tokio::spawn(async move { store.create(&key, body(racer)).await })
        });
        let mut winners = Vec::new();
        for (racer, result) in futures::future::join_all(racers).await.into_iter().enumerate() {
            let created = result.map_err(|source| StoreError::Unavailable {
                key: key.to_owned(),
                source: Box::new(source),
            })??;
            if created == Created::ByUs {
                winners.push(racer);
            }
        }
        let [winner] = winners[..] else {
            let count = winners.len();
            return Err(self.broken(format!(
                "{RACERS} writers created one object at the same time, and {count} were told that \
                 they were first; exactly one must be"
            )));
        };
        if self.create(key, body(RACERS)).await? != Created::AlreadyThere {
            return Err(self.broken("an object that exists can be created again".into()));
        }
        if self.get(key).await? != body(winner) {
            return Err(
                self.broken("an object does not hold the bytes of the writer that won".into())
            );
        }
        if !self.list(keys::PROBE_FOLDER).await?.iter().any(|k| k == key) {
            return Err(self.broken("an object that was created is not listed".into()));
        }
        Ok(())
    }

    fn broken(&self, problem: String) -> StoreError {
        StoreError::UnsafeStore { location: self.location().to_owned(), problem }
    }
}

/// Bytes that tell racers apart.
fn body(racer: usize) -> Vec<u8> {
    let name = format!("racer {racer}\n");
    name.bytes().cycle().take(BODY_BYTES).collect()
}
