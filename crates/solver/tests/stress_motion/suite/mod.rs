//! The stress suite for what moves: scenes made to break floating point, and what judges the solver.
//!
//! Three layers look at every pixel of a case:
//!
//! 1. The solver: the visibility intervals of the pixel, [`sightline_solver::visit_intervals`].
//! 2. [`judge`]: who is nearest at chosen times, in `f64` with a bound on every number; where that does
//!    not decide, in rational arithmetic.
//! 3. [`sightline_solver::reference::motion`]: the whole pixel with real algebraic numbers, for samples.
//!
//! A disagreement is *explained* when a derived bound covers it: the solver's answer is right for
//! primitives moved by no more than the bound. Anything else is *unexplained*, and a bug of the solver
//! or of the judge.
//!
//! [`families`] and [`balls`] hold the scenes, functions of a seed; [`shells`] the closed meshes, which
//! have no bound to hide behind; [`quadratics`] the equations under all of them. Random numbers, poses and
//! shapes are those of the suite for what rests.

#[path = "../../stress/suite/case.rs"]
pub mod case;
#[path = "../../stress/suite/closed.rs"]
pub mod closed;
#[path = "../../stress/suite/random.rs"]
pub mod random;

pub mod balls;
pub mod families;
pub mod judge;
pub mod quadratics;
pub mod scene;
pub mod shells;
pub mod shuffle;
pub mod verdict;
