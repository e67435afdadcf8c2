//! Closed meshes, which must not leak.
