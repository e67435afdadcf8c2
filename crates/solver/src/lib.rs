//! From-segment visibility: the fast solver and its exact reference twin.
