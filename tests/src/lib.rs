//! What the end-to-end, licence and architecture tests stand on: the workspace as cargo sees it,
//! the built commands, processes that never outlive a test, datasets to compare, Kubernetes Jobs run
//! as processes, and requirements that are skipped loudly when this machine lacks them.

pub mod binaries;
pub mod campaign;
pub mod certificates;
pub mod chaos;
pub mod city;
pub mod conformance;
pub mod dataset;
pub mod flaky_proxy;
pub mod fuzzing;
pub mod glb;
pub mod job;
pub mod manifests;
pub mod pods;
pub mod process;
pub mod requirement;
pub mod scenes;
pub mod servers;
pub mod simulation;
pub mod sources;
pub mod tcp_proxy;
pub mod workspace;
