//! What can go wrong with SUMO, and whether the user's files or the program are at fault.

use std::path::PathBuf;

use ipc_schema::failure::{Failure, FailureKind};

/// SUMO cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum SumoError {
    /// libsumo is one simulation for the whole process, and another [`super::Sumo`] holds it.
    #[error("SUMO is already running in this process")]
    AlreadyRunning,
    /// A file that SUMO needs does not exist.
    #[error("{path} does not exist{}", named_in(referenced_by.as_ref()))]
    Missing {
        /// The file.
        path: PathBuf,
        /// The file that names it; `None` for a file that the run names.
        referenced_by: Option<PathBuf>,
    },
    /// A file exists but cannot be read.
    #[error("cannot read {path}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// A file is not XML.
    #[error("{path} is not well-formed XML: {reason}")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// A value in a file is no number.
    #[error("{path}: {what} \"{value}\" is no number")]
    NoNumber {
        /// The file.
        path: PathBuf,
        /// What the value is of.
        what: String,
        /// The value.
        value: String,
    },
    /// SUMO refused its input.
    #[error("SUMO refused {place}: {reason}")]
    Refused {
        /// The file, with the line where it is known.
        place: String,
        /// SUMO's message.
        reason: String,
    },
    /// SUMO failed in a step.
    #[error("SUMO failed at {time_s} s in {place}: {reason}")]
    Step {
        /// Simulated time, seconds.
        time_s: f64,
        /// The file, with the line where it is known.
        place: String,
        /// SUMO's message.
        reason: String,
    },
    /// A call to SUMO between two steps failed.
    #[error("SUMO could not {action}: {reason}")]
    Call {
        /// What SUMO was asked to do.
        action: &'static str,
        /// SUMO's message.
        reason: String,
    },
    /// The net has no connected roads for a class of road users.
    #[error("{net} has too few connected edges for {class}: at least {needed} are needed, {found} found")]
    NoRoads {
        /// The net.
        net: PathBuf,
        /// Vehicle class.
        class: String,
        /// Edges needed.
        needed: usize,
        /// Edges found.
        found: usize,
    },
    /// `traffic.hero_route` is not a route.
    #[error("no hero can drive `traffic.hero_route`: {reason}")]
    HeroRoute {
        /// SUMO's message.
        reason: String,
    },
    /// SUMO's own process cannot be started (`traffic.engine`).
    #[error("cannot start {program}")]
    Server {
        /// The program.
        program: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// There is no SUMO to attach to, or it is another simulation than the run's (`traffic.traci_host`).
    #[error("the run cannot attach to SUMO at {address}: {reason}")]
    Unattachable {
        /// Host and port.
        address: String,
        /// Why.
        reason: String,
    },
    /// The output directory cannot be made.
    #[error("cannot create {path}")]
    Output {
        /// The directory.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
}

fn named_in(referrer: Option<&PathBuf>) -> String {
    referrer.map_or_else(String::new, |file| format!(" (named in {})", file.display()))
}

impl SumoError {
    fn kind(&self) -> FailureKind {
        match self {
            Self::AlreadyRunning | Self::Call { .. } | Self::Output { .. } | Self::Server { .. } => FailureKind::Run,
            Self::Missing { .. }
            | Self::Unreadable { .. }
            | Self::Malformed { .. }
            | Self::NoNumber { .. }
            | Self::Refused { .. }
            | Self::Step { .. }
            | Self::NoRoads { .. }
            | Self::HeroRoute { .. }
            | Self::Unattachable { .. } => FailureKind::Config,
        }
    }

    fn help(&self) -> &'static str {
        match self {
            Self::Missing { .. } => "check the path; paths in a .sumocfg are relative to it",
            Self::Unreadable { .. } => "check the permissions of the file",
            Self::Malformed { .. } | Self::NoNumber { .. } => {
                "repair the file; SUMO's own `sumo` must be able to run it"
            }
            Self::Refused { .. } | Self::Step { .. } => {
                "correct the file; `sumo` on the same input gives the same message, `netedit` shows the net's edges"
            }
            Self::NoRoads { .. } => {
                "use a net whose roads lead everywhere and back (sidewalks and crossings for pedestrians), or ask for none of them"
            }
            Self::HeroRoute { .. } => "name edges that cars may use, each leading to the next (`netedit` shows them)",
            Self::Server { .. } => {
                "set traffic.engine to \"libsumo\" or \"traci\", or install the libraries that sumo-gui needs"
            }
            Self::Unattachable { .. } => {
                "start it first, on the same .sumocfg: `sumo -c FILE --remote-port PORT --num-clients N` (docs/traci.md)"
            }
            Self::Output { .. } => "check free space and permissions of the run directory",
            Self::AlreadyRunning | Self::Call { .. } => {
                "this is a defect of traffic-bridge: please report it with its log"
            }
        }
    }
}

impl From<SumoError> for Failure {
    fn from(error: SumoError) -> Self {
        Self::from_error(error.kind(), &error).with_help(error.help())
    }
}
