//! The state of a bake in the store: the protocol between coordinators and workers.
//!
//! Nothing that matters is held in memory alone, and nothing is changed once it is written: every
//! object below is created only if absent. So there is no moment at which a crash leaves a mess.
//!
//! Invariants, besides those of `sightline_jobs` (JB, SC); the simulation in `tests` checks them behind
//! every step of its clock:
//! - CL-1: no object of a bake is replaced or deleted, but for the pointer and the probe's scratch.
//! - CL-2: epochs have no gaps, and one owner each.
//! - CL-3: a commit is created after the parts that it names, and they hold the bytes it says.
//! - CL-4: messages decide nothing. A lost, repeated, late or forged one costs time at most: a task is
//!   done when its commit exists, and a coordinator is replaced when a newer epoch exists.
//! - CL-5: a write whose answer was lost is settled by reading it back; bytes that are there count as
//!   written, whoever is told that they were there before.
//!
//! | object | written by | meaning |
//! | --- | --- | --- |
//! | `bake/<bake>/plan.bin` | the first coordinator | what the numbers of tasks mean |
//! | `bake/<bake>/epochs/<n>` | coordinator n | coordinators below n are replaced |
//! | `bake/<bake>/parts/...` | any attempt, under its own name | the output of an attempt |
//! | `bake/<bake>/commits/<task>` | the first attempt that ends | the task is done (JB-1) |
//!
//! A coordinator starts with these steps. Killed behind any of them, the next one starts over:
//! 1. *Plan.* Create the plan. When one is there it has to be the same, but for where the scene
//!    lies: the bake id is a hash of what the plan is made from.
//! 2. *Epoch.* Create the epoch after the highest there is; the loser of a race takes the next.
//!    A crash leaves a number that nobody uses.
//! 3. *Commits.* List the commits: these tasks are done. A commit created after the listing is
//!    found when its worker reports it, or when another attempt cannot create it.
//!
//! Then it leases tasks. Leases are only in memory: a new coordinator leases a task again that an
//! old worker still solves. That costs time and nothing else, since both attempts write the same
//! bytes (VI-3) and one commit wins.
//!
//! A worker's attempt:
//! 1. *Parts.* Write the parts under the attempt's own name. A crash leaves parts that no commit
//!    names; nobody reads them.
//! 2. *Commit.* Create the commit, which names the parts with their hashes. A crash behind it
//!    leaves a task that is done and not reported: the coordinator looks for the commit when the
//!    lease ends.
//! 3. *Report.* Tell the coordinator. It believes the commit object, not the message.
//!
//! An attempt whose commit was created by another changes and deletes nothing, and reports the
//! task as committed: it is.
//!
//! What can go wrong, and what it costs:
//!
//! | what | what happens | cost |
//! | --- | --- | --- |
//! | a worker dies | its lease runs out, the task is leased again | the attempt |
//! | a worker is asked to stop | it ends the task at hand within its drain time, or gives the lease back | at most the attempt |
//! | a worker stops for ten minutes and wakes | its lease is lost; should it still commit, the commit is there or is the first: the same bytes (CL-3) | nothing |
//! | a replaced coordinator sees all tasks through before it hears of it | the newer one, alone, lists the commits every half minute, and publishes the same dataset | nothing |
//! | a worker is slow | an idle one gets a second attempt (SC-1); one commit wins, the other is told at its next heartbeat | an attempt |
//! | a worker fails everything | its tasks go elsewhere, it pauses longer and longer | little |
//! | the coordinator dies | workers look for it with growing pauses; the next one lists commits and goes on | what was not committed |
//! | the coordinator stops for a while | another takes the next epoch; the old one finds it in the store and ends. Until then both lease tasks, which is safe | double work |
//! | the network parts them | calls fail, connections end by their keepalive, workers register again | time |
//! | the store does not answer | attempts are retried later, with growing pauses that differ by task; the coordinator waits it out | time |
//! | the store answers too late | the write is read back (CL-5), or arrives after all and finds the object there | nothing |
//! | the store breaks create-if-absent | the probe at the start finds out, and the bake is refused | the bake |
//! | a task cannot succeed | it is quarantined with its reason, the rest of the bake goes on, nothing is published (JB-2) | the dataset |
//!
//! When all tasks are committed the coordinator writes the dataset. Its files are named by content
//! and the manifest is found again (see `sightline_store::publish`), so a crash leaves files that
//! the next coordinator uses. A coordinator that was replaced without noticing publishes the same
//! bytes. Readers see the old dataset or the whole new one (JB-2).

use prost::Message;
use sightline_jobs::{Plan, SceneRef, TaskId};
use sightline_proto::{decode_plan, encode_plan, v1};
use sightline_store::{BakeStore, Created, keys};

use crate::CoordinatorError;

