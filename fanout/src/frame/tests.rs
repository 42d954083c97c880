use std::collections::BTreeSet;

use bytemuck::{cast_slice, cast_slice_mut};
use ipc_schema::{
    block::view_mut,
    image::{ImageHead, ImageLayout, ImagePlane, SeenObject},
    traffic::id_hash,
};
use proptest::prelude::*;

use super::*;

fn header(shape: [u32; DIMENSIONS]) -> MessageHeader {
    MessageHeader {
        schema_version: ipc_schema::SCHEMA_VERSION,
        run_id: 7,
        tick: 11,
        shape,
        ..MessageHeader::default()
    }
}

fn states(count: usize) -> Vec<VehicleState> {
    (0..count)
        .map(|i| VehicleState {
            x_m: i as f64,
            vehicle: u32::try_from(i).unwrap(),
            id_hash: id_hash(&format!("cav.{i}")),
            ..VehicleState::default()
        })
        .collect()
}

/// A payload as words of 8 bytes, so that sections are aligned as in shared memory.
fn payload(len: usize) -> Vec<u64> {
    (0..len.div_ceil(8) as u64).collect()
}

#[test]
fn world_keeps_every_state_and_no_sub_step() {
    let layout = WorldLayout::new(3, 10);
    let mut words = payload(layout.len);
    let bytes: &mut [u8] = cast_slice_mut(&mut words);
    bytes[..layout.states.len].copy_from_slice(cast_slice(&states(3)));
    let frame = encode(Channel::World, &header(layout.shape), bytes).unwrap();
    let (head, body) = decode(&frame.bytes).unwrap();
    assert_eq!(head, header([3, 0, 0, 3]));
    assert_eq!(body, cast_slice::<_, u8>(&states(3)));
    assert_eq!(frame.left_out, 0);
}

#[test]
fn trailing_bodies_stay_behind_the_road_users_in_a_sample_too() {
    let mut crowd = states(8_000);
    let trailing = crowd.split_off(6_000);
    for state in trailing {
        crowd.push(VehicleState {
            kind: Kind::Trailing as u32,
            ..state
        });
    }
    let frame = encode(Channel::World, &header([6_000, 0, 0, 8_000]), cast_slice(&crowd)).unwrap();
    let (head, body) = decode(&frame.bytes).unwrap();
    let [road_users, _, _, bodies] = head.shape.map(|size| size as usize);
    assert_eq!((bodies, frame.left_out), (5_920, 2_080));
    let kinds: Vec<u32> = body
        .chunks_exact(size_of::<VehicleState>())
        .map(|state| pod_read_unaligned::<VehicleState>(state).kind)
        .collect();
    assert_eq!(kinds.len(), bodies);
    let is_trailing = |kind: &u32| *kind == Kind::Trailing as u32;
    assert!(!kinds[..road_users].iter().any(is_trailing) && kinds[road_users..].iter().all(is_trailing));
    assert!(
        (1_300..1_650).contains(&(bodies - road_users)),
        "{road_users} of {bodies}"
    );
}

#[test]
fn a_crowd_is_sampled_by_id_and_counted() {
    let shown = |crowd: &[VehicleState]| -> BTreeSet<u64> {
        let count = u32::try_from(crowd.len()).unwrap();
        let shape = [count, 0, 0, count];
        let frame = encode(Channel::World, &header(shape), cast_slice(crowd)).unwrap();
        let (head, body) = decode(&frame.bytes).unwrap();
        assert!(frame.bytes.len() <= MAX_FRAME_BYTES);
        assert_eq!((head.rows() + frame.left_out, head.rows()), (crowd.len(), 5_920));
        let rows = body
            .chunks_exact(size_of::<VehicleState>())
            .map(pod_read_unaligned::<VehicleState>);
        rows.map(|state| state.id_hash).collect()
    };
    let mut crowd = states(20_000);
    crowd[7_777].kind = Kind::Hero as u32;
    let before = shown(&crowd);
    assert!(before.contains(&crowd[7_777].id_hash), "heroes are always shown");
    // A tick later some have left and the rows are others: those shown before and still present are shown again.
    crowd.rotate_left(3_333);
    crowd.truncate(19_900);
    let present: BTreeSet<u64> = crowd.iter().map(|state| state.id_hash).collect();
    let after = shown(&crowd);
    assert!(before.intersection(&present).all(|id_hash| after.contains(id_hash)));
    // Over the map they are as evenly spread as all are.
    let western = before.iter().filter(|id_hash| {
        crowd
            .iter()
            .any(|state| state.id_hash == **id_hash && state.x_m < 10_000.0)
    });
    let share = western.count() as f64 / before.len() as f64;
    assert!((0.45..0.55).contains(&share), "{share}");
}

