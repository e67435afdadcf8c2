//! The cluster protocol: generated gRPC code and conversions.
