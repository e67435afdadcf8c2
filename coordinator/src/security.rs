//! Who may talk to the coordinator: encryption, client certificates, bearer tokens, roles.
//!
//! What is configured decides what is asked of a caller:
//!
//! | client CA | token file | a caller needs |
//! | --- | --- | --- |
//! | no | no | nothing: only on loopback, or with `insecure` |
//! | yes | no | a certificate of that CA; its URIs name the roles |
//! | no | yes | a token; the file names its roles |
//! | yes | yes | both; it may do what both allow |
//!
//! Invariants:
//! - AC-1: beyond loopback, a coordinator starts only when it encrypts and asks who is there, or
//!   when it was told `insecure`.
//! - AC-2: a call is answered only when [`sightline_proto::access::rule_of`] its path lets one of
//!   the caller's roles in. Health is open to all who can connect: probes have no credentials.
//! - AC-3: no secret is logged. Tokens are compared as BLAKE3 hashes, which takes the same time
//!   whatever is alike, and only the hashes stay in memory.
//!
//! Connections are limited in the module `accept`.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use futures::future::ready;
use http::{HeaderMap, header};
use sightline_proto::access::{Roles, Rule, Token, TokenFile, TokenFileError, rule_of};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{RootCertStore, ServerConfig};
use tonic::body::Body;
use tonic::{Code, Status};
use tower::{Layer, Service};

use crate::accept::{ConnectionLimits, Peer};
use crate::metrics::Metrics;

/// Refusals that are logged one by one within [`REFUSALS_EVERY`]; the rest is counted.
const REFUSALS_LOGGED: u64 = 10;
const REFUSALS_EVERY: Duration = Duration::from_secs(10);
/// Longest part of a caller's path that is logged, bytes.
const PATH_BYTES_LOGGED: usize = 100;

/// Files of TLS, in PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TlsFiles {
    /// The coordinator's certificate, and those between it and its CA.
    pub cert: PathBuf,
    /// Its private key.
    pub key: PathBuf,
    /// Certificates of the CAs whose clients are let in. Without it, no certificate is asked for.
    pub client_ca: Option<PathBuf>,
}

/// The flags of a coordinator that say who may talk to it.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct SecurityFlags {
    /// Own certificate (PEM, with those between it and its CA): encrypts with TLS.
    #[arg(long, value_name = "FILE", env = "SIGHTLINE_TLS_CERT", requires = "tls_key")]
    pub tls_cert: Option<PathBuf>,
    /// Private key of that certificate (PEM).
    #[arg(long, value_name = "FILE", env = "SIGHTLINE_TLS_KEY", requires = "tls_cert")]
    pub tls_key: Option<PathBuf>,
    /// CA of clients (PEM): asks every caller for a certificate, whose URIs name its role.
    #[arg(long, value_name = "FILE", env = "SIGHTLINE_TLS_CLIENT_CA", requires = "tls_cert")]
    pub tls_client_ca: Option<PathBuf>,
    /// File of bearer tokens, lines of `worker: TOKEN` and `viewer: TOKEN`: asks every caller for
    /// one. Read again when it changes.
    #[arg(long, value_name = "FILE", env = "SIGHTLINE_TOKEN_FILE")]
    pub token_file: Option<PathBuf>,
    /// Allow plain text, or callers without credentials, on an address beyond this machine.
    #[arg(long, env = "SIGHTLINE_INSECURE")]
    pub insecure: bool,
    /// Most connections at a time; a worker has one.
    #[arg(long, value_name = "N", default_value_t = ConnectionLimits::default().connections_max)]
    pub connections_max: usize,
}

impl From<SecurityFlags> for SecurityOptions {
    fn from(flags: SecurityFlags) -> Self {
        let tls = flags.tls_cert.zip(flags.tls_key);
        let limits = ConnectionLimits {
            connections_max: flags.connections_max,
            ..ConnectionLimits::default()
        };
        Self {
            tls: tls.map(|(cert, key)| TlsFiles { cert, key, client_ca: flags.tls_client_ca }),
            token_file: flags.token_file,
            insecure: flags.insecure,
            limits,
        }
    }
}

