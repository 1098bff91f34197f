"""How fast this machine runs the package: stage by stage against its memory, and beside other programs."""
