//! `caraware generate`: writes a scenario of any size in which every vehicle stays on the road until the end. Plain SUMO runs it too.
//!
//! The net is the grid of netgenerate with signals at every junction and a position on the globe. The same arguments give the same bytes.

mod demand;
mod streets;

use std::{
    io::Write as _,
    path::{Path, PathBuf},
    process::Command,
};

use crate::{cli::GenerateArgs, failure::Exit, install::Install};
use demand::TripDemand;
use streets::GridStreets;

/// Vehicles on a kilometre of lane if the user does not set the size of the grid.
const VEHICLES_PER_KM: f64 = 10.0;
/// Latitude and longitude of the city's centre, degrees.
const ORIGIN_DEG: [f64; 2] = [52.26, 10.52];
/// WGS 84: semi-major axis (metres), squared eccentricity.
const WGS84: [f64; 2] = [6_378_137.0, 0.006_694_379_990_14];

/// The parameters of a generated scenario.
#[derive(Debug, Clone, PartialEq)]
pub struct GeneratedCity {
    /// Vehicles on the road from the first step to the last.
    pub vehicles: u32,
    /// Simulated time, seconds.
    pub duration_s: f64,
    /// SUMO's step, seconds.
    pub step_s: f64,
    /// Seed of routes and of SUMO.
    pub seed: u64,
    /// Junctions along each side of the grid.
    pub junctions: u32,
    /// Distance from junction to junction, metres.
    pub block_m: f64,
    /// Lanes in each direction.
    pub lanes: u32,
    /// Speed limit, km/h.
    pub speed_kmh: f64,
}

impl GeneratedCity {
    /// A city that has room for its vehicles: ten on a kilometre of lane, blocks of 200 m, one lane in each direction, 50 km/h.
    #[must_use]
    pub fn of(vehicles: u32, duration_s: f64, step_s: f64, seed: u64) -> Self {
        let city = Self {
            vehicles,
            duration_s,
            step_s,
            seed,
            junctions: 2,
            block_m: 200.0,
            lanes: 1,
            speed_kmh: 50.0,
        };
        city.with_room()
    }

    /// Country roads with as many vehicles on a kilometre of lane: 2 km from junction to junction, 100 km/h. SUMO spends most time on
    /// junctions, so a step takes about half as long as in a city.
    #[must_use]
    pub fn country(vehicles: u32, duration_s: f64, step_s: f64, seed: u64) -> Self {
        let country = Self {
            block_m: 2000.0,
            speed_kmh: 100.0,
            ..Self::of(vehicles, duration_s, step_s, seed)
        };
        country.with_room()
    }

    /// Sets the number of junctions that [`VEHICLES_PER_KM`] requires: n on each side make 4·n·(n − 1) streets.
    #[must_use]
    fn with_room(self) -> Self {
        let street = VEHICLES_PER_KM * 1e-3 * self.block_m * f64::from(self.lanes);
        let enough = |n: &u32| f64::from(4 * n) * f64::from(n - 1) * street >= f64::from(self.vehicles);
        let junctions = (2..1 << 14).find(enough).unwrap_or(1 << 14);
        Self { junctions, ..self }
    }

    /// Speed limit, m/s.
    fn speed_mps(&self) -> f64 {
        self.speed_kmh / 3.6
    }

    /// Writes `city.net.xml`, `city.rou.xml` and `city.sumocfg` to `directory`; returns the path of the last.
    ///
    /// # Errors
    /// The vehicles do not fit, the directory is not writable, or netgenerate fails.
    pub fn write(&self, install: &Install, directory: &Path) -> Result<PathBuf, Exit> {
        self.check()?;
        std::fs::create_dir_all(directory).map_err(|error| Exit::io("create", directory, &error))?;
        let write = |name: &str, text: &str| {
            let path = directory.join(name);
            std::fs::write(&path, text).map_err(|error| Exit::io("write", &path, &error))?;
            Ok::<_, Exit>(path)
        };
        let net = self.net(install, directory)?;
        let streets = GridStreets::of(&net).map_err(|reason| Exit::run(format!("netgenerate's net: {reason}"), ""))?;
        let routes = TripDemand::new(self, &streets)?.text();
        write("city.net.xml", &net)?;
        write("city.rou.xml", &routes)?;
        write("city.sumocfg", &self.configuration())
    }

