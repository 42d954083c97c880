"""zenoh → rerun: watch a run from anywhere. Needs the documented wire layout and nothing else of the project."""
