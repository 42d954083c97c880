//! Maps that are packed here, field by field: what comes out of them, and what is refused.

use std::{fs, io::Write as _};

use flate2::{Compression, write::ZlibEncoder};
use prost::Message;

use super::{
    message::{
        Blob, BlobHeader, DenseInfo, DenseNodes, HeaderBlock, Info, PackedRelation, PackedWay, PlainNode,
        PrimitiveBlock, PrimitiveGroup, StringTable,
    },
    *,
};

/// Indices of [`block`]'s texts.
const HIGHWAY: u32 = 1;
const RESIDENTIAL: u32 = 2;
const NAME: u32 = 3;
const ODD: u32 = 4;
const INNER: i32 = 5;

/// A block of elements with the texts above.
fn block(group: PrimitiveGroup) -> PrimitiveBlock {
    let texts = ["", "highway", "residential", "name", "<\"A&B\">\n\u{1}ß", "inner"];
    PrimitiveBlock {
        strings: Some(StringTable {
            texts: texts.iter().map(|text| text.as_bytes().into()).collect(),
        }),
        groups: vec![group],
        ..Default::default()
    }
}

/// A length, a header and a blob.
fn framed(kind: &str, blob: &Blob) -> Vec<u8> {
    let blob = blob.encode_to_vec();
    let header = BlobHeader {
        kind: Some(kind.to_owned()),
        size: Some(i32::try_from(blob.len()).unwrap()),
    }
    .encode_to_vec();
    let length = u32::try_from(header.len()).unwrap().to_be_bytes();
    [&length[..], &header, &blob].concat()
}

