"""Recordings of runs as data: lazy arrays over memory maps, episodes, vehicles, a torch data set, and exports.

`open_recording("runs/town-1")` opens what `caraware train --record` has written; `docs/recording.md` shows more.
"""

from caraware.data.dataset import TickDataset
from caraware.data.recording import Episode, Recording, RecordingError, VehicleTrack, open_recording

__all__ = ["Episode", "Recording", "RecordingError", "TickDataset", "VehicleTrack", "open_recording"]
