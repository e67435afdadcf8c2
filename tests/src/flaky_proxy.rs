//! A proxy in front of an HTTP server that does to a share of the requests what networks and busy
//! servers do: delays, cuts, answers 500 or says nothing, before or after the server has done its work.
//!
//! Which request meets which fault follows from a seed and the number of the request in the order of
//! arrival. A fault that comes after the server's work is the one that matters for commits: the object is
//! there, and the writer does not know.
//!
//! One request a connection: answers say so, and the client makes a new one.

use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

use crate::tcp_proxy::listen;

/// Largest head of a request, bytes.
const HEAD_BYTES_MAX: usize = 64 << 10;

/// The answer of a server that has failed.
const FAILED: &[u8] =
    b"HTTP/1.1 500 Internal Server Error\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";

/// What happens to a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// It takes its time.
    Delay,
    /// The connection is cut; the server never sees the request.
    CutBefore,
    /// The server does its work; the connection is cut before its answer.
    CutAfter,
    /// The answer is 500; the server never sees the request.
    ErrorBefore,
    /// The server does its work; the answer is 500.
    ErrorAfter,
    /// The server does its work; no answer comes until the client gives up.
    SilenceAfter,
}

impl Fault {
    /// All faults, in the order in which their shares are given.
    pub const ALL: [Self; 6] = [
        Self::Delay,
        Self::CutBefore,
        Self::CutAfter,
        Self::ErrorBefore,
        Self::ErrorAfter,
        Self::SilenceAfter,
    ];
}

/// How often what goes wrong.
#[derive(Clone, Copy, Debug)]
pub struct Faults {
    /// Decides which requests.
    pub seed: u64,
    /// Share of the requests that meet each of [`Fault::ALL`], per thousand.
    pub per_thousand: [u16; 6],
    /// Longest delay.
    pub delay_max: Duration,
    /// How long a silence lasts; longer than the client waits.
    pub silence: Duration,
}

impl Faults {
    /// A bad day: every sixth request meets one fault or another.
    #[must_use]
    pub const fn bad_day(seed: u64) -> Self {
        Self {
            seed,
            per_thousand: [50, 25, 30, 25, 30, 6],
            delay_max: Duration::from_millis(200),
            silence: Duration::from_secs(60),
        }
    }

    /// What happens to the request with this number, and a number to choose a delay by.
    #[must_use]
    pub fn of(&self, request: u64) -> (Option<Fault>, u64) {
        let chance = mixed(self.seed ^ mixed(request));
        let mut left = chance % 1000;
        for (fault, share) in Fault::ALL.into_iter().zip(self.per_thousand.map(u64::from)) {
            if left < share {
                return (Some(fault), chance / 1000);
            }
            left -= share;
        }
        (None, chance / 1000)
    }
}