#[test]
fn what_is_known_from_messages_has_the_slots_of_its_observation_and_nothing_that_a_policy_sees() {
    let layout = NeighboursLayout::sized(5, 3, 5, 8);
    let words = payload(layout.len);
    let bytes: &[u8] = cast_slice(&words);
    for chosen in [None, Some(vec![1, 4])] {
        let rows = chosen.clone().unwrap_or_else(|| (0..5).collect());
        let frame = encode_neighbours(&header(layout.shape), bytes, chosen.as_deref()).unwrap();
        let (head, body) = decode(&frame.bytes).unwrap();
        let short = NeighboursLayout::of(&head);
        assert_eq!(head.shape, NeighboursLayout::sized(rows.len(), 3, 0, 0).shape);
        assert_eq!((body.len(), frame.left_out), (short.len, 5 - rows.len()));
        for ((name, from), (_, to)) in layout.named().into_iter().zip(short.named()) {
            if ["speech", "achieved"].contains(&name) {
                assert_eq!(to.len, 0);
                continue;
            }
            let row = to.len / rows.len();
            let kept = rows.iter().flat_map(|slot| &bytes[from.offset + slot * row..][..row]);
            assert!(body[to.offset..][..to.len].iter().eq(kept), "{name}");
        }
    }
    // Of more slots than fit, the first ones.
    let crowd = NeighboursLayout::sized(3_000, 16, 0, 0);
    let words = payload(crowd.len);
    let frame = encode(Channel::Neighbours, &header(crowd.shape), cast_slice(&words)).unwrap();
    assert!((850_000..=MAX_FRAME_BYTES).contains(&frame.bytes.len()));
    assert!(frame.left_out > 1_500);
}

#[test]
fn a_prediction_has_the_slots_of_its_observation() {
    let layout = ObservationLayout::new(10_000, 9, 1);
    let mut words = payload(layout.len);
    let bytes: &mut [u8] = cast_slice_mut(&mut words);
    for slot in 0..10_000_usize {
        let of_id = id_hash(&format!("cav.{slot}")).to_le_bytes();
        bytes[layout.id_hash.offset + 8 * slot..][..8].copy_from_slice(&of_id);
        let vehicle = if slot < 2_000 {
            EMPTY_SLOT
        } else {
            u32::try_from(slot).unwrap()
        };
        bytes[layout.vehicle.offset + 4 * slot..][..4].copy_from_slice(&vehicle.to_le_bytes());
    }
    let observed = encode(Channel::Observation, &header(layout.shape), bytes).unwrap();
    let chosen = chosen_slots(&header(layout.shape), bytes).unwrap().unwrap();
    let (head, body) = decode(&observed.bytes).unwrap();
    let short = ObservationLayout::of(&head);
    assert_eq!((head.rows(), observed.left_out), (chosen.len(), 10_000 - chosen.len()));
    assert!((850_000..=MAX_FRAME_BYTES).contains(&observed.bytes.len()));
    let vehicles: Vec<u32> = body[short.vehicle.offset..][..short.vehicle.len]
        .chunks_exact(4)
        .map(pod_read_unaligned)
        .collect();
    // Of vehicles and empty slots, the vehicles.
    assert!(
        vehicles
            .iter()
            .zip(&chosen)
            .all(|(vehicle, slot)| *vehicle as usize == *slot && *slot >= 2_000)
    );
    for ((_, from), (name, to)) in layout.named().into_iter().zip(short.named()) {
        // Frames carry no images.
        if name == "images" {
            assert_eq!(to.len, 0);
            continue;
        }
        let row = to.len / chosen.len();
        let kept = chosen.iter().map(|slot| &bytes[from.offset + slot * row..][..row]);
        assert!(kept.eq(body[to.offset..][..to.len].chunks_exact(row)), "{name}");
    }
    let layout = PredictionLayout::sized(10_000, 2, 10_000, 10_000);
    let words: Vec<u64> = (0..layout.len as u64 / 8).collect();
    let predicted = encode_prediction(&header(layout.shape), cast_slice(&words), Some(&chosen)).unwrap();
    let (head, body) = decode(&predicted.bytes).unwrap();
    let short = PredictionLayout::of(&head);
    assert_eq!(head.rows(), chosen.len());
    let [(_, first), (_, second), (_, vehicle)] = short.named();
    assert_eq!(vehicle.len, 0, "the observation's frame has the vehicles");
    for (section, begin) in [(first, 0), (second, layout.named()[1].1.offset / 8)] {
        let rows: Vec<u64> = body[section.offset..][..section.len]
            .chunks_exact(8)
            .map(pod_read_unaligned)
            .collect();
        assert!(
            rows.iter()
                .zip(&chosen)
                .all(|(row, slot)| *row == (begin + slot) as u64)
        );
    }
}

