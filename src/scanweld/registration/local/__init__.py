"""The local methods' residuals, compiled: one kernel that fills rows, one that adds them up."""
