//! The actions of an episode in a file, from which a process that is started again makes the same ticks.
//!
//! One file for each episode: `actions/<environment>/<episode>.bin` in the run's directory, a record for each tick. A record is the tick
//! (u64), the number of agents (u64), and the action of each, all little-endian: of a hero its dense index (u32), steering and acceleration
//! (f32); of a station of the messages task its dense index and its choice (u32). A record cut by a kill is dropped: its tick has not been
//! made.

use std::{
    collections::BTreeMap,
    fs::{File, OpenOptions},
    io::{self, Seek as _, SeekFrom, Write as _},
    path::{Path, PathBuf},
};

use bytemuck::Pod;

use ipc_schema::{
    failure::{Failure, FailureKind},
    run::RunFile,
};

/// Files that are kept: a checkpoint may be some episodes old.
const EPISODES_KEPT: u64 = 16;
const HEAD_BYTES: usize = 16;

/// The log of one environment, of actions `A`.
#[derive(Debug)]
pub struct ActionLog<A> {
    folder: PathBuf,
    file: Option<File>,
    sensed_ahead: u64,
    /// The episode that is logged.
    episode: Option<u64>,
    /// Actions that an earlier process has logged, by the tick that they moved.
    logged: BTreeMap<u64, Vec<A>>,
}

impl<A: Pod> ActionLog<A> {
    /// The log in the run's directory. Sensors may be `sensed_ahead` ticks ahead of actions.
    #[must_use]
    pub fn new(run_dir: &Path, env_index: u32, sensed_ahead: u64) -> Self {
        Self {
            folder: run_dir.join("actions").join(env_index.to_string()),
            file: None,
            sensed_ahead,
            episode: None,
            logged: BTreeMap::new(),
        }
    }

    /// The actions that moved `tick` of an episode before; `None` if it has not been made, so that they have to come from the trainer.
    ///
    /// # Errors
    /// The file cannot be read or written, or the tick has been made and its actions are not there.
    pub fn actions_before(&mut self, run: &RunFile, episode: u64, tick: u64) -> Result<Option<Vec<A>>, Failure> {
        if self.episode != Some(episode) {
            self.episode = Some(episode);
            // A resumed run draws anew what it has not learnt; processes that are started again within a run do not.
            let newest = if run.restart.is_some() {
                u64::MAX
            } else {
                run.committed_ticks()
            };
            self.begin(episode, newest).map_err(|error| {
                Failure::new(FailureKind::Run, format!("cannot log actions: {error}"))
                    .with_help("free space for the run's directory")
            })?;
        }
        if let Some(actions) = self.take(tick) {
            return Ok(Some(actions));
        }
        if run.restart.is_none() && (run.first_tick() + 1..=run.committed_ticks()).contains(&tick) {
            return Err(Failure::new(
                FailureKind::Run,
                format!("the actions that moved tick {tick} are not in the run's directory"),
            )
            .with_help(
                "resume the run by its name; or start another that begins with task.begin_from = \"CHECKPOINT\"",
            ));
        }
        // Ticks that were sensed were made with actions, but for those that were under way.
        if let Some(restart) = run.restart
            && tick > run.first_tick()
            && tick + self.sensed_ahead < restart.sensed_ticks
        {
            return Err(Failure::new(
                FailureKind::Run,
                format!(
                    "the actions that moved tick {tick} are not in the run's directory, which keeps those of the newest episodes"
                ),
            )
            .with_help("let the learner commit more often, or free space for the run's directory"));
        }
        Ok(None)
    }

    /// Begins an episode: reads what an earlier process has logged of it up to the tick `newest`, and continues behind that.
    fn begin(&mut self, episode: u64, newest: u64) -> io::Result<()> {
        self.file = None;
        std::fs::create_dir_all(&self.folder)?;
        if let Some(old) = episode.checked_sub(EPISODES_KEPT) {
            let _ = std::fs::remove_file(self.of_episode(old));
        }
        let path = self.of_episode(episode);
        let bytes = match std::fs::read(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Vec::new(),
            read => read?,
        };
        let (logged, whole) = records(&bytes, newest);
        self.logged = logged;
        let mut file = OpenOptions::new().create(true).truncate(false).write(true).open(path)?;
        file.set_len(whole as u64)?;
        file.seek(SeekFrom::End(0))?;
        self.file = Some(file);
        Ok(())
    }

