//! How workers find a bake that runs on a machine nobody knows beforehand, as on a render farm: a
//! file on storage that all machines share.
//!
//! `bake --listen ADDRESS --announce FILE` writes the URL of its coordinator into the file, and
//! [`OVER`] when the dataset is published. `worker --coordinator @FILE` waits for the file and
//! works for the URL in it, or ends at once when the bake is over. Such workers help: a bake that
//! nobody joins does all of its tasks itself, and a worker that finds no bake has nothing to do.
//! Neither is a failure.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::write_whole;
use crate::failure::{Failure, Kind, Result};
use crate::progress::note;

/// What the file holds when the bake is over.
const OVER: &str = "over";
/// How long a worker waits for a bake to announce itself.
const FIND_TIME: Duration = Duration::from_secs(600);
/// How often it looks.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// Where others may join a bake, and where they read of it.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Joining {
    /// Let workers of other machines join the bake at this address. Without it, none can.
    #[arg(long, value_name = "HOST:PORT")]
    pub listen: Option<SocketAddr>,
    /// Write the address into this file, for `sightline worker --coordinator @FILE`.
    #[arg(long, value_name = "FILE", requires = "listen")]
    pub announce: Option<PathBuf>,
}

impl Joining {
    /// The address to listen on: a port of loopback when nobody is to join.
    pub fn address(&self) -> SocketAddr {
        self.listen.unwrap_or_else(|| SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
    }

    /// Tells where the bake is.
    pub fn announce(&self, listening: SocketAddr) -> Result<()> {
        self.write(&format!("http://{}", reachable(listening)))
    }

    /// Tells that the bake is over.
    pub fn over(&self) -> Result<()> {
        self.write(OVER)
    }

    fn write(&self, line: &str) -> Result<()> {
        let Some(path) = &self.announce else { return Ok(()) };
        let failed = |e| Failure::io(Kind::Store, "write", path, &e);
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(failed)?;
        }
        write_whole(path, |partial| std::fs::write(partial, format!("{line}\n")).map_err(failed))
    }
}

/// The address of this machine as others see it.
fn reachable(listening: SocketAddr) -> String {
    if !listening.ip().is_unspecified() {
        return listening.to_string();
    }
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    match name.trim() {
        "" => SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), listening.port()).to_string(),
        name => format!("{name}:{}", listening.port()),
    }
}

/// The URL of `--coordinator`, read from a file where it is `@FILE`. `None` when there is nothing
/// to work for.
pub async fn find(coordinator: &str) -> Result<Option<String>> {
    let Some(file) = coordinator.strip_prefix('@') else { return Ok(Some(coordinator.to_owned())) };
    let (file, start) = (Path::new(file), Instant::now());
    loop {
        match std::fs::read_to_string(file) {
            Ok(text) if text.trim() == OVER => {
                note("the bake is over");
                return Ok(None);
            }
            Ok(text) => return Ok(Some(text.trim().to_owned())),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
            Err(error) => return Err(Failure::io(Kind::Input, "read", file, &error)),
        }
        if start.elapsed() > FIND_TIME {
            note(&format!("no bake has announced itself in {}: nothing to do", file.display()));
            return Ok(None);
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

/// True when `--coordinator` is a file that says that the bake is over.
pub fn is_over(coordinator: &str) -> bool {
    let text = coordinator.strip_prefix('@').map(std::fs::read_to_string);
    matches!(text, Some(Ok(text)) if text.trim() == OVER)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_worker_finds_what_a_bake_announces() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("bake/address");
        let joining = Joining { listen: None, announce: Some(file.clone()) };
        let at = format!("@{}", file.display());
        joining.announce(SocketAddr::from(([127, 0, 0, 1], 7070))).unwrap();
        assert_eq!(find(&at).await.unwrap().as_deref(), Some("http://127.0.0.1:7070"));
        assert!(!is_over(&at));
        joining.over().unwrap();
        assert!(is_over(&at) && !is_over("http://a:1"));
        assert_eq!(find(&at).await.unwrap(), None);
        assert_eq!(find("http://a:1").await.unwrap().as_deref(), Some("http://a:1"));
    }

    #[test]
    fn an_address_of_all_interfaces_is_announced_by_the_name_of_the_machine() {
        let named = reachable(SocketAddr::from(([0, 0, 0, 0], 7070)));
        assert!(named.ends_with(":7070") && !named.starts_with("0.0.0.0"), "{named}");
    }
}
