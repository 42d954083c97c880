//! SUMO as a value. A [`Sumo`] is a running simulation: starting returns one, closing or reloading consumes it. A process has at
//! most one, because libsumo keeps its simulation in global variables.

pub mod connected;
pub mod convention;
pub mod engine;
pub mod error;
pub mod frame;
pub mod inputs;
pub mod interpolation;
pub mod lanes;
pub mod libsumo;
pub mod options;

use std::{
    path::Path,
    pin::Pin,
    sync::atomic::{AtomicBool, Ordering},
    time::Instant,
};

use cxx::UniquePtr;

use engine::{Engine, LISTENS_WITHIN, RunningServer, ServerProcess};
use error::SumoError;
use frame::{RoadUserRegister, TrafficFrame, signal_meta};
use inputs::InputFiles;
use lanes::LaneGraph;
use libsumo::ffi;
use options::SumoOptions;
use serde::{Deserialize, Serialize};

/// True while a [`Sumo`] holds libsumo's global simulation.
static TAKEN: AtomicBool = AtomicBool::new(false);

/// The text of libsumo's exception when the reason went to standard error.
const SAYS_NOTHING: &str = "Process Error";

/// Difference of two steps that are the same, seconds.
const TIME_TOLERANCE_S: f64 = 1e-6;
/// The box of a run's net is larger than the net by this on each side, metres.
const NET_MARGIN_M: f64 = 20.0;
/// Difference of the corners of two nets that are the same, metres.
const NET_TOLERANCE_M: f64 = 0.5;

/// Holds libsumo for one [`Sumo`].
#[derive(Debug)]
struct LibsumoClaim;

impl LibsumoClaim {
    fn take() -> Result<Self, SumoError> {
        if TAKEN.swap(true, Ordering::AcqRel) {
            Err(SumoError::AlreadyRunning)
        } else {
            Ok(Self)
        }
    }
}

impl Drop for LibsumoClaim {
    fn drop(&mut self) {
        TAKEN.store(false, Ordering::Release);
    }
}

/// Processor time by purpose since SUMO was started, seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct SumoCost {
    /// SUMO's own steps.
    pub step_s: f64,
    /// Reading events and states of all road users.
    pub getters_s: f64,
    /// Reading traffic lights.
    pub signals_s: f64,
}

impl SumoCost {
    /// The sum of both.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            step_s: self.step_s + other.step_s,
            getters_s: self.getters_s + other.getters_s,
            signals_s: self.signals_s + other.signals_s,
        }
    }
}

/// A running simulation. Not `Send`: libsumo stays on the thread that started it.
pub struct Sumo {
    simulation: UniquePtr<ffi::Simulation>,
    register: RoadUserRegister,
    files: InputFiles,
    step_s: f64,
    begin_s: f64,
    end_s: f64,
    steps: u64,
    /// The world frame's (0, 0) in the net's coordinates, metres.
    world_origin_m: [f64; 2],
    /// SUMO's own process, if it has one: dropped after `simulation`, whose destructor closes the connection.
    server: Option<ServerProcess>,
    // Last: dropped after `simulation`, whose destructor still uses libsumo.
    claim: LibsumoClaim,
}

impl std::fmt::Debug for Sumo {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Sumo")
            .field("files", &self.files)
            .field("steps", &self.steps)
            .finish_non_exhaustive()
    }
}

impl Sumo {
    /// Starts SUMO. Sets `SUMO_HOME`, `PROJ_DATA` and `PROJ_LIB` of this process: no other thread may be reading the environment.
    ///
    /// # Errors
    /// SUMO is already running in this process, or it refuses its input.
    pub fn start(options: SumoOptions) -> Result<Self, SumoError> {
        let claim = LibsumoClaim::take()?;
        set_environment(&options.sumo_home);
        let simulation = match &options.engine {
            Engine::InProcess => ffi::new_simulation(),
            Engine::Traci(_) | Engine::Attached(_) => ffi::new_remote_simulation(),
        };
        Self::begin(simulation, claim, options)
    }

