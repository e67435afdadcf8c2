//! How a client of the coordinator shows who it is and finds out whom it talks to.
//!
//! Used by workers and by whoever looks at a bake. Certificates are read once, at the start; a
//! token file is read again when it changes. A token goes to another machine only over TLS, or with
//! `insecure`.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use sightline_proto::MESSAGE_BYTES_MAX;
use sightline_proto::access::{Role, Token, TokenFile, TokenFileError, token_for};
use sightline_proto::v1::coordinator_client::CoordinatorClient;
use sightline_telemetry::trace;
use tonic::metadata::AsciiMetadataValue;
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{Request, Status};

use crate::WorkerError;

/// Longest a connection may take, and a call: a lease request waits for a second at most.
const CONNECT_TIME: Duration = Duration::from_secs(5);
const CALL_TIME: Duration = Duration::from_secs(20);

/// A client of the coordinator.
pub type Client = CoordinatorClient<InterceptedService<Channel, Credentials>>;

/// Credentials of a client, and whom it trusts. The default is none, for loopback.
#[derive(Clone, Debug, Default, PartialEq, Eq, clap::Args)]
pub struct ClientSecurity {
    /// CA of the coordinator's certificate (PEM), for https:// addresses.
    #[arg(long = "tls-ca", value_name = "FILE", env = "SIGHTLINE_TLS_CA")]
    pub ca: Option<PathBuf>,
    /// Own certificate (PEM), where the coordinator asks for one. Its URIs name the role.
    #[arg(long = "tls-cert", value_name = "FILE", env = "SIGHTLINE_TLS_CERT", requires = "key")]
    pub cert: Option<PathBuf>,
    /// Private key of that certificate (PEM).
    #[arg(long = "tls-key", value_name = "FILE", env = "SIGHTLINE_TLS_KEY", requires = "cert")]
    pub key: Option<PathBuf>,
    /// File with the bearer token to show; read again when it changes.
    #[arg(long, value_name = "FILE", env = "SIGHTLINE_TOKEN_FILE")]
    pub token_file: Option<PathBuf>,
    /// Send a token in plain text to another machine.
    #[arg(long, env = "SIGHTLINE_INSECURE")]
    pub insecure: bool,
}

/// Shows the token with every call, and which trace it belongs to.
#[derive(Clone, Debug)]
pub struct Credentials {
    token: Option<Arc<TokenFile<AsciiMetadataValue>>>,
}

impl Interceptor for Credentials {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.token {
            request.metadata_mut().insert("authorization", token.get().as_ref().clone());
        }
        trace::inject(&tracing::Span::current(), request.metadata_mut());
        Ok(request)
    }
}

/// How often a silent connection is asked whether its other end still lives, and how long that may take
/// to answer. A machine that loses its power closes no connection.
const KEEPALIVE: Duration = Duration::from_secs(10);

/// How to get from an address to a connection; for tests in which the network is simulated.
pub type Dial = Arc<dyn Fn(&Endpoint) -> Channel + Send + Sync>;

impl ClientSecurity {
    /// A client of the coordinator at `url`, which shows the token of `role`. Does not connect yet.
    ///
    /// # Errors
    /// [`WorkerError::BadUrl`], or [`WorkerError::Credentials`] when a file cannot be used or a
    /// token would go out in plain text.
    pub fn client(&self, url: &str, role: Role) -> Result<Client, WorkerError> {
        self.client_over(url, role, None)
    }

    /// As [`ClientSecurity::client`], over connections that `dial` makes.
    pub(crate) fn client_over(
        &self,
        url: &str,
        role: Role,
        dial: Option<&Dial>,
    ) -> Result<Client, WorkerError> {
        let bad = |problem: String| WorkerError::BadUrl { url: url.to_owned(), problem };
        let mut endpoint = Endpoint::from_shared(url.to_owned())
            .map_err(|error| bad(error.to_string()))?
            .connect_timeout(CONNECT_TIME)
            .timeout(CALL_TIME)
            .http2_keep_alive_interval(KEEPALIVE)
            .keep_alive_timeout(KEEPALIVE)
            .keep_alive_while_idle(true);
        match endpoint.uri().scheme_str() {
            Some("http") => self.check_plain(endpoint.uri().host().unwrap_or_default())?,
            Some("https") => {
                let tls = self.tls()?;
                endpoint = endpoint.tls_config(tls).map_err(|error| refused(error.to_string()))?;
            }
            _ => return Err(bad("it starts neither with http:// nor with https://".into())),
        }
        let make = match role {
            Role::Worker => {
                |path: &Path, tokens| header(&token_for(Role::Worker, path, tokens)?, path)
            }
            Role::Viewer => {
                |path: &Path, tokens| header(&token_for(Role::Viewer, path, tokens)?, path)
            }
        };
        let token = self.token_file.as_deref().map(|path| TokenFile::open(path, make));
        let token = token.transpose().map_err(|error| refused(error.to_string()))?;
        let credentials = Credentials { token: token.map(Arc::new) };
        let channel = dial.map_or_else(|| endpoint.connect_lazy(), |dial| dial(&endpoint));
        Ok(CoordinatorClient::with_interceptor(channel, credentials)
            .max_decoding_message_size(MESSAGE_BYTES_MAX)
            .max_encoding_message_size(MESSAGE_BYTES_MAX))
    }

