//! Where the bake of a run goes, and what goes wrong there.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use super::disk::Disk;
use super::{Campaign, faults};
use crate::flaky_proxy::{Fault, Faults, FlakyProxy};
use crate::requirement;
use crate::servers::Server;

/// How long the client of a store waits for an answer, as the environment has it.
const TIMEOUT: &str = "1 second";

/// Where one bake goes.
pub(super) enum Place<'c> {
    Folder {
        dataset: PathBuf,
        /// Absent where no file system can be mounted.
        disk: Option<Disk>,
    },
    Server {
        server: &'c Server,
        proxy: FlakyProxy,
        prefix: String,
    },
}

impl<'c> Place<'c> {
    /// In `folder`, or on the campaign's server behind faults drawn from `seed`.
    pub fn of(campaign: &'c Campaign, folder: &Path, seed: u64) -> Self {
        let Some(server) = &campaign.server else {
            let mounted = folder.join("disk");
            std::fs::create_dir(&mounted).expect("a folder can be made");
            let disk = Disk::mount(&mounted);
            if disk.is_none() {
                requirement::skip("the fault `disk full`", "the right to mount a tmpfs");
            }
            return Self::Folder { dataset: mounted.join("dataset"), disk };
        };
        // Less often than on a bad day: a start alone takes a hundred requests, and there are many.
        let faults = Faults {
            seed,
            per_thousand: [25, 10, 20, 10, 20, 3],
            delay_max: Duration::from_millis(200),
            silence: Duration::from_secs(5),
        };
        let proxy = FlakyProxy::before(server.port(), faults);
        Self::Server { server, proxy, prefix: format!("chaos-{seed}") }
    }

    /// The location, for a command.
    pub fn out(&self) -> String {
        match self {
            Self::Folder { dataset, .. } => dataset.display().to_string(),
            Self::Server { server, prefix, .. } => server.url(prefix),
        }
    }

    /// Gives a command the way there.
    pub fn admit<'m>(&self, command: &'m mut Command) -> &'m mut Command {
        match self {
            Self::Folder { .. } => command,
            Self::Server { server, proxy, .. } => {
                server.admit_by(command, proxy.port());
                command.env("AWS_TIMEOUT", TIMEOUT).env("AZURE_TIMEOUT", TIMEOUT)
            }
        }
    }

    /// The disk that can be filled.
    pub const fn disk(&self) -> Option<&Disk> {
        match self {
            Self::Folder { disk, .. } => disk.as_ref(),
            Self::Server { .. } => None,
        }
    }

    /// Ends the faults.
    pub fn calm(&self) {
        match self {
            Self::Folder { disk, .. } => disk.iter().for_each(Disk::free),
            Self::Server { proxy, .. } => proxy.calm(),
        }
    }

    /// Faults met so far.
    pub fn met(&self) -> BTreeMap<String, u64> {
        let Self::Server { proxy, .. } = self else { return BTreeMap::new() };
        let met = Fault::ALL.map(|fault| (faults::name_at_store(fault), proxy.met(fault)));
        met.into_iter().filter(|(_, times)| *times > 0).collect()
    }

    /// A folder with what is there.
    pub fn fetch(&self) -> PathBuf {
        match self {
            Self::Folder { dataset, .. } => dataset.clone(),
            Self::Server { server, prefix, .. } => server.fetch(prefix),
        }
    }
}
