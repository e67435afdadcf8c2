//! Connections: how many there are, and how long one may take to say something useful.
//!
//! ```text
//!   accepted --> handshake (TLS) --> preface (HTTP/2) --> serving, on trial --> admitted
//!      |              |                    |                     |
//!      +--------------+--------------------+---------------------+--> refused, logged
//! ```
//!
//! A connection is *on trial* until a request of its passes [`crate::security`]. Invariants:
//! - CN-1: there are at most `connections_max` connections, and at most `trials_max` of them on
//!   trial, at most `trials_per_address_max` from one address. Those above are closed at once.
//! - CN-2: a trial ends after `trial_time`: by admission, or with the connection. So neither
//!   half-open connections nor strangers who stay keep others out for long.
//! - CN-3: what is not HTTP/2 is refused at its first wrong byte.
//!
//! Who is admitted is watched by pings of HTTP/2, which the server sends: dead connections end.

use std::collections::BTreeMap;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use futures::{Stream, StreamExt};
use sightline_proto::access::Roles;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, ReadBuf};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{Instant, Sleep};
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::server::TlsStream;
use tonic::transport::server::Connected;

use crate::security::Gate;

/// What every HTTP/2 connection starts with: RFC 9113, section 3.4.
const PREFACE: &[u8; 24] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// Pause when the system cannot accept, such as without file descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Limits on connections.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// Connections in all. A worker has one.
    pub connections_max: usize,
    /// Connections on trial in all.
    pub trials_max: usize,
    /// Connections on trial from one address.
    pub trials_per_address_max: usize,
    /// How long a trial takes.
    pub trial_time: Duration,
}

impl Default for ConnectionLimits {
    fn default() -> Self {
        Self {
            connections_max: 4096,
            trials_max: 1024,
            trials_per_address_max: 256,
            trial_time: Duration::from_secs(10),
        }
    }
}

/// What a client certificate says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Certificate {
    pub roles: Roles,
    /// Hash of the certificate: who it is, from one connection to the next.
    pub fingerprint: blake3::Hash,
}

impl Certificate {
    fn new(der: &CertificateDer<'_>) -> Self {
        let roles = webpki::EndEntityCert::try_from(der)
            .map_or_else(|_| Roles::default(), |cert| Roles::of_uris(cert.valid_uri_names()));
        Self { roles, fingerprint: blake3::hash(der) }
    }
}

/// Who is at the other end; an extension of every request.
#[derive(Clone, Debug)]
pub(crate) struct Peer {
    pub address: SocketAddr,
    pub certificate: Option<Certificate>,
    trial: Arc<Trial>,
}

impl Peer {
    /// The trial is passed.
    pub fn admit(&self) {
        if !self.trial.is_over.swap(true, Ordering::AcqRel) {
            // A free place for the next.
            drop(self.trial.place().take());
        }
    }
}

#[derive(Debug)]
struct Trial {
    is_over: AtomicBool,
    place: Mutex<Option<Place>>,
}

impl Trial {
    fn place(&self) -> MutexGuard<'_, Option<Place>> {
        self.place.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Connections that there are.
#[derive(Debug, Default)]
struct Counts {
    connections: usize,
    trials: usize,
    trials_by_address: BTreeMap<IpAddr, usize>,
}

/// Counts connections; its clones count together.
#[derive(Clone, Debug, Default)]
struct Census(Arc<Mutex<Counts>>);

impl Census {
    fn counts(&self) -> MutexGuard<'_, Counts> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// CN-1.
    fn enter(
        &self,
        address: IpAddr,
        limits: &ConnectionLimits,
    ) -> Result<(Counted, Place), &'static str> {
        let mut counts = self.counts();
        let by_address = counts.trials_by_address.get(&address).copied().unwrap_or(0);
        if counts.connections >= limits.connections_max {
            return Err("there are too many connections");
        }
        if counts.trials >= limits.trials_max {
            return Err("there are too many new connections");
        }
        if by_address >= limits.trials_per_address_max {
            return Err("there are too many new connections from this address");
        }
        counts.connections += 1;
        counts.trials += 1;
        *counts.trials_by_address.entry(address).or_default() += 1;
        drop(counts);
        Ok((Counted(self.clone()), Place { census: self.clone(), address }))
    }
}

/// One connection of the census.
#[derive(Debug)]
struct Counted(Census);

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.counts().connections -= 1;
    }
}

/// One connection on trial.
#[derive(Debug)]
struct Place {
    census: Census,
    address: IpAddr,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut counts = self.census.counts();
        counts.trials -= 1;
        if let Some(count) = counts.trials_by_address.get_mut(&self.address) {
            *count -= 1;
            if *count == 0 {
                counts.trials_by_address.remove(&self.address);
            }
        }
    }
}

enum Transport<IO> {
    Plain(IO),
    Tls(Box<TlsStream<IO>>),
}

/// A connection that has sent the preface of HTTP/2.
pub(crate) struct Connection<IO> {
    transport: Transport<IO>,
    /// Bytes of the preface that the server has not read again.
    preface: &'static [u8],
    peer: Peer,
    /// CN-2; `None` once it is admitted.
    trial_end: Option<Pin<Box<Sleep>>>,
    gate: Arc<Gate>,
    _counted: Counted,
}

impl<IO> Connected for Connection<IO> {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        self.peer.clone()
    }
}

