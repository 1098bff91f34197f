"""The parts of registration without an initial guess.

- viewpoint: where a scan was seen from, told by how its points are spread
- scan: a cloud thinned, with oriented normals and features
- hypotheses: motions that many feature matches agree on, one after the other
- agreement: how well the surfaces agree at a motion, and whether they stand in each other's free space
"""