#[test]
fn a_dense_scan_is_thinned_and_keeps_where_the_sensor_was() {
    let layout = PointcloudLayout::new(40_000);
    let mut words = payload(layout.len);
    let bytes: &mut [u8] = cast_slice_mut(&mut words);
    let scan = Scan {
        id_hash: 9,
        ..Scan::default()
    };
    bytes[..layout.scan.len].copy_from_slice(bytes_of(&scan));
    let frame = encode(Channel::Pointcloud, &header(layout.shape), bytes).unwrap();
    let (head, body) = decode(&frame.bytes).unwrap();
    let kept = head.rows();
    assert!(frame.bytes.len() <= MAX_SENSOR_BYTES && kept + frame.left_out == 40_000 && kept > 13_000);
    assert_eq!(pod_read_unaligned::<Scan>(&body[..size_of::<Scan>()]), scan);
    assert_eq!(body.len(), layout.points.offset + kept * size_of::<LidarPoint>());
}

/// An image of `width` × `height` pixels with these planes, whose bytes are numbered, and one road user in columns 600 to 900.
fn image(width: u32, height: u32, planes: &[ImagePlane]) -> (ImageLayout, Vec<u64>) {
    let bytes_of_planes: usize = planes.iter().map(|plane| plane.pixel_bytes()).sum();
    let layout = ImageLayout::new(1, bytes_of_planes * (width * height) as usize, 0);
    let mut words = payload(layout.len);
    let bytes: &mut [u8] = cast_slice_mut(&mut words);
    view_mut::<ImageHead>(bytes, layout.head).unwrap()[0] = ImageHead {
        id_hash: 9,
        width,
        height,
        planes: planes.iter().map(|plane| plane.bit()).sum(),
        focal_px: 600.0,
        range_m: 150.0,
        ..ImageHead::default()
    };
    view_mut::<SeenObject>(bytes, layout.objects).unwrap()[0] = SeenObject {
        object: 7,
        visible_px: 9_000,
        visible_box_px: [600, 30, 900, 60],
        full_box_px: [-30.0, 30.0, 900.0, 61.5],
        depth_m: [20.0, 24.0],
        ..SeenObject::default()
    };
    (layout, words)
}

#[test]
fn an_image_that_fits_goes_out_as_it_is() {
    let (layout, words) = image(84, 84, &ImagePlane::ALL);
    let bytes: &[u8] = cast_slice(&words);
    let frame = encode(Channel::Image, &header(layout.shape), bytes).unwrap();
    assert_eq!(
        decode(&frame.bytes).unwrap(),
        (header(layout.shape), &bytes[..layout.len])
    );
    assert_eq!(frame.left_out, 0);
}

