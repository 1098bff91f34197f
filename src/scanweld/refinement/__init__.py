"""Direct bundle adjustment of keyframes after a run, and self-calibration of the camera (docs/refinement.md)."""
