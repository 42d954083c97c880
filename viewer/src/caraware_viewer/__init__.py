"""zenoh → rerun: watch a run from anywhere. It needs the documented wire layout and no other part of the project."""