    /// Plain text is for loopback, and for what is no secret.
    fn check_plain(&self, host: &str) -> Result<(), WorkerError> {
        if self.ca.is_some() || self.cert.is_some() {
            return Err(refused("--tls-ca and --tls-cert are for https:// addresses".into()));
        }
        let address = host.trim_start_matches('[').trim_end_matches(']').parse();
        let is_loopback = host.eq_ignore_ascii_case("localhost")
            || address.is_ok_and(|ip: std::net::IpAddr| ip.to_canonical().is_loopback());
        if self.token_file.is_some() && !is_loopback && !self.insecure {
            return Err(refused(format!(
                "the token would go to {host} in plain text. Use an https:// address and --tls-ca; \
                 or --insecure where nobody listens in"
            )));
        }
        Ok(())
    }

    fn tls(&self) -> Result<ClientTlsConfig, WorkerError> {
        let Some(ca) = &self.ca else {
            let problem = "an https:// address needs --tls-ca, the CA of the coordinator";
            return Err(refused(problem.into()));
        };
        let mut tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(read(ca)?));
        if let (Some(cert), Some(key)) = (&self.cert, &self.key) {
            tls = tls.identity(Identity::from_pem(read(cert)?, read(key)?));
        }
        Ok(tls)
    }
}

fn refused(problem: String) -> WorkerError {
    WorkerError::Credentials(problem)
}

fn header(token: &Token, path: &Path) -> Result<AsciiMetadataValue, TokenFileError> {
    let value = AsciiMetadataValue::try_from(format!("Bearer {}", token.reveal()));
    let mut value = value
        .map_err(|_| TokenFileError::NoToken { path: path.to_owned(), role: "visible ASCII" })?;
    // Left out of what HTTP/2 keeps in its tables, and of `Debug`.
    value.set_sensitive(true);
    Ok(value)
}

fn read(path: &Path) -> Result<Vec<u8>, WorkerError> {
    std::fs::read(path).map_err(|error| refused(format!("{}: {error}", path.display())))
}

/// What a call was answered with: its message, and what that comes from. Transport errors say
/// little by themselves.
#[must_use]
pub fn told(status: &Status) -> String {
    let mut text = match status.message() {
        "" => status.code().to_string(),
        message => message.to_owned(),
    };
    let first = std::error::Error::source(status);
    for cause in std::iter::successors(first, |cause| cause.source()) {
        let more = cause.to_string();
        if !text.contains(&more) {
            text = format!("{text}: {more}");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_token(folder: &Path) -> ClientSecurity {
        let token_file = folder.join("tokens");
        std::fs::write(&token_file, "worker: 0123456789abcdef-w\n").unwrap();
        ClientSecurity { token_file: Some(token_file), ..ClientSecurity::default() }
    }

    #[tokio::test]
    async fn a_token_does_not_leave_the_machine_in_plain_text() {
        let folder = tempfile::tempdir().unwrap();
        let security = with_token(folder.path());
        for near in ["http://127.0.0.1:1", "http://localhost:1", "http://[::1]:1"] {
            assert!(security.client(near, Role::Worker).is_ok(), "{near}");
        }
        let far = "http://10.0.0.1:1";
        let error = security.client(far, Role::Worker).err().unwrap().to_string();
        assert!(error.contains("plain text") && !error.contains("0123456789"), "{error}");
        assert!(ClientSecurity { insecure: true, ..security }.client(far, Role::Worker).is_ok());
        assert!(ClientSecurity::default().client(far, Role::Worker).is_ok(), "there is no secret");
    }

    #[tokio::test]
    async fn what_is_missing_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let error = |security: &ClientSecurity, url, role| {
            security.client(url, role).err().unwrap().to_string()
        };
        let none = ClientSecurity::default();
        assert!(error(&none, "https://127.0.0.1:1", Role::Worker).contains("--tls-ca"));
        assert!(error(&none, "ftp://x", Role::Worker).contains("https://"));
        let no_viewer = with_token(folder.path());
        assert!(error(&no_viewer, "http://127.0.0.1:1", Role::Viewer).contains("viewer"));
    }

    #[test]
    fn the_token_is_not_debugged() {
        let folder = tempfile::tempdir().unwrap();
        let path = with_token(folder.path()).token_file.unwrap();
        let make = |path: &Path, tokens| header(&token_for(Role::Worker, path, tokens)?, path);
        let credentials =
            Credentials { token: Some(Arc::new(TokenFile::open(&path, make).unwrap())) };
        let mut request = credentials.clone();
        let request = request.call(Request::new(())).unwrap();
        assert!(request.metadata().contains_key("authorization"));
        assert!(!format!("{credentials:?} {request:?}").contains("0123456789"));
    }
}
