//! Setting up logs and traces: once, in `main`.
//!
//! What is logged is chosen by `RUST_LOG`, else by the program's default. Text is for people; JSON
//! has an object a line, with the fields of the event and of the span that it is in.

use std::io::{self, IsTerminal};
use std::net::SocketAddr;

use opentelemetry::trace::TracerProvider;
use opentelemetry_sdk::trace::SdkTracerProvider;
use tracing_subscriber::filter::filter_fn;
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::layer::{Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Registry};

use crate::metrics::parse_address;
use crate::trace::{self, TraceError};

/// How log lines look.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// An object a line.
    Json,
}

/// The flags of a process that say how it can be watched.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct WatchFlags {
    /// How log lines look, on stderr.
    #[arg(long, value_enum, default_value_t, value_name = "FORMAT", env = "SIGHTLINE_LOG_FORMAT")]
    pub log_format: LogFormat,
    /// Answer Prometheus there, under /metrics: HOST:PORT, or a port on loopback.
    #[arg(long, value_name = "ADDRESS", value_parser = parse_address, env = "SIGHTLINE_METRICS")]
    pub metrics: Option<SocketAddr>,
}

/// What to log, and how.
#[derive(Clone, Copy, Debug)]
pub struct LogOptions<'a> {
    /// How lines look.
    pub format: LogFormat,
    /// What is logged where `RUST_LOG` does not say, in its syntax.
    pub filter: &'a str,
    /// Name of the program in traces.
    pub service: &'static str,
}

/// Logs and traces of this process. Held by `main` until the end: dropping it sends the spans that
/// have not been sent.
#[must_use = "dropping it ends the export of traces"]
#[derive(Debug)]
pub struct Telemetry {
    export: Option<trace::Export>,
}

impl Telemetry {
    /// Starts to log to `writer`, and to export traces when the environment names a collector.
    ///
    /// # Errors
    /// When the collector's address cannot be used. Logs are set up all the same.
    ///
    /// # Panics
    /// When logging was set up before.
    pub fn start<W>(options: LogOptions<'_>, writer: W) -> Result<Self, TraceError>
    where
        W: for<'w> MakeWriter<'w> + Send + Sync + 'static,
    {
        let filter =
            EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(options.filter));
        let lines = match options.format {
            LogFormat::Text => tracing_subscriber::fmt::layer()
                .with_ansi(io::stderr().is_terminal())
                .with_writer(writer)
                .boxed(),
            LogFormat::Json => tracing_subscriber::fmt::layer()
                .json()
                .flatten_event(true)
                .with_span_list(false)
                .with_writer(writer)
                .boxed(),
        };
        let (export, failed) = match trace::Export::from_environment(options.service) {
            Ok(export) => (export, None),
            Err(error) => (None, Some(error)),
        };
        let spans = export.as_ref().map(|export| span_layer(export.provider()));
        tracing_subscriber::registry().with(spans).with(lines.with_filter(filter)).init();
        match failed {
            Some(error) => Err(error),
            None => Ok(Self { export }),
        }
    }

    /// As [`Self::start`], to stderr.
    ///
    /// # Errors
    /// As [`Self::start`].
    pub fn to_stderr(options: LogOptions<'_>) -> Result<Self, TraceError> {
        Self::start(options, io::stderr)
    }
}

impl Drop for Telemetry {
    fn drop(&mut self) {
        if let Some(export) = self.export.take() {
            export.end();
        }
    }
}

/// Our own spans, whatever is logged; not those of libraries.
fn span_layer(provider: &SdkTracerProvider) -> impl Layer<Registry> + use<> {
    tracing_opentelemetry::layer()
        .with_tracer(provider.tracer("sightline"))
        .with_filter(filter_fn(|of| of.is_span() && of.target().starts_with("sightline")))
}
