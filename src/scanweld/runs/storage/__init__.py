"""Recordings and run folders on disks and behind URLs."""
