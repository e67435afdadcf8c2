//! The gRPC health service on a port of its own, for the probes of a container platform.
//!
//! Kubelet's gRPC probes speak plain text and send no credentials, so they cannot ask on the port
//! of the coordinator once that is secured. This port answers `grpc.health.v1.Health` and nothing
//! else: it says that a process is there, and nothing about the bake.
//!
//! - Service `""`: the process runs, from the first moment. For liveness.
//! - Service `sightline.v1.Coordinator`: tasks can be leased. Not while the scene is read and the
//!   plan is made. For readiness.

use std::net::SocketAddr;

use sightline_proto::v1::coordinator_server::SERVICE_NAME;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_stream::wrappers::TcpListenerStream;
use tonic_health::ServingStatus;
use tonic_health::server::HealthReporter;

use crate::CoordinatorError;

/// A running health service. Dropping it ends the service.
#[derive(Debug)]
pub struct Health {
    /// Where it listens.
    pub addr: SocketAddr,
    reporter: HealthReporter,
    server: JoinHandle<()>,
}

impl Health {
    /// Serves on `listen`; port 0 takes a free one. Nothing is ready yet.
    ///
    /// # Errors
    /// When the address cannot be listened on.
    pub async fn serve(listen: SocketAddr) -> Result<Self, CoordinatorError> {
        let refused = |source| CoordinatorError::Listen { address: listen, source };
        let listener = TcpListener::bind(listen).await.map_err(refused)?;
        let addr = listener.local_addr().map_err(refused)?;
        let (reporter, service) = tonic_health::server::health_reporter();
        reporter.set_service_status(SERVICE_NAME, ServingStatus::NotServing).await;
        let server = tokio::spawn(async move {
            let incoming = TcpListenerStream::new(listener);
            let served = crate::coordinator::limited()
                .add_service(service)
                .serve_with_incoming(incoming)
                .await;
            if let Err(error) = served {
                tracing::error!(%error, "probes are not answered any more");
            }
        });
        Ok(Self { addr, reporter, server })
    }

    /// Tasks can be leased from here on.
    pub async fn ready(&self) {
        self.reporter.set_service_status(SERVICE_NAME, ServingStatus::Serving).await;
    }
}

impl Drop for Health {
    fn drop(&mut self) {
        self.server.abort();
    }
}

#[cfg(test)]
mod tests {
    use tonic_health::pb::HealthCheckRequest;
    use tonic_health::pb::health_client::HealthClient;

    use super::*;

    #[tokio::test]
    async fn a_coordinator_lives_before_it_is_ready() {
        let health = Health::serve(SocketAddr::from(([127, 0, 0, 1], 0))).await.unwrap();
        let endpoint = tonic::transport::Endpoint::from_shared(format!("http://{}", health.addr));
        let mut client = HealthClient::new(endpoint.unwrap().connect().await.unwrap());
        let mut ask = async |service: &str| {
            let request = HealthCheckRequest { service: service.into() };
            client.check(request).await.unwrap().into_inner().status
        };
        let (serving, waiting) = (ServingStatus::Serving as i32, ServingStatus::NotServing as i32);
        assert_eq!(ask("").await, serving);
        assert_eq!(ask(SERVICE_NAME).await, waiting);
        health.ready().await;
        assert_eq!(ask(SERVICE_NAME).await, serving);
    }
}
