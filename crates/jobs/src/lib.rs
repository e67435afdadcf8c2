//! Bake configuration, plans, task states and pure scheduling.
