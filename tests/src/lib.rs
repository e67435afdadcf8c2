//! End-to-end, golden and architecture tests.
