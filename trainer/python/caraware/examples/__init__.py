"""Trainers to start from: run one by `trainer.module`."""
