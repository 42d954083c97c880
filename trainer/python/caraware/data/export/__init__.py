"""Recordings in the formats of other tools: `caraware export FILE --to FORMAT`, one part for each episode."""
