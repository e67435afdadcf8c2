//! What keeps a geometry that is larger than memory within its memory.
//!
//! The arrays of such a geometry are mapped from a file ([`crate::Array`]): what a walk touches is
//! loaded by the operating system, and stays until someone gives it back. This module knows neither
//! files nor systems; it only says when it is time to look. Giving back is allowed at any moment, also
//! while others read: what is touched again is loaded again, with the same content.

use std::fmt;

/// Gives memory back when too much of a geometry is loaded.
pub trait Residency: fmt::Debug + Send + Sync {
    /// Called by whoever walks the geometry, after at most [`STEPS`] steps.
    fn look(&self);
}

/// Steps of a walk (nodes, or what touches about as much) between two looks. A step loads a page or
/// two where nothing is loaded yet.
pub const STEPS: u64 = 1024;
