//! Metrics for Prometheus: a listener, and what all processes count.
//!
//! The listener answers `GET /metrics` in the OpenMetrics text format and `GET /healthz` with 200,
//! and nothing else. It tells names of tasks' states and counts, no ids and no paths; it has no
//! access control, so an address without a host means loopback.

use std::convert::Infallible;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http::{Method, Request, Response, StatusCode, header};
use http_body_util::Full;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::{Family, MetricConstructor};
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
pub use prometheus_client::registry::Registry;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio::task::JoinHandle;

/// Connections that are served at a time; more wait.
const CONNECTIONS_MAX: usize = 16;
/// Longest a connection may take: scrapers keep them open between scrapes.
const CONNECTION_TIME: Duration = Duration::from_secs(300);
/// Longest the head of a request may take.
const HEAD_TIME: Duration = Duration::from_secs(5);
/// Pause when the system cannot accept, such as without file descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// The format of [`encode`].
const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Reads the address of a listener: `HOST:PORT`, or a port alone for loopback.
///
/// # Errors
/// When it is neither.
pub fn parse_address(text: &str) -> Result<SocketAddr, String> {
    if let Ok(port) = text.parse::<u16>() {
        return Ok((Ipv4Addr::LOCALHOST, port).into());
    }
    text.parse().map_err(|_| "write HOST:PORT with an IP address, or a port for loopback".into())
}

/// A running listener; dropping it stops it.
#[derive(Debug)]
pub struct Listener {
    /// Where it listens.
    pub address: SocketAddr,
    served: JoinHandle<()>,
}

impl Drop for Listener {
    fn drop(&mut self) {
        self.served.abort();
    }
}

impl Listener {
    /// Serves a registry; port 0 takes a free port.
    ///
    /// # Errors
    /// When the address cannot be listened on.
    pub async fn start(address: SocketAddr, registry: Registry) -> std::io::Result<Self> {
        let listener = TcpListener::bind(address).await?;
        let address = listener.local_addr()?;
        tracing::info!(%address, "metrics are at /metrics");
        let served = tokio::spawn(serve(listener, Arc::new(registry)));
        Ok(Self { address, served })
    }
}

async fn serve(listener: TcpListener, registry: Arc<Registry>) {
    let places = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    loop {
        // Never closed.
        let Ok(place) = Arc::clone(&places).acquire_owned().await else { return };
        let Ok((stream, _)) = listener.accept().await else {
            tokio::time::sleep(ACCEPT_PAUSE).await;
            continue;
        };
        let registry = Arc::clone(&registry);
        tokio::spawn(async move {
            let service = service_fn(move |request| {
                let answer = answer(&request, &registry);
                async move { Ok::<_, Infallible>(answer) }
            });
            let connection = hyper::server::conn::http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(HEAD_TIME)
                .serve_connection(TokioIo::new(stream), service);
            // A scraper that went away is no failure of ours.
            let _ = tokio::time::timeout(CONNECTION_TIME, connection).await;
            drop(place);
        });
    }
}

fn answer<B>(request: &Request<B>, registry: &Registry) -> Response<Full<Bytes>> {
    let plain = "text/plain; charset=utf-8";
    let (status, kind, text) = match (request.method(), request.uri().path()) {
        (&Method::GET, "/metrics") => (StatusCode::OK, CONTENT_TYPE, text_of(registry)),
        (&Method::GET, "/healthz") => (StatusCode::OK, plain, "ok\n".to_owned()),
        (&Method::GET, _) => (StatusCode::NOT_FOUND, plain, "metrics are at /metrics\n".to_owned()),
        _ => (StatusCode::METHOD_NOT_ALLOWED, plain, String::new()),
    };
    let mut response = Response::new(Full::new(Bytes::from(text)));
    *response.status_mut() = status;
    response.headers_mut().insert(header::CONTENT_TYPE, header::HeaderValue::from_static(kind));
    response
}

/// All metrics of a registry, as the listener gives them.
#[must_use]
pub fn text_of(registry: &Registry) -> String {
    let mut text = String::new();
    match encode(&mut text, registry) {
        Ok(()) => text,
        // Writing to a string does not fail.
        Err(std::fmt::Error) => String::new(),
    }
}

