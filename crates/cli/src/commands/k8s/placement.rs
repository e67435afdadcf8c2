//! Where pods run: nodes that the cloud may take back, nodes with a GPU.

use std::collections::BTreeMap;

use k8s_openapi::api::core::v1::{
    Affinity, Container, EnvVar, NodeAffinity, NodeSelector, NodeSelectorRequirement,
    NodeSelectorTerm, PodSpec, PreferredSchedulingTerm, Toleration,
};
use k8s_openapi::apimachinery::pkg::api::resource::Quantity;

use super::options::Render;

/// What nodes that may be taken back are labelled with: label, value. One suffices.
const SPOT_LABELS: [(&str, &str); 4] = [
    ("cloud.google.com/gke-spot", "true"),
    ("eks.amazonaws.com/capacityType", "SPOT"),
    ("karpenter.sh/capacity-type", "spot"),
    ("kubernetes.azure.com/scalesetpriority", "spot"),
];

/// Taints of such nodes, and of nodes with a GPU.
const SPOT_TAINTS: [(&str, &str); 3] = [
    ("cloud.google.com/gke-spot", "true"),
    ("karpenter.sh/capacity-type", "spot"),
    ("kubernetes.azure.com/scalesetpriority", "spot"),
];

/// How long pods stay bound to a node that does not answer, s. Kubernetes waits 300 s by default.
const GONE_NODE_SECONDS: i64 = 30;

/// The coordinator: quickly away from a node that is gone, and not on nodes that go by design.
pub fn coordinator(render: &Render, spec: &mut PodSpec) {
    let mut tolerations = vec![];
    for key in ["node.kubernetes.io/not-ready", "node.kubernetes.io/unreachable"] {
        tolerations.push(Toleration {
            key: Some(key.into()),
            operator: Some("Exists".into()),
            effect: Some("NoExecute".into()),
            toleration_seconds: Some(GONE_NODE_SECONDS),
            value: None,
        });
    }
    spec.tolerations = Some(tolerations);
    if !render.spot {
        return;
    }
    let stays = SPOT_LABELS.map(|(key, value)| requirement(key, "NotIn", value));
    let preferred = PreferredSchedulingTerm {
        preference: NodeSelectorTerm { match_expressions: Some(stays.into()), match_fields: None },
        weight: 100,
    };
    let affinity = NodeAffinity {
        preferred_during_scheduling_ignored_during_execution: Some(vec![preferred]),
        ..NodeAffinity::default()
    };
    spec.affinity = Some(Affinity { node_affinity: Some(affinity), ..Affinity::default() });
}

/// Workers: on the nodes that were asked for.
pub fn worker(render: &Render, spec: &mut PodSpec) {
    let mut tolerations = vec![];
    if render.gpu {
        tolerations.push(tolerate("nvidia.com/gpu", None));
    }
    if render.spot {
        tolerations.extend(SPOT_TAINTS.map(|(key, value)| tolerate(key, Some(value))));
        let terms = SPOT_LABELS.map(|(key, value)| NodeSelectorTerm {
            match_expressions: Some(vec![requirement(key, "In", value)]),
            match_fields: None,
        });
        let affinity = NodeAffinity {
            required_during_scheduling_ignored_during_execution: Some(NodeSelector {
                node_selector_terms: terms.into(),
            }),
            ..NodeAffinity::default()
        };
        spec.affinity = Some(Affinity { node_affinity: Some(affinity), ..Affinity::default() });
    }
    spec.tolerations = (!tolerations.is_empty()).then_some(tolerations);
}

/// The GPU is a resource of the container.
pub fn worker_container(render: &Render, container: &mut Container) {
    if !render.gpu {
        return;
    }
    let gpu = || BTreeMap::from([("nvidia.com/gpu".to_owned(), Quantity("1".into()))]);
    if let Some(resources) = &mut container.resources {
        resources.limits.get_or_insert_default().extend(gpu());
        resources.requests.get_or_insert_default().extend(gpu());
    }
    container.env.get_or_insert_default().push(EnvVar {
        name: "NVIDIA_DRIVER_CAPABILITIES".into(),
        value: Some("compute,utility".into()),
        ..EnvVar::default()
    });
}

fn tolerate(key: &str, value: Option<&str>) -> Toleration {
    Toleration {
        key: Some(key.into()),
        operator: Some(if value.is_some() { "Equal" } else { "Exists" }.into()),
        value: value.map(str::to_owned),
        effect: Some("NoSchedule".into()),
        toleration_seconds: None,
    }
}

fn requirement(key: &str, operator: &str, value: &str) -> NodeSelectorRequirement {
    NodeSelectorRequirement {
        key: key.into(),
        operator: operator.into(),
        values: Some(vec![value.into()]),
    }
}