    /// What an earlier process has logged for `tick`.
    fn take(&mut self, tick: u64) -> Option<Vec<A>> {
        self.logged.remove(&tick)
    }

    /// Logs the actions that move `tick`.
    ///
    /// # Errors
    /// The file cannot be written; then nothing more of this episode is logged.
    pub fn add(&mut self, tick: u64, actions: &[A]) -> io::Result<()> {
        let Some(file) = &mut self.file else { return Ok(()) };
        let mut record = Vec::with_capacity(HEAD_BYTES + size_of_val(actions));
        record.extend_from_slice(&tick.to_le_bytes());
        record.extend_from_slice(&(actions.len() as u64).to_le_bytes());
        record.extend_from_slice(bytemuck::cast_slice(actions));
        let written = file.write_all(&record);
        if written.is_err() {
            self.file = None;
        }
        written
    }

    fn of_episode(&self, episode: u64) -> PathBuf {
        self.folder.join(format!("{episode}.bin"))
    }
}

/// The whole records in `bytes` of ticks up to `newest`, and how many bytes they are.
fn records<A: Pod>(bytes: &[u8], newest: u64) -> (BTreeMap<u64, Vec<A>>, usize) {
    let (mut found, mut at) = (BTreeMap::new(), 0);
    while let Some((tick, rest)) = bytes[at..].split_first_chunk::<8>()
        && let Some((count, rest)) = rest.split_first_chunk::<8>()
        && let Some(len) = usize::try_from(u64::from_le_bytes(*count))
            .ok()
            .and_then(|count| count.checked_mul(size_of::<A>()))
        && let Some(actions) = rest.get(..len)
    {
        if u64::from_le_bytes(*tick) > newest {
            break;
        }
        let actions = actions
            .chunks_exact(size_of::<A>())
            .map(bytemuck::pod_read_unaligned)
            .collect();
        found.insert(u64::from_le_bytes(*tick), actions);
        at += HEAD_BYTES + len;
    }
    (found, at)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driving::action::LoggedAction;

    #[test]
    fn a_log_gives_back_its_whole_records_and_continues_behind_them() {
        let folder = tempfile::tempdir().unwrap();
        let actions = |vehicle| {
            [LoggedAction {
                vehicle,
                action: [0.5, f32::NAN],
            }]
        };
        let mut log: ActionLog<LoggedAction> = ActionLog::new(folder.path(), 2, 2);
        log.begin(7, u64::MAX).unwrap();
        log.add(100, &actions(1)).unwrap();
        log.add(101, &[]).unwrap();
        log.add(102, &actions(3)).unwrap();
        // A kill amid the third record.
        let file = folder.path().join("actions/2/7.bin");
        let bytes = std::fs::read(&file).unwrap();
        std::fs::write(&file, &bytes[..bytes.len() - 1]).unwrap();
        let mut again: ActionLog<LoggedAction> = ActionLog::new(folder.path(), 2, 2);
        again.begin(7, u64::MAX).unwrap();
        assert!(again.take(99).is_none());
        let first = again.take(100).unwrap();
        assert_eq!((first[0].vehicle, first[0].action[0]), (1, 0.5));
        assert!(first[0].action[1].is_nan(), "a refused action is refused again");
        assert_eq!(again.take(101), Some(Vec::new()));
        assert_eq!(again.take(102), None);
        again.add(102, &actions(4)).unwrap();
        again.begin(7, u64::MAX).unwrap();
        assert_eq!(again.take(102).unwrap()[0].vehicle, 4);
        again.begin(7, 101).unwrap();
        assert_eq!((again.take(101), again.take(102)), (Some(Vec::new()), None));
        again.begin(7 + EPISODES_KEPT, u64::MAX).unwrap();
        assert!(!file.exists());
    }
}
