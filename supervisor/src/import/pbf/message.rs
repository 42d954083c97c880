//! The messages of the PBF format, of which only the fields that an import needs: `fileformat.proto` and `osmformat.proto` of
//! <https://github.com/openstreetmap/OSM-binary>. A field that is required there is optional here, so that a reader can report its absence.

use prost::bytes::Bytes;

/// What stands before each blob.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct BlobHeader {
    #[prost(string, optional, tag = "1")]
    pub(super) kind: Option<String>,
    /// Bytes of the blob.
    #[prost(int32, optional, tag = "3")]
    pub(super) size: Option<i32>,
}

/// A block, mostly packed.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Blob {
    #[prost(bytes = "bytes", optional, tag = "1")]
    pub(super) raw: Option<Bytes>,
    /// Bytes of the block when it is unpacked.
    #[prost(int32, optional, tag = "2")]
    pub(super) unpacked_size: Option<i32>,
    #[prost(bytes = "bytes", optional, tag = "3")]
    pub(super) zlib: Option<Bytes>,
    #[prost(bytes = "bytes", optional, tag = "4")]
    pub(super) lzma: Option<Bytes>,
    #[prost(bytes = "bytes", optional, tag = "5")]
    pub(super) bzip2: Option<Bytes>,
    #[prost(bytes = "bytes", optional, tag = "6")]
    pub(super) lz4: Option<Bytes>,
    #[prost(bytes = "bytes", optional, tag = "7")]
    pub(super) zstd: Option<Bytes>,
}

/// The first block of a file.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct HeaderBlock {
    /// Features without which a program cannot read the file.
    #[prost(string, repeated, tag = "4")]
    pub(super) required_features: Vec<String>,
    #[prost(string, repeated, tag = "5")]
    pub(super) optional_features: Vec<String>,
}

/// Every further block.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct PrimitiveBlock {
    #[prost(message, optional, tag = "1")]
    pub(super) strings: Option<StringTable>,
    #[prost(message, repeated, tag = "2")]
    pub(super) groups: Vec<PrimitiveGroup>,
    /// Unit of the coordinates, nanodegrees.
    #[prost(int32, optional, tag = "17", default = "100")]
    pub(super) granularity: Option<i32>,
    /// Nanodegrees.
    #[prost(int64, optional, tag = "19")]
    pub(super) latitude_offset: Option<i64>,
    /// Nanodegrees.
    #[prost(int64, optional, tag = "20")]
    pub(super) longitude_offset: Option<i64>,
}

/// The texts of a block, UTF-8. Tags and roles are indices into it.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct StringTable {
    #[prost(bytes = "bytes", repeated, tag = "1")]
    pub(super) texts: Vec<Bytes>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct PrimitiveGroup {
    #[prost(message, repeated, tag = "1")]
    pub(super) nodes: Vec<PlainNode>,
    #[prost(message, optional, tag = "2")]
    pub(super) dense: Option<DenseNodes>,
    #[prost(message, repeated, tag = "3")]
    pub(super) ways: Vec<PackedWay>,
    #[prost(message, repeated, tag = "4")]
    pub(super) relations: Vec<PackedRelation>,
}

/// What is known of an element's history.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Info {
    #[prost(int32, optional, tag = "1")]
    pub(super) version: Option<i32>,
    /// Whether the element exists. Absent: it does.
    #[prost(bool, optional, tag = "6")]
    pub(super) visible: Option<bool>,
}

/// [`Info`] of many nodes.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct DenseInfo {
    #[prost(int32, repeated, tag = "1")]
    pub(super) versions: Vec<i32>,
    #[prost(bool, repeated, tag = "6")]
    pub(super) visible: Vec<bool>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct PlainNode {
    #[prost(sint64, optional, tag = "1")]
    pub(super) id: Option<i64>,
    #[prost(uint32, repeated, tag = "2")]
    pub(super) keys: Vec<u32>,
    #[prost(uint32, repeated, tag = "3")]
    pub(super) values: Vec<u32>,
    #[prost(message, optional, tag = "4")]
    pub(super) info: Option<Info>,
    #[prost(sint64, optional, tag = "8")]
    pub(super) latitude: Option<i64>,
    #[prost(sint64, optional, tag = "9")]
    pub(super) longitude: Option<i64>,
}

/// Nodes, column by column. Ids and coordinates are differences to the node before.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct DenseNodes {
    #[prost(sint64, repeated, tag = "1")]
    pub(super) ids: Vec<i64>,
    #[prost(message, optional, tag = "5")]
    pub(super) info: Option<DenseInfo>,
    #[prost(sint64, repeated, tag = "8")]
    pub(super) latitudes: Vec<i64>,
    #[prost(sint64, repeated, tag = "9")]
    pub(super) longitudes: Vec<i64>,
    /// Key, value, key, value, …, 0 of each node in turn; empty if no node has tags.
    #[prost(int32, repeated, tag = "10")]
    pub(super) keys_values: Vec<i32>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct PackedWay {
    #[prost(int64, optional, tag = "1")]
    pub(super) id: Option<i64>,
    #[prost(uint32, repeated, tag = "2")]
    pub(super) keys: Vec<u32>,
    #[prost(uint32, repeated, tag = "3")]
    pub(super) values: Vec<u32>,
    #[prost(message, optional, tag = "4")]
    pub(super) info: Option<Info>,
    /// Ids of its nodes, as differences.
    #[prost(sint64, repeated, tag = "8")]
    pub(super) nodes: Vec<i64>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct PackedRelation {
    #[prost(int64, optional, tag = "1")]
    pub(super) id: Option<i64>,
    #[prost(uint32, repeated, tag = "2")]
    pub(super) keys: Vec<u32>,
    #[prost(uint32, repeated, tag = "3")]
    pub(super) values: Vec<u32>,
    #[prost(message, optional, tag = "4")]
    pub(super) info: Option<Info>,
    #[prost(int32, repeated, tag = "8")]
    pub(super) roles: Vec<i32>,
    /// Ids, as differences.
    #[prost(sint64, repeated, tag = "9")]
    pub(super) members: Vec<i64>,
    /// 0 node, 1 way, 2 relation.
    #[prost(int32, repeated, tag = "10")]
    pub(super) kinds: Vec<i32>,
}
