"""The trainer's end of the shared memory: observations in, predictions out, ticks acknowledged."""