    /// Ends this simulation and starts another in its place: a new episode, where dense indices begin at 0 again.
    ///
    /// # Errors
    /// SUMO refuses its input; SUMO is not running afterwards.
    pub fn reload(mut self, options: SumoOptions) -> Result<Self, SumoError> {
        if let Engine::Attached(running) = &options.engine {
            return Err(SumoError::Unattachable {
                address: running.to_string(),
                reason: "it cannot begin again".to_owned(),
            });
        }
        called("end the simulation", self.simulation.pin_mut().close())?;
        drop(self.server.take());
        Self::begin(self.simulation, self.claim, options)
    }

    /// Ends the simulation and completes its output files. Dropping the value does the same but reports no error.
    ///
    /// # Errors
    /// SUMO cannot finish its outputs.
    pub fn close(mut self) -> Result<(), SumoError> {
        called("end the simulation", self.simulation.pin_mut().close())?;
        drop(self.server.take());
        Ok(())
    }

    fn begin(
        mut simulation: UniquePtr<ffi::Simulation>,
        claim: LibsumoClaim,
        options: SumoOptions,
    ) -> Result<Self, SumoError> {
        simulation.pin_mut().take_messages();
        let server = connect(&mut simulation, &options).map_err(|failure| match failure {
            StartFailure::Refused(reason) => SumoError::Refused {
                place: options.files.place_of(&reason),
                reason,
            },
            StartFailure::NoServer(error) => error,
        })?;
        let step_s = called("report its step", simulation.step_length())?;
        let begin_s = called("report the time", simulation.time())?;
        let end_s = called("report its end", simulation.end_time())?;
        let register = RoadUserRegister::new(options.rule, options.world_origin_m);
        Ok(Self {
            simulation,
            register,
            files: options.files,
            step_s,
            begin_s,
            end_s,
            steps: 0,
            world_origin_m: options.world_origin_m,
            server,
            claim,
        })
    }

    /// Runs one step and replaces the content of `frame`, whose buffers are reused.
    ///
    /// # Errors
    /// SUMO fails, for instance at an input file that it reads while it runs.
    pub fn step(&mut self, frame: &mut TrafficFrame) -> Result<(), SumoError> {
        if let Err(error) = self.simulation.pin_mut().step() {
            let reason = reason(&error, &self.simulation.pin_mut().take_messages());
            let time_s = self.simulation.time().unwrap_or(self.begin_s);
            return Err(SumoError::Step {
                time_s,
                place: self.files.place_of(&reason),
                reason,
            });
        }
        self.steps += 1;
        frame.step = self.steps;
        frame.time_s = self.time_s()?;
        self.register
            .fill(frame, self.simulation.states(), self.simulation.events(), self.step_s);
        frame.signals.clear();
        frame.signals.extend(self.simulation.signals().iter().map(signal_meta));
        Ok(())
    }

    /// From now on frames say where vehicles are on their lanes. Returns the lanes.
    ///
    /// # Errors
    /// SUMO is no longer loaded.
    pub fn read_lanes(&mut self) -> Result<LaneGraph, SumoError> {
        let mut lanes = called("list its lanes", self.simulation.pin_mut().net_lanes())?;
        for lane in &mut lanes {
            for point in lane.shape.as_chunks_mut::<3>().0 {
                [point[0], point[1]] = convention::world_from_net([point[0], point[1]], self.world_origin_m);
            }
        }
        self.register.reads_lanes = true;
        Ok(LaneGraph::new(lanes))
    }

    /// Multiplies the speed limits of all lanes; 1 changes nothing.
    ///
    /// # Errors
    /// SUMO refuses.
    pub fn scale_speed_limits(&mut self, factor: f64) -> Result<(), SumoError> {
        #[expect(clippy::float_cmp, reason = "what the user wrote")]
        if factor == 1.0 {
            return Ok(());
        }
        called("scale speed limits", self.simulation_mut().scale_speed_limits(factor))
    }

    /// From now on frames say where road users are in SUMO's terms ([`TrafficFrame::positions`]). Call [`Sumo::read_lanes`] before, whose
    /// indices they use.
    pub fn read_positions(&mut self) {
        self.simulation.pin_mut().read_positions();
        self.register.reads_positions = true;
    }

    /// SUMO's time at the start of the episode, seconds.
    #[must_use]
    pub fn begin_s(&self) -> f64 {
        self.begin_s
    }