/// Of a large image one plane remains, and of that the pixel amid each block; whatever is in pixels is in those of the frame's image.
#[test]
fn an_image_that_does_not_fit_has_one_plane_and_fewer_pixels() {
    use ImagePlane::{Binary, Depth, Infrared, Instance, Rgb, Semantic};
    for (planes, kept, before, factor) in [
        (&ImagePlane::ALL[..], Rgb, 19, 2),
        (&[Depth, Instance, Infrared], Infrared, 8, 2),
        (&[Depth, Instance, Semantic], Semantic, 8, 1),
        (&[Depth, Instance, Binary], Depth, 0, 2),
        (&[Instance, Binary], Binary, 4, 1),
        (&[Instance], Instance, 0, 2),
    ] {
        let (width, height) = (1_001, 435);
        let (layout, words) = image(width, height, planes);
        let bytes: &[u8] = cast_slice(&words);
        let frame = encode(Channel::Image, &header(layout.shape), bytes).unwrap();
        assert!(frame.bytes.len() <= MAX_SENSOR_BYTES);
        let (head, body) = decode(&frame.bytes).unwrap();
        let found = ImageLayout::of(&head);
        let shown: ImageHead = pod_read_unaligned(&body[..size_of::<ImageHead>()]);
        assert_eq!(
            (shown.width, shown.height, shown.planes),
            (width / factor, height / factor, kept.bit())
        );
        assert_eq!(
            (shown.id_hash, shown.focal_px, shown.range_m),
            (9, 600.0 / factor as f32, 150.0)
        );
        // Pixel by pixel.
        let pixel = kept.pixel_bytes();
        let whole = &bytes[layout.planes.offset + before * (width * height) as usize..];
        let pixels = &body[found.planes.offset..found.planes.offset + found.planes.len];
        assert_eq!(pixels.len(), (shown.width * shown.height) as usize * pixel);
        assert_eq!(frame.left_out, layout.planes.len - pixels.len());
        for (index, value) in pixels.chunks_exact(pixel).enumerate() {
            let (row, column) = (index as u32 / shown.width, index as u32 % shown.width);
            let place = (row * factor + factor / 2) * width + column * factor + factor / 2;
            assert_eq!(
                value,
                &whole[place as usize * pixel..][..pixel],
                "{planes:?} {row} {column}"
            );
        }
        // The road user.
        let object: SeenObject = pod_read_unaligned(&body[found.objects.offset..][..size_of::<SeenObject>()]);
        let factor_px = factor as u16;
        assert_eq!(
            object.visible_box_px,
            [600, 30, 900, 60].map(|edge: u16| edge / factor_px)
        );
        assert_eq!(
            object.full_box_px,
            [-30.0, 30.0, 900.0, 61.5].map(|edge: f32| edge / factor as f32)
        );
        assert_eq!((object.object, object.depth_m), (7, [20.0, 24.0]));
        assert_eq!(object.visible_px, 9_000 / (factor * factor));
    }
}

#[test]
fn an_image_whose_planes_do_not_have_its_size_is_refused() {
    let planes = [ImagePlane::Rgb, ImagePlane::Semantic];
    for change in [
        |head: &mut ImageHead| head.width += 1,
        |head: &mut ImageHead| head.height = u32::MAX,
        |head: &mut ImageHead| head.planes |= ImagePlane::Depth.bit(),
        |head: &mut ImageHead| head.planes = 0,
    ] {
        let (layout, mut words) = image(40, 30, &planes);
        let bytes: &mut [u8] = cast_slice_mut(&mut words);
        change(&mut view_mut::<ImageHead>(bytes, layout.head).unwrap()[0]);
        assert_eq!(
            encode(Channel::Image, &header(layout.shape), bytes),
            Err(FrameError::Image)
        );
    }
}

#[test]
fn the_detections_of_a_radar_go_out_as_they_are() {
    let layout = RadarLayout::new(ipc_schema::radar::MOST_DETECTIONS);
    let words = payload(layout.len);
    let bytes = &cast_slice::<_, u8>(&words)[..layout.detections.offset + layout.detections.len];
    let frame = encode(Channel::Radar, &header(layout.shape), cast_slice(&words)).unwrap();
    let (head, body) = decode(&frame.bytes).unwrap();
    assert_eq!(
        (head, &body[..size_of::<RadarScan>()]),
        (header(layout.shape), &bytes[..size_of::<RadarScan>()])
    );
    assert_eq!(body[layout.detections.offset..], bytes[layout.detections.offset..]);
}

