"""A run of the trainer: the loop over its environments, settings, checkpoints, curriculum, play."""