fn deflated(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// A block as most programs write it.
fn packed(kind: &str, message: &impl Message) -> Vec<u8> {
    let bytes = message.encode_to_vec();
    let blob = Blob {
        unpacked_size: Some(i32::try_from(bytes.len()).unwrap()),
        zlib: Some(deflated(&bytes).into()),
        ..Default::default()
    };
    framed(kind, &blob)
}

/// A block that is not packed, and so has no checksum.
fn raw(kind: &str, message: &impl Message) -> Vec<u8> {
    let blob = Blob {
        raw: Some(message.encode_to_vec().into()),
        ..Default::default()
    };
    framed(kind, &blob)
}

fn header(required: &[&str], optional: &[&str]) -> Vec<u8> {
    let owned = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
    let header = HeaderBlock {
        required_features: owned(required),
        optional_features: owned(optional),
    };
    packed("OSMHeader", &header)
}

fn usual_header() -> Vec<u8> {
    header(&["OsmSchema-V0.6", "DenseNodes"], &["Sort.Type_then_ID"])
}

/// Nodes 1, 2, … at these latitudes and longitudes, 10⁻⁷ degrees.
fn nodes(places: &[(i64, i64)]) -> PrimitiveGroup {
    let steps = |values: Vec<i64>| {
        let before = std::iter::once(0).chain(values.clone());
        values
            .iter()
            .zip(before)
            .map(|(value, before)| value - before)
            .collect()
    };
    PrimitiveGroup {
        dense: Some(DenseNodes {
            ids: vec![1; places.len()],
            latitudes: steps(places.iter().map(|place| place.0).collect()),
            longitudes: steps(places.iter().map(|place| place.1).collect()),
            ..Default::default()
        }),
        ..Default::default()
    }
}

/// A street with an id and nodes, the latter as differences.
fn street(id: i64, nodes: &[i64]) -> PackedWay {
    PackedWay {
        id: Some(id),
        keys: vec![HIGHWAY],
        values: vec![RESIDENTIAL],
        nodes: nodes.to_vec(),
        ..Default::default()
    }
}

fn streets(ways: &[PackedWay]) -> PrimitiveGroup {
    PrimitiveGroup {
        ways: ways.to_vec(),
        ..Default::default()
    }
}

/// A relation of nodes (kind 0), ways (1) or relations (2).
fn relation(id: i64, kind: i32, members: &[i64]) -> PackedRelation {
    PackedRelation {
        id: Some(id),
        roles: vec![INNER; members.len()],
        members: members.to_vec(),
        kinds: vec![kind; members.len()],
        ..Default::default()
    }
}

/// Header, two nodes, and a street between them.
fn small_map() -> [Vec<u8>; 3] {
    let way = streets(&[street(7, &[1, 1])]);
    [
        usual_header(),
        packed("OSMData", &block(nodes(&[(10, 20), (30, 40)]))),
        packed("OSMData", &block(way)),
    ]
}

/// What a file of these bytes is unpacked to. Nothing may be left of the destination.
fn unpacked_part(bytes: &[u8], area: Option<&str>, limits: &UnpackLimits) -> Result<String, PbfError> {
    let directory = tempfile::tempdir().unwrap();
    let (file, destination) = (directory.path().join("map.osm.pbf"), directory.path().join("map.osm"));
    fs::write(&file, bytes).unwrap();
    let area = area.map(|area| area.parse::<BoundingBox>().unwrap());
    let map = unpack_within(&file, area.as_ref(), &destination, limits);
    let text = map.map(|map| fs::read_to_string(&map.path).unwrap());
    assert!(!destination.exists());
    text
}

fn unpacked(bytes: &[u8]) -> Result<String, PbfError> {
    unpacked_part(bytes, None, &LIMITS)
}

/// The failure of a file as the user reads it, message and help.
fn said(bytes: &[u8]) -> String {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("map.osm.pbf");
    fs::write(&file, bytes).unwrap();
    let exit = unpack(&file, None, &directory.path().join("map.osm")).unwrap_err();
    let Exit::Failure(failure) = &exit else {
        panic!("{exit:?}")
    };
    assert_eq!(failure.kind, FailureKind::Config, "{failure:?}");
    let (message, help) = exit.summary();
    format!("{message}; {}", help.unwrap())
}

fn elements(xml: &str) -> Vec<&str> {
    let lines = xml.lines().map(str::trim);
    lines
        .filter(|line| ["<node", "<way", "<relation"].iter().any(|name| line.starts_with(name)))
        .map(|line| line.split('"').nth(1).unwrap())
        .collect()
}

#[test]
fn every_kind_of_element_becomes_xml() {
    let dense = DenseNodes {
        ids: vec![5, -8, 1],
        info: Some(DenseInfo {
            versions: vec![3, -1, 1],
            visible: vec![true, true, false],
        }),
        latitudes: vec![520_390_294, -1_040_780_588, 1],
        longitudes: vec![5, -12, 1],
        keys_values: vec![NAME as i32, ODD as i32, 0, 0, HIGHWAY as i32, RESIDENTIAL as i32, 0],
    };
    let group = PrimitiveGroup {
        nodes: vec![PlainNode {
            id: Some(-1),
            latitude: Some(900_000_000),
            longitude: Some(-1_800_000_000),
            ..Default::default()
        }],
        dense: Some(dense),
        ways: vec![PackedWay {
            info: Some(Info {
                version: Some(2),
                visible: Some(true),
            }),
            ..street(-9, &[5, -8])
        }],
        relations: vec![PackedRelation {
            keys: vec![NAME],
            values: vec![HIGHWAY],
            kinds: vec![0, 1, 2],
            ..relation(4, 0, &[5, -14, 10])
        }],
    };
    let xml = unpacked(&[usual_header(), raw("OSMData", &block(group))].concat()).unwrap();
    let expected = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<osm version=\"0.6\" generator=\"caraware\">\n \
         <node id=\"-1\" visible=\"true\" lat=\"90.0000000\" lon=\"-180.0000000\"/>\n \
         <node id=\"5\" visible=\"true\" version=\"3\" lat=\"52.0390294\" lon=\"0.0000005\">\n  \
         <tag k=\"name\" v=\"&lt;&quot;A&amp;B&quot;&gt;&#10;\u{fffd}ß\"/>\n \
         </node>\n \
         <node id=\"-3\" visible=\"true\" lat=\"-52.0390294\" lon=\"-0.0000007\"/>\n \
         <way id=\"-9\" visible=\"true\" version=\"2\">\n  \
         <nd ref=\"5\"/>\n  <nd ref=\"-3\"/>\n  <tag k=\"highway\" v=\"residential\"/>\n \
         </way>\n \
         <relation id=\"4\" visible=\"true\">\n  \
         <member type=\"node\" ref=\"5\" role=\"inner\"/>\n  \
         <member type=\"way\" ref=\"-9\" role=\"inner\"/>\n  \
         <member type=\"relation\" ref=\"1\" role=\"inner\"/>\n  <tag k=\"name\" v=\"highway\"/>\n \
         </relation>\n</osm>\n";
    assert_eq!(xml, expected);
}

#[test]
fn places_are_in_the_unit_of_their_block() {
    let place = |granularity: i32, offset: i64, latitude: i64| {
        let data = PrimitiveBlock {
            granularity: Some(granularity),
            latitude_offset: Some(offset),
            ..block(PrimitiveGroup {
                ways: vec![street(7, &[1])],
                ..nodes(&[(latitude, 0)])
            })
        };
        let xml = unpacked(&[usual_header(), packed("OSMData", &data)].concat()).unwrap();
        let (_, rest) = xml.split_once("lat=\"").unwrap();
        rest.split_once('"').unwrap().0.to_owned()
    };
    assert_eq!(place(100, 0, 123_456_789), "12.3456789");
    assert_eq!(place(1000, 1_000_000_000, -3_000_001), "-2.0000010");
    // Nanodegrees are rounded to the nearest unit.
    assert_eq!(place(1, 0, 149), "0.0000001");
    assert_eq!(place(1, 0, 150), "0.0000002");
    assert_eq!(place(1, 0, -150), "-0.0000002");
}

#[test]
fn a_file_that_ends_early_is_refused() {
    let map = small_map();
    let bytes = map.concat();
    assert_eq!(elements(&unpacked(&bytes).unwrap()), ["1", "2", "7"]);
    let begins = [0, map[0].len(), map[0].len() + map[1].len()];
    for length in 0..bytes.len() {
        let error = unpacked(&bytes[..length]).unwrap_err();
        let begin = begins.into_iter().rev().find(|begin| *begin <= length).unwrap();
        let is_right = match error {
            // Its first bytes may be those of anything.
            PbfError::NotPbf => length < 4,
            PbfError::NoWays => length == begin,
            PbfError::Truncated { offset } => offset == begin as u64,
            _ => false,
        };
        assert!(is_right, "{length} of {begins:?}: {error:?}");
    }
}

/// A few bits of a blob that is stored rather than deflated have no meaning.
#[test]
fn no_flipped_bit_changes_a_packed_map_without_an_error() {
    let bytes = small_map().concat();
    let map = unpacked(&bytes).unwrap();
    for bit in 0..bytes.len() * 8 {
        let mut flipped = bytes.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        match unpacked(&flipped) {
            Ok(text) => assert_eq!(text, map, "bit {} of byte {}", bit % 8, bit / 8),
            Err(error) => assert!(
                !matches!(error, PbfError::Read(_) | PbfError::Write { .. }),
                "{error:?}"
            ),
        }
    }
}

/// Without a checksum a changed bit may give another map, but no panic.
#[test]
fn flipped_bits_of_an_unpacked_block_are_read_or_refused() {
    let group = PrimitiveGroup {
        relations: vec![relation(4, 1, &[7])],
        ways: vec![street(7, &[1, 1])],
        ..nodes(&[(10, 20), (30, 40)])
    };
    let [header, data] = [usual_header(), raw("OSMData", &block(group))];
    let (mut read, mut refused) = (0, 0);
    for bit in 0..data.len() * 8 {
        let mut flipped = data.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        match unpacked(&[&header[..], &flipped].concat()) {
            Ok(_) => read += 1,
            Err(PbfError::Read(_) | PbfError::Write { .. }) => panic!("bit {bit}"),
            Err(_) => refused += 1,
        }
    }
    assert!(read > 100 && refused > 100, "{read} read, {refused} refused");
}

#[test]
fn a_block_that_contradicts_itself_is_refused() {
    let dense = |change: &dyn Fn(&mut DenseNodes)| {
        let mut group = nodes(&[(10, 20), (30, 40)]);
        change(group.dense.as_mut().unwrap());
        group
    };
    let way = |change: &dyn Fn(&mut PackedWay)| {
        let mut way = street(7, &[1, 1]);
        change(&mut way);
        streets(&[way])
    };
    let of = |change: &dyn Fn(&mut PackedRelation)| {
        let mut relation = relation(4, 1, &[7]);
        change(&mut relation);
        PrimitiveGroup {
            relations: vec![relation],
            ..Default::default()
        }
    };
    let node = PrimitiveGroup {
        nodes: vec![PlainNode::default()],
        ..Default::default()
    };
    for (group, part) in [
        (node, "no id or no place"),
        (dense(&|nodes| nodes.latitudes = vec![1]), "as many places"),
        (dense(&|nodes| nodes.ids.push(1)), "as many places"),
        (dense(&|nodes| nodes.latitudes[1] = 900_000_000), "not on the globe"),
        (dense(&|nodes| nodes.longitudes[0] = i64::MAX), "not on the globe"),
        (dense(&|nodes| nodes.latitudes[0] = i64::MIN / 2), "not on the globe"),
        (dense(&|nodes| nodes.ids = vec![i64::MAX, 1]), "out of range"),
        (dense(&|nodes| nodes.keys_values = vec![0]), "no end"),
        (dense(&|nodes| nodes.keys_values = vec![1, 2]), "no end"),
        (dense(&|nodes| nodes.keys_values = vec![0, 1]), "no value"),
        (dense(&|nodes| nodes.keys_values = vec![0, 0, 0]), "more tags"),
        (dense(&|nodes| nodes.keys_values = vec![1, 99, 0, 0]), "text is missing"),
        (dense(&|nodes| nodes.keys_values = vec![-1, 1, 0, 0]), "text is missing"),
        (
            dense(&|nodes| {
                nodes.info = Some(DenseInfo {
                    versions: vec![1],
                    ..Default::default()
                });
            }),
            "as many versions",
        ),
        (way(&|way| way.id = None), "no id"),
        (way(&|way| way.nodes = vec![i64::MIN, -1]), "out of range"),
        (way(&|way| way.keys = vec![1, 1]), "as many values"),
        (way(&|way| way.values = vec![u32::MAX]), "text is missing"),
        (of(&|relation| relation.id = None), "no id"),
        (of(&|relation| relation.roles = vec![]), "as many roles"),
        (of(&|relation| relation.roles = vec![-1]), "text is missing"),
        (of(&|relation| relation.kinds = vec![3]), "no kind"),
    ] {
        let offset = usual_header().len() as u64;
        let error = unpacked(&[usual_header(), packed("OSMData", &block(group))].concat()).unwrap_err();
        let PbfError::Damaged { offset: begin, what } = error else {
            panic!("{part}: {error:?}")
        };
        assert!(begin == offset && what.contains(part), "{part}: {what}");
    }
    let mut texts = block(streets(&[street(7, &[1])]));
    texts.strings.as_mut().unwrap().texts.push(vec![0xff].into());
    let said = said(&[usual_header(), packed("OSMData", &texts)].concat());
    assert!(
        said.contains("not UTF-8") && said.contains("download or export the map again"),
        "{said}"
    );
}

#[test]
fn a_blob_is_as_long_as_it_says() {
    let message = block(streets(&[street(7, &[1])])).encode_to_vec();
    let length = i32::try_from(message.len()).unwrap();
    for size in [
        None,
        Some(-1),
        Some(0),
        Some(length - 1),
        Some(length + 1),
        Some(i32::MAX),
    ] {
        let blob = Blob {
            unpacked_size: size,
            zlib: Some(deflated(&message).into()),
            ..Default::default()
        };
        let error = unpacked(&[usual_header(), framed("OSMData", &blob)].concat()).unwrap_err();
        assert!(matches!(error, PbfError::Damaged { .. }), "{size:?}: {error:?}");
    }
    // A blob of a gigabyte would need it in memory.
    let header = BlobHeader {
        kind: Some("OSMData".to_owned()),
        size: Some(1 << 30),
    }
    .encode_to_vec();
    let long = [
        &u32::try_from(header.len()).unwrap().to_be_bytes()[..],
        &header,
        &[0; 99],
    ]
    .concat();
    let error = unpacked(&[usual_header(), long].concat()).unwrap_err();
    assert!(
        matches!(error, PbfError::Damaged { what: "its length", .. }),
        "{error:?}"
    );
}

#[test]
fn what_a_reader_must_know_and_does_not_is_named() {
    for (header, parts) in [
        (
            header(&["OsmSchema-V0.6", "HistoricalInformation"], &[]),
            ["HistoricalInformation", "osmium time-filter"],
        ),
        (header(&["Future"], &[]), ["Future", "as it comes from OpenStreetMap"]),
        (
            header(&["OsmSchema-V0.6"], &["LocationsOnWays"]),
            ["LocationsOnWays", "as it comes from OpenStreetMap"],
        ),
    ] {
        let said = said(&[header, small_map()[1..].concat()].concat());
        assert!(parts.iter().all(|part| said.contains(part)), "{said}");
    }
    let blob = Blob {
        unpacked_size: Some(9),
        zstd: Some(vec![1, 2, 3].into()),
        ..Default::default()
    };
    let said = said(&[usual_header(), framed("OSMData", &blob)].concat());
    assert!(
        said.contains("packed by Zstandard") && said.contains("pbf_compression=zlib"),
        "{said}"
    );
}

#[test]
fn a_file_of_another_format_is_named() {
    let gzip = [0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 3];
    for (bytes, part) in [
        (&b""[..], "give a map"),
        (b"no map at all, but a text", "give a map"),
        (b"\n<?xml version=\"1.0\"?><osm/>", "rename it to .osm"),
        (b"<osm version=\"0.6\"/>", "rename it to .osm"),
        (&gzip, "packed by gzip"),
        (&[0; 100], "give a map"),
        (&small_map()[1], "give a map"),
    ] {
        let said = said(bytes);
        assert!(said.contains("map.osm.pbf is no PBF") && said.contains(part), "{said}");
    }
}

#[test]
fn a_whole_country_is_refused() {
    let map = small_map().concat();
    let bytes = map.len() as u64;
    let limits = |bytes, nodes| UnpackLimits { bytes, nodes };
    assert!(unpacked_part(&map, None, &limits(bytes, 2)).is_ok());
    let error = unpacked_part(&map, None, &limits(bytes - 1, 2)).unwrap_err();
    assert!(matches!(error, PbfError::TooManyBytes { .. }), "{error:?}");
    let (said, help) = error.exit(Path::new("land.osm.pbf")).summary();
    assert!(said.contains("land.osm.pbf has"), "{said}");
    let help = help.unwrap();
    assert!(help.contains("--bbox") && help.contains("osmium extract"), "{help}");
    let error = unpacked_part(&map, None, &limits(bytes, 1)).unwrap_err();
    assert!(matches!(error, PbfError::TooManyNodes { most: 1 }), "{error:?}");
    // A part of a large file is imported, if it is small.
    let part = "0,0,0.000002,0.000001";
    assert!(unpacked_part(&map, Some(part), &limits(1, 2)).is_ok());
    let all = unpacked_part(&map, Some("0,0,1,1"), &limits(1, 1)).unwrap_err();
    assert!(matches!(all, PbfError::TooManyNodes { most: 1 }), "{all:?}");
}

/// Nodes 1 to 5 along a parallel, 10⁻⁶ degrees apart; the box has 2 and 3, of which 3 is on its border.
const LINE: [(i64, i64); 5] = [(0, 10), (0, 20), (0, 30), (0, 40), (0, 50)];
const LINE_PART: &str = "0.0000015,-1,0.000003,1";

#[test]
fn a_part_has_its_ways_with_all_their_nodes() {
    let ways = streets(&[
        street(71, &[1, 1]),  // 1, 2: crosses the border
        street(72, &[3, 1]),  // 3, 4: begins on the border
        street(73, &[4, 1]),  // 4, 5: outside
        street(74, &[1, 98]), // 1, 99: outside and unknown
    ]);
    let relations = PrimitiveGroup {
        relations: vec![
            relation(81, 1, &[74, -3]), // 74, 71
            relation(82, 1, &[73]),
            relation(83, 0, &[2]),
            relation(84, 0, &[1]), // a node outside, although a way brings it
            relation(85, 2, &[81]),
        ],
        ..Default::default()
    };
    let [nodes, ways, relations] = [nodes(&LINE), ways, relations].map(|group| packed("OSMData", &block(group)));
    let parts = [&usual_header()[..], &nodes, &ways, &relations].concat();
    let kept = ["1", "2", "3", "4", "71", "72", "81", "83"];
    assert_eq!(
        elements(&unpacked_part(&parts, Some(LINE_PART), &LIMITS).unwrap()),
        kept
    );
    // The same elements in another order.
    let mixed = [&usual_header()[..], &relations, &ways, &nodes].concat();
    let kept = ["81", "83", "71", "72", "1", "2", "3", "4"];
    assert_eq!(
        elements(&unpacked_part(&mixed, Some(LINE_PART), &LIMITS).unwrap()),
        kept
    );
    // A box that has everything changes nothing but the relation of an unknown part of the map.
    let all = unpacked_part(&parts, Some("-180,-90,180,90"), &LIMITS).unwrap();
    assert_eq!(elements(&all).len(), elements(&unpacked(&parts).unwrap()).len() - 1);
    let error = unpacked_part(&parts, Some("1,1,2,2"), &LIMITS).unwrap_err();
    assert!(matches!(error, PbfError::NoWaysInside), "{error:?}");
}

#[test]
fn a_box_has_four_borders_in_order() {
    assert!("-13.5, 51,13.6,52.0".parse::<BoundingBox>().is_ok());
    for (text, part) in [
        ("", "west,south,east,north"),
        ("1,2,3", "west,south,east,north"),
        ("1,2,3,4,5", "west,south,east,north"),
        ("1,2,3,north", "west,south,east,north"),
        ("2,2,1,3", "west must be less"),
        ("1,3,2,2", "west must be less"),
        ("51,13,52,94", "94 is not in [-90, 90]"),
        ("NaN,1,2,3", "NaN is not in"),
        ("0,0,inf,1", "inf is not in"),
    ] {
        let said = text.parse::<BoundingBox>().unwrap_err();
        assert!(said.contains(part), "{text}: {said}");
    }
}
