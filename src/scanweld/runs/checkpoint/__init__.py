"""The state of a run on disk, so that what interrupts it costs a minute and not the run (docs/checkpoints.md)."""
