//! One scan: splits the tick into spans, gathers candidates, draws surfaces and writes returns.

use ipc_schema::{
    config::OWN_SENSOR,
    pointcloud::{LidarPoint, Scan},
};

use super::{
    LidarModel, Targets,
    candidates::{CandidateKind, Candidates, SensorSweep, SpanCandidate},
    firing::{ColumnSpan, SPAN},
    pattern::RayGroup,
    random::ScanKey,
    raster::{LinearValue, ScanCanvas, SpanWall, SurfaceBody},
    sensor::SensorPose,
    simd::{Simd, WIDTH},
    terrain::GroundProfile,
};

/// Working memory of one thread: empty at first, then kept.
#[derive(Debug, Default)]
pub struct ScanScratch {
    canvas: ScanCanvas,
    candidates: Candidates,
    spans: Vec<ColumnSpan>,
    sensors: Vec<[SensorPose; 2]>,
    walls: Vec<SpanWall>,
    profile: GroundProfile,
}

/// Input of a scan.
#[derive(Clone, Copy)]
pub(super) struct ScanOrder<'a> {
    pub(super) lidar: &'a LidarModel,
    pub(super) targets: &'a Targets,
    pub(super) row: usize,
    pub(super) tick: u64,
    pub(super) episode_seed: u64,
}

/// The scan of one span.
pub(super) struct SpanScan<'a> {
    pub(super) order: &'a ScanOrder<'a>,
    pub(super) span: ColumnSpan,
    pub(super) sensors: [SensorPose; 2],
    /// First column of the tick within the cycle.
    begin: usize,
    /// Length of a sub-step, seconds.
    dt_s: f64,
}

