//! Unpacks a map of OpenStreetMap from PBF to the XML that SUMO's tools read, block by block, and cuts out a part of it.
//!
//! prost decodes the messages; the rest of the format is checked here, so that a damaged file is an error. The crates for the format
//! leave that open: `osmpbf` 0.3 ends an element's tags at a damaged text, `rosm_pbf_reader` 1.0 and `osm_pbf_iter` 0.2 panic.

mod area;
mod blocks;
mod elements;
mod message;
#[cfg(test)]
mod tests;
mod xml;

use std::{
    fs::File,
    io::{self, BufWriter, Read as _},
    path::{Path, PathBuf},
};

use tempfile::TempPath;

use crate::{display::FileProgress, failure::Exit};
pub use area::BoundingBox;
use area::{AreaScan, Selection};
use blocks::PbfBlocks;
use elements::{ElementFault, OsmElement, visit_elements};
use ipc_schema::failure::{Failure, FailureKind};
use xml::OsmXml;

/// How much may be unpacked. A large city stays below; a country, given by mistake, is beyond.
pub(super) struct UnpackLimits {
    /// Bytes of a file that is unpacked whole.
    pub(super) bytes: u64,
    /// Nodes that are written.
    pub(super) nodes: usize,
}

/// A megabyte of PBF has about 100 000 nodes.
const LIMITS: UnpackLimits = UnpackLimits {
    bytes: 200_000_000,
    nodes: 20_000_000,
};