/// The state of one bake in a store.
#[derive(Clone, Debug)]
pub struct Journal {
    store: BakeStore,
    bake_id: String,
}

impl Journal {
    /// The state of the bake `bake_id`.
    #[must_use]
    pub fn new(store: BakeStore, bake_id: &str) -> Self {
        Self { store, bake_id: bake_id.to_owned() }
    }

    /// The store.
    #[must_use]
    pub const fn store(&self) -> &BakeStore {
        &self.store
    }

    /// Folder of the bake's state, with the store's location, for messages.
    #[must_use]
    pub fn folder(&self) -> String {
        format!("{}/{}/{}", self.store.location(), keys::BAKE_FOLDER, self.bake_id)
    }

    /// Step 1 of a start: writes the plan, or checks that the one there is the same.
    ///
    /// # Errors
    /// [`CoordinatorError::PlanDiffers`], or what the store reports.
    pub async fn write_plan(&self, plan: &Plan) -> Result<(), CoordinatorError> {
        let key = keys::plan(&self.bake_id);
        if self.store.create(&key, encode_plan(plan)).await? == Created::ByUs {
            return Ok(());
        }
        let found = decode_plan(&self.store.get(&key).await?)
            .map_err(|error| self.damaged(&key, &error))?;
        // Where the scene lies does not matter.
        let found = Plan {
            scene: SceneRef {
                uri: plan.scene.uri.clone(),
                name: plan.scene.name.clone(),
                ..found.scene
            },
            ..found
        };
        if found == *plan {
            return Ok(());
        }
        Err(CoordinatorError::PlanDiffers {
            location: self.store.location().to_owned(),
            bake_id: self.bake_id.clone(),
            folder: self.folder(),
        })
    }

    /// Step 2 of a start: takes the next epoch. `coordinator` tells racing coordinators apart.
    ///
    /// # Errors
    /// What the store reports.
    pub async fn claim_epoch(&self, coordinator: &str) -> Result<u64, CoordinatorError> {
        let mut number = self.newest_epoch().await? + 1;
        loop {
            let epoch = v1::Epoch { number, coordinator: coordinator.to_owned() };
            let key = keys::epoch(&self.bake_id, number);
            match self.store.create(&key, epoch.encode_to_vec()).await? {
                Created::ByUs => return Ok(number),
                Created::AlreadyThere => number += 1,
            }
        }
    }

    /// The highest epoch; 0 when there is none.
    ///
    /// # Errors
    /// What the store reports.
    pub async fn newest_epoch(&self) -> Result<u64, CoordinatorError> {
        let listed = self.store.list(&keys::epochs(&self.bake_id)).await?;
        let number = |key: &String| key.rsplit('/').next()?.parse::<u64>().ok();
        Ok(listed.iter().filter_map(number).max().unwrap_or(0))
    }

    /// Step 3 of a start: the tasks that are done.
    ///
    /// # Errors
    /// What the store reports.
    pub async fn committed_tasks(&self) -> Result<Vec<TaskId>, CoordinatorError> {
        let listed = self.store.list(&keys::commits(&self.bake_id)).await?;
        Ok(listed.iter().filter_map(|key| keys::commit_task(key)).map(TaskId).collect())
    }

    /// The commit of a task, when it exists.
    ///
    /// # Errors
    /// [`CoordinatorError::DamagedState`] when it is not one, or what the store reports.
    pub async fn commit(&self, task: TaskId) -> Result<Option<v1::Commit>, CoordinatorError> {
        let key = keys::commit(&self.bake_id, task.0);
        let Some(bytes) = self.store.get_if_exists(&key).await? else { return Ok(None) };
        let commit = v1::Commit::decode(bytes).map_err(|error| self.damaged(&key, &error))?;
        if commit.task != task.0 {
            return Err(self.damaged(&key, &format!("it belongs to task {}", commit.task)));
        }
        Ok(Some(commit))
    }

    /// The bytes of a committed part, checked against the commit.
    ///
    /// # Errors
    /// [`CoordinatorError::DamagedState`] when they are not the bytes that were committed, or
    /// what the store reports.
    pub async fn part(&self, part: &v1::CommittedPart) -> Result<Vec<u8>, CoordinatorError> {
        let Some(bytes) = self.store.get_if_exists(&part.key).await? else {
            return Err(self.damaged(&part.key, &"it is missing"));
        };
        if bytes.len() as u64 != part.bytes || blake3::hash(&bytes).to_hex().as_str() != part.digest
        {
            return Err(self.damaged(&part.key, &"it does not hold the bytes that were committed"));
        }
        Ok(bytes.into())
    }

    pub(crate) fn damaged(&self, key: &str, problem: &impl std::fmt::Display) -> CoordinatorError {
        CoordinatorError::DamagedState {
            key: key.to_owned(),
            problem: problem.to_string(),
            folder: self.folder(),
        }
    }
}