/// Steele, Lea and Flood, "Fast splittable pseudorandom number generators": the finalizer of SplitMix64.
const fn mixed(mut z: u64) -> u64 {
    z = z.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// What all connections share.
struct Shared {
    server: u16,
    faults: Faults,
    requests: AtomicU64,
    met: [AtomicU64; 6],
    is_calm: AtomicBool,
}

/// A running proxy; it ends when dropped.
pub struct FlakyProxy {
    runtime: Option<tokio::runtime::Runtime>,
    port: u16,
    shared: Arc<Shared>,
}

impl FlakyProxy {
    /// A proxy on a free port of loopback in front of the server on the port `server`.
    ///
    /// # Panics
    /// When it cannot listen.
    #[must_use]
    pub fn before(server: u16, faults: Faults) -> Self {
        let (runtime, listener, port) = listen();
        let (requests, met, is_calm) = Default::default();
        let shared = Arc::new(Shared { server, faults, requests, met, is_calm });
        runtime.spawn(accept(listener, Arc::clone(&shared)));
        Self { runtime: Some(runtime), port, shared }
    }

    /// Where it listens.
    #[must_use]
    pub const fn port(&self) -> u16 {
        self.port
    }

    /// Ends the faults: requests from now on pass.
    pub fn calm(&self) {
        self.shared.is_calm.store(true, Ordering::Relaxed);
    }

    /// Requests so far.
    #[must_use]
    pub fn requests(&self) -> u64 {
        self.shared.requests.load(Ordering::Relaxed)
    }

    /// How many requests met a fault so far.
    #[must_use]
    pub fn met(&self, fault: Fault) -> u64 {
        self.shared.met[fault as usize].load(Ordering::Relaxed)
    }
}

impl Drop for FlakyProxy {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

async fn accept(listener: TcpListener, shared: Arc<Shared>) {
    while let Ok((client, _)) = listener.accept().await {
        let shared = Arc::clone(&shared);
        tokio::spawn(async move {
            // A connection that breaks by itself is what the client has to bear anyway.
            let _ = pass_on(client, &shared).await;
        });
    }
}

/// One request and its answer, or what becomes of them.
async fn pass_on(mut client: TcpStream, shared: &Shared) -> std::io::Result<()> {
    let Some(request) = read_request(&mut client).await? else { return Ok(()) };
    let number = shared.requests.fetch_add(1, Ordering::Relaxed);
    let (fault, chance) = shared.faults.of(number);
    let fault = fault.filter(|_| !shared.is_calm.load(Ordering::Relaxed));
    if let Some(fault) = fault {
        shared.met[fault as usize].fetch_add(1, Ordering::Relaxed);
    }
    match fault {
        Some(Fault::CutBefore) => return Ok(()),
        Some(Fault::ErrorBefore) => return client.write_all(FAILED).await,
        Some(Fault::Delay) => {
            let longest = shared.faults.delay_max.as_millis().max(1) as u64;
            tokio::time::sleep(Duration::from_millis(chance % longest)).await;
        }
        _ => {}
    }
    let mut server = TcpStream::connect((Ipv4Addr::LOCALHOST, shared.server)).await?;
    server.write_all(&request).await?;
    let mut answer = Vec::new();
    server.read_to_end(&mut answer).await?;
    match fault {
        Some(Fault::CutAfter) => Ok(()),
        Some(Fault::ErrorAfter) => client.write_all(FAILED).await,
        Some(Fault::SilenceAfter) => {
            tokio::time::sleep(shared.faults.silence).await;
            Ok(())
        }
        _ => client.write_all(&answer).await,
    }
}

/// A whole request that asks the server to close the connection; `None` when the client has gone.
async fn read_request(client: &mut TcpStream) -> std::io::Result<Option<Vec<u8>>> {
    let mut bytes = Vec::new();
    let end = loop {
        if let Some(at) = bytes.windows(4).position(|four| four == b"\r\n\r\n") {
            break at;
        }
        if bytes.len() > HEAD_BYTES_MAX || client.read_buf(&mut bytes).await? == 0 {
            return Ok(None);
        }
    };
    let head = String::from_utf8_lossy(&bytes[..end]).into_owned();
    let value = |name: &str| {
        head.lines().skip(1).find_map(|line| {
            let (found, value) = line.split_once(':')?;
            found.trim().eq_ignore_ascii_case(name).then(|| value.trim().to_owned())
        })
    };
    let length = value("content-length").and_then(|text| text.parse::<usize>().ok()).unwrap_or(0);
    if value("expect").is_some() {
        client.write_all(b"HTTP/1.1 100 Continue\r\n\r\n").await?;
    }
    while bytes.len() < end + 4 + length {
        if client.read_buf(&mut bytes).await? == 0 {
            return Ok(None);
        }
    }
    let kept = head.lines().filter(|line| {
        let name = line.split(':').next().unwrap_or_default().trim().to_ascii_lowercase();
        name != "connection" && name != "expect"
    });
    let mut request = kept.collect::<Vec<_>>().join("\r\n").into_bytes();
    request.extend_from_slice(b"\r\nConnection: close\r\n\r\n");
    request.extend_from_slice(&bytes[end + 4..]);
    Ok(Some(request))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_follow_from_the_seed_in_their_shares() {
        let faults = Faults::bad_day(7);
        let count = |faults: &Faults, fault| {
            (0..10_000).filter(|n| faults.of(*n).0 == Some(fault)).count() as f64
        };
        for (fault, share) in Fault::ALL.into_iter().zip(faults.per_thousand) {
            let (met, expected) = (count(&faults, fault), f64::from(share) * 10.0);
            assert!((met - expected).abs() < 5.0 * expected.sqrt(), "{fault:?} met {met} times");
        }
        let all = |faults: &Faults| (0..100).map(|n| faults.of(n)).collect::<Vec<_>>();
        assert_eq!(all(&faults), all(&Faults::bad_day(7)));
        assert_ne!(all(&faults), all(&Faults::bad_day(8)));
    }
}
