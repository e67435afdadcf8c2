//! Typed identifiers. A `CellId` is not an `ObjectId` is not a `u32`.

use serde::{Deserialize, Serialize};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(
            Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
        )]
        #[serde(transparent)]
        pub struct $name(pub u32);

        impl $name {
            /// The id as an array index.
            #[must_use]
            pub const fn index(self) -> usize {
                self.0 as usize
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                self.0.fmt(f)
            }
        }
    };
}

id!(
    /// Global number of a primitive (a triangle of one instance, or a particle) in a scene.
    PrimitiveId
);
id!(
    /// Number of an object, in the order of the primitive numbering.
    ObjectId
);
id!(
    /// Number of an instance, in the order of the primitive numbering.
    InstanceId
);
id!(
    /// Number of a mesh: one body of triangles that instances share.
    MeshId
);
id!(
    /// Number of a view cell, in Hilbert order over the view region.
    CellId
);
id!(
    /// Number of a view segment in a plan.
    SegmentId
);