impl ScanOrder<'_> {
    /// Sub-steps of the scan: 0 if all objects are seen in their pose at the end of the tick.
    fn sub_steps(&self) -> usize {
        if self.lidar.is_rolling {
            self.targets.sub_steps
        } else {
            0
        }
    }

    fn dt_s(&self) -> f64 {
        self.lidar.tick_s / self.targets.sub_steps.max(1) as f64
    }

    fn sensor(&self, span: &ColumnSpan, end: usize) -> SensorPose {
        let pose = match self.sub_steps() {
            0 => self.targets.movers[self.row].end,
            count => {
                let share = span.at[end] * count as f64 - span.sub_step as f64;
                self.targets.pose(self.row, span.sub_step, share, self.dt_s())
            }
        };
        self.lidar.mount.sensor(&pose)
    }

    /// Runs the whole scan and returns the number of points written.
    #[inline(always)]
    pub(super) fn run<S: Simd>(&self, scratch: &mut ScanScratch, scan: &mut Scan, points: &mut [LidarPoint]) -> usize {
        let lidar = self.lidar;
        let (begin, count) = lidar.firing.tick(self.tick);
        lidar.firing.spans(self.tick, self.sub_steps(), &mut scratch.spans);
        let stands = self.sub_steps() == 0 || self.targets.is_still(self.row);
        scratch.sensors.clear();
        for span in &scratch.spans {
            let both = match scratch.sensors.last() {
                Some(before) if stands => *before,
                _ => [self.sensor(span, 0), self.sensor(span, 1)],
            };
            scratch.sensors.push(both);
        }
        *scan = self.header(begin, &scratch.spans);
        let Some(watch) = SensorSweep::new(&scratch.sensors, lidar.steepest) else {
            return 0;
        };
        scratch.candidates.gather(lidar, self.targets, self.row, &watch);
        let rotation = lidar.firing.per_rotation;
        scratch
            .candidates
            .sort(&scratch.spans, (begin % rotation, count), rotation);
        let is_upright = lidar.is_flat_fan && self.targets.is_upright(self.row);
        // Code for hills of its own: as a part of the other, it would cost flat ground a twentieth.
        if is_upright {
            self.spans::<S, true, false>(begin, scratch, points)
        } else if lidar.terrain.is_some() {
            self.spans::<S, false, true>(begin, scratch, points)
        } else {
            self.spans::<S, false, false>(begin, scratch, points)
        }
    }

    fn header(&self, begin: usize, spans: &[ColumnSpan]) -> Scan {
        let lidar = self.lidar;
        let mover = &self.targets.movers[self.row];
        let sensor = lidar.mount.sensor(&mover.end);
        let rotation = lidar.firing.per_rotation;
        let first = spans.first().map_or(0, |span| (begin + span.first) % rotation);
        let azimuth = libm::atan2(lidar.firing.sines[first], lidar.firing.cosines[first]);
        let azimuth = if azimuth < 0.0 {
            azimuth + std::f64::consts::TAU
        } else {
            azimuth
        };
        let columns = spans
            .iter()
            .flat_map(|span| (0..span.count).map(|column| begin + span.first + column));
        let rays = |column: usize| -> u32 {
            let groups = lidar.pattern.column(column % rotation);
            groups.iter().map(|group| group.live.count_ones()).sum()
        };
        let rays = if lidar.pattern.is_table {
            columns.map(rays).sum()
        } else {
            (columns.count() * lidar.pattern.lasers) as u32
        };
        Scan {
            position_m: sensor.position_m,
            attitude_rad: sensor.attitude_rad(),
            id_hash: mover.id_hash,
            azimuth_rad: azimuth as f32,
            range_m: lidar.range_m as f32,
            rays,
            axes: u32::from(lidar.is_paper),
            vehicle: mover.object,
            azimuths: lidar.columns() as u32,
            sensor: OWN_SENSOR,
            reserved: 0,
        }
    }

    #[inline(always)]
    fn spans<S: Simd, const UPRIGHT: bool, const HILLS: bool>(
        &self,
        begin: usize,
        scratch: &mut ScanScratch,
        points: &mut [LidarPoint],
    ) -> usize {
        let lidar = self.lidar;
        let mover = &self.targets.movers[self.row];
        let key = ScanKey::new(self.episode_seed, mover.id_hash, self.tick);
        let ScanScratch {
            canvas,
            candidates,
            spans,
            sensors,
            walls,
            profile,
        } = scratch;
        canvas.make_room(lidar.pattern.per_column);
        canvas.tan.clear();
        canvas.cot.clear();
        if UPRIGHT {
            canvas.tan.extend(lidar.pattern.groups.iter().map(|group| group.tan));
            canvas.cot.extend(lidar.pattern.groups.iter().map(|group| group.cot));
        }
        let mut cursor = 0;
        for (number, span) in spans.iter().enumerate() {
            let work = SpanScan {
                order: self,
                span: *span,
                sensors: sensors[number],
                begin,
                dt_s: self.dt_s(),
            };
            let terrain = if HILLS { lidar.terrain.as_ref() } else { None };
            let terrain = terrain.and_then(|terrain| Some((terrain, terrain.view(&work.sensors)?)));
            work.start::<S, UPRIGHT>(canvas);
            if HILLS && let Some((terrain, view)) = &terrain {
                work.near_relief::<S>(canvas, (terrain, view), profile);
            }
            work.surfaces::<S, UPRIGHT>(canvas, candidates, candidates.of_span(number), walls);
            if HILLS && let Some((terrain, view)) = &terrain {
                work.far_relief::<S>(canvas, (terrain, view), profile);
            }
            if !UPRIGHT && !lidar.meshes.is_empty(terrain.is_none()) {
                work.meshes(canvas, terrain.is_none());
            }
            let first = (span.fired_before * lidar.pattern.per_column) as u32;
            let groups = |column: usize| work.groups(column);
            cursor = lidar
                .receiver
                .write::<S, UPRIGHT>(canvas, groups, work.sun(), (&key, first), points, cursor);
        }
        cursor
    }
}

impl<'a> SpanScan<'a> {
    /// A column of the span in the rotation.
    #[inline(always)]
    pub(super) fn column(&self, column: usize) -> usize {
        (self.begin + self.span.first + column) % self.order.lidar.firing.per_rotation
    }

