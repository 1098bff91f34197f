"""Runs to look at: live or finished in a browser (viser), or as a recording (Rerun)."""