/// Why a map cannot be unpacked.
#[derive(Debug, thiserror::Error)]
pub(super) enum PbfError {
    #[error("cannot read it")]
    Read(#[source] io::Error),
    #[error("cannot write {}", .path.display())]
    Write {
        path: PathBuf,
        #[source]
        cause: io::Error,
    },
    #[error("is no PBF")]
    NotPbf,
    #[error("ends within the block that begins at byte {offset}")]
    Truncated { offset: u64 },
    #[error("is damaged in the block that begins at byte {offset}: {what}")]
    Damaged { offset: u64, what: &'static str },
    #[error("has the feature {feature}, which an import does not know")]
    Feature { feature: String },
    #[error("is packed by {packing}, not by zlib")]
    Packing { packing: &'static str },
    #[error("has {bytes} bytes, more than the {most} that an import unpacks")]
    TooManyBytes { bytes: u64, most: u64 },
    #[error("has more than {most} nodes to import")]
    TooManyNodes { most: usize },
    #[error("has no ways, so no roads")]
    NoWays,
    #[error("has no ways inside --bbox")]
    NoWaysInside,
}

impl PbfError {
    /// The failure as the user sees it.
    fn exit(self, file: &Path) -> Exit {
        let help = match &self {
            Self::Read(error) => return Exit::io("read", file, error),
            Self::Write { path, cause } => return Exit::io("write", path, cause),
            Self::NotPbf => other_format(file),
            Self::Truncated { .. } | Self::Damaged { .. } => {
                "download or export the map again: its transfer ended early or changed it"
            }
            Self::Feature { feature } if feature == "HistoricalInformation" => {
                "take the map of one day out of the history: osmium time-filter FILE.osh.pbf 2026-01-01T00:00:00Z -o FILE.osm.pbf"
            }
            Self::Feature { .. } => "give the map as it comes from OpenStreetMap or Geofabrik, or as .osm",
            Self::Packing { .. } => "pack it anew: osmium cat FILE.osm.pbf -o NEW.osm.pbf -f pbf,pbf_compression=zlib",
            Self::TooManyBytes { .. } | Self::TooManyNodes { .. } => {
                "cut out a part: --bbox west,south,east,north in degrees, or osmium extract -b west,south,east,north \
                 FILE.osm.pbf -o PART.osm.pbf"
            }
            Self::NoWays => "give a map with roads: if its download ended early, download it again",
            Self::NoWaysInside => "give a box where the map has roads: --bbox west,south,east,north in degrees",
        };
        let failure = Failure::from_error(FailureKind::Config, &self);
        Exit::config(format!("{} {}", file.display(), failure.message), help)
    }
}

/// What to do with a file that is no PBF, by how it begins.
fn other_format(file: &Path) -> &'static str {
    let mut begin = Vec::new();
    let read = File::open(file).and_then(|file| file.take(64).read_to_end(&mut begin));
    let begin = begin.trim_ascii_start();
    match read {
        Ok(_) if begin.starts_with(b"<?xml") || begin.starts_with(b"<osm") => {
            "it is XML: if it is a map of OpenStreetMap, rename it to .osm"
        }
        Ok(_) if begin.starts_with(&[0x1f, 0x8b]) => {
            "it is packed by gzip: unpack it, or rename it to .osm.gz if it is XML"
        }
        _ => "give a map of OpenStreetMap (.osm, .osm.gz, .osm.pbf) or OpenDRIVE (.xodr)",
    }
}

/// A map as XML. The file is removed with this value.
#[derive(Debug)]
pub(super) struct UnpackedMap {
    pub(super) path: TempPath,
    pub(super) nodes: usize,
    pub(super) ways: usize,
    pub(super) relations: usize,
}

/// Unpacks a file, or what of it is in `area`, to `destination`.
///
/// # Errors
/// The file is no PBF, is damaged, is too large or has no ways, or the destination cannot be written. Nothing is left of it then.
pub(super) fn unpack(file: &Path, area: Option<&BoundingBox>, destination: &Path) -> Result<UnpackedMap, Exit> {
    unpack_within(file, area, destination, &LIMITS).map_err(|error| error.exit(file))
}

fn unpack_within(
    file: &Path,
    area: Option<&BoundingBox>,
    destination: &Path,
    limits: &UnpackLimits,
) -> Result<UnpackedMap, PbfError> {
    // A file of another format is reported as that, whatever its size.
    drop(PbfBlocks::open(file)?);
    let bytes = std::fs::metadata(file).map_err(PbfError::Read)?.len();
    if area.is_none() && bytes > limits.bytes {
        return Err(PbfError::TooManyBytes {
            bytes,
            most: limits.bytes,
        });
    }
    let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let selection = match area {
        None => None,
        Some(area) => {
            let mut scan = AreaScan::new(area, limits);
            let mut visit = |element: OsmElement<'_>| scan.visit(&element);
            visit_file(
                file,
                &mut FileProgress::new(format!("searching {name}"), bytes),
                &mut visit,
            )?;
            if scan.end_pass() {
                let mut visit = |element: OsmElement<'_>| scan.visit(&element);
                visit_file(
                    file,
                    &mut FileProgress::new(format!("searching {name}"), bytes),
                    &mut visit,
                )?;
            }
            Some(scan.finish())
        }
    };
    let mut progress = FileProgress::new(format!("unpacking {name}"), bytes);
    let map = write_map(file, selection.as_ref(), destination, limits, &mut progress)?;
    match map.ways {
        0 if area.is_some() => Err(PbfError::NoWaysInside),
        0 => Err(PbfError::NoWays),
        _ => Ok(map),
    }
}

/// Writes the elements of a file, or those of `selection`.
fn write_map(
    file: &Path,
    selection: Option<&Selection>,
    destination: &Path,
    limits: &UnpackLimits,
    progress: &mut FileProgress,
) -> Result<UnpackedMap, PbfError> {
    let failed = |cause| PbfError::Write {
        path: destination.to_path_buf(),
        cause,
    };
    let output = File::create_new(destination).map_err(failed)?;
    let mut map = UnpackedMap {
        path: TempPath::try_from_path(destination).map_err(failed)?,
        nodes: 0,
        ways: 0,
        relations: 0,
    };
    let mut xml = OsmXml::begin(BufWriter::new(output)).map_err(failed)?;
    visit_file(file, progress, &mut |element| {
        if selection.is_some_and(|selection| !selection.has(&element)) {
            return Ok(());
        }
        match element {
            OsmElement::Node { .. } => map.nodes += 1,
            OsmElement::Way { .. } => map.ways += 1,
            OsmElement::Relation { .. } => map.relations += 1,
        }
        if map.nodes > limits.nodes {
            return Err(PbfError::TooManyNodes { most: limits.nodes });
        }
        xml.write(&element).map_err(failed)
    })?;
    xml.finish().map_err(failed)?;
    Ok(map)
}

/// Calls `visit` for each element of a file.
fn visit_file(
    file: &Path,
    progress: &mut FileProgress,
    visit: &mut impl FnMut(OsmElement<'_>) -> Result<(), PbfError>,
) -> Result<(), PbfError> {
    let mut blocks = PbfBlocks::open(file)?;
    loop {
        let offset = blocks.offset();
        let Some(block) = blocks.next()? else {
            return Ok(());
        };
        visit_elements(&block, visit).map_err(|fault| match fault {
            ElementFault::Damaged(what) => PbfError::Damaged { offset, what },
            ElementFault::Visitor(error) => error,
        })?;
        progress.update(blocks.offset());
    }
}