/// How the coordinator is secured. The default is plain text and no authentication, for loopback.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SecurityOptions {
    /// Encryption.
    pub tls: Option<TlsFiles>,
    /// Bearer tokens; see [`sightline_proto::access`].
    pub token_file: Option<PathBuf>,
    /// Permits plain text or missing authentication beyond loopback.
    pub insecure: bool,
    /// Limits on connections.
    pub limits: ConnectionLimits,
}

/// Why a coordinator does not start as it was told to.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SecurityError {
    /// AC-1.
    #[error(
        "{address} can be reached from other machines, and {missing}. Give {give}; or --insecure \
         where everyone who can reach it may do everything"
    )]
    Open {
        /// Where it would listen.
        address: SocketAddr,
        /// What is missing.
        missing: &'static str,
        /// The flags that help.
        give: &'static str,
    },
    /// A file cannot be used.
    #[error("{path} cannot be used as {what}: {problem}", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What it is to be.
        what: &'static str,
        /// What is wrong.
        problem: String,
    },
    /// Certificate and key do not belong together, or one is of no use.
    #[error("the certificate {cert} cannot be used with its key: {problem}", cert = cert.display())]
    Certificate {
        /// The certificate.
        cert: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// The token file cannot be used.
    #[error(transparent)]
    Tokens(#[from] TokenFileError),
}

/// A token as it is kept.
type Known = (blake3::Hash, Roles);

/// Decides who is let in.
pub(crate) struct Gate {
    tls: Option<TlsAcceptor>,
    asks_for_certificates: bool,
    tokens: Option<TokenFile<Vec<Known>>>,
    refusals: RefusalLog,
    pub limits: ConnectionLimits,
    pub metrics: Arc<Metrics>,
}

impl Gate {
    /// Reads the files, and checks AC-1.
    pub fn new(
        options: &SecurityOptions,
        address: SocketAddr,
        metrics: Arc<Metrics>,
    ) -> Result<Self, SecurityError> {
        let tokens = options.token_file.as_deref().map(|path| TokenFile::open(path, hashed));
        let gate = Self {
            tls: options.tls.as_ref().map(acceptor).transpose()?,
            asks_for_certificates: options.tls.as_ref().is_some_and(|tls| tls.client_ca.is_some()),
            tokens: tokens.transpose()?,
            refusals: RefusalLog::default(),
            limits: options.limits,
            metrics,
        };
        gate.check_address(address, options.insecure)?;
        Ok(gate)
    }

    fn check_address(&self, address: SocketAddr, insecure: bool) -> Result<(), SecurityError> {
        let is_loopback = address.ip().to_canonical().is_loopback();
        let missing = match (self.tls.is_some(), self.authenticates()) {
            (true, true) => return Ok(()),
            (false, true) => ("tokens would pass in plain text", "--tls-cert and --tls-key"),
            (true, false) => ("nobody is asked who they are", "--tls-client-ca or --token-file"),
            (false, false) => (
                "there is neither encryption nor authentication",
                "--tls-cert and --tls-key, and --tls-client-ca or --token-file",
            ),
        };
        let (missing, give) = missing;
        if is_loopback {
            tracing::info!(%address, "open to this machine alone: {missing}");
        } else if insecure {
            tracing::warn!(%address, "insecure, as asked for: {missing}");
        } else {
            return Err(SecurityError::Open { address, missing, give });
        }
        Ok(())
    }

    /// True when callers are asked who they are.
    pub const fn authenticates(&self) -> bool {
        self.asks_for_certificates || self.tokens.is_some()
    }

    pub const fn tls(&self) -> Option<&TlsAcceptor> {
        self.tls.as_ref()
    }

    /// AC-2.
    fn check(&self, path: &str, headers: &HeaderMap, peer: Option<&Peer>) -> Result<(), Status> {
        let rule = rule_of(path);
        if rule == Rule::Open || !self.authenticates() {
            return Ok(());
        }
        let mut roles = Roles::ALL;
        if self.asks_for_certificates {
            let of_peer = peer.and_then(|peer| peer.certificate.as_ref());
            let certificate = of_peer.ok_or_else(|| {
                Status::unauthenticated("this coordinator asks for a certificate")
            })?;
            roles = roles.and(certificate.roles);
        }
        if let Some(tokens) = &self.tokens {
            let token = bearer(headers).ok_or_else(|| {
                Status::unauthenticated("this coordinator asks for a bearer token")
            })?;
            let granted = roles_of(&tokens.get(), token)
                .ok_or_else(|| Status::unauthenticated("the bearer token is not known here"))?;
            roles = roles.and(granted);
        }
        if roles.allow(rule) {
            return Ok(());
        }
        Err(Status::permission_denied(match rule {
            Rule::Only(role) => format!("this is for callers with the role `{}`", role.name()),
            Rule::Any | Rule::Open => "this is for callers with a role".into(),
        }))
    }

    /// Counts a refusal, and logs it unless there are too many.
    pub fn refused(&self, address: Option<SocketAddr>, what: &str, why: &str) {
        self.metrics.refused();
        let address = address.map_or_else(|| "?".to_owned(), |a| a.to_string());
        if let Some(unlogged) = self.refusals.admit(Instant::now()) {
            tracing::warn!(peer = address, what = printable(what), why, unlogged, "refused");
        }
    }
}

/// At most [`REFUSALS_LOGGED`] lines within [`REFUSALS_EVERY`]: whoever tries again and again
/// does not fill the disk.
#[derive(Debug, Default)]
struct RefusalLog {
    window: Mutex<Option<Instant>>,
    logged: AtomicU64,
    unlogged: AtomicU64,
}

impl RefusalLog {
    /// Whether to log; with the number of those that were not logged since the last.
    fn admit(&self, now: Instant) -> Option<u64> {
        let mut window = self.window.lock().unwrap_or_else(PoisonError::into_inner);
        if window.is_none_or(|since| now.duration_since(since) >= REFUSALS_EVERY) {
            *window = Some(now);
            self.logged.store(0, Ordering::Relaxed);
        }
        if self.logged.fetch_add(1, Ordering::Relaxed) < REFUSALS_LOGGED {
            return Some(self.unlogged.swap(0, Ordering::Relaxed));
        }
        self.unlogged.fetch_add(1, Ordering::Relaxed);
        None
    }
}

/// What a stranger sent, fit for a log.
fn printable(text: &str) -> String {
    text.chars()
        .take(PATH_BYTES_LOGGED)
        .map(|c| if c == ' ' || c.is_ascii_graphic() { c } else { '?' })
        .collect()
}

#[expect(clippy::unnecessary_wraps, reason = "the type that a token file asks for")]
fn hashed(_: &Path, tokens: Vec<(Roles, Token)>) -> Result<Vec<Known>, TokenFileError> {
    let hash = |token: &Token| blake3::hash(token.reveal().as_bytes());
    Ok(tokens.iter().map(|(roles, token)| (hash(token), *roles)).collect())
}

/// AC-3: looks at all of them; comparing hashes takes the same time whatever they are.
fn roles_of(known: &[Known], token: &[u8]) -> Option<Roles> {
    let presented = blake3::hash(token);
    let mut found = None;
    for (hash, roles) in known {
        if *hash == presented {
            found = Some(found.unwrap_or_default()).map(|before: Roles| before.or(*roles));
        }
    }
    found
}

/// The answer to a message that is too large or is none, or to a method that there is not: what a
/// caller of the same version does not send.
fn unusable(headers: &HeaderMap) -> Option<Status> {
    let status = Status::from_header_map(headers)?;
    let is_unusable = matches!(
        status.code(),
        Code::OutOfRange | Code::ResourceExhausted | Code::Internal | Code::Unimplemented
    );
    is_unusable.then_some(status)
}

fn bearer(headers: &HeaderMap) -> Option<&[u8]> {
    let value = headers.get(header::AUTHORIZATION)?.as_bytes();
    let (scheme, token) = value.split_at_checked("Bearer ".len())?;
    scheme.eq_ignore_ascii_case(b"Bearer ").then_some(token)
}

fn acceptor(files: &TlsFiles) -> Result<TlsAcceptor, SecurityError> {
    let bad = |path: &Path, what, problem: String| SecurityError::File {
        path: path.to_owned(),
        what,
        problem,
    };
    let certificates = |path: &Path, what| {
        let read: Result<Vec<CertificateDer<'static>>, _> =
            CertificateDer::pem_file_iter(path).and_then(Iterator::collect);
        match read {
            Ok(found) if found.is_empty() => Err(bad(path, what, "it holds no certificate".into())),
            Ok(found) => Ok(found),
            Err(error) => Err(bad(path, what, error.to_string())),
        }
    };
    let unusable = |error: &dyn std::error::Error| SecurityError::Certificate {
        cert: files.cert.clone(),
        problem: error.to_string(),
    };
    let provider = Arc::new(ring::default_provider());
    let builder = ServerConfig::builder_with_provider(Arc::clone(&provider))
        .with_safe_default_protocol_versions()
        .map_err(|error| unusable(&error))?;
    let builder = match &files.client_ca {
        None => builder.with_no_client_auth(),
        Some(path) => {
            let what = "the CA of clients";
            let mut roots = RootCertStore::empty();
            for certificate in certificates(path, what)? {
                roots.add(certificate).map_err(|error| bad(path, what, error.to_string()))?;
            }
            let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider)
                .build()
                .map_err(|error| bad(path, what, error.to_string()))?;
            builder.with_client_cert_verifier(verifier)
        }
    };
    let chain = certificates(&files.cert, "a certificate")?;
    let key = PrivateKeyDer::from_pem_file(&files.key)
        .map_err(|error| bad(&files.key, "a private key", error.to_string()))?;
    let mut config = builder.with_single_cert(chain, key).map_err(|error| unusable(&error))?;
    config.alpn_protocols = vec![b"h2".to_vec()];
    Ok(TlsAcceptor::from(Arc::new(config)))
}

