//! Input and output of bytes: streams, documents, tables, folders; independent of traffic.

#[cfg(feature = "parquet")]
pub(crate) mod columns;
pub(crate) mod files;
pub(crate) mod json;
pub(crate) mod stream;
#[cfg(feature = "parquet")]
pub(crate) mod table;
pub mod tfrecord;
pub(crate) mod write_atomically;
#[cfg(any(feature = "commonroad", feature = "taf-bw"))]
pub(crate) mod xml;
