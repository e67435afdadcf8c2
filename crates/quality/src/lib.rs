//! Pixel error of visible sets against the full scene.
