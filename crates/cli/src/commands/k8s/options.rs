//! The flags of `sightline k8s`.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};

/// What the base bakes: to be replaced by who uses it.
pub const EXAMPLE_CONFIG: &str = "\
[region]
rectangles = [[-60.0, -60.0, 60.0, 60.0]]
cell_size = 10.0
eye_height = [1.5, 1.8]

[accuracy]
target_error = 0.0001
";

/// `k8s`.
#[derive(Debug, Args)]
#[command(arg_required_else_help = true, subcommand_required = true)]
pub struct K8s {
    /// What to do.
    #[command(subcommand)]
    pub task: Task,
}

/// What can be done.
#[derive(Debug, Subcommand)]
pub enum Task {
    /// Print the manifests of a bake: a coordinator, workers, and what they need.
    Render(Box<Render>),
}

/// How workers come and go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Scaling {
    /// An Indexed Job: a fixed number of slots.
    Job,
    /// A KEDA ScaledJob: as many workers as there are tasks for, up to the number of slots.
    Keda,
}

/// How workers and coordinator know each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Auth {
    /// Certificates on both sides.
    Mtls,
    /// A certificate of the coordinator, and a token that workers show.
    Token,
    /// Nothing: anyone who reaches the port may lease tasks. For networks that are trusted.
    None,
}

/// `k8s render`.
#[derive(Debug, Args)]
#[command(after_long_help = "Example:\n  sightline k8s render --scene s3://studio/city.glb \
    --out s3://studio/visible --config bake.toml --image registry/sightline:1 | kubectl apply -f -")]
pub struct Render {
    /// The scene, as pods see it: an object store URL, or a path below /shared with --claim.
    #[arg(long, default_value = "s3://sightline/scenes/city.glb", value_name = "LOCATION")]
    pub scene: String,
    /// Where the dataset goes, as pods see it: a URL, or a path below /shared with --claim.
    #[arg(long, default_value = "s3://sightline/datasets/city", value_name = "LOCATION")]
    pub out: String,
    /// Configuration of the bake (TOML); becomes part of a ConfigMap. An example when absent.
    #[arg(long, value_name = "bake.toml")]
    pub config: Option<PathBuf>,
    /// Image that holds the `sightline` command; see k8s/Dockerfile.
    #[arg(long, default_value = concat!("sightline:", env!("CARGO_PKG_VERSION")))]
    pub image: String,
    /// Name of the bake: every object is called NAME or NAME-something.
    #[arg(long, default_value = "sightline")]
    pub name: String,
    /// Namespace of every object.
    #[arg(long, default_value = "sightline")]
    pub namespace: String,
    /// How workers come and go.
    #[arg(long, value_enum, default_value = "job")]
    pub scaling: Scaling,
    /// Worker slots: workers that run at the same time, at most.
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub workers: u32,
    /// With KEDA: open tasks for which one more worker is started.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..))]
    pub tasks_per_worker: u32,
    /// Processor cores of a worker, and its threads.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub cpu: u32,
    /// Memory of a worker's container, GiB. It plans with three quarters of it.
    #[arg(long, default_value = "8GiB", value_parser = parse_gib)]
    pub memory: u32,
    /// Cache of a worker for parts of the scene, GiB, on the disk of its node.
    #[arg(long, default_value = "20GiB", value_parser = parse_gib)]
    pub cache_size: u32,
    /// Memory of the coordinator's container, GiB: it reads the whole scene once.
    #[arg(long, default_value = "8GiB", value_parser = parse_gib)]
    pub coordinator_memory: u32,
    /// Give each worker a GPU of NVIDIA.
    #[arg(long)]
    pub gpu: bool,
    /// Put workers on nodes that the cloud may take back (GKE, EKS, Karpenter, AKS).
    #[arg(long)]
    pub spot: bool,
    /// How workers and coordinator know each other.
    #[arg(long, value_enum, default_value = "mtls")]
    pub auth: Auth,
    /// Secret with the coordinator's tls.crt, tls.key and ca.crt; NAME-coordinator-tls when absent.
    #[arg(long, value_name = "SECRET")]
    pub coordinator_tls_secret: Option<String>,
    /// Secret with the workers' tls.crt, tls.key and ca.crt; NAME-worker-tls when absent. With
    /// --auth token only its ca.crt is used.
    #[arg(long, value_name = "SECRET")]
    pub worker_tls_secret: Option<String>,
    /// Secret with the tls.crt, tls.key and ca.crt of KEDA; NAME-keda-tls when absent.
    #[arg(long, value_name = "SECRET")]
    pub keda_tls_secret: Option<String>,
    /// Secret with the key `token`; NAME-token when absent.
    #[arg(long, value_name = "SECRET")]
    pub token_secret: Option<String>,
    /// Secret whose keys are environment variables of the object store's credentials. It may be
    /// missing; NAME-store when absent.
    #[arg(long, value_name = "SECRET")]
    pub store_secret: Option<String>,
    /// Port of the object store.
    #[arg(long, default_value_t = 443, value_parser = clap::value_parser!(u16).range(1..))]
    pub store_port: u16,
    /// Service account of the pods, made with the rest; NAME when absent. Clouds tie rights to it.
    #[arg(long, value_name = "ACCOUNT")]
    pub service_account: Option<String>,
    /// A volume that all pods can write (ReadWriteMany), mounted at /shared.
    #[arg(long, value_name = "CLAIM")]
    pub claim: Option<String>,
    /// Namespace of Prometheus, which may read the coordinator's metrics.
    #[arg(long, default_value = "monitoring", value_name = "NAMESPACE")]
    pub prometheus_namespace: String,
    /// Namespace of KEDA, which may ask the coordinator for the number of workers.
    #[arg(long, default_value = "keda", value_name = "NAMESPACE")]
    pub keda_namespace: String,
    /// Write one file an object and a kustomization.yaml into this folder, not to stdout.
    #[arg(long, value_name = "DIR")]
    pub output: Option<PathBuf>,
}

