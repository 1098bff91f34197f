"""A run: read a sequence, build the map, evaluate, write a folder that is complete or absent."""
