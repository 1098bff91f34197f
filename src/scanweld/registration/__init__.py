"""Alignment of point sets: closed form, nearest-neighbour ICP, and the parts that they share with the tracker.

- closed_form: pairs known; Horn, Kabsch, Umeyama, any dimension
- icp: pairs unknown; nearest neighbours, point-to-point or point-to-plane, 2-D and 3-D
    - icp_problem: what a run works on; settings, centred clouds, pairs
    - correspondences: who is paired with whom
    - residuals: how far a pair is apart, and how that changes with the motion
    - robust: how much a pair counts
    - gauss_newton: the step, and the directions that the data leaves free
    - plausibility: whether the answer is better than chance
- projective, verification: points against a depth image, for the tracker
- explain, pictures: every step as numbers and text, and drawn
- result: the one result type
"""