impl Render {
    /// `NAME-part`.
    pub fn named(&self, part: &str) -> String {
        format!("{}-{part}", self.name)
    }

    fn secret(&self, given: Option<&String>, part: &str) -> String {
        given.cloned().unwrap_or_else(|| self.named(part))
    }

    /// Name of the secret with the coordinator's certificate.
    pub fn coordinator_tls(&self) -> String {
        self.secret(self.coordinator_tls_secret.as_ref(), "coordinator-tls")
    }

    /// Name of the secret with the workers' certificate.
    pub fn worker_tls(&self) -> String {
        self.secret(self.worker_tls_secret.as_ref(), "worker-tls")
    }

    /// Name of the secret with KEDA's certificate.
    pub fn keda_tls(&self) -> String {
        self.secret(self.keda_tls_secret.as_ref(), "keda-tls")
    }

    /// Name of the secret with the token.
    pub fn token(&self) -> String {
        self.secret(self.token_secret.as_ref(), "token")
    }

    /// Name of the secret with the object store's credentials.
    pub fn store(&self) -> String {
        self.secret(self.store_secret.as_ref(), "store")
    }

    /// Name of the service account.
    pub fn account(&self) -> String {
        self.service_account.clone().unwrap_or_else(|| self.name.clone())
    }

    /// URL of the coordinator for pods of the namespace.
    pub fn coordinator_url(&self) -> String {
        let scheme = if self.auth == Auth::None { "http" } else { "https" };
        format!("{scheme}://{}:{}", self.named("coordinator"), super::network::COORDINATOR_PORT)
    }
}

/// Whole GiB: `8GiB`, `8Gi` or `8`.
fn parse_gib(text: &str) -> Result<u32, String> {
    let digits = text.trim_end_matches('B').trim_end_matches("Gi");
    match digits.parse() {
        Ok(gib) if (1..=65_536).contains(&gib) => Ok(gib),
        _ => Err("give a whole number of GiB, such as 8GiB".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_whole_gib() {
        assert_eq!(parse_gib("8GiB"), Ok(8));
        assert_eq!(parse_gib("8Gi"), Ok(8));
        assert_eq!(parse_gib("8"), Ok(8));
        assert!(parse_gib("8MiB").is_err() && parse_gib("0").is_err() && parse_gib("8G").is_err());
    }
}