    /// Simulated time since the start of the episode, seconds.
    ///
    /// # Errors
    /// SUMO is no longer loaded.
    pub fn time_s(&self) -> Result<f64, SumoError> {
        Ok(called("report the time", self.simulation.time())? - self.begin_s)
    }

    /// The world frame's (0, 0) in the net's coordinates, metres.
    #[must_use]
    pub fn world_origin_m(&self) -> [f64; 2] {
        self.world_origin_m
    }

    /// Contacts that SUMO has reported since the start of the episode.
    #[must_use]
    pub fn contacts(&self) -> u64 {
        self.simulation.contacts()
    }

    /// Times that a person has boarded a vehicle since the start of the episode.
    #[must_use]
    pub fn rides(&self) -> u64 {
        self.simulation.rides()
    }

    /// Times that a container has been loaded onto a vehicle since the start of the episode.
    #[must_use]
    pub fn container_loads(&self) -> u64 {
        self.simulation.loads()
    }

    /// Length of a step, seconds.
    #[must_use]
    pub fn step_s(&self) -> f64 {
        self.step_s
    }

    /// Length of the episode by the scenario's own `end`, seconds; `None` if it names none.
    #[must_use]
    pub fn duration_s(&self) -> Option<f64> {
        (self.end_s >= 0.0).then_some(self.end_s - self.begin_s)
    }

    /// True once `sumo` would end by itself: at the scenario's end or, if it names none, when no road user is left or expected.
    ///
    /// # Errors
    /// SUMO is no longer loaded.
    pub fn finished(&self) -> Result<bool, SumoError> {
        match self.duration_s() {
            Some(duration_s) => Ok(self.time_s()? >= duration_s),
            None => Ok(self.min_expected()? == 0),
        }
    }

    /// Road users on the road or known to come; 0 means that the scenario is over.
    ///
    /// # Errors
    /// SUMO is no longer loaded.
    pub fn min_expected(&self) -> Result<u32, SumoError> {
        let expected = called("count road users", self.simulation.min_expected())?;
        Ok(u32::try_from(expected).unwrap_or(0))
    }

    /// Processor time spent so far, over all reloads.
    #[must_use]
    pub fn cost(&self) -> SumoCost {
        SumoCost {
            step_s: self.simulation.seconds_in_step(),
            getters_s: self.simulation.seconds_in_getters(),
            signals_s: self.simulation.seconds_in_signals(),
        }
    }

    /// The files this simulation was started from.
    #[must_use]
    pub fn files(&self) -> &InputFiles {
        &self.files
    }

    pub(crate) fn simulation(&self) -> &ffi::Simulation {
        &self.simulation
    }

    pub(crate) fn simulation_mut(&mut self) -> Pin<&mut ffi::Simulation> {
        self.simulation.pin_mut()
    }
}

/// Why a simulation does not start.
enum StartFailure {
    /// SUMO refuses its input: its reason.
    Refused(String),
    /// SUMO's own process does not start.
    NoServer(SumoError),
}

/// Loads SUMO, or starts its process and connects to it.
fn connect(
    simulation: &mut UniquePtr<ffi::Simulation>,
    options: &SumoOptions,
) -> Result<Option<ServerProcess>, StartFailure> {
    let server = match &options.engine {
        Engine::InProcess => {
            return match simulation.pin_mut().start(&options.arguments, "", 0, 0) {
                Ok(()) => Ok(None),
                Err(error) => {
                    let messages = simulation.pin_mut().take_messages();
                    Err(StartFailure::Refused(reason(&error, &messages)))
                }
            };
        }
        Engine::Attached(running) => {
            return attach(simulation, running, options).map(|()| None).map_err(|reason| {
                StartFailure::NoServer(SumoError::Unattachable {
                    address: running.to_string(),
                    reason,
                })
            });
        }
        Engine::Traci(server) => server,
    };
    let order = u32::from(server.clients > 1);
    let mut process =
        ServerProcess::start(server, &options.arguments, &options.sumo_home).map_err(StartFailure::NoServer)?;
    // SUMO listens once it has read its files.
    while let Err(error) = simulation.pin_mut().start(&[], "localhost", server.port, order) {
        if !process.is_alive() {
            return Err(StartFailure::Refused(reason(&error, &process.messages())));
        }
        ServerProcess::wait_a_moment();
    }
    Ok(Some(process))
}

