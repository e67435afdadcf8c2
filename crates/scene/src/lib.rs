//! glTF scenes: reading, validation, numbering, view regions, generators.
