//! Traces: the life of a task across processes.
//!
//! Spans are exported by OTLP over gRPC when `OTEL_EXPORTER_OTLP_ENDPOINT` or
//! `OTEL_EXPORTER_OTLP_TRACES_ENDPOINT` is set; the other variables of OpenTelemetry (headers,
//! timeouts, `OTEL_TRACES_SAMPLER`, `OTEL_RESOURCE_ATTRIBUTES`) mean what they always mean. The
//! exporter has a thread and a runtime of its own: a collector that is slow or away costs spans,
//! never a task.
//!
//! One trace goes through several processes as the header `traceparent` of W3C Trace Context in
//! gRPC metadata: [`inject`] writes the current span to it, [`adopt`] makes it a span's parent.

use opentelemetry::Context;
use opentelemetry::propagation::{Extractor, Injector, TextMapPropagator};
use opentelemetry::trace::TraceContextExt;
use opentelemetry_otlp::SpanExporter;
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::SdkTracerProvider;
use tonic::metadata::{MetadataKey, MetadataMap, MetadataValue};
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt;

/// Variables that name a collector.
const ENDPOINTS: [&str; 2] = ["OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT"];

/// Why traces cannot be exported.
#[derive(Debug, thiserror::Error)]
#[error(
    "traces cannot be exported: {problem}; OTEL_EXPORTER_OTLP_ENDPOINT is the address of an OTLP \
     collector over gRPC, such as http://127.0.0.1:4317"
)]
pub struct TraceError {
    problem: String,
}

/// A running export of traces.
#[derive(Debug)]
pub(crate) struct Export {
    provider: SdkTracerProvider,
    runtime: tokio::runtime::Runtime,
}

impl Export {
    /// Starts an export if the environment names a collector.
    pub fn from_environment(service: &'static str) -> Result<Option<Self>, TraceError> {
        let is_set = |name: &&str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
        if !ENDPOINTS.iter().any(is_set) {
            return Ok(None);
        }
        let failed = |problem: String| TraceError { problem };
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("traces")
            .enable_all()
            .build()
            .map_err(|error| failed(error.to_string()))?;
        let inside = runtime.enter();
        let exporter = SpanExporter::builder()
            .with_tonic()
            .build()
            .map_err(|error| failed(error.to_string()))?;
        drop(inside);
        let provider = SdkTracerProvider::builder()
            .with_batch_exporter(exporter)
            .with_resource(Resource::builder().with_service_name(service).build())
            .build();
        Ok(Some(Self { provider, runtime }))
    }

    pub const fn provider(&self) -> &SdkTracerProvider {
        &self.provider
    }

    /// Sends what is left, for a while.
    pub fn end(self) {
        if let Err(error) = self.provider.shutdown() {
            tracing::warn!(%error, "the last spans were not exported");
        }
        self.runtime.shutdown_background();
    }
}

struct Headers<'a>(&'a mut MetadataMap);

impl Injector for Headers<'_> {
    fn set(&mut self, key: &str, value: String) {
        if let (Ok(key), Ok(value)) =
            (MetadataKey::from_bytes(key.as_bytes()), MetadataValue::try_from(value))
        {
            self.0.insert(key, value);
        }
    }
}

struct Received<'a>(&'a MetadataMap);

impl Extractor for Received<'_> {
    fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key)?.to_str().ok()
    }

    fn keys(&self) -> Vec<&str> {
        // Only asked for by propagators whose keys are not known beforehand.
        Vec::new()
    }
}

/// Writes `span` into metadata. Nothing where traces are not exported.
pub fn inject(span: &Span, metadata: &mut MetadataMap) {
    TraceContextPropagator::new().inject_context(&span.context(), &mut Headers(metadata));
}

/// Makes the span in metadata, if there is one, the parent of `span`, which has not been entered.
pub fn adopt(span: &Span, metadata: &MetadataMap) {
    let context =
        TraceContextPropagator::new().extract_with_context(&Context::new(), &Received(metadata));
    if context.span().span_context().is_valid() {
        // Fails where traces are not exported.
        let _ = span.set_parent(context);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_strangers_send_as_a_parent_does_no_harm() {
        for text in ["", "00", "00-0-0-00", "zz-\u{7f}", &"0".repeat(10_000)] {
            let mut metadata = MetadataMap::new();
            if let Ok(value) = MetadataValue::try_from(text) {
                metadata.insert("traceparent", value);
            }
            adopt(&tracing::info_span!("test"), &metadata);
        }
    }

    #[test]
    fn nothing_is_sent_where_nothing_is_exported() {
        let mut metadata = MetadataMap::new();
        inject(&tracing::info_span!("test"), &mut metadata);
        assert!(metadata.is_empty());
    }
}
