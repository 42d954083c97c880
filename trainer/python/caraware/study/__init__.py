"""Studies over recorded ticks: every learner and every filter sees the same bytes (docs/reproduce.md)."""