    fn check(&self) -> Result<(), Exit> {
        let positive = |name: &str, value: f64| {
            if value > 0.0 && value.is_finite() {
                return Ok(());
            }
            Err(Exit::config(format!("--{name} is {value}"), "give a number above 0"))
        };
        positive("duration-s", self.duration_s)?;
        positive("step-s", self.step_s)?;
        positive("vehicles", self.vehicles.into())?;
        positive("lanes", self.lanes.into())?;
        positive("speed-kmh", self.speed_kmh)?;
        // In shorter blocks the junctions leave no room for streets.
        if self.junctions < 2 || self.block_m < 50.0 {
            return Err(Exit::config(
                format!(
                    "a grid of {} junctions a side, {} m apart",
                    self.junctions, self.block_m
                ),
                "give --junctions 2 or more and --block-m 50 or more",
            ));
        }
        Ok(())
    }

    /// Runs netgenerate, and returns its grid without the comment that holds the time, placed on the globe.
    fn net(&self, install: &Install, directory: &Path) -> Result<String, Exit> {
        let file = directory.join("city.net.xml");
        let program = install.sumo_program("netgenerate");
        let output = Command::new(&program)
            .args(["--grid", "--default-junction-type", "traffic_light", "--no-turnarounds"])
            .args(["--grid.number", &self.junctions.to_string()])
            .args(["--grid.length", &self.block_m.to_string()])
            .args(["--default.lanenumber", &self.lanes.to_string()])
            .args(["--default.speed", &format!("{:.2}", self.speed_mps())])
            .arg("--output-file")
            .arg(&file)
            .env("SUMO_HOME", &install.sumo_home)
            .output()
            .map_err(|error| Exit::io("start", &program, &error))?;
        if !output.status.success() {
            let reason = String::from_utf8_lossy(&output.stderr);
            return Err(Exit::run(
                format!("netgenerate could not build the grid: {}", reason.trim()),
                "`caraware doctor` checks the SUMO installation",
            ));
        }
        let text = std::fs::read_to_string(&file).map_err(|error| Exit::io("read", &file, &error))?;
        self.placed(&text)
            .ok_or_else(|| Exit::run("netgenerate's net has no <location>", ""))
    }

    /// The net without its comment, and with the `<location>` of the city.
    fn placed(&self, net: &str) -> Option<String> {
        let (head, rest) = net.split_once("<!--")?;
        let (_, rest) = rest.split_once("-->")?;
        let (before, rest) = rest.split_once("<location ")?;
        let (_, after) = rest.split_once("/>")?;
        Some(format!(
            "{}\n{}{}{after}",
            head.trim_end(),
            before.trim_start(),
            self.location()
        ))
    }

    /// The `<location>` of the city: a transverse Mercator projection around its centre.
    fn location(&self) -> String {
        let side_m = f64::from(self.junctions - 1) * self.block_m;
        let half_m = 0.5 * side_m;
        let [latitude, longitude] = ORIGIN_DEG;
        let [axis_m, eccentricity] = WGS84;
        let curved = 1.0 - eccentricity * latitude.to_radians().sin().powi(2);
        let meridian_m = axis_m * (1.0 - eccentricity) / curved.powf(1.5);
        let parallel_m = axis_m / curved.sqrt() * latitude.to_radians().cos();
        let (up, right) = ((half_m / meridian_m).to_degrees(), (half_m / parallel_m).to_degrees());
        format!(
            "<location netOffset=\"{half_m:.2},{half_m:.2}\" convBoundary=\"0.00,0.00,{side_m:.2},{side_m:.2}\" \
             origBoundary=\"{:.6},{:.6},{:.6},{:.6}\" projParameter=\"+proj=tmerc +lat_0={latitude} +lon_0={longitude} +k=1 +x_0=0 +y_0=0 \
             +ellps=WGS84 +units=m +no_defs\"/>",
            longitude - right,
            latitude - up,
            longitude + right,
            latitude + up,
        )
    }

    fn configuration(&self) -> String {
        let Self {
            duration_s,
            step_s,
            seed,
            ..
        } = self;
        // SUMO's seed is a positive `int`.
        let seed = seed & 0x7fff_ffff;
        format!(
            "<configuration>\n\
             \x20   <input>\n\
             \x20       <net-file value=\"city.net.xml\"/>\n\
             \x20       <route-files value=\"city.rou.xml\"/>\n\
             \x20   </input>\n\
             \x20   <output>\n\
             \x20       <summary-output value=\"summary.xml\"/>\n\
             \x20       <tripinfo-output value=\"tripinfo.xml\"/>\n\
             \x20       <tripinfo-output.write-unfinished value=\"true\"/>\n\
             \x20   </output>\n\
             \x20   <time>\n\
             \x20       <begin value=\"0\"/>\n\
             \x20       <end value=\"{duration_s}\"/>\n\
             \x20       <step-length value=\"{step_s}\"/>\n\
             \x20   </time>\n\
             \x20   <random_number>\n\
             \x20       <seed value=\"{seed}\"/>\n\
             \x20   </random_number>\n\
             \x20   <report>\n\
             \x20       <no-step-log value=\"true\"/>\n\
             \x20   </report>\n\
             </configuration>\n"
        )
    }
}

