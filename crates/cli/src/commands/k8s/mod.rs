//! `sightline k8s render`: the Kubernetes manifests of a bake.
//!
//! ```text
//! Service NAME-coordinator <---- lease, report ---- workers: one of
//!        |                                            Job NAME-worker        (an index a slot)
//! Job NAME-coordinator                                ScaledJob NAME-worker  (KEDA; a job a slot)
//!        |
//! ConfigMap NAME-bake: what to bake, from where, to where
//! ```
//!
//! and around them a service account without a token, network policies, and a disruption budget.
//! Manifests are typed: what the API of Kubernetes does not know cannot be written. They are a
//! function of the flags alone. `k8s/base` is what the defaults give; a test compares the two.
//!
//! What decides how pods end, numbered for tests and documents:
//! - KU-1: a pod is a slot, not a task: it leases tasks until the bake is over.
//! - KU-2: a pod that was disrupted (evicted, preempted, its node drained) never counts as a
//!   failure, and its slot is filled again.
//! - KU-3: a worker that is stopped ends with the code for "interrupted", never with 0: a slot
//!   whose worker was stopped is not a slot that saw the end of the bake.
//! - KU-4: one worker that saw the end of the bake ends the Job: the others have nothing to do.
//! - KU-5: what cannot get better by itself (a wrong configuration, a scene that cannot be read, a
//!   bake with tasks missing) fails the Job at once.
//! - KU-6: everything else is tried again, and counted: a slot is given up after
//!   [`jobs::RETRIES_OF_A_SLOT`] failures, the Job when more than half of its slots are.
//! - KU-7: manifests hold names of secrets, never secrets.

mod document;
mod jobs;
mod keda;
mod network;
mod options;
mod placement;
mod pods;

pub use options::K8s;

use document::Document;
use options::{Render, Scaling, Task};

use super::bake::read_config_file;
use crate::failure::{Failure, Kind, Result};
use crate::progress::note;
use crate::report::print;

/// Runs `sightline k8s`.
pub fn run(command: &K8s) -> Result<()> {
    let Task::Render(render) = &command.task;
    let config = match &render.config {
        Some(path) => read_config_file(path)?,
        None => options::EXAMPLE_CONFIG.to_owned(),
    };
    // A configuration with a wrong key is refused here, not by a pod an hour later.
    sightline_jobs::BakeConfig::from_toml_with(&config, &[])?;
    let documents = manifests(render, &config)?;
    match &render.output {
        None => print(&document::to_text(&documents)?),
        Some(folder) => {
            document::write_folder(&documents, folder)?;
            note(&format!("kubectl apply -k {}", folder.display()));
        }
    }
    Ok(())
}

/// All objects, in the order to create them.
fn manifests(render: &Render, config: &str) -> Result<Vec<Document>> {
    check_names(render)?;
    let mut documents = vec![
        Document::of("service-account", &pods::service_account(render))?,
        Document::of("config-map", &pods::config_map(render, config))?,
        Document::of("service", &network::service(render))?,
    ];
    for (file, policy) in network::policies(render) {
        documents.push(Document::of(file, &policy)?);
    }
    documents.push(Document::of("coordinator-job", &jobs::coordinator(render))?);
    match render.scaling {
        Scaling::Job => {
            documents.push(Document::of("worker-job", &jobs::workers(render))?);
            if let Some(budget) = jobs::disruption_budget(render) {
                documents.push(Document::of("disruption-budget", &budget)?);
            }
        }
        Scaling::Keda => {
            if let Some(authentication) = keda::trigger_authentication(render) {
                documents.push(Document::of("trigger-authentication", &authentication)?);
            }
            documents.push(Document::of("scaled-job", &keda::scaled_job(render))?);
        }
    }
    Ok(documents)
}

/// Names that the API server would refuse, or that would clash, are refused here.
fn check_names(render: &Render) -> Result<()> {
    // A pod of an indexed Job has the host name NAME-worker-99999, 63 characters at most.
    const NAME_MAX: usize = 63 - "-coordinator-99999".len();
    let wrong = |what: &str, name: &str, why: &str| {
        Err(Failure::new(Kind::Usage, format!("the {what} `{name}` {why}"))
            .with_help("give lower-case letters, digits and dashes, with a letter first"))
    };
    let label = |name: &str| {
        let inner = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-';
        name.starts_with(|c: char| c.is_ascii_lowercase())
            && !name.ends_with('-')
            && name.bytes().all(inner)
    };
    if render.name.len() > NAME_MAX {
        return wrong("name", &render.name, &format!("is longer than {NAME_MAX} characters"));
    }
    let claim = render.claim.as_deref().map(|claim| ("claim", claim));
    let named = [("name", render.name.as_str()), ("namespace", &render.namespace)];
    for (what, name) in named.into_iter().chain(claim) {
        if name.len() > 63 || !label(name) {
            return wrong(what, name, "is no name of Kubernetes");
        }
    }
    Ok(())
}