/// Connects to a SUMO that runs already, and checks that it is the simulation that the run was prepared for.
fn attach(
    simulation: &mut UniquePtr<ffi::Simulation>,
    running: &RunningServer,
    options: &SumoOptions,
) -> Result<(), String> {
    let since = Instant::now();
    while let Err(error) = simulation
        .pin_mut()
        .start(&[], &running.host, running.port, running.order)
    {
        if since.elapsed() > LISTENS_WITHIN {
            return Err(reason(&error, ""));
        }
        ServerProcess::wait_a_moment();
    }
    let failed = |error: cxx::Exception| reason(&error, "");
    let step_s = simulation.step_length().map_err(failed)?;
    if (step_s - options.step_s).abs() > TIME_TOLERANCE_S {
        return Err(format!(
            "its step is {step_s} s, and that of the run {} s",
            options.step_s
        ));
    }
    let corners = simulation.net_boundary().map_err(failed)?;
    let [x_min, y_min, x_max, y_max] = options.net_bounds_m;
    let expected = [
        [x_min + NET_MARGIN_M, y_min + NET_MARGIN_M],
        [x_max - NET_MARGIN_M, y_max - NET_MARGIN_M],
    ];
    let is_same = corners
        .as_chunks::<2>()
        .0
        .iter()
        .zip(expected)
        .all(|(corner, expected)| {
            let [x, y] = convention::world_from_net(*corner, options.world_origin_m);
            (x - expected[0]).abs() < NET_TOLERANCE_M && (y - expected[1]).abs() < NET_TOLERANCE_M
        });
    match is_same {
        true => Ok(()),
        false => Err(format!(
            "its net has the corners {corners:?}, and is not that of the run's .sumocfg"
        )),
    }
}

/// Processor time of this thread, seconds.
#[must_use]
pub fn processor_time_s() -> f64 {
    ffi::processor_seconds()
}

/// Paths that SUMO has taken in this process through our functions, which keep nothing of them: SUMO's own keep each for ever.
#[must_use]
pub fn paths_passed() -> u64 {
    ffi::paths_passed_to_sumo()
}

/// Turns the failure of a call into an error that names what SUMO was asked to do.
pub(crate) fn called<T>(action: &'static str, result: Result<T, cxx::Exception>) -> Result<T, SumoError> {
    result.map_err(|error| SumoError::Call {
        action,
        reason: error.what().trim().to_owned(),
    })
}

fn set_environment(sumo_home: &Path) {
    ffi::set_environment("SUMO_HOME", &sumo_home.to_string_lossy());
    // PROJ before 9.1 reads the second name; the wheel sets both.
    for name in ["PROJ_DATA", "PROJ_LIB"] {
        ffi::set_environment(name, &sumo_home.join("data/proj").to_string_lossy());
    }
}

/// SUMO's reason on one line: the exception, and the errors (not the warnings) that it wrote before.
fn reason(error: &cxx::Exception, messages: &str) -> String {
    let errors = errors_in(messages);
    let what = error.what().trim();
    let parts: &[&str] = match (what, errors.as_str()) {
        (SAYS_NOTHING, "") => &["no reason given, see the log"],
        (SAYS_NOTHING, errors) => &[errors],
        (what, "") => &[what],
        (what, errors) => &[what, errors],
    };
    parts.join(" ").split_whitespace().collect::<Vec<_>>().join(" ")
}

fn errors_in(messages: &str) -> String {
    let mut is_error = false;
    let mut errors = String::new();
    for line in messages.lines() {
        if line.starts_with("Warning:") {
            is_error = false;
        }
        if let Some(error) = line.strip_prefix("Error:") {
            is_error = true;
            errors.push_str(error);
        } else if is_error {
            errors.push_str(line);
        }
        errors.push(' ');
    }
    errors.trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::errors_in;

    #[test]
    fn errors_are_separated_from_warnings() {
        let messages = "Warning: w1\n more of w1\nError: e1\n more of e1\nWarning: w2\nError: e2\n";
        let words: Vec<_> = errors_in(messages).split_whitespace().map(str::to_owned).collect();
        assert_eq!(words.join(" "), "e1 more of e1 e2");
    }
}