/// The frame holds as many slots as fit.
#[test]
fn long_observations_are_cut_to_the_slots_that_fit() {
    let layout = ObservationLayout::new(20_000, 9, 1);
    let words = payload(layout.len);
    let frame = encode(Channel::Observation, &header(layout.shape), cast_slice(&words)).unwrap();
    let (head, body) = decode(&frame.bytes).unwrap();
    let short = ObservationLayout::of(&head);
    assert_eq!(head.rows() + frame.left_out, 20_000);
    assert!(
        (850_000..=MAX_FRAME_BYTES).contains(&frame.bytes.len()),
        "{}",
        frame.bytes.len()
    );
    assert_eq!(body.len(), short.len);
}

#[test]
fn a_header_that_promises_too_much_is_refused() {
    for channel in [
        Channel::World,
        Channel::Observation,
        Channel::Prediction,
        Channel::Event,
        Channel::Pointcloud,
        Channel::Image,
        Channel::Radar,
    ] {
        for columns in [1, 9, u32::MAX] {
            for more in [0, 1, u32::MAX] {
                // The states of a world are counted by the last dimension.
                let bodies = |rows: u32| if channel == Channel::World { rows } else { 0 };
                let promised = |rows: u32| header([rows, columns, more, bodies(rows)]);
                let error = encode(channel, &promised(100), &[0; 64]).unwrap_err();
                assert!(matches!(error, FrameError::Block(_)), "{error}");
                assert!(encode(channel, &promised(u32::MAX), &[0; 64]).is_err());
            }
        }
    }
    assert!(decode(&[0; HEADER_BYTES - 1]).is_none());
}

#[test]
fn a_long_table_goes_out_in_parts_that_make_the_whole() {
    let rows: Vec<u8> = (0..10_000_u64)
        .flat_map(|i| [i; 19])
        .flat_map(u64::to_le_bytes)
        .collect();
    let (mut next_row, mut parts) = (0, Vec::new());
    for _ in 0..2 {
        let (part, whole) = table(&header([0, 3, 0, 0]), &rows, 152, &mut next_row);
        assert!(part.len() <= MAX_FRAME_BYTES);
        assert_eq!(decode(&whole).unwrap(), (header([10_000, 0, 0, 0]), rows.as_slice()));
        let (head, body) = decode(&part).unwrap();
        assert_eq!(head.rows() * 152, body.len());
        parts.extend_from_slice(body);
    }
    assert_eq!(parts, rows);
    assert_eq!(next_row, 10_000);
    assert_eq!(
        decode(&table(&header([0; DIMENSIONS]), &[], 152, &mut next_row).0)
            .unwrap()
            .0
            .rows(),
        0
    );
}

proptest! {
    #[test]
    fn frames_come_back_as_they_were(n in 0_usize..200, d in 1_u32..12, estimates in any::<bool>()) {
        let observed = header(ObservationLayout::new(n, d as usize, 0).shape);
        let predicted = MessageHeader {
            policy_version: 1 << 40,
            ..header(PredictionLayout::new(n, d as usize, estimates).shape)
        };
        let lengths = [ObservationLayout::of(&observed).len, PredictionLayout::of(&predicted).len];
        for (channel, header, len) in [(Channel::Observation, observed, lengths[0]), (Channel::Prediction, predicted, lengths[1])] {
            let words = payload(len);
            let bytes = &cast_slice::<_, u8>(&words)[..len];
            let frame = encode(channel, &header, bytes).unwrap();
            prop_assert_eq!(decode(&frame.bytes).unwrap(), (header, bytes));
        }
    }

    /// No content of shared memory, however wrong, ends the fan-out.
    #[test]
    fn random_content_is_an_error_and_no_panic(header in prop::array::uniform24(any::<u32>()), len in 0_usize..40) {
        let header: MessageHeader = bytemuck::cast(header);
        let words = vec![u64::MAX; 8 * len];
        for channel in Channel::ALL {
            let _ = encode(channel, &header, cast_slice(&words));
        }
    }
}