/// Puts a [`Gate`] before all services.
#[derive(Clone)]
pub(crate) struct GateLayer(pub Arc<Gate>);

impl<S> Layer<S> for GateLayer {
    type Service = Gated<S>;

    fn layer(&self, inner: S) -> Self::Service {
        Gated { inner, gate: Arc::clone(&self.0) }
    }
}

/// A service behind a [`Gate`].
#[derive(Clone)]
pub(crate) struct Gated<S> {
    inner: S,
    gate: Arc<Gate>,
}

impl<S, B> Service<http::Request<B>> for Gated<S>
where
    S: Service<http::Request<B>, Response = http::Response<Body>>,
    S::Future: Send + 'static,
    S::Error: Send + 'static,
{
    type Response = S::Response;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<S::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: http::Request<B>) -> Self::Future {
        let peer = request.extensions().get::<Peer>();
        let path = request.uri().path();
        match self.gate.check(path, request.headers(), peer) {
            Ok(()) => {
                // Health alone does not earn a stranger the right to stay.
                if let Some(peer) = peer
                    && (rule_of(path) != Rule::Open || !self.gate.authenticates())
                {
                    peer.admit();
                }
                let (gate, address) = (Arc::clone(&self.gate), peer.map(|peer| peer.address));
                let path = printable(path);
                let answered = self.inner.call(request);
                Box::pin(async move {
                    let response = answered.await?;
                    if let Some(status) = unusable(response.headers()) {
                        gate.refused(address, &path, status.message());
                    }
                    Ok(response)
                })
            }
            Err(status) => {
                self.gate.refused(peer.map(|peer| peer.address), path, status.message());
                Box::pin(ready(Ok(status.into_http())))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gate(options: &SecurityOptions, address: &str) -> Result<Gate, SecurityError> {
        Gate::new(options, address.parse().unwrap(), Arc::new(Metrics::default()))
    }

    fn tokens(folder: &Path) -> SecurityOptions {
        let path = folder.join("tokens");
        std::fs::write(&path, "worker: 0123456789abcdef-w\nviewer: 0123456789abcdef-v\n").unwrap();
        SecurityOptions { token_file: Some(path), ..SecurityOptions::default() }
    }

    #[test]
    fn beyond_loopback_an_open_coordinator_does_not_start() {
        let open = SecurityOptions::default();
        for address in ["127.0.0.1:0", "127.9.9.9:0", "[::1]:0", "[::ffff:127.0.0.1]:0"] {
            assert!(gate(&open, address).is_ok(), "{address}");
        }
        for address in ["0.0.0.0:0", "192.168.1.1:0", "[::]:0"] {
            let error = gate(&open, address).err().unwrap().to_string();
            assert!(error.contains("--token-file") && error.contains("--insecure"), "{error}");
        }
        assert!(gate(&SecurityOptions { insecure: true, ..open }, "0.0.0.0:0").is_ok());
    }

    #[test]
    fn tokens_in_plain_text_stay_on_loopback() {
        let folder = tempfile::tempdir().unwrap();
        let options = tokens(folder.path());
        assert!(gate(&options, "127.0.0.1:0").is_ok());
        let error = gate(&options, "10.0.0.1:0").err().unwrap().to_string();
        assert!(error.contains("plain text") && error.contains("--tls-cert"), "{error}");
    }

    #[test]
    fn a_token_opens_what_its_role_may_do_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let gate = gate(&tokens(folder.path()), "127.0.0.1:0").unwrap();
        let ask = |authorization: &str, method: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::AUTHORIZATION, authorization.parse().unwrap());
            let path = format!("/sightline.v1.Coordinator/{method}");
            gate.check(&path, &headers, None).map_err(|status| status.code())
        };
        use tonic::Code::{PermissionDenied, Unauthenticated};
        assert_eq!(ask("Bearer 0123456789abcdef-w", "Lease"), Ok(()));
        assert_eq!(ask("bearer 0123456789abcdef-v", "GetStatus"), Ok(()));
        assert_eq!(ask("Bearer 0123456789abcdef-v", "Lease"), Err(PermissionDenied));
        assert_eq!(ask("Bearer 0123456789abcdef-w", "GetStatus"), Err(PermissionDenied));
        for wrong in ["", "Bearer ", "Bearer 0123456789abcdef", "Basic 0123456789abcdef-w"] {
            assert_eq!(ask(wrong, "Lease"), Err(Unauthenticated), "{wrong}");
        }
        let health = gate.check("/grpc.health.v1.Health/Check", &HeaderMap::new(), None);
        assert!(health.is_ok(), "probes have no credentials");
    }

    #[test]
    fn refusals_are_not_logged_for_ever() {
        let (log, start) = (RefusalLog::default(), Instant::now());
        let logged = (0..1000).filter(|_| log.admit(start).is_some()).count();
        assert_eq!(logged as u64, REFUSALS_LOGGED);
        assert_eq!(log.admit(start + REFUSALS_EVERY), Some(1000 - REFUSALS_LOGGED));
    }

    #[test]
    fn what_strangers_send_is_fit_for_a_log() {
        assert_eq!(printable("/a b\n\u{1b}[31m\u{e9}"), "/a b??[31m?");
        assert_eq!(printable(&"x".repeat(1000)).len(), PATH_BYTES_LOGGED);
    }
}