    #[inline(always)]
    pub(super) fn groups(&self, column: usize) -> &'a [RayGroup] {
        let pattern = &self.order.lidar.pattern;
        if pattern.is_table {
            pattern.column(self.column(column))
        } else {
            &pattern.groups
        }
    }

    #[inline(always)]
    fn surfaces<S: Simd, const UPRIGHT: bool>(
        &self,
        canvas: &mut ScanCanvas,
        candidates: &Candidates,
        entries: &[SpanCandidate],
        walls: &mut Vec<SpanWall>,
    ) {
        let solids = &self.order.lidar.solids;
        for entry in entries {
            let candidate = &candidates.all[entry.candidate as usize];
            if candidate.near_m >= farthest::<S>(canvas) {
                break;
            }
            let body = |object: u32, word: u32, z: [LinearValue; 2]| SurfaceBody {
                object,
                word,
                z,
                near: candidate.near_m,
                chunks: entry.chunks.map(usize::from),
            };
            match candidate.kind {
                CandidateKind::Wall(index, number) => {
                    let still = &solids.stills[number as usize];
                    let body = body(still.object, still.word, self.heights(still.z_m, still.z_m));
                    canvas.wall::<S, UPRIGHT>(&self.still_wall(index), &body);
                }
                CandidateKind::Cap(number) => {
                    let still = &solids.stills[number as usize];
                    walls.clear();
                    walls.extend(still.walls.clone().map(|index| self.still_wall(index)));
                    let body = body(still.object, still.word, self.heights(still.z_m, still.z_m));
                    self.caps::<S, UPRIGHT>(canvas, walls, &body);
                }
                CandidateKind::RoadUser(row) => self.mover::<S, UPRIGHT>(canvas, row as usize, &body, walls),
            }
        }
    }

    #[inline(always)]
    fn heights(&self, first: [f64; 2], last: [f64; 2]) -> [LinearValue; 2] {
        let [z0, z1] = self.sensors.map(|sensor| sensor.position_m[2]);
        [0, 1].map(|i: usize| LinearValue::between(first[i] - z0, last[i] - z1))
    }

    /// Corners at both ends of the span, relative to the sensor.
    #[inline(always)]
    fn seen(&self, first: [f64; 2], last: [f64; 2]) -> ([[f64; 2]; 2], [LinearValue; 2]) {
        let [from, to] = self.sensors.map(|sensor| sensor.position_m);
        let ends = [
            [first[0] - from[0], first[1] - from[1]],
            [last[0] - to[0], last[1] - to[1]],
        ];
        (
            ends,
            [0, 1].map(|axis: usize| LinearValue::between(ends[0][axis], ends[1][axis])),
        )
    }

    #[inline(always)]
    fn still_wall(&self, index: u32) -> SpanWall {
        let wall = &self.order.lidar.solids.walls[index as usize];
        let (ends, p) = self.seen(wall.p_m, wall.p_m);
        let (_, q) = self.seen(wall.q_m, wall.q_m);
        let offset = ends.map(|end| wall.normal[0] * end[0] + wall.normal[1] * end[1]);
        SpanWall {
            p,
            q,
            normal: wall.normal.map(|part| LinearValue(part as f32, 0.0)),
            offset: LinearValue::between(offset[0], offset[1]),
        }
    }

    #[inline(always)]
    fn caps<S: Simd, const UPRIGHT: bool>(&self, canvas: &mut ScanCanvas, walls: &[SpanWall], body: &SurfaceBody) {
        let [low, high] = body.z;
        if high.0 < 0.0 || high.0 + high.1 < 0.0 {
            canvas.cap::<S, UPRIGHT>(walls, high, body);
        }
        if low.0 > 0.0 || low.0 + low.1 > 0.0 {
            canvas.cap::<S, UPRIGHT>(walls, low, body);
        }
    }

    #[inline(always)]
    fn mover<S: Simd, const UPRIGHT: bool>(
        &self,
        canvas: &mut ScanCanvas,
        row: usize,
        body: &impl Fn(u32, u32, [LinearValue; 2]) -> SurfaceBody,
        walls: &mut Vec<SpanWall>,
    ) {
        let (targets, span) = (self.order.targets, &self.span);
        let mover = &targets.movers[row];
        let sub_steps = self.order.sub_steps();
        let poses = [0, 1].map(|end: usize| {
            if sub_steps == 0 {
                return mover.end;
            }
            let share = span.at[end] * sub_steps as f64 - span.sub_step as f64;
            targets.pose(row, span.sub_step, share, self.dt_s)
        });
        let z = poses.map(|pose| [pose.position_m[2], pose.position_m[2] + mover.height_m]);
        let body = body(mover.object, mover.word, self.heights(z[0], z[1]));
        if mover.is_person {
            let [first, last] = poses.map(|pose| [pose.position_m[0], pose.position_m[1]]);
            let (_, centre) = self.seen(first, last);
            canvas.cylinder::<S, UPRIGHT>(centre, mover.half_width_m as f32, &body);
            return;
        }
        let corners = poses.map(|pose| mover.corners_m(&pose));
        let turns = poses.map(|pose| libm::sincos(pose.attitude_rad[2]));
        walls.clear();
        let seen: [_; 4] = std::array::from_fn(|corner| self.seen(corners[0][corner], corners[1][corner]));
        for side in 0..4 {
            // Left, rear, right, front: from a corner to the next one.
            let normals = turns.map(|(sin, cos)| [[-sin, cos], [-cos, -sin], [sin, -cos], [cos, sin]][side]);
            let ((ends, p), (_, q)) = (seen[side], seen[(side + 1) % 4]);
            let offset = [0, 1].map(|end: usize| normals[end][0] * ends[end][0] + normals[end][1] * ends[end][1]);
            let wall = SpanWall {
                p,
                q,
                normal: [0, 1].map(|axis: usize| LinearValue::between(normals[0][axis], normals[1][axis])),
                offset: LinearValue::between(offset[0], offset[1]),
            };
            if offset[0] < 0.0 || offset[1] < 0.0 {
                canvas.wall::<S, UPRIGHT>(&wall, &body);
            }
            walls.push(wall);
        }
        self.caps::<S, UPRIGHT>(canvas, walls, &body);
    }

    /// Rays one by one against meshes, and against the ground if `with_ground`.
    #[inline(never)]
    fn meshes(&self, canvas: &mut ScanCanvas, with_ground: bool) {
        let lidar = self.order.lidar;
        let [from, to] = self.sensors.map(|sensor| sensor.position_m);
        for column in 0..canvas.count {
            let share = column as f64 / (canvas.count - 1).max(1) as f64;
            let origin_m = std::array::from_fn(|axis| from[axis] + share * (to[axis] - from[axis]));
            for group in 0..canvas.groups {
                let (place, live) = (column * canvas.groups + group, self.groups(column)[group].live);
                for element in (0..WIDTH).filter(|element| live >> element & 1 == 1) {
                    let direction = [0, 1, 2].map(|axis: usize| f64::from(canvas.direction[axis][place].0[element]));
                    let range_m = f64::from(canvas.t[place].0[element]);
                    if let Some(hit) = lidar.meshes.cast(origin_m, direction, range_m, with_ground) {
                        canvas.t[place].0[element] = hit.range_m as f32;
                        canvas.incidence[place].0[element] = hit.incidence_cos as f32;
                        canvas.object[place].0[element] = hit.object;
                        canvas.word[place].0[element] = hit.word;
                    }
                }
            }
        }
    }
}

/// Largest distance that any ray of the span still reaches.
#[inline(always)]
fn farthest<S: Simd>(canvas: &ScanCanvas) -> f32 {
    let chunks = canvas.count.div_ceil(WIDTH);
    let far = canvas.columns[..chunks]
        .iter()
        .fold(S::splat(0.0), |far, chunk| S::max(far, S::load(&chunk.far)));
    S::largest(far)
}

const _: () = assert!(SPAN.is_multiple_of(WIDTH));
