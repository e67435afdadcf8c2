//! The worker: leases tasks, solves them, writes the results.
