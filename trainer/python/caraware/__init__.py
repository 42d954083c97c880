"""The trainer: learns where every vehicle is from its sensors, over shared memory, with PPO."""

__version__ = "0.1.0"