/// Generates the scenario and prints the command that runs it.
///
/// # Errors
/// As [`GeneratedCity::write`].
pub fn generate(args: &GenerateArgs) -> Result<(), Exit> {
    let roomy = GeneratedCity {
        block_m: args.block_m,
        lanes: args.lanes,
        speed_kmh: args.speed_kmh,
        ..GeneratedCity::of(args.vehicles, args.duration_s, args.step_s, args.seed)
    }
    .with_room();
    let city = GeneratedCity {
        junctions: args.junctions.unwrap_or(roomy.junctions),
        ..roomy
    };
    let sumocfg = city.write(&Install::find()?, &args.directory)?;
    let (path, junctions) = (sumocfg.display(), city.junctions * city.junctions);
    let GeneratedCity {
        vehicles, duration_s, ..
    } = city;
    // A closed standard output (`| head`) is ignored: the files are written.
    let _ = writeln!(
        std::io::stdout(),
        "{path}: {vehicles} vehicles for {duration_s} s on {junctions} junctions with signals\n\
         caraware simulate {path} --set traffic.max_road_users={vehicles}",
    );
    Ok(())
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;
    use crate::scenario;

    fn small(seed: u64) -> GeneratedCity {
        GeneratedCity {
            junctions: 3,
            ..GeneratedCity::of(40, 30.0, 0.5, seed)
        }
    }

    fn files(city: &GeneratedCity) -> (tempfile::TempDir, [String; 3]) {
        let directory = tempfile::tempdir().unwrap();
        city.write(&Install::find().unwrap(), directory.path()).unwrap();
        let read = |name| std::fs::read_to_string(directory.path().join(name)).unwrap();
        let texts = ["city.net.xml", "city.rou.xml", "city.sumocfg"].map(read);
        (directory, texts)
    }

    #[test]
    fn the_same_seed_gives_the_same_bytes_and_another_seed_other_routes() {
        let (one, again, other) = (files(&small(1)).1, files(&small(1)).1, files(&small(2)).1);
        assert_eq!(one, again);
        assert_eq!(one[0], other[0]);
        assert_ne!(one[1], other[1]);
    }

    #[test]
    fn the_city_lies_on_the_globe() {
        let (directory, _) = files(&small(1));
        let map = scenario::map_info(&directory.path().join("city.net.xml"), None).unwrap();
        assert!(map.projection.starts_with("+proj=tmerc +lat_0=52.26"), "{map:?}");
        assert_eq!(map.net_offset_m, [200.0, 200.0]);
        assert_eq!(map.bounds_m, [-20.0, -20.0, 420.0, 420.0]);
    }

    #[test]
    fn room_grows_with_the_vehicles_and_shrinks_with_longer_blocks_and_more_lanes() {
        let junctions = |vehicles| GeneratedCity::of(vehicles, 30.0, 0.5, 1).junctions;
        assert_eq!([1, 16, 17, 5000, 50_000].map(junctions), [2, 2, 3, 26, 80]);
        assert_eq!(GeneratedCity::country(20_000, 30.0, 1.0, 1).junctions, 17);
        let wide = GeneratedCity {
            lanes: 3,
            ..GeneratedCity::country(20_000, 30.0, 1.0, 1)
        };
        assert_eq!(wide.with_room().junctions, 10);
    }

    #[test]
    fn more_vehicles_than_fit_are_refused() {
        let city = GeneratedCity {
            vehicles: 4000,
            ..small(1)
        };
        let directory = tempfile::tempdir().unwrap();
        let refused = city.write(&Install::find().unwrap(), directory.path()).unwrap_err();
        let Exit::Failure(failure) = refused else {
            unreachable!("{refused:?}")
        };
        assert!(failure.message.contains("4000 vehicles"), "{failure:?}");
        assert!(failure.help.unwrap().contains("--junctions"));
    }
}