/// Buckets of times from 1 ms to two hours, s.
#[must_use]
pub fn duration_buckets() -> Histogram {
    Histogram::new(exponential_buckets(0.001, 2.0, 24))
}

/// One label.
pub type Label = [(&'static str, &'static str); 1];
/// Makes a series for each of these values of a label, at zero: what has not happened can be asked for
/// as well.
pub fn begin<M: Clone, C: MetricConstructor<M>>(
    family: &Family<Label, M, C>,
    label: &'static str,
    values: impl IntoIterator<Item = &'static str>,
) {
    for value in values {
        drop(family.get_or_create(&[(label, value)]));
    }
}

/// Two labels.
pub type Labels = [(&'static str, &'static str); 2];

/// What a process asks of the object store.
#[derive(Clone, Debug)]
pub struct StoreMetrics {
    operations: Family<Labels, Counter>,
    durations: Family<Label, Histogram, fn() -> Histogram>,
}

impl StoreMetrics {
    /// Metrics of operations of these kinds with these results. Every series is there from the start, at
    /// zero: what has not happened can be asked for as well.
    #[must_use]
    pub fn new(kinds: &[&'static str], results: &[&'static str]) -> Self {
        let metrics = Self {
            operations: Family::default(),
            durations: Family::new_with_constructor(duration_buckets),
        };
        for kind in kinds {
            drop(metrics.durations.get_or_create(&[("operation", *kind)]));
            for result in results {
                let labels = [("operation", *kind), ("result", *result)];
                drop(metrics.operations.get_or_create(&labels));
            }
        }
        metrics
    }

    /// Makes them known to a registry.
    pub fn register(&self, registry: &mut Registry) {
        registry.register(
            "sightline_store_operations",
            "Operations on the object store by kind and result",
            self.operations.clone(),
        );
        registry.register(
            "sightline_store_operation_duration_seconds",
            "Time of operations on the object store by kind",
            self.durations.clone(),
        );
    }

    /// Counts an operation.
    pub fn operation(&self, kind: &'static str, result: &'static str, time: Duration) {
        self.operations.get_or_create(&[("operation", kind), ("result", result)]).inc();
        self.durations.get_or_create(&[("operation", kind)]).observe(time.as_secs_f64());
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpStream;

    use super::*;

    #[test]
    fn a_port_alone_is_loopback() {
        assert_eq!(parse_address("9464"), Ok("127.0.0.1:9464".parse().unwrap()));
        assert_eq!(parse_address("[::]:9464"), Ok("[::]:9464".parse().unwrap()));
        assert!(parse_address("host").is_err());
    }

    async fn ask(address: SocketAddr, request: &str) -> String {
        let mut stream = TcpStream::connect(address).await.unwrap();
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut text = String::new();
        stream.read_to_string(&mut text).await.unwrap();
        text
    }

    #[tokio::test]
    async fn metrics_are_served_and_nothing_else_is() {
        let (mut registry, store) =
            (Registry::default(), StoreMetrics::new(&["get"], &["ok", "error"]));
        store.register(&mut registry);
        store.operation("get", "ok", Duration::from_millis(5));
        let listener = Listener::start(([127, 0, 0, 1], 0).into(), registry).await.unwrap();
        let get =
            |path: &str| format!("GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n");
        let metrics = ask(listener.address, &get("/metrics")).await;
        assert!(metrics.starts_with("HTTP/1.1 200") && metrics.contains(CONTENT_TYPE), "{metrics}");
        let counted = "sightline_store_operations_total{operation=\"get\",result=\"ok\"} 1";
        assert!(metrics.contains(counted) && metrics.contains("# EOF"), "{metrics}");
        assert!(ask(listener.address, &get("/healthz")).await.starts_with("HTTP/1.1 200"));
        assert!(ask(listener.address, &get("/etc/passwd")).await.starts_with("HTTP/1.1 404"));
        let post = "POST /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n";
        assert!(ask(listener.address, post).await.starts_with("HTTP/1.1 405"));
        assert!(ask(listener.address, "\u{0}garbage\r\n\r\n").await.starts_with("HTTP/1.1 400"));
    }
}