impl<IO: AsyncRead + AsyncWrite + Unpin> AsyncRead for Connection<IO> {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        if this.peer.trial.is_over.load(Ordering::Acquire) {
            this.trial_end = None;
        }
        if let Some(end) = &mut this.trial_end
            && end.as_mut().poll(context).is_ready()
        {
            this.gate.refused(Some(this.peer.address), "a connection", "nobody was let in on it");
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        if !this.preface.is_empty() {
            let (now, later) = this.preface.split_at(this.preface.len().min(buffer.remaining()));
            buffer.put_slice(now);
            this.preface = later;
            return Poll::Ready(Ok(()));
        }
        match &mut this.transport {
            Transport::Plain(io) => Pin::new(io).poll_read(context, buffer),
            Transport::Tls(io) => Pin::new(io).poll_read(context, buffer),
        }
    }
}

impl<IO: AsyncRead + AsyncWrite + Unpin> AsyncWrite for Connection<IO> {
    fn poll_write(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        match &mut self.get_mut().transport {
            Transport::Plain(io) => Pin::new(io).poll_write(context, bytes),
            Transport::Tls(io) => Pin::new(io).poll_write(context, bytes),
        }
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.get_mut().transport {
            Transport::Plain(io) => Pin::new(io).poll_flush(context),
            Transport::Tls(io) => Pin::new(io).poll_flush(context),
        }
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.get_mut().transport {
            Transport::Plain(io) => Pin::new(io).poll_shutdown(context),
            Transport::Tls(io) => Pin::new(io).poll_shutdown(context),
        }
    }
}

/// The connections of `accepted` that pass, as a server takes them. Dropping the stream closes
/// `accepted` and what has not passed yet.
pub(crate) fn connections<IO>(
    accepted: impl Stream<Item = io::Result<(IO, SocketAddr)>> + Send + 'static,
    gate: Arc<Gate>,
) -> impl Stream<Item = io::Result<Connection<IO>>> + Send
where
    IO: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let (passed, connections) = mpsc::channel(16);
    tokio::spawn(accept(accepted, gate, passed));
    tokio_stream::wrappers::ReceiverStream::new(connections).map(Ok)
}

async fn accept<IO>(
    accepted: impl Stream<Item = io::Result<(IO, SocketAddr)>> + Send + 'static,
    gate: Arc<Gate>,
    passed: mpsc::Sender<Connection<IO>>,
) where
    IO: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let census = Census::default();
    let mut trials = JoinSet::new();
    let mut accepted = Box::pin(accepted);
    loop {
        let next = tokio::select! {
            next = accepted.next() => next,
            Some(_) = trials.join_next() => continue,
            () = passed.closed() => None,
        };
        match next {
            None => return,
            Some(Err(error)) => {
                gate.refused(None, "a connection", &error.to_string());
                tokio::time::sleep(ACCEPT_PAUSE).await;
            }
            Some(Ok((io, address))) => match census.enter(address.ip(), &gate.limits) {
                Err(why) => gate.refused(Some(address), "a connection", why),
                Ok((counted, place)) => {
                    let (gate, passed) = (Arc::clone(&gate), passed.clone());
                    trials.spawn(async move {
                        if let Some(connection) = begin(io, address, gate, counted, place).await {
                            // The server may be gone.
                            let _ = passed.send(connection).await;
                        }
                    });
                }
            },
        }
    }
}

/// Handshake and preface, within the time of a trial.
async fn begin<IO: AsyncRead + AsyncWrite + Unpin>(
    io: IO,
    address: SocketAddr,
    gate: Arc<Gate>,
    counted: Counted,
    place: Place,
) -> Option<Connection<IO>> {
    let end = Instant::now() + gate.limits.trial_time;
    let opened = async {
        let (mut transport, certificate) = match gate.tls() {
            None => (Transport::Plain(io), None),
            Some(acceptor) => {
                let stream = acceptor.accept(io).await.map_err(|e| format!("no TLS: {e}"))?;
                let certificates = stream.get_ref().1.peer_certificates();
                let certificate = certificates.and_then(|c| c.first()).map(Certificate::new);
                (Transport::Tls(Box::new(stream)), certificate)
            }
        };
        match &mut transport {
            Transport::Plain(io) => read_preface(io).await?,
            Transport::Tls(io) => read_preface(io).await?,
        }
        Ok::<_, String>((transport, certificate))
    };
    let opened = tokio::time::timeout_at(end, opened).await;
    match opened.unwrap_or_else(|_| Err("it took too long to say something".into())) {
        Err(why) => {
            gate.refused(Some(address), "a connection", &why);
            None
        }
        Ok((transport, certificate)) => {
            let trial =
                Arc::new(Trial { is_over: AtomicBool::new(false), place: Mutex::new(Some(place)) });
            let trial_end = Some(Box::pin(tokio::time::sleep_until(end)));
            let peer = Peer { address, certificate, trial };
            let preface = &PREFACE[..];
            Some(Connection { transport, preface, peer, trial_end, gate, _counted: counted })
        }
    }
}

/// CN-3.
async fn read_preface(io: &mut (impl AsyncRead + Unpin)) -> Result<(), String> {
    let mut read = 0;
    let mut bytes = [0; PREFACE.len()];
    while read < bytes.len() {
        let more = io.read(&mut bytes[read..]).await.map_err(|error| error.to_string())?;
        if more == 0 {
            return Err("it was closed before it said anything useful".into());
        }
        read += more;
        if bytes[..read] != PREFACE[..read] {
            return Err("this is not HTTP/2".into());
        }
    }
    Ok(())
}
