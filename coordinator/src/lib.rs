//! The coordinator: plans a bake, leases its tasks, publishes the dataset.
