//! Who may talk to whom: nothing that is not listed.
//!
//! | from | to | port |
//! | --- | --- | --- |
//! | workers | coordinator | 7070, gRPC |
//! | KEDA, with `--scaling keda` | coordinator | 7070, the external-scaler service |
//! | Prometheus | coordinator | 9090, metrics |
//! | workers, coordinator | DNS of the cluster | 53 |
//! | workers, coordinator | object store, anywhere | 443, or `--store-port` |
//!
//! Probes come from the node itself, which network policies do not stop.

use std::collections::BTreeMap;

use k8s_openapi::api::core::v1::{ContainerPort, Service, ServicePort, ServiceSpec};
use k8s_openapi::api::networking::v1::{
    NetworkPolicy, NetworkPolicyEgressRule, NetworkPolicyIngressRule, NetworkPolicyPeer,
    NetworkPolicyPort, NetworkPolicySpec,
};
use k8s_openapi::apimachinery::pkg::apis::meta::v1::LabelSelector;
use k8s_openapi::apimachinery::pkg::util::intstr::IntOrString;

use super::options::{Render, Scaling};
use super::pods;

/// Port of leases, reports and the external scaler.
pub const COORDINATOR_PORT: u16 = 7070;
/// Port of the health service alone, without encryption: kubelet's probes know none.
pub const HEALTH_PORT: u16 = 7071;
/// Port of the Prometheus metrics.
pub const METRICS_PORT: u16 = 9090;

/// Ports of the coordinator's container.
pub fn ports() -> Vec<ContainerPort> {
    [("grpc", COORDINATOR_PORT), ("health", HEALTH_PORT), ("metrics", METRICS_PORT)]
        .map(|(name, port)| ContainerPort {
            name: Some(name.into()),
            container_port: i32::from(port),
            ..ContainerPort::default()
        })
        .into()
}

/// The address of the coordinator, wherever it runs.
pub fn service(render: &Render) -> Service {
    let port = |name: &str, port: u16| ServicePort {
        name: Some(name.into()),
        port: i32::from(port),
        target_port: Some(IntOrString::String(name.into())),
        ..ServicePort::default()
    };
    Service {
        metadata: pods::metadata(render, render.named("coordinator"), Some("coordinator")),
        spec: Some(ServiceSpec {
            selector: Some(pods::labels(render, Some("coordinator"))),
            ports: Some(vec![port("grpc", COORDINATOR_PORT), port("metrics", METRICS_PORT)]),
            ..ServiceSpec::default()
        }),
        status: None,
    }
}

/// The policies, each with the name of its file.
pub fn policies(render: &Render) -> Vec<(&'static str, NetworkPolicy)> {
    let mut ingress = vec![ingress(&[pods_of(render, "worker")], COORDINATOR_PORT)];
    if render.scaling == Scaling::Keda {
        ingress.push(self::ingress(&[namespace(&render.keda_namespace)], COORDINATOR_PORT));
    }
    ingress.push(self::ingress(&[namespace(&render.prometheus_namespace)], METRICS_PORT));
    let store = || egress(None, &[("TCP", render.store_port)]);
    let coordinator = NetworkPolicySpec {
        ingress: Some(ingress),
        egress: Some(vec![dns(), store()]),
        ..applying_to(render, Some("coordinator"))
    };
    let lease = egress(Some(pods_of(render, "coordinator")), &[("TCP", COORDINATOR_PORT)]);
    let worker = NetworkPolicySpec {
        egress: Some(vec![dns(), lease, store()]),
        ..applying_to(render, Some("worker"))
    };
    // For pods of the bake that are of neither kind, now or later.
    let rest = applying_to(render, None);
    let policy = |name: String, component: Option<&str>, spec| NetworkPolicy {
        metadata: pods::metadata(render, name, component),
        spec: Some(spec),
    };
    vec![
        ("network-policy", policy(render.name.clone(), None, rest)),
        (
            "coordinator-network-policy",
            policy(render.named("coordinator"), Some("coordinator"), coordinator),
        ),
        ("worker-network-policy", policy(render.named("worker"), Some("worker"), worker)),
    ]
}

fn applying_to(render: &Render, component: Option<&str>) -> NetworkPolicySpec {
    NetworkPolicySpec {
        pod_selector: Some(selector(pods::labels(render, component))),
        policy_types: Some(vec!["Ingress".into(), "Egress".into()]),
        ..NetworkPolicySpec::default()
    }
}

const fn selector(labels: BTreeMap<String, String>) -> LabelSelector {
    LabelSelector { match_labels: Some(labels), match_expressions: None }
}

fn pods_of(render: &Render, component: &str) -> NetworkPolicyPeer {
    NetworkPolicyPeer {
        pod_selector: Some(selector(pods::labels(render, Some(component)))),
        ..NetworkPolicyPeer::default()
    }
}

fn namespace(name: &str) -> NetworkPolicyPeer {
    let label = ("kubernetes.io/metadata.name".to_owned(), name.to_owned());
    NetworkPolicyPeer {
        namespace_selector: Some(selector(BTreeMap::from([label]))),
        ..NetworkPolicyPeer::default()
    }
}

fn ports_of(list: &[(&str, u16)]) -> Vec<NetworkPolicyPort> {
    list.iter()
        .map(|(protocol, port)| NetworkPolicyPort {
            protocol: Some((*protocol).into()),
            port: Some(IntOrString::Int(i32::from(*port))),
            end_port: None,
        })
        .collect()
}

fn ingress(from: &[NetworkPolicyPeer], port: u16) -> NetworkPolicyIngressRule {
    NetworkPolicyIngressRule { from: Some(from.to_vec()), ports: Some(ports_of(&[("TCP", port)])) }
}

fn egress(to: Option<NetworkPolicyPeer>, ports: &[(&str, u16)]) -> NetworkPolicyEgressRule {
    NetworkPolicyEgressRule { to: to.map(|peer| vec![peer]), ports: Some(ports_of(ports)) }
}

fn dns() -> NetworkPolicyEgressRule {
    egress(Some(namespace("kube-system")), &[("UDP", 53), ("TCP", 53)])
}
