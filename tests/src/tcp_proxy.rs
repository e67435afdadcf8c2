//! A proxy between clients and a TCP server that cuts, delays and stalls, whatever is spoken.
//!
//! It does so when it is told to, to all its connections alike. Where it leads to can be changed: new
//! connections go to the new server, those that are there stay with the old one. So it stands for the
//! address of a service whose processes come and go.

use std::net::Ipv4Addr;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Runtime;
use tokio::sync::watch;

/// Most bytes that are passed on at a time.
const CHUNK_BYTES: usize = 16 << 10;

/// How it is with the network.
#[derive(Clone, Copy, Debug)]
struct Line {
    /// Port of the server that new connections are made to.
    server: u16,
    /// How often all connections have been cut.
    cuts: u64,
    /// Bytes are taken and not passed on.
    is_stalled: bool,
    /// How long each chunk is held back.
    delay: Duration,
}

/// A running proxy; it ends when dropped.
pub struct TcpProxy {
    runtime: Option<Runtime>,
    port: u16,
    line: watch::Sender<Line>,
}

impl TcpProxy {
    /// A proxy on a free port of loopback in front of the server on the port `server`.
    ///
    /// # Panics
    /// When it cannot listen.
    #[must_use]
    pub fn before(server: u16) -> Self {
        let (runtime, listener, port) = listen();
        let line = Line { server, cuts: 0, is_stalled: false, delay: Duration::ZERO };
        let (line, seen) = watch::channel(line);
        runtime.spawn(accept(listener, seen));
        Self { runtime: Some(runtime), port, line }
    }

    /// Where it listens.
    #[must_use]
    pub const fn port(&self) -> u16 {
        self.port
    }

    /// Leads new connections to another server.
    pub fn lead_to(&self, server: u16) {
        self.line.send_modify(|line| line.server = server);
    }

    /// Ends all connections, with what is under way.
    pub fn cut(&self) {
        self.line.send_modify(|line| line.cuts += 1);
    }

    /// Holds everything back until told otherwise; connections stay open.
    pub fn stall(&self, is_stalled: bool) {
        self.line.send_modify(|line| line.is_stalled = is_stalled);
    }

    /// Holds each chunk back for a while.
    pub fn delay(&self, delay: Duration) {
        self.line.send_modify(|line| line.delay = delay);
    }
}

/// A runtime for a proxy, and a listener of it on a free port of loopback.
///
/// # Panics
/// When there is none.
pub(crate) fn listen() -> (Runtime, TcpListener, u16) {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .expect("a runtime starts");
    let listener =
        runtime.block_on(TcpListener::bind((Ipv4Addr::LOCALHOST, 0))).expect("a port is free");
    let port = listener.local_addr().expect("it has an address").port();
    (runtime, listener, port)
}

impl Drop for TcpProxy {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

async fn accept(listener: TcpListener, line: watch::Receiver<Line>) {
    while let Ok((client, _)) = listener.accept().await {
        let line = line.clone();
        tokio::spawn(async move {
            // A connection that breaks by itself is what clients have to bear anyway.
            let _ = pass_on(client, line).await;
        });
    }
}

/// One connection, until a side ends it or it is cut.
async fn pass_on(client: TcpStream, mut line: watch::Receiver<Line>) -> std::io::Result<()> {
    let Line { server, cuts, .. } = *line.borrow();
    let server = TcpStream::connect((Ipv4Addr::LOCALHOST, server)).await?;
    client.set_nodelay(true)?;
    server.set_nodelay(true)?;
    let (from_client, to_client) = client.into_split();
    let (from_server, to_server) = server.into_split();
    let (up, down) = (line.clone(), line.clone());
    tokio::select! {
        ended = copy(from_client, to_server, up) => ended,
        ended = copy(from_server, to_client, down) => ended,
        _ = line.wait_for(|line| line.cuts != cuts) => Ok(()),
    }
}

async fn copy(
    mut from: impl AsyncRead + Unpin,
    mut to: impl AsyncWrite + Unpin,
    mut line: watch::Receiver<Line>,
) -> std::io::Result<()> {
    let mut bytes = vec![0; CHUNK_BYTES];
    loop {
        let read = from.read(&mut bytes).await?;
        if read == 0 {
            return Ok(());
        }
        let delay = match line.wait_for(|line| !line.is_stalled).await {
            Ok(line) => line.delay,
            // The proxy is no more.
            Err(_) => return Ok(()),
        };
        tokio::time::sleep(delay).await;
        to.write_all(&bytes[..read]).await?;
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::net::{TcpListener, TcpStream};

    use super::*;

    /// A server that answers each connection with one byte and keeps it open.
    fn server(answer: u8) -> u16 {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a port is free");
        let port = listener.local_addr().expect("it has an address").port();
        std::thread::spawn(move || {
            let mut open = Vec::new();
            for stream in listener.incoming() {
                let mut stream = stream.expect("a connection comes");
                stream.write_all(&[answer]).expect("it can be written to");
                open.push(stream);
            }
        });
        port
    }

    fn answer(stream: &mut TcpStream) -> Option<u8> {
        let mut byte = [0];
        stream.read_exact(&mut byte).is_ok().then_some(byte[0])
    }

    #[test]
    fn connections_are_cut_and_led_elsewhere() {
        let proxy = TcpProxy::before(server(1));
        let connect = || TcpStream::connect((Ipv4Addr::LOCALHOST, proxy.port())).expect("it is up");
        let mut first = connect();
        assert_eq!(answer(&mut first), Some(1));
        proxy.lead_to(server(2));
        assert_eq!(answer(&mut connect()), Some(2));
        proxy.cut();
        assert_eq!(answer(&mut first), None, "the connection is gone");
        assert_eq!(answer(&mut connect()), Some(2), "the next one works");
    }

    #[test]
    fn what_is_stalled_arrives_later() {
        let proxy = TcpProxy::before(server(3));
        proxy.stall(true);
        let mut stream = TcpStream::connect((Ipv4Addr::LOCALHOST, proxy.port())).expect("it is up");
        stream.set_read_timeout(Some(Duration::from_millis(50))).expect("it can be set");
        assert_eq!(answer(&mut stream), None);
        stream.set_read_timeout(None).expect("it can be set");
        proxy.delay(Duration::from_millis(1));
        proxy.stall(false);
        assert_eq!(answer(&mut stream), Some(3));
    }
}
